"""Fields on disk: what ParaView reads is the mechanics that was computed."""

import xml.etree.ElementTree as ET
from dataclasses import replace

import numpy as np
import pytest
import pyvista as pv
from scipy.interpolate import make_interp_spline

from limbfit.bench.timing import build_punched_block
from limbfit.fe import ELEMENTS, Indenter, OgdenQLV, StepControl, solve
from limbfit.fields import Animation, write_fields
from limbfit.mesh import cell_volumes, read_vtu

KPA = 1e-3
STEPS = StepControl(load_steps=8, unload_steps=4)
ELASTIC = {"skin": OgdenQLV(0.009, 6.0, 0.0, 0.5), "muscle": OgdenQLV(0.004, 4.0, 0.0, 0.3)}


def played(problem, folder, **control):
    """Force, area, penetration of each step, and the grids of an animation, rest first."""
    animation = Animation(problem, folder / "site.pvd")
    result = solve(problem, replace(STEPS, **control), on_step=animation.add)
    assert result.completed, result.reason
    return result, [pv.read(file) for _, file in animation.frames]


@pytest.fixture(scope="module", params=[("hex8", 10), ("tet10", 7)], ids=["hex8", "tet10"])
def elastic(request, tmp_path_factory):
    """A long-term elastic block under a flat round punch that covers several faces."""
    problem = replace(
        build_punched_block(*request.param),
        materials=ELASTIC,
        indenter=Indenter("cylinder", 30.0, 6.0, (0.0, 0.0, 1.0), (0.0, 0.0, -1.0)),
    )
    return problem, *played(problem, tmp_path_factory.mktemp("elastic"))


def pushed(problem, grid) -> tuple[float, float]:
    """Force (N) of the contact pressure on the deformed skin along the punch, and its moment arm about the
    bottom, (N mm)."""
    faces = problem.contact_faces
    x = grid.points + grid["displacement_mm"]
    at, weights = problem.formulation.face_rules["gauss"]
    N, dN = problem.formulation.face_shape(at)
    tangents = np.einsum("fki,qkj->fqij", x[faces], dN)
    upwards = np.cross(tangents[..., 0], tangents[..., 1])[..., 2] * weights
    force = (grid["contact_pressure_kPa"][faces] @ N.T) * KPA * upwards
    height = x[faces][..., 2] @ N.T - problem.mesh.points[:, 2].min()
    return float(force.sum()), float((force * height).sum())


def test_pressure_integrates_to_the_force(elastic):
    """Within what a coarse mesh tells about the rounding: its faces do not follow the punch's."""
    problem, result, grids = elastic
    for step in (4, 8, 10):
        assert pushed(problem, grids[step])[0] == pytest.approx(result.force[step], rel=0.05)


@pytest.mark.parametrize("element", ["tet4", "tet10", "hex8"])
@pytest.mark.parametrize("rule", ["nodes", "gauss"])
def test_pressure_under_a_platen_is_the_force_exactly(element, rule, tmp_path):
    platen = Indenter("square", 90.0, 2.0, (0.0, 0.0, 1.0), (0.0, 0.0, -1.0))
    problem = replace(build_punched_block(element, 4), indenter=platen, contact_rule=rule)
    history = replace(problem.history, displacement=np.array([0.0, 2.0, 0.0]))
    rows = []
    result = solve(
        replace(problem, history=history), StepControl(load_steps=2, unload_steps=2), on_step=rows.append
    )
    write_fields(result.system, problem, rows[1].state, tmp_path / "peak.vtu")
    assert pushed(problem, pv.read(tmp_path / "peak.vtu"))[0] == pytest.approx(result.force[2], rel=1e-3)


def test_pressure_is_there_where_the_punch_is(elastic):
    _, _, grids = elastic
    peak = grids[8]
    under = np.hypot(*peak.points[:, :2].T) < 9.0
    top = peak.points[:, 2] == 0.0
    assert (peak["contact_pressure_kPa"][top & under] > 0.0).all()
    assert (peak["contact_pressure_kPa"][~top] == 0.0).all()
    far = np.hypot(*peak.points[:, :2].T) > 28.0  # a face of 8.6 mm beyond the punch
    assert (peak["contact_pressure_kPa"][far] == 0.0).all()
    assert (grids[0]["contact_pressure_kPa"] == 0.0).all()
    assert grids[-1]["contact_pressure_kPa"].max() < 1e-3 * peak["contact_pressure_kPa"].max()


