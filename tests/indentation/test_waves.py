"""Speeds of shear waves on the strain that an indentation makes: closed forms, derivatives, places."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from layered import SKIN_OVER_MUSCLE as TRUTH
from layered import build_block_site
from limbfit.bench.timing import build_layered_block
from limbfit.errors import ProblemError
from limbfit.fe import History, OgdenQLV, Problem, Result, StepControl, Support, solve
from limbfit.indentation import SimulationJob, SiteModel, WavePlace, place_waves_under, simulate, to_vector
from limbfit.indentation.observing import DISC_HALF_MM, DISC_RADIUS_MM, compute_wave_speeds, sample_disc
from limbfit.mesh import locate
from limbfit.study import IndenterTable, SolverTable

TISSUES = tuple(TRUTH)
C, M, GAMMA, TAU = 0.006, 5.0, 2.0, 0.8  # MPa, -, -, s
SHORTER, RAMP_S = 0.25, 0.02
MIDDLE = (0.0, 0.0, -16.0)


def compressed(element: str, hold_s: float) -> Result:
    """A nearly incompressible cube that is shortened along z at once, free to widen, and held."""
    mesh = build_layered_block(element, 2)
    low, points = mesh.points.min(axis=0), mesh.points
    supports = [Support(np.flatnonzero(np.abs(points[:, i] - low[i]) < 1e-9), i) for i in range(3)]
    top = np.flatnonzero(np.abs(points[:, 2]) < 1e-9)
    travel = SHORTER * np.ptp(points[:, 2])
    same = OgdenQLV(C, M, GAMMA, TAU, kappa_ratio=2e4)
    problem = Problem(
        mesh,
        {"skin": same, "muscle": same},
        fixed=np.zeros(0, dtype=np.int64),
        contact_faces=np.zeros((0, mesh.face_sets["skin"].shape[1]), dtype=np.int64),
        indenter=None,
        history=History(np.array([0.0, RAMP_S, RAMP_S + hold_s]), np.array([0.0, travel, travel])),
        supports=(*supports, Support(top, 2, -1.0)),
    )
    return solve(problem, steps=StepControl(load_steps=6, unload_steps=12), store="all")


def pull(stretch: float) -> float:
    """``lambda dW/dlambda`` of the law, MPa."""
    return C / M * (stretch**M - stretch**-M)


@pytest.mark.parametrize("element", ["hex8", "tet10"])
def test_speeds_in_a_compressed_cube(element: str) -> None:
    """A wave along i with motion along j has ``rho v^2 = l_i^2 (l_i W_i - l_j W_j)/(l_i^2 - l_j^2)`` when the
    strain has just come; while it is held the stress relaxes, and what that adds to the stiffness with it."""
    result = compressed(element, 2.4)
    assert result.completed
    x, z = (1.0 - SHORTER) ** -0.5, 1.0 - SHORTER
    ways = {"z": ((1.0, 0.0, 0.0), (0.0, 0.0, 1.0)), "x": ((0.0, 0.0, 1.0), (1.0, 0.0, 0.0))}
    places = [WavePlace("muscle", MIDDLE, motion, way) for motion, way in ways.values()]
    speeds, slopes = compute_wave_speeds(result, places)
    assert slopes is None
    assert speeds[:, 0] == pytest.approx(np.sqrt(1e6 * C * (1.0 + GAMMA) / 1e3), rel=1e-9)
    mean = (2.0 * pull(x) + pull(z)) / 3.0
    left = np.exp(-(result.times - RAMP_S) / TAU)  # of a stress that came at once
    for way, (i, j), own in zip(ways, ((z, x), (x, z)), speeds, strict=True):
        sudden = (1.0 + GAMMA) * i**2 * (pull(i) - pull(j)) / (i**2 - j**2)
        relaxed = GAMMA * (1.0 - left) * (pull(i) - mean)
        held = result.times >= RAMP_S
        expected = np.sqrt(1e6 * (sudden - relaxed) / 1e3)
        assert own[held] == pytest.approx(expected[held], rel=4e-3), way
    assert speeds[1, -1] > 1.05 * speeds[1, 0]


def site(folder: Path) -> SiteModel:
    steps = SolverTable(load_steps=4, unload_steps=3, penalty_per_mm=400.0)
    mesh = build_layered_block("tet10", 4)
    mesh = replace(mesh, node_sets={"fixed_bottom": mesh.node_sets["bottom"]})
    model = build_block_site("a", folder / "a.vtu", mesh, 4.0, steps)
    return replace(model, waves=place_waves_under(model, mesh, [("skin", None), ("muscle", 20.0)]))


def test_places_under_the_indenter(tmp_path: Path) -> None:
    skin, muscle = site(tmp_path).waves
    assert (skin.tissue, skin.point) == ("skin", pytest.approx((0.0, 0.0, -1.5)))
    assert (muscle.tissue, muscle.point) == ("muscle", pytest.approx((0.0, 0.0, -20.0)))
    assert skin.motion == pytest.approx((0.0, 0.0, -1.0))
    assert np.dot(skin.way, skin.motion) == pytest.approx(0.0)
    mesh = build_layered_block("tet10", 6)
    found = place_waves_under(site(tmp_path), mesh)
    assert [place.tissue for place in found] == ["skin", "muscle"]
    for wanted, told in (
        (("fat", None), "no fat lies under the indenter's axis, only skin, muscle"),
        (("skin", 12.0), "skin lies 0.0 to 3.0 mm deep, and not at 12 mm"),
    ):
        with pytest.raises(ProblemError, match=told):
            place_waves_under(site(tmp_path), mesh, [wanted])


def test_speeds_and_their_slopes_beside_the_force(tmp_path: Path) -> None:
    """Instantaneous moduli at rest; slopes, along one direction of all parameters, within 2e-4 of central
    differences of whole simulations."""
    model, times = site(tmp_path), tuple(np.linspace(0.0, 8.0, 9))
    vector = to_vector(TRUTH, TISSUES)
    found = simulate(SimulationJob(model, TISSUES, tuple(vector), times))
    assert found.completed
    assert found.observed.shape == (2, 9)
    assert found.observed[:, 0] == pytest.approx(np.sqrt([9.0 * 3.0, 4.5 * 4.0]), rel=1e-9)
    assert (np.ptp(found.observed, axis=1) > 0.3).all()
    assert found.observed_jacobian is not None
    step = 1e-3 * vector * np.random.default_rng(3).uniform(-1.0, 1.0, len(vector))
    ends = [simulate(SimulationJob(model, TISSUES, tuple(vector + s), times, False)) for s in (step, -step)]
    change = (ends[0].observed - ends[1].observed) / 2.0
    assert found.observed_jacobian @ step == pytest.approx(change, abs=2e-4 * np.abs(change).max())


def test_means_over_a_disc_of_equal_weights() -> None:
    points = sample_disc()
    assert points[0] == pytest.approx([0.0, 0.0, 0.0])
    assert np.hypot(points[:, 0], points[:, 1]).max() < DISC_RADIUS_MM
    mean, moments = points[1:].mean(axis=0), points[1:].T @ points[1:] / len(points[1:])
    assert mean == pytest.approx([0.0, 0.0, 0.0], abs=1e-12)
    across, along = DISC_RADIUS_MM**2 / 4, DISC_HALF_MM**2 / 3
    assert np.diag(moments) == pytest.approx([across, across, along], rel=0.1)
    assert moments - np.diag(np.diag(moments)) == pytest.approx(np.zeros((3, 3)), abs=0.02)


@pytest.mark.slow
def test_speeds_under_a_ball_are_the_same_on_any_fine_mesh(tmp_path: Path) -> None:
    """Where the middle is a node, and where it is amid a face: points alone differ by 2.7 %."""
    found = []
    for divisions in (15, 16):
        mesh = build_layered_block("tet10", divisions)
        mesh = replace(mesh, node_sets={"fixed_bottom": mesh.node_sets["bottom"]})
        steps = SolverTable(load_steps=5, unload_steps=3, penalty_per_mm=150.0)
        model = build_block_site("a", tmp_path / f"{divisions}.vtu", mesh, 4.0, steps)
        ball = IndenterTable(shape="sphere", width_mm=24.0)
        model = replace(model, indenter=ball, waves=place_waves_under(model, mesh))
        vector = tuple(to_vector(TRUTH, TISSUES))
        found.append(simulate(SimulationJob(model, TISSUES, vector, (2.0, 4.0), False)).observed)
    assert found[0] == pytest.approx(found[1], rel=0.02)


def test_a_place_that_the_mesh_does_not_have_is_refused(tmp_path: Path) -> None:
    model = site(tmp_path)
    lost = replace(model.waves[0], point=(0.0, 0.0, -9.0))
    with pytest.raises(ProblemError, match=r"the place \(0.0, 0.0, -9.0\) is 6.0 mm off the simulated skin"):
        simulate(
            SimulationJob(replace(model, waves=(lost,)), TISSUES, tuple(to_vector(TRUTH, TISSUES)), (1.0,))
        )


@pytest.mark.parametrize("kind", ["hex8", "tet10"])
def test_points_are_located_in_cells(kind: str) -> None:
    mesh = build_layered_block(kind, 6)
    points = np.array([[3.3, -7.1, -12.4], [-29.9, 14.0, -3.2], [0.0, 0.0, -1.0]])
    cells, local, off = locate(mesh, points, mesh.region_names.index("muscle"))
    assert off == pytest.approx([0.0, 0.0, 2.0], abs=1e-9)
    values, _ = mesh.kind.shape(local)
    back = np.einsum("mk,mki->mi", values, mesh.points[mesh.cells[cells]])
    assert back[:2] == pytest.approx(points[:2], abs=1e-9)
    assert back[2] == pytest.approx([0.0, 0.0, -3.0])
    assert (mesh.regions[cells] == mesh.region_names.index("muscle")).all()
