"""Points of the skin around the indenter as material points, and their moves in a simulation."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from layered import SKIN_OVER_MUSCLE as TRUTH
from layered import build_block_site
from limbfit.bench.timing import build_layered_block
from limbfit.errors import ProblemError
from limbfit.fe import Indenter
from limbfit.indentation import (
    SimulationJob,
    SiteModel,
    choose_points_around,
    find_skin_points,
    is_under,
    simulate,
    to_vector,
)
from limbfit.study import IndenterTable, SolverTable

TISSUES = tuple(TRUTH)


@pytest.mark.parametrize("kind", ["hex8", "tet10"])
def test_a_point_follows_the_skin(kind: str) -> None:
    """Displacements that the elements represent exactly, on edges, inside faces and off the skin."""
    mesh = build_layered_block(kind, 6)
    asked = np.array([[0.0, 0.0, 0.0], [12.3, -4.1, 1.5], [-7.7, 9.4, -0.5], [35.0, 1.0, 0.0]])
    found = find_skin_points(mesh, asked)
    feet = np.array([[0.0, 0.0, 0.0], [12.3, -4.1, 0.0], [-7.7, 9.4, 0.0], [30.0, 1.0, 0.0]])
    assert found.points == pytest.approx(feet, abs=1e-9)
    assert found.off_mm == pytest.approx([0.0, 1.5, 0.5, 5.0])
    x, y, z = mesh.points.T
    field = np.column_stack([0.1 * x - 0.02 * y + 0.3 * z, 0.05 * y, 0.2 * x - 1.0])
    told = np.array([gauge.read(field) for gauge in found.gauges(np.eye(3))]).reshape(-1, 3)
    x, y, _ = feet.T
    assert told == pytest.approx(np.column_stack([0.1 * x - 0.02 * y, 0.05 * y, 0.2 * x - 1.0]), abs=1e-9)
    (along,) = find_skin_points(mesh, asked[1:2]).gauges(np.array([[0.6, 0.0, 0.8]]))
    assert along.read(field) == pytest.approx(told[1] @ [0.6, 0.0, 0.8])


def test_quadratic_faces_interpolate_quadratic_moves() -> None:
    mesh = build_layered_block("tet10", 6)
    (gauge,) = find_skin_points(mesh, np.array([[2.3, -4.1, 0.0]])).gauges(np.array([[0.0, 0.0, 1.0]]))
    sunk = np.zeros((len(mesh.points), 3))
    sunk[:, 2] = 0.02 * mesh.points[:, 0] ** 2
    assert gauge.read(sunk) == pytest.approx(0.02 * 2.3**2, rel=1e-9)


def test_a_mesh_without_skin_is_refused() -> None:
    mesh = replace(build_layered_block("hex8", 4), face_sets={})
    with pytest.raises(ProblemError, match="no face set 'skin'; mesh the site anew"):
        find_skin_points(mesh, np.zeros((1, 3)))


@pytest.mark.parametrize(("shape", "inside"), [("square", (9.5, 9.5)), ("sphere", (6.9, 6.9))])
def test_what_the_indenter_hides(shape: str, inside: tuple[float, float]) -> None:
    indenter = Indenter(shape, 20.0, 0.0 if shape == "sphere" else 1.0)
    edge = indenter.frame[0]
    points = np.array([[*inside, 0.0], 10.5 * edge, 9.9 * edge, -9.9 * edge, [0.0, 0.0, -30.0]])
    assert is_under(indenter, points).tolist() == [True, False, True, True, True]


def test_rings_are_on_the_skin_and_beside_the_indenter() -> None:
    mesh = build_layered_block("tet10", 6)
    indenter = Indenter("square", 20.0, 2.0)
    around = choose_points_around(mesh, indenter)
    assert len(around) == 24
    assert np.abs(around[:, 2]).max() < 1e-9
    assert not is_under(indenter, around).any()
    at_the_end = choose_points_around(mesh, replace(indenter, centre=(25.0, 0.0, 0.0)))
    assert 8 <= len(at_the_end) < 24
    assert at_the_end[:, 0].max() <= 30.0 + 1e-9


def site(folder: Path) -> SiteModel:
    """A block of 60 mm under a ball, 3 mm deep."""
    steps = SolverTable(load_steps=3, unload_steps=2, penalty_per_mm=400.0)
    mesh = build_layered_block("tet10", 6)
    mesh = replace(mesh, node_sets={"fixed_bottom": mesh.node_sets["bottom"]})
    model = build_block_site("a", folder / "a.vtu", mesh, 3.0, steps)
    return replace(model, indenter=IndenterTable(shape="sphere", width_mm=16.0))


@pytest.mark.slow
def test_moves_follow_the_parameters(tmp_path: Path) -> None:
    """Slopes of all moves beside central differences, to 1e-3 of the largest slope; force and layers too."""
    points = ((10.0, 0.0, 0.0), (2.0, -12.0, 0.0), (-14.0, 9.0, 0.0))
    model = replace(site(tmp_path), skin_points=points, layers=("muscle",))
    vector, times = to_vector(TRUTH, TISSUES), tuple(np.linspace(0.2, 5.5, 12))
    found = simulate(SimulationJob(model, TISSUES, tuple(vector), times))
    assert found.completed
    assert found.observed.shape == (1 + 9, 12)
    assert found.observed_jacobian is not None
    moves = found.observed[1:].reshape(3, 3, 12)
    assert np.abs(moves).max() > 0.3
    peak = int(np.argmax(found.force_N))
    assert (moves[:2, 2, peak] < 0.0).all()  # beside the indenter the skin goes down with it
    for i in range(len(vector)):
        step = 1e-3 * vector[i] * np.eye(len(vector))[i]
        ends = [
            simulate(SimulationJob(model, TISSUES, tuple(vector + s), times, False)) for s in (step, -step)
        ]
        slope = (ends[0].observed - ends[1].observed) / (2e-3 * vector[i])
        own = found.observed_jacobian[:, :, i]
        assert own[1:] == pytest.approx(slope[1:], abs=1e-3 * np.abs(slope[1:]).max())


def test_a_point_off_the_skin_is_refused(tmp_path: Path) -> None:
    model = replace(site(tmp_path), skin_points=((0.0, 0.0, 9.0),))
    with pytest.raises(ProblemError, match=r"the point \(0.0, 0.0, 9.0\) is 9.0 mm off the simulated skin"):
        simulate(SimulationJob(model, TISSUES, tuple(to_vector(TRUTH, TISSUES)), (1.0,)))
