"""FEBio itself beside limbfit: what limbfit writes, FEBio runs to its end, with the same forces.

Blocks of few elements, and limbfit at FEBio's own steps with FEBio's integration in time, so that the two
differ by nothing but contact: FEBio's acts along the skin's normal over the current area, limbfit's along
the indenter's normal over the area at rest. Under a plate that covers the block this hardly matters, and
forces are within 0.5 %; a round indenter touches single points at other times, and they are within 1 to 2 %.

Run with ``python -m pytest -m febio``; FEBio is that of ``FEBIO_CMD``, of the path, or beside the repository.
"""

import re
import shutil
import subprocess
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh

from limbfit import OgdenQLV
from limbfit.bench.timing import build_punched_block
from limbfit.fe import (
    Activation,
    ContractileMaterial,
    FibredMaterial,
    History,
    Indenter,
    Motion,
    NeoHookean,
    Pressure,
    Problem,
    Result,
    RigidBody,
    RigidSurface,
    StepControl,
    isochoric_stretch,
    solve,
)
from limbfit.febio import FebSettings, build_result, read_log, run_febio, write_feb
from limbfit.febio.abaqus import write_inp
from limbfit.febio.optimisation import ParameterRange, turn_to_indenter_frame, write_optimisation
from limbfit.febio.preparation import Preparation
from limbfit.mesh import Mesh
from reference import REFERENCE, recorded

pytestmark = pytest.mark.febio

SKIN, MUSCLE = OgdenQLV(0.009, 6.0, 2.0, 0.5), OgdenQLV(0.004, 4.0, (0.8, 0.3), (0.2, 1.5))
FIVE = OgdenQLV(0.009, 6.0, (0.5, 0.4, 0.3, 0.2, 0.1), (0.05, 0.2, 1.0, 5.0, 20.0))
ASKEW = np.array([1.0, -1.0, 0.5])
FIBRED = FibredMaterial(MUSCLE, 0.012, 2.5)
TAUT = isochoric_stretch(np.array([0.0, 0.0, 1.0]), 0.93)[0]
DOWN = (0.0, 0.0, -1.0)
PLATE = Indenter("square", 90.0, 4.0, (0.0, 0.0, 5.0), DOWN)
BALL = Indenter("sphere", 40.0, 0.0, (0.0, 0.0, 5.0), DOWN)
IN_AND_OUT = History(np.array([0.0, 3.0, 6.0]), np.array([0.0, 5.0, 0.0]))


def block(divisions: int, element: str = "hex8", **changes: object) -> Problem:
    given = {"materials": {"skin": SKIN, "muscle": MUSCLE}, "history": IN_AND_OUT, "indenter": PLATE}
    return replace(build_punched_block(element, divisions), **(given | changes))


def with_tendon(mesh: Mesh) -> Mesh:
    """A quarter of the muscle is another tissue, from the bottom to the skin."""
    x, y, _ = mesh.points[mesh.corners].mean(axis=1).T
    muscle = mesh.regions == mesh.region_names.index("muscle")
    regions = np.where(muscle & (x > 0.0) & (y > 0.0), len(mesh.region_names), mesh.regions)
    return replace(mesh, regions=regions, region_names=(*mesh.region_names, "tendon"))


def run_both(program: Path, folder: Path, problem: Problem) -> tuple[Result, Result]:
    """FEBio's result of a problem, and limbfit's at FEBio's steps, with the contact stiffness of the file."""
    write_feb(problem, folder / "model.feb", FebSettings())
    end = Preparation.from_problem(problem).seconds + float(problem.history.times[-1])
    run = run_febio(program, folder, end, "forces.txt", time_limit_s=300.0)
    assert run.verdict.is_completed, run.verdict.reason
    theirs = build_result(problem, run.log, run.verdict)
    times = tuple(t for t in theirs.times if t > 0.0)
    mine = solve(problem, StepControl(times=times, stress="linear", hold_penalty=True), store="none")
    assert mine.completed, mine.reason
    return theirs, mine


def differ_by(theirs: Result, mine: Result) -> float:
    """Largest difference of two courses of force, as a share of FEBio's largest force."""
    return float(np.abs(mine.force_at(theirs.times) - theirs.force).max() / np.abs(theirs.force).max())


