"""Contact stiffness as FEBio has it: held to its algorithm, and to the forces that it logged."""

import gzip
from dataclasses import replace

import numpy as np
import pytest
from febfiles import back, export

from limbfit.bench.timing import build_punched_block
from limbfit.fe import State, Step, StepControl, System, solve
from limbfit.fe.kernel.elements import build_face_quadrature
from limbfit.febio import (
    FacePenalties,
    FebSettings,
    build_step_control,
    compute_axial_force,
    compute_mean_penalty,
    describe_differences,
    read_log,
    run_feb,
    write_feb,
)
from limbfit.febio.penalty import CURRENT_AREA, compute_automatic_penalties, compute_explicit_penalty
from limbfit.febio.reading.model import Contact
from reference import REFERENCE, recorded

EXPORTS = REFERENCE / "exports"
SITES = ("01", "05", "10", "13", "15", "17")


def turned(element, axis, divisions=2):
    """The block with its surface normal along ``axis``."""
    problem = build_punched_block(element, divisions)
    z = np.asarray(axis, dtype=float) / np.linalg.norm(axis)
    x = np.cross(z, [0.3, 0.9, -0.2])
    x /= np.linalg.norm(x)
    frame = np.array([x, np.cross(z, x), z])
    tool = replace(problem.indenter, axis=-z, centre=z, edge=x)
    return replace(problem, mesh=problem.mesh.with_points(problem.mesh.points @ frame), indenter=tool)


def modulus_as_febio(normal, mu, kappa):
    """FEBio's own way: the tangent as a 6 x 6 matrix, inverted, and its entries taken as a tensor's."""
    tangent = np.diag([2.0 * mu] * 3 + [mu] * 3)
    tangent[:3, :3] += kappa - 2.0 / 3.0 * mu
    x, y, z = normal
    v = np.array([x * x, y * y, z * z, 2 * x * y, 2 * y * z, 2 * x * z])
    return 1.0 / (v @ np.linalg.inv(tangent) @ v)


@pytest.mark.parametrize(
    ("element", "axis"),
    [
        ("hex8", (0, 0, 1)),
        ("hex8", (1, 1, 0)),
        ("hex8", (0.7, -0.2, 0.4)),
        ("tet4", (1, 1, 1)),
        ("tet10", (1, 1, 0)),
    ],
)
def test_the_automatic_penalty_depends_on_the_normal(element, axis):
    problem = turned(element, axis)
    dt = 1e-9  # of the instant
    normal = np.asarray(axis) / np.linalg.norm(axis)
    skin = problem.materials["skin"]
    mu, kappa = skin.instantaneous_modulus, skin.table().kappa
    found = compute_automatic_penalties(problem, problem.contact_faces, dt)
    straight = compute_automatic_penalties(turned(element, (0, 0, 1)), problem.contact_faces, dt)
    expected = modulus_as_febio(normal, mu, kappa) / modulus_as_febio((0, 0, 1), mu, kappa)
    np.testing.assert_allclose(found, expected * straight, rtol=1e-6)
    if element == "hex8":  # a square of 30 mm on a layer of 3 mm: A/V is one over the thickness
        np.testing.assert_allclose(found, modulus_as_febio(normal, mu, kappa) / 3.0, rtol=1e-6)


def test_the_mean_is_over_what_the_indenter_covers():
    """Faces beyond it, of other normals or sizes, say nothing of how far it sinks in."""
    problem = build_punched_block("hex8", 12)
    contact = Contact("sliding-elastic", ("", ""), 3.0, True, False, 0)
    mean = compute_mean_penalty(contact, problem, 0.1)
    points = problem.mesh.points.copy()
    outside = np.abs(points[:, 0]) > 18.0
    points[outside, 2] += 0.4 * (np.abs(points[outside, 0]) - 18.0)  # a slope beside the punch
    bent = replace(problem, mesh=problem.mesh.with_points(points))
    assert compute_mean_penalty(contact, bent, 0.1) == pytest.approx(mean, rel=1e-9)


