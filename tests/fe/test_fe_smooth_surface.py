"""Smooth surfaces as rigid bodies: their distances, their brim, and how they grow onto the tissue."""

import numpy as np
import pytest
from blocks import OVERLAP, TUBE, check_press_fit, punch, quarter_tube, sector

from limbfit.errors import ProblemError
from limbfit.fe import (
    History,
    Motion,
    OgdenQLV,
    RigidBody,
    SmoothSurface,
    StepControl,
    solve,
)

STILL = History(np.array([0.0, 2.0]), np.zeros(2))


def cup(radius: float, length: float, n: int = 64, rows: int = 24) -> tuple[np.ndarray, np.ndarray]:
    """Points and triangles of a round cup seen from inside: half a ball, then a pipe up to ``length``."""
    angles = np.linspace(0.0, 2.0 * np.pi, n, endpoint=False)
    turns = np.linspace(0.0, np.pi / 2, rows)[1:]
    profile = [(radius * np.sin(t), -radius * np.cos(t)) for t in turns]
    profile += [(radius, z) for z in np.linspace(0.0, length, rows)[1:]]
    points = [(0.0, 0.0, -radius), *((r * np.cos(a), r * np.sin(a), z) for r, z in profile for a in angles)]
    faces = [(0, 1 + j, 1 + (j + 1) % n) for j in range(n)]
    for i in range(len(profile) - 1):
        for j in range(n):
            a, b = 1 + i * n + j, 1 + i * n + (j + 1) % n
            faces += [(a, a + n, b), (b, a + n, b + n)]
    return np.array(points), np.array(faces)


def on_cup(radius: float, count: int) -> np.ndarray:
    """Points (count, 3) around a cup's pipe, ``radius`` off the axis."""
    rng = np.random.default_rng(0)
    angle, height = rng.uniform(0.0, 2.0 * np.pi, count), rng.uniform(2.0, 55.0, count)
    return np.column_stack([radius * np.cos(angle), radius * np.sin(angle), height])


CUP = cup(30.0, 60.0)
ROUND = SmoothSurface.of(*CUP, clear=CUP[0] * [1.15, 1.1, 1.0] - [0.0, 0.0, 3.0])


def test_a_smooth_distance_is_that_of_the_facets():
    """Facets of 64 to the round, 0.1 rad between two: off by at most spacing times angle over eight,
    0.025 mm, and by the facets' own 0.036 mm from the round."""
    facets = np.cos(np.pi / 64)  # the middle of a facet, over its corners
    for off in (-4.0, 0.0, 4.0):
        values, slopes, _ = ROUND.local_distance(on_cup(30.0 + off, 500))
        assert (values <= 0.025 - off).all()
        assert (values >= -off - 30.0 * (1.0 - facets) - 0.025).all()
        np.testing.assert_allclose(np.linalg.norm(slopes, axis=1), 1.0, atol=0.02)
    end = 34.0 * np.array([[0.0, 0.0, -1.0], [0.6, 0.0, -0.8]])
    np.testing.assert_allclose(ROUND.signed_distance(end), -4.0, atol=0.06)


@pytest.mark.parametrize("growth", [1.0, 0.4])
def test_derivatives_of_a_smooth_distance_are_differences(growth):
    """Behind the wall, and where it fades past the brim at a height of 60 mm."""
    surface, h = ROUND.grown(growth), 1e-5
    x = on_cup(33.0 + 4.0 * (1.0 - growth), 300)
    x[:200, 2] += 6.0
    values, slopes, bends = surface.local_distance(x)
    felt = np.isfinite(values) & (x[:, 2] < 60.0 + 3.9 * growth)
    assert (x[felt, 2] > 60.5).any()
    for d in range(3):
        ahead, back = (surface.local_distance(x + s * h * np.eye(3)[d]) for s in (1.0, -1.0))
        both = felt & np.isfinite(ahead[0]) & np.isfinite(back[0])
        slope = (ahead[0][both] - back[0][both]) / (2 * h)
        np.testing.assert_allclose(slope, slopes[both, d], atol=1e-7)
        bend = (ahead[1][both] - back[1][both]) / (2 * h)
        np.testing.assert_allclose(bend, bends[both, d], atol=1e-7)


def test_a_smooth_surface_fades_past_its_brim_and_beyond_its_reach():
    heights = np.array([55.0, 59.9, 62.0, 63.9, 64.5])
    gaps = ROUND.signed_distance(np.column_stack([np.full((5, 1), 31.0), np.zeros(5), heights]))
    np.testing.assert_allclose(gaps[:2], -1.0, atol=0.03)
    assert gaps[2] == pytest.approx(-0.5, abs=0.05)
    assert -1e-3 < gaps[3] < 0.0
    assert np.isinf(gaps[4])
    assert np.isinf(ROUND.signed_distance(np.array([[0.0, 0.0, 20.0], [60.0, 0.0, 20.0]]))).all()


def test_a_surface_grows_from_its_clear_shape_to_the_final_one():
    x = on_cup(31.0, 60)
    angle = np.arctan2(x[:, 1], x[:, 0])
    clear = SmoothSurface.of(CUP[0] * [1.15, 1.1, 1.0] - [0.0, 0.0, 3.0], CUP[1], spacing=1.5)
    np.testing.assert_allclose(ROUND.grown(0.0).signed_distance(x), clear.signed_distance(x), atol=0.05)
    half, slopes, _ = ROUND.grown(0.5).local_distance(x)
    ends = [ROUND.grown(share).signed_distance(x) for share in (0.0, 1.0)]
    np.testing.assert_allclose(half, np.mean(ends, axis=0), atol=1e-12)
    assert (ends[0] > 0.0).all()
    assert (ends[1] < 0.0).all()
    length = np.linalg.norm(slopes, axis=1)
    assert length.min() > 0.97
    assert np.ptp(half[np.abs(np.sin(angle)) > 0.9]) < np.ptp(half)