CYCLES = History(np.array([0.0, 2.0, 6.0, 8.0, 10.0, 12.0]), np.array([0.0, 5.0, 5.0, 1.0, 5.0, 0.0]))
TENSED = {
    "materials": {"skin": SKIN, "muscle": ContractileMaterial(FIBRED, 0.005)},
    "fibres": ASKEW,
    "activation": Activation([0.0, 1.0, 6.0], [0.0, 1.0, 0.4]),
}
LAWS: dict[str, dict[str, object]] = {
    "relaxing in a hold and in cycles": {"history": CYCLES},
    "five relaxation times": {"materials": {"skin": FIVE, "muscle": MUSCLE}},
    "elastic": {"materials": {"skin": OgdenQLV(0.009, 6.0, 0.0, 1.0), "muscle": NeoHookean(0.01)}},
    "fibres": {"materials": {"skin": SKIN, "muscle": FIBRED}, "fibres": ASKEW},
    "contraction": TENSED,
    "pre-stretch": {"prestretch": TAUT},
    "all": TENSED | {"prestretch": TAUT},
}


@pytest.mark.parametrize("element", ["tet10", "tet10p0"])
def test_tetrahedra_push_as_hard(febio, tmp_path, element):
    assert differ_by(*run_both(febio, tmp_path, block(4, element))) < 0.01


def test_a_tendon_in_the_muscle_counts_as_much(febio, tmp_path):
    problem, stiff = block(4), OgdenQLV(0.03, 6.0, 2.0, 0.5)
    problem = replace(
        problem, mesh=with_tendon(problem.mesh), materials=dict(problem.materials) | {"tendon": stiff}
    )
    theirs, mine = run_both(febio, tmp_path, problem)
    assert differ_by(theirs, mine) < 0.005
    without, _ = run_both(febio, tmp_path, block(4))
    assert theirs.force.max() > 1.2 * without.force.max()


@pytest.mark.parametrize("case", LAWS)
def test_tissue_under_a_plate_pushes_as_hard(febio, tmp_path, case):
    assert differ_by(*run_both(febio, tmp_path, block(4, **LAWS[case]))) < 0.005


ROUND = trimesh.creation.icosphere(subdivisions=3, radius=20.0)
FACETED = RigidSurface(ROUND.vertices - np.array([0.0, 0.0, 20.0]), ROUND.faces)
INDENTERS = {
    "square": (Indenter("square", 20.0, 2.0, (0.0, 0.0, 5.0), DOWN), 0.01),
    "cylinder": (Indenter("cylinder", 30.0, 6.0, (0.0, 0.0, 5.0), DOWN), 0.02),
    "sphere": (BALL, 0.01),
    "tilted": (replace(BALL, centre=(1.0, 2.0, 5.0), axis=(0.1, -0.05, -1.0)), 0.02),
    "stl": (Indenter("stl", centre=(0.0, 0.0, 5.0), axis=DOWN, surface=FACETED), 0.02),
}


@pytest.mark.parametrize("shape", INDENTERS)
def test_indenters_are_pushed_as_hard(febio, tmp_path, shape):
    indenter, most = INDENTERS[shape]
    assert differ_by(*run_both(febio, tmp_path, block(6, indenter=indenter))) < most


def test_a_force_goes_as_deep(febio, tmp_path):
    pressed = History(np.array([0.0, 3.0, 6.0]), force=np.array([0.0, 5.0, 1.0]))
    theirs, mine = run_both(febio, tmp_path, block(6, indenter=BALL, history=pressed))
    assert differ_by(theirs, mine) < 0.01
    depth = np.interp(theirs.times, mine.times, mine.displacement)
    np.testing.assert_allclose(depth, theirs.displacement, atol=0.01 * theirs.displacement.max())


def test_friction_resists_as_hard_where_it_is_pressed_and_dragged(febio, tmp_path):
    across = np.array([[0.0, 0.0], [0.0, 0.0], [3.0, 0.0]])
    dragged = History(np.array([0.0, 3.0, 6.0]), np.array([0.0, 5.0, 5.0]), across=across)
    problem = block(6, indenter=BALL, history=dragged, friction=0.4, sticking="stepwise")
    assert differ_by(*run_both(febio, tmp_path, problem)) < 0.02


def test_a_pressure_beside_the_indenter_counts_as_much(febio, tmp_path):
    problem = block(6, indenter=BALL)
    rim = problem.mesh.points[problem.contact_faces][:, :, :2]
    faces = problem.contact_faces[np.abs(rim).max(axis=(1, 2)) > 25.0]
    pressed = replace(problem, pressures=(Pressure(faces, [0.0, 3.0, 6.0], [0.0, 0.02, 0.01]),))
    theirs, mine = run_both(febio, tmp_path, pressed)
    assert differ_by(theirs, mine) < 0.02
    assert abs(mine.peak_force - solve(problem, store="none").peak_force) > 0.05 * mine.peak_force


