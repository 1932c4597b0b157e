"""A region inside the core as a tissue of a study: felt by a site over it, exported, identified."""

import xml.etree.ElementTree as ET
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from bodies import ellipsoid, limb
from limbfit import load_study, run_study
from limbfit.anatomy.meshing.meshing import MeshSettings, mesh_site
from limbfit.anatomy.surfaces.surfaces import write_surface
from limbfit.errors import StudyError
from limbfit.febio import write_feb
from limbfit.indentation import SimulationJob, SiteModel, build_problem, simulate, to_parameters
from limbfit.mesh import read_vtu, write_vtu
from limbfit.phantom.robot import Ramp, record
from limbfit.pipeline.commands.run import compute_keys
from limbfit.pipeline.engine.store import Store
from limbfit.study import IndenterTable, SolverTable, Study

CUT = np.array([12.0, -80.0, 300.0])  # the middle of the limb's proximal cut, LPS mm


def at(x: float, y: float, z: float) -> np.ndarray:
    """A point from the middle of the cut."""
    return CUT + np.array([x, y, z])


RADIUS, SLOPE = 28.0 + 6.0 * 30.0 / 70.0, 6.0 / 70.0  # of the limb's skin 40 mm below the cut
PLACES = {
    "over": (at(-RADIUS, 0.0, -40.0), (1.0, 0.0, SLOPE)),
    "aside": (at(0.0, RADIUS, -40.0), (0.0, -1.0, SLOPE)),
}
TISSUES = ("skin", "scar", "muscle")
TRUTH = (9.0, 6.0, 2.0, 0.5, 25.0, 4.0, 3.0, 0.4, 4.0, 4.0, 3.0, 0.4)
DEPTH = 4.0
STEPS = SolverTable(load_steps=5, unload_steps=4)
PUNCH = IndenterTable(width_mm=14.0, edge_radius_mm=2.0)
STUDY = """
[study]
name = "scar"
[surfaces]
skin = "skin.stl"
bones = { tibia = "tibia.stl" }
[geometry]
proximal_cut = { point = [12.0, -80.0, 300.0] }
regions = [{ name = "scar", surface = "scar.stl" }]
[mesh]
edge_near_mm = 4.0
edge_far_mm = 16.0
near_radius_mm = 10.0
growth = 0.9
[indenter]
width_mm = 14.0
edge_radius_mm = 2.0
[solver]
load_steps = 5
unload_steps = 4
[material]
start = { m = 4.0, gamma = 3.0, tau_s = 0.4 }
[material.tissues.skin]
start = { c_kPa = 9.0, m = 6.0, gamma = 2.0, tau_s = 0.5 }
[material.tissues.scar]
start = { c_kPa = 10.0 }
upper = { c_kPa = 500.0 }
[calibration]
search_radius_mm = 0
fixed = ["skin.c_kPa", "skin.m", "skin.gamma", "skin.tau_s"]
"""
SITE = """
[[sites]]
name = "{name}"
fitted = true
trace = "{name}.csv"
position = [{x}, {y}, {z}]
"""


def anatomy():
    scar = ellipsoid(at(-19.0, 0.0, -40.0), np.array([6.0, 11.0, 15.0]))
    return replace(limb(), regions={"scar": scar})


def model_of(folder: Path, name: str, settings: MeshSettings) -> SiteModel:
    """A site of the limb, its mesh stored."""
    position, inward = PLACES[name]
    axis = np.array(inward) / np.linalg.norm(inward)
    mesh, _ = mesh_site(anatomy(), position, axis, settings)
    write_vtu(mesh, folder / f"{name}.vtu")
    ramp = DEPTH / 0.96
    return SiteModel(
        name=name,
        mesh=folder / f"{name}.vtu",
        mesh_digest=name,
        position=tuple(position),
        axis=tuple(axis),
        knots_s=(0.0, ramp, 2 * ramp),
        knots_mm=(0.0, DEPTH, 0.0),
        indenter=PUNCH,
        steps=STEPS,
        element="tet10p0",
    )


def write_study(folder: Path, text: str = STUDY) -> Study:
    body = anatomy()
    for name, surface in {"skin": body.skin, **body.bones, **body.regions}.items():
        write_surface(folder / f"{name}.stl", surface)
    for name, (position, _) in PLACES.items():
        (folder / f"{name}.csv").touch()
        text += SITE.format(name=name, **dict(zip("xyz", position)))
    (folder / "study.toml").write_text(text, encoding="utf-8")
    return load_study(folder)


@pytest.fixture(scope="module")
def over(tmp_path_factory) -> SiteModel:
    settings = MeshSettings(edge_near_mm=8.0, edge_far_mm=24.0, near_radius_mm=8.0, growth=1.0)
    model = model_of(tmp_path_factory.mktemp("scar"), "over", settings)
    return replace(model, steps=SolverTable(load_steps=3, unload_steps=2))