def test_a_motion_grows_and_goes_on():
    grown = Motion.of([0.0, 2.0, 4.0], growth=[0.0, 1.0, 1.0])
    both = grown.then(Motion.of([0.0, 1.0], force={"z": [0.0, 5.0]}))
    assert [both.at(t)[2] for t in (0.0, 0.5, 2.0, 4.0, 4.5)] == [0.0, 0.25, 1.0, 1.0, 1.0]
    assert list(grown.turns) == [2.0]
    assert not Motion.of([0.0, 1.0], z=1.0).grows
    for growth, said in (([0.0, 1.0], "one share for each"), ([0.0, 2.0, 1.0], "between 0 and 1")):
        with pytest.raises(ProblemError, match=said):
            Motion.of([0.0, 2.0, 4.0], growth=growth)


def test_what_cannot_grow_is_refused():
    problem = punch("tet10", 2, 1)
    growing = Motion.of([0.0, 20.0], growth=[0.0, 1.0])
    body = RigidBody(problem.indenter, problem.contact_faces, growing)
    with pytest.raises(ProblemError, match="does not grow"):
        solve(punch("tet10", 2, 1, bodies=(body,)))
    points, faces = CUP
    with pytest.raises(ProblemError, match="clear shape has points"):
        SmoothSurface.of(points, faces, clear=points[1:])
    with pytest.raises(ProblemError, match="do not agree on a side"):
        SmoothSurface.of(points, np.concatenate([faces, faces[:1, ::-1]]))


def pipe(radius: float, length: float, n: int = 480) -> tuple[np.ndarray, np.ndarray]:
    """Points and triangles of a quarter of a pipe seen from inside, ``length`` mm to both sides."""
    angles = np.linspace(0.0, np.pi / 2, n + 1)
    rows = np.linspace(-length, length, 9)
    points = np.array([(radius * np.cos(a), radius * np.sin(a), z) for z in rows for a in angles])
    corners = [(i * (n + 1) + j, i * (n + 1) + j + 1) for i in range(8) for j in range(n)]
    return points, np.array([t for a, b in corners for t in ((a, a + n + 1, b), (b, a + n + 1, b + n + 1))])


@pytest.mark.slow
def test_a_press_fit_by_growth_is_lames_and_comes_off_by_its_friction():
    """A rigid pipe grows onto a tube, and is pulled."""
    height = float(TUBE.points[:, 2].max())
    final, faces = pipe(20.0 - OVERLAP, 2.0 * height)
    clear = pipe(20.02, 2.0 * height)[0]
    shape = SmoothSurface.of(final, faces, clear=clear, spacing=0.5, reach=2.0)
    growth = Motion.of([0.0, 1.0], growth=[0.0, 1.0]).then(Motion.of([0.0, 1.0], z=[0.0, 0.5]))
    # the mesh's facets are off the round
    times = (0.25, 0.5, 0.75, 1.0, 1.1, 1.25, 1.5, 2.0)
    check_press_fit(shape, growth, times, contact_rule="nodes")


def test_sensitivities_through_growth_equal_central_differences():
    """A cone grows onto a tube by 1 mm, and is pulled with friction: displacements and axial force by the
    parameters."""
    law = OgdenQLV(0.01, 4.0, 1.5, 0.4)
    mesh = sector(np.linspace(10.0, 20.0, 4), 6)
    height = float(mesh.points[:, 2].max())
    wide, faces = pipe(20.2, 4.0 * height, 60)
    final = wide * [0.95, 0.95, 1.0] * (1.0 + 0.002 * wide[:, 2:]) ** [1.0, 1.0, 0.0]
    shape = SmoothSurface.of(final, faces, clear=wide, reach=4.0)
    motion = Motion.of([0.0, 1.0], growth=[0.0, 1.0]).then(Motion.of([0.0, 1.0], z=[0.0, 0.3]))
    body = RigidBody(shape, mesh.face_sets["outside"], motion, 0.3)
    problem = quarter_tube(mesh, law, body)
    control = StepControl(
        times=(0.4, 0.7, 1.0, 1.4, 2.0), penalty=100.0, hold_penalty=True, penetration=1.0, tolerance=1e-9
    )
    centre = solve(problem, control, sensitivities=True, store="all")
    assert centre.completed, centre.reason
    change = 1e-4 * problem.parameters * np.random.default_rng(3).uniform(-1, 1, len(problem.parameters))

    def changed(sign):
        values = (problem.parameters + sign * change).reshape(-1, 4)
        laws = {name: OgdenQLV(*row) for name, row in zip(mesh.region_names, values)}
        return solve(problem.with_materials(laws), control, store="all")

    ahead, back = changed(1), changed(-1)
    force = 0.5 * (ahead.force - back.force)
    assert np.abs(force).max() > 0.0
    np.testing.assert_allclose(centre.force_sensitivity @ change, force, atol=1e-3 * np.abs(force).max())
    u = 0.5 * (ahead.states[-1].u - back.states[-1].u)
    slope = centre.states[-1].sensitivity @ change
    np.testing.assert_allclose(slope, u, atol=1e-3 * np.abs(u).max())