def test_work_of_the_punch_is_the_strain_energy(elastic):
    """All work is stored, but for what the penalty springs hold: half of force times penetration at most."""
    problem, result, grids = elastic
    volumes = cell_volumes(problem.mesh)
    z, force = result.displacement[:9], result.force[:9]
    fine = np.linspace(0.0, z[-1], 400)
    work = np.trapezoid(make_interp_spline(z, force, k=3)(fine), fine)
    energy = (grids[8]["energy_density_kPa"] * KPA * volumes).sum()
    held = 0.5 * force[-1] * result.penetration[8]
    assert energy - 0.005 * work < work < energy + held + 0.005 * work


def test_volume_ratio_is_that_of_the_deformed_cells(elastic):
    problem, _, grids = elastic
    for grid in (grids[0], grids[8]):
        moved = problem.mesh.with_points(problem.mesh.points + grid["displacement_mm"])
        ratio = cell_volumes(moved) / cell_volumes(problem.mesh)
        np.testing.assert_allclose(grid["J"], ratio, rtol=5e-4)  # four points see no cubic exactly
        assert grid["J"].mean() == pytest.approx(ratio.mean(), abs=2e-6)
        product = grid["largest_stretch"] * grid["middle_stretch"] * grid["smallest_stretch"]
        np.testing.assert_allclose(product, grid["J"], rtol=2e-2)
        assert (grid["largest_stretch"] >= grid["middle_stretch"]).all()


def test_fields_at_rest_are_none(elastic):
    _, _, grids = elastic
    rest = grids[0]
    for name in ("cauchy_kPa", "von_mises_kPa", "energy_density_kPa", "displacement_mm", "cauchy_nodal_kPa"):
        assert np.abs(rest[name]).max() < 1e-12
    assert rest["cauchy_kPa"].shape == (rest.n_cells, 6)
    np.testing.assert_allclose(rest["J"], 1.0)


def test_stress_balances_the_pressure(elastic):
    """The volume integral of the stress is that of the boundary forces' moments (bottom: no height)."""
    problem, _, grids = elastic
    for step in (4, 8):
        grid = grids[step]
        volumes = cell_volumes(problem.mesh) * grid["J"]
        carried = -(grid["cauchy_kPa"][:, 2] * KPA * volumes).sum()
        assert carried == pytest.approx(pushed(problem, grid)[1], rel=0.05)


def test_peak_file_and_animation_frame_are_the_same(elastic, tmp_path):
    problem, result, grids = elastic
    write_fields(result.system, problem, result.states[0], tmp_path / "peak.vtu")
    peak = pv.read(tmp_path / "peak.vtu")
    for name in grids[8].array_names:
        np.testing.assert_array_equal(peak[name], grids[8][name], err_msg=name)


def test_collection_plays_all_steps(tmp_path):
    problem = replace(build_punched_block("tet4", 4), contact_rule="nodes")
    (tmp_path / "site").mkdir()
    (tmp_path / "site" / "step-0099.vtu").write_text("left by a run with more steps")
    result, _ = played(problem, tmp_path)
    entries = [node.attrib for node in ET.parse(tmp_path / "site.pvd").getroot().iter("DataSet")]
    np.testing.assert_allclose([float(entry["timestep"]) for entry in entries], result.times)
    files = [tmp_path / entry["file"] for entry in entries]
    assert files == sorted((tmp_path / "site").iterdir())
    reader = pv.get_reader(tmp_path / "site.pvd")
    reader.set_active_time_value(result.times[8])
    shown = reader.read()[0]
    np.testing.assert_allclose(shown["displacement_mm"][:, 2].min(), -6.0, rtol=0.03)
    mesh = read_vtu(files[-1])
    np.testing.assert_array_equal(mesh.cells, problem.mesh.cells)
    np.testing.assert_array_equal(mesh.node_sets["bottom"], problem.mesh.node_sets["bottom"])


def test_elements_share_one_set_of_fields(tmp_path):
    """Files of every element hold the same arrays, so that a ParaView state serves all."""
    names = set()
    for element in ELEMENTS:
        problem = build_punched_block(element, 4)
        animation = Animation(problem, tmp_path / f"{element}.pvd")
        names.add(tuple(sorted(pv.read(animation.frames[0][1]).array_names)))
    assert len(names) == 1