@pytest.mark.parametrize(("rule", "grown"), [("sliding-elastic", 1.21), ("sliding-facet-on-facet", 1.0)])
def test_every_face_has_its_own_penalty_over_its_own_area(rule, grown):
    """Skin that stretches by a tenth both ways: the area of a step ahead is foreseen from the last two."""
    problem = build_punched_block("hex8", 4)
    points = problem.mesh.points.copy()
    points[:, 0] += np.where(points[:, 0] > 0.0, 0.2 * points[:, 0], 0.0)  # two sizes of faces
    problem = replace(problem, mesh=problem.mesh.with_points(points), start="as-given")
    contact = Contact(rule, ("", ""), 3.0, True, False, 0)
    system = System(problem)
    times = np.array([1.0, 2.0, 3.0])
    weights = FacePenalties(system, (contact,), times)
    own = compute_automatic_penalties(problem, problem.contact_faces, 1.0) * 3.0
    modulus = np.mean([m.instantaneous_modulus for m in problem.materials.values()])
    rest = build_face_quadrature(problem.formulation, points, problem.contact_faces, "gauss")[1]
    uniform = compute_mean_penalty(contact, problem, 1.0) * modulus
    np.testing.assert_allclose(
        uniform * system.bodies.first_body.surface.areas, own[:, None] * rest, rtol=1e-12
    )
    for t, stretch in ((1.0, 1.0), (2.0, np.sqrt(1.105))):  # 1.21 is as far from 1.105 as that from 1
        u = np.column_stack([(stretch - 1.0) * points[:, :2], np.zeros(len(points))])
        state, nothing = State(t, float(problem.history.at(t)), u, 1.0, None), np.zeros((1, 6))
        place = np.array([[0.0, 0.0, state.displacement, 0.0, 0.0, 0.0]])
        weights.update_after(Step(t, state.displacement, 0.0, 0.0, 0.0, 1, None, nothing, place, None, state))
    np.testing.assert_allclose(
        uniform * system.bodies.first_body.surface.areas, grown * own[:, None] * rest, rtol=1e-9
    )


def test_an_explicit_penalty_goes_out_and_comes_back(tmp_path):
    """It is as stiff as limbfit's: what is read has the stiffness that limbfit has."""
    problem = build_punched_block("tet4", 4)
    steps = StepControl(penalty=300.0)
    again, model = back(problem, tmp_path, FebSettings(steps=steps))
    text = (tmp_path / "model.feb").read_text()
    for tag in ("<auto_penalty>0<", "<max_ups>0<", "<max_refs>60<"):
        assert tag in text
    found = build_step_control(model, again)
    assert found.penalty == pytest.approx(300.0)
    modulus = np.mean([m.instantaneous_modulus for m in problem.materials.values()])
    assert compute_explicit_penalty(problem, steps) == pytest.approx(300.0 * modulus / CURRENT_AREA)
    assert compute_explicit_penalty(problem, StepControl()) == pytest.approx(100.0 * modulus / CURRENT_AREA)
    text = export(problem, tmp_path, FebSettings(penalty=3.0))
    assert "<penalty>3.0</penalty>\n<auto_penalty>1<" in text


def test_what_differs_is_said_in_the_file(tmp_path):
    problem = build_punched_block("tet4", 4)
    for settings, words in ((FebSettings(), "as stiff as limbfit's; FEBio's"), (FebSettings(3.0), "smaller")):
        text = export(problem, tmp_path, settings)
        lines = describe_differences(problem, settings)
        assert words in lines[0]
        assert all(f"<!-- {line} -->" in text for line in lines)
    assert not any("edge" in line for line in lines)
    sharp = replace(problem, indenter=replace(problem.indenter, edge_radius=0.0))
    assert any("may stop before the end" in line for line in describe_differences(sharp, FebSettings()))


@pytest.mark.slow
def test_a_written_model_is_as_stiff_as_its_own(tmp_path):
    """Read back and solved as FEBio would, with its steps and its penalty: within 1.5 % of the peak."""
    problem = build_punched_block("tet4", 8)
    own = solve(problem, store="none")
    assert own.completed
    write_feb(problem, tmp_path / "model.feb", FebSettings())
    back = run_feb(tmp_path / "model.feb", tmp_path / "out").result
    assert back.completed
    times = own.times
    assert np.abs(back.force_at(times) - own.force).max() < 0.015 * own.peak_force


@recorded
@pytest.mark.slow
@pytest.mark.parametrize("name", [*SITES, "05-explicit"])
def test_exports_as_febio_ran_them(tmp_path, name):
    """FEBio's own forces on exports, the thin site over the tibia (05) among them."""
    file = tmp_path / "model.feb"
    file.write_bytes(gzip.decompress((EXPORTS / f"{name}.feb.gz").read_bytes()))
    result = run_feb(file, tmp_path / "out").result
    assert result.completed
    log = read_log(EXPORTS / f"{name}-forces.txt")
    febio = compute_axial_force(result.problem, log)
    assert np.abs(result.force_at(log.times) - febio).max() < 0.015 * febio.max()
