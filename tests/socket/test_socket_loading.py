"""What a socket's loads do to the tissue in figures, on a block of which all of them are known."""

import numpy as np
import pytest

from bodies import limb
from limbfit.donning import Load, LoadedState, SocketFit, Strains, build_socket_steps
from limbfit.identify.checks.domain import ANGLE, LEVEL, PRESSURE, RATE, SHEAR, TIME, Extent, RecordedRange
from limbfit.mesh import Mesh, boundary_faces, cell_volumes
from limbfit.mesh.cells import SIX_TETS, build_boxes
from limbfit.pipeline.simulation.loading import LimbAxis, LoadHistory, describe_socket_load
from tetrahedra import turn_upright


@pytest.fixture(scope="module")
def mesh() -> Mesh:
    """A block of cubes of 5 mm: ``top`` is the uppermost layer, ``deep`` what is below."""
    points, corners = build_boxes(
        np.arange(0.0, 41.0, 5.0), np.arange(-90.0, -69.0, 5.0), np.arange(200.0, 231.0, 5.0)
    )
    cells = turn_upright(points, corners[:, SIX_TETS].reshape(-1, 4))
    deep = points[cells].mean(axis=1)[:, 2] < 225.0
    return Mesh.from_arrays(points, cells, regions=deep.astype(int), names={0: "top", 1: "deep"})


def held(mesh: Mesh, shear: float, pressure_kPa: float) -> LoadedState:
    """A state in which the top is sheared twice as much as what is deep, and its upper side is pressed."""
    strain = np.where(mesh.regions == 0, 2 * shear, shear)
    pressed = mesh.points[:, 2] >= mesh.points[:, 2].max() - 1e-9
    strains = Strains(strain, 0.5 * strain, strain, cell_volumes(mesh))
    nothing = np.zeros_like(mesh.points)
    return LoadedState(None, np.where(pressed, pressure_kPa, 0.0), nothing, nothing, strains, {})  # type: ignore[arg-type]


def test_strain_rate_pressure_and_place_of_a_load(mesh):
    """The rate is that of what a load adds; of the deep tissue what lies within reach of the pressed side."""
    axis = LimbAxis(limb())
    faces = boundary_faces(mesh)
    upper = faces[mesh.points[faces][:, :, 2].min(axis=1) >= mesh.points[:, 2].max() - 1e-9]
    tested = RecordedRange((Extent(PRESSURE, "kPa", 0.0, 20.0),), (0.0,))

    def describe(state: LoadedState, before: list[Extent], history: LoadHistory) -> dict:
        found = describe_socket_load(mesh, upper, state, before, history, ("top", "deep"), 20.0, axis, tested)
        return {(one.quantity, one.tissue): one for one in found}

    donned = describe(held(mesh, 0.1, 10.0), [], LoadHistory(2.0, 12.0, 0.5))
    assert donned[TIME, None] == Extent(TIME, "s", 2.0, 12.0)
    assert donned[SHEAR, "top"].high == pytest.approx(0.2)
    assert donned[RATE, "deep"].high == pytest.approx(0.05)
    loaded = describe(held(mesh, 0.4, 30.0), [*donned.values()], LoadHistory(0.5, 14.0, 2.0))
    assert loaded[RATE, "top"].high == pytest.approx((0.8 - 0.2) / 0.5)
    assert loaded[PRESSURE, None].high == pytest.approx(30.0)
    (row,) = tested.find_outside(loaded.values())
    assert (row.quantity, row.share) == (PRESSURE, pytest.approx(1.0))
    less = describe(held(mesh, 0.1, 25.0), [*loaded.values()], LoadHistory(0.5, 16.0, 2.0))
    assert less[RATE, "top"].high == loaded[RATE, "top"].high  # it was strained as fast before
    level = axis.measure_level(np.array([[0.0, -90.0, 230.0]]))[0]
    assert (loaded[LEVEL, None].low, loaded[LEVEL, None].high) == pytest.approx((level, level))
    angles = axis.measure_angle(mesh.points[upper].mean(axis=1))
    expected = np.abs((angles + 180.0) % 360.0 - 180.0)
    assert loaded[ANGLE, None].high == pytest.approx(np.quantile(expected, 0.99), abs=8.0)


def test_directions_go_around_the_limb():
    """A quarter turn about its axis is 90 degrees, at every level."""
    body = limb()
    axis, middle = LimbAxis(body), body.skin.points.mean(axis=0)
    for z in (240.0, 290.0):
        turns = np.radians([0.0, 90.0, 180.0, 270.0])
        ring = np.column_stack([20 * np.cos(turns), 20 * np.sin(turns), np.full(4, z) - middle[2]]) + middle
        steps = np.diff(axis.measure_angle(ring)) % 360.0
        assert np.allclose(steps, 90.0, atol=6.0) or np.allclose(steps, 270.0, atol=6.0)
        np.testing.assert_allclose(np.diff(axis.measure_level(ring)), 0.0, atol=1e-9)


def test_a_hold_of_hours_ends_once():
    """Not again in the steps of a load that comes on within seconds of its end."""
    up, hours = np.array([0.0, 0.0, 1.0]), 8 * 3600.0
    load = Load("stance", 800.0 * up, np.zeros(3), np.zeros(3), 1.0, 2.0)
    fit = SocketFit(np.zeros(3), up, np.array([0.0, -1.0, 0.0]), hold_s=hours, loads=[load])
    ends = [
        (time, name) for time in build_socket_steps(fit, 0.01).times or () for name in fit.find_held(time)
    ]
    assert ends == [(pytest.approx(2.0 + hours), "donning"), (pytest.approx(5.0 + hours), "stance")]