@pytest.mark.parametrize("taut", [False, True], ids=["clamped", "clamped and taut"])
def test_a_clamped_limb_is_touched_later_and_pushes_as_hard(febio, tmp_path, taut):
    """A pin that presses from the first second on; the indenter touches after it, at 2 s."""
    pin = Indenter("sphere", 30.0, centre=(18.0, 0.0, 0.3), axis=(0.2, 0.0, -1.0), edge=(0.0, 1.0, 0.0))
    faces = block(6).contact_faces
    clamp = RigidBody(pin, faces, Motion.of([0.0, 1.0, 5.0], force={"z": [0.0, 0.5, 0.5]}), name="clamp")
    later = History(np.array([0.0, 2.0, 4.0, 5.0]), np.array([0.0, 0.0, 4.0, 1.0]))
    indenter = replace(BALL, centre=(-10.0, 0.0, 1.0))
    problem = block(6, indenter=indenter, history=later, bodies=(clamp,), touch_down_s=2.0)
    if taut:
        problem = replace(problem, prestretch=TAUT)
    theirs, mine = run_both(febio, tmp_path, problem)
    late = theirs.times >= 2.0
    gap = np.abs(mine.force_at(theirs.times) - theirs.force)[late].max()
    assert gap < 0.02 * theirs.peak_force


@recorded
def test_febios_own_fit_ends_at_the_relaxation_that_made_the_force(febio, tmp_path):
    """Without the ties of c, m and the bulk modulus: not every FEBio has LEVMAR, which they need."""
    true, start = OgdenQLV(0.004, 4.0, 2.0, 0.5), OgdenQLV(0.004, 4.0, 1.6, 0.6)
    problem = turn_to_indenter_frame(block(2, materials={"skin": SKIN, "muscle": true}))
    theirs, _ = run_both(febio, tmp_path, problem)
    values = {"c": start.c, "m": start.m, "gamma": start.gamma, "tau": start.tau}
    bounds = ({name: factor * value for name, value in values.items()} for factor in (0.2, 5.0))
    file, model = tmp_path / "optimize.feb", tmp_path / "model.feb"
    write_feb(problem.with_materials({"skin": SKIN, "muscle": start}), model, FebSettings())
    write_optimisation(file, {"muscle": ParameterRange(values, *bounds, 100.0)}, theirs.times, theirs.force)
    text = re.sub("<Constraints>.*</Constraints>", "", file.read_text(), flags=re.DOTALL)
    text = re.sub(r"<param name=.*\.(elastic\.\w+|k)\">.*</param>\n", "", text)
    file.write_text(text.replace("constrained levmar", "levmar"))
    done = subprocess.run(
        [febio, "-i", model, "-s", file],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )
    assert "N O R M A L" in done.stdout, done.stdout[-500:]
    found = dict(re.findall(r"'muscle'\)\.(\w1) = (\S+)", done.stdout.partition("Optimal parameters")[2]))
    assert float(found["g1"]) == pytest.approx(2.0, rel=0.01)
    assert float(found["t1"]) == pytest.approx(0.5, rel=0.01)


def test_calculix_pushes_as_hard_into_elastic_tissue(tmp_path):
    """Ten-node tetrahedra of both, without relaxation, which CalculiX has not."""
    if shutil.which("ccx") is None:
        pytest.skip("there is no CalculiX (ccx) on the path")
    elastic = {"skin": OgdenQLV(0.009, 6.0, 0.0, 1.0), "muscle": OgdenQLV(0.004, 4.0, 0.0, 1.0)}
    pressed = History(np.array([0.0, 1.0]), np.array([0.0, 5.0]))
    problem = block(4, "tet10", materials=elastic, history=pressed)
    write_inp(problem, tmp_path / "m.inp", "calculix", FebSettings())
    done = subprocess.run(["ccx", "-i", "m"], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout[-500:]
    forces = re.findall(r"forces .* time +(\S+)\s+\d+ +\S+ +\S+ +(\S+)", (tmp_path / "m.dat").read_text())
    times, theirs = np.array(forces, dtype=float).T
    mine = solve(problem, StepControl(times=tuple(times)), store="none")
    assert np.abs(mine.force_at(times) + theirs).max() < 0.01 * mine.force.max()


@pytest.mark.parametrize("case", ["cube/cube_skin", "cube/cube_lim_par", "block/block_hex8", "socket/tube"])
def test_febio_gives_again_what_is_stored_of_it(febio, tmp_path, case):
    """So that what is compared with the stored results is compared with FEBio."""
    file = REFERENCE / f"{case}.feb"
    table = file.with_suffix(".txt")
    stored = read_log(table)
    shutil.copy(file, tmp_path / "model.feb")
    run = run_febio(febio, tmp_path, float(stored.times[-1]), table.name, time_limit_s=300.0)
    assert run.verdict.is_completed, run.verdict.reason
    assert run.log is not None
    np.testing.assert_allclose(run.log.values, stored.values, atol=1e-9 * np.abs(stored.values).max())