@pytest.mark.slow
def test_a_site_over_it_feels_it_with_exact_derivatives(over: SiteModel) -> None:
    times = tuple(np.linspace(0.0, over.knots_s[-1], 13))

    def force(c_kPa: float) -> np.ndarray:
        values = (*TRUTH[:4], c_kPa, *TRUTH[5:])
        return simulate(SimulationJob(over, TISSUES, values, times, sensitivities=False)).force_N

    found = simulate(SimulationJob(over, TISSUES, TRUTH, times))
    assert found.jacobian is not None
    slope = found.jacobian[:, 4]
    assert 25.0 * slope.max() > 0.2 * found.force_N.max()  # twice as stiff a scar is felt by a tenth and more
    difference = (force(25.0 * 1.02) - force(25.0 * 0.98)) / (0.04 * 25.0)
    assert np.abs(slope - difference).max() < 1e-3 * np.abs(difference).max()


def test_it_is_a_part_of_its_own_in_febio_s_input(over: SiteModel, tmp_path) -> None:
    mesh = read_vtu(over.mesh)
    write_feb(build_problem(over, mesh, to_parameters(TRUTH, TISSUES)), tmp_path / "over.feb")
    root = ET.parse(tmp_path / "over.feb").getroot()
    parts = {part.get("name"): len(part) for part in root.iter("Elements")}
    assert parts["scar"] == (mesh.regions == 1).sum() > 0
    assert "scar" in [material.get("name") for material in root.iter("material")]


def test_a_study_has_it_among_its_tissues(tmp_path) -> None:
    study = write_study(tmp_path)
    assert study.tissues == TISSUES
    before = compute_keys(study)
    write_surface(tmp_path / "scar.stl", ellipsoid(at(-18.0, 0.0, -40.0), np.array([6.0, 11.0, 15.0])))
    after = compute_keys(load_study(tmp_path))
    assert before["surfaces"] != after["surfaces"]
    assert before["traces"] == after["traces"]


@pytest.mark.parametrize(
    ("region", "more", "words"),
    [
        ('{ name = "scar" }', "", "give either label"),
        ('{ name = "scar", label = "scar", surface = "scar.stl" }', "", "give either label"),
        ('{ name = "scar", label = "scar" }', "", "has no labels; give surface"),
        ('{ name = "muscle", surface = "scar.stl" }', "", "need different names"),
        ('{ name = "a b", surface = "scar.stl" }', "", "name"),
        ('{ name = "scar", surface = "none.stl" }', "", "none.stl"),
        ('{ name = "scar", surface = "scar.stl" }', 'engine = "netgen"\n', "cannot mesh geometry.regions"),
    ],
)
def test_regions_that_cannot_be_are_refused(tmp_path, region: str, more: str, words: str) -> None:
    text = STUDY.replace('{ name = "scar", surface = "scar.stl" }', region)
    with pytest.raises(StudyError, match=words):
        write_study(tmp_path, text.replace("[mesh]\n", f"[mesh]\n{more}"))


@pytest.mark.slow
def test_its_stiffness_is_identified_beside_the_muscle_s(tmp_path) -> None:
    """All else known, forces from finer meshes than the study's, noise of 0.03 to 0.05 N on 2 N."""
    known = [f"{tissue}.{name}" for tissue in ("scar", "muscle") for name in ("m", "gamma", "tau_s")]
    write_study(tmp_path, STUDY.replace('"skin.tau_s"]', f'"skin.tau_s", {str(known)[1:-1]}]'))
    random = np.random.default_rng(3)
    fine = MeshSettings(edge_near_mm=3.5, edge_far_mm=16.0, near_radius_mm=10.0, growth=0.9)
    for name in PLACES:
        truth = model_of(tmp_path, name, fine)
        times = np.linspace(0.0, truth.knots_s[-1], 201)
        force = simulate(SimulationJob(truth, TISSUES, TRUTH, tuple(times), False)).force_N
        made = record(Ramp(DEPTH, 0.96), partial(np.interp, xp=times, fp=force), random)
        made.write(tmp_path / f"{name}.csv")
    study = load_study(tmp_path)
    run_study(study, until="calibrate")
    found = Store(study.results).results.calibration.to_plain()
    last = found["stages"][-1]["parameters"]
    low, high = found["uncertainty"]["intervals_95"]["scar"]["c_kPa"]
    assert low < 25.0 < high < 2.0 * low
    assert last["scar"]["c_kPa"] == pytest.approx(25.0, rel=0.1)
    assert last["muscle"]["c_kPa"] == pytest.approx(4.0, rel=0.1)
