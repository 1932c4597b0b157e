"""The pins that clamp a limb: where they are, what they do, and the indentation between them."""

from dataclasses import replace

import numpy as np
import pytest
from blocks import boundary

from limbfit import History, Indenter, OgdenQLV, Problem
from limbfit.errors import ProblemError
from limbfit.fe import StepControl, System, solve
from limbfit.indentation import build_clamping_pins, clamp_problem
from limbfit.mesh import Mesh
from limbfit.mesh.cells import SIX_TETS, build_boxes
from limbfit.study import ClampsTable
from tetrahedra import turn_upright

INNER, OUTER, LENGTH = 15.0, 45.0, 100.0  # mm
UP = np.array([0.0, 0.0, 1.0])


def pipe(radial: int = 3, around: int = 28, up: int = 10) -> Mesh:
    """Tissue around a rigid bone along z."""
    lines = np.linspace(INNER, OUTER, radial + 1), np.linspace(0.0, 2.0 * np.pi, around + 1)
    points, corners = build_boxes(*lines, np.linspace(0.0, LENGTH, up + 1))
    r, angle, z = points.T
    points = np.column_stack([r * np.cos(angle), r * np.sin(angle), z])
    _, first, number = np.unique(np.round(points, 6), axis=0, return_index=True, return_inverse=True)
    cells = number.ravel()[corners[:, SIX_TETS].reshape(-1, 4)]
    points, r = points[first], r[first]
    cells = turn_upright(points, cells)
    faces = boundary(cells, "tet4")
    skin = faces[(r[faces] > OUTER - 1e-6).all(axis=1)]
    sets = {"fixed_bone": np.flatnonzero(r < INNER + 1e-6)}
    return Mesh(points, cells, "tet4", np.zeros(len(cells), dtype=int), ("muscle",), sets, {"skin": skin})


def site(mesh: Mesh, axis: tuple[float, float, float] = (-1.0, 0.0, 0.0)) -> Problem:
    """An indentation by 4 mm from the x axis."""
    faces = mesh.face_sets["skin"]
    near = mesh.points[faces].mean(axis=1)[:, 0] > 0.6 * OUTER
    tool = Indenter("square", 20.0, 2.0, centre=(OUTER, 0.0, 0.5 * LENGTH), axis=axis)
    history = History(np.array([0.0, 4.0, 8.0]), np.array([0.0, 4.0, 0.0]))
    tissue = {"muscle": OgdenQLV(0.02, 4.0, 0.5, 0.5)}
    return Problem(mesh, tissue, mesh.held, faces[near], tool, history)


def pins_of(problem: Problem) -> dict[str, Indenter]:
    """The usual ones."""
    assert problem.indenter is not None
    skin = problem.mesh.face_sets["skin"]
    return build_clamping_pins(problem.mesh.points, skin, problem.indenter, UP, ClampsTable())


def test_eleven_of_fourteen_pins_clamp_all_around_but_beside_the_test_pin():
    problem = site(pipe())
    pins = pins_of(problem)
    assert len(pins) == 11
    axes = np.array([pin.frame[2] for pin in pins.values()])
    turns = np.degrees(np.arccos(axes @ [-1.0, 0.0, 0.0]))
    np.testing.assert_allclose(
        sorted(turns), sorted([360.0 / 14.0 * min(k, 14 - k) for k in range(2, 13)]), atol=1e-6
    )
    np.testing.assert_allclose(axes[:, 2], 0.0, atol=1e-12)


def test_stated_pins_are_where_they_are_stated():
    problem = site(pipe())
    table = ClampsTable(angles_degrees=(90.0, -90.0), levels_mm=(20.0, -10.0))
    bodies = clamp_problem(problem, UP, table).bodies
    centres = np.array([body.shape.centre for body in bodies])
    apart = centres - [0.0, 0.0, 0.5 * LENGTH]
    np.testing.assert_allclose(apart[:, 2], [20.0, -10.0], atol=1e-9)
    np.testing.assert_allclose(apart[:, 1], [OUTER, -OUTER], atol=1.0)  # a polygon, not a circle
    np.testing.assert_allclose(apart[:, 0], 0.0, atol=0.5)
    assert [body.name for body in bodies] == ["clamp at 90 degrees", "clamp at -90 degrees"]


@pytest.mark.parametrize(
    ("stated", "match"),
    [
        ({"angles_degrees": (12.0,)}, "clamp at 12 degrees would lie on the test pin, 9"),
        ({"angles_degrees": (90.0,), "levels_mm": (80.0,)}, "80 mm along the limb, misses the skin"),
        ({"levels_mm": (80.0,)}, "no clamping pin meets the skin"),
    ],
)
def test_a_pin_that_cannot_be_placed_is_refused(stated, match):
    with pytest.raises(ProblemError, match=f"clamps: .*{match}.*; give clamps.angles_degrees"):
        clamp_problem(site(pipe()), UP, ClampsTable(**stated))


def test_a_test_pin_along_the_limb_has_no_ring():
    problem = site(pipe(), axis=(-0.1, 0.0, -1.0))
    with pytest.raises(ProblemError, match="points along the limb"):
        pins_of(problem)


def clamped_pipe() -> Problem:
    """Pins of 8 N on stiff tissue, before the test pin touches it."""
    table = ClampsTable(force_N=8.0)
    problem = site(pipe())
    later = replace(problem, history=problem.history.delay(table.lead_s), touch_down_s=table.lead_s)
    return clamp_problem(later, UP, table)


def test_a_direction_is_taken_as_far_as_its_contact_is_foreseen():
    """A twentieth of a pin's width, 1 mm, wherever something moves; all where no force drives a body."""
    problem = clamped_pipe()
    for stated, bounded in ((problem, True), (site(problem.mesh), False)):
        system = System(stated)
        direction = np.zeros((system.rows, 3))
        for row in (-2, 0):  # the last pin, and a node
            for way, share in ((0.5, 1.0), (-4.0, 0.25), (160.0, 1.0 / 160.0)):
                direction[row, 1] = way
                found = system.bodies.compute_trusted_share(direction)
                assert found == pytest.approx(share if bounded else 1.0)
            direction[:] = 0.0


def test_the_bound_of_a_step_changes_no_equilibrium(monkeypatch):
    problem = clamped_pipe()
    control = StepControl(times=(1.0, 2.0), tolerance=1e-6, penalty=300.0, hold_penalty=True)
    bounded = solve(problem, control, store="none")
    monkeypatch.setattr("limbfit.fe.bodies.TRUSTED_MOVE", np.inf)
    free = solve(problem, control, store="none")
    assert bounded.completed
    assert free.completed
    assert (bounded.coordinates[-1, 1:, 2] > 1.0).all()
    np.testing.assert_allclose(bounded.coordinates[-1], free.coordinates[-1], atol=1e-5)
    np.testing.assert_allclose(bounded.reactions[-1, 1:, 2], 8.0, rtol=1e-5)


@pytest.mark.slow
def test_a_clamped_limb_bulges_between_the_pins_and_is_indented_from_there():
    problem, control = site(pipe()), StepControl(load_steps=4, unload_steps=3)
    bare = solve(problem, control)
    table = ClampsTable(force_N=8.0, settling_s=2.0)
    begun = table.lead_s
    later = replace(problem, history=problem.history.delay(begun), touch_down_s=begun)
    found = solve(clamp_problem(later, UP, table), control)
    assert found.completed, found.reason
    after = found.times > begun * (1 + 1e-9)
    assert not found.force[~after].any()
    np.testing.assert_allclose(found.reactions[after, 1:, 2], 8.0, rtol=1e-3)
    moved = (found.coordinates[:, 0, 2] - found.displacement)[after]
    np.testing.assert_allclose(moved, moved[0], atol=1e-9)
    assert moved[0] < -0.1  # outwards: the tissue has to go somewhere
    assert (found.coordinates[after, 1:, 2] > 0.2).all()
    assert found.force_at([begun + 4.0])[0] == pytest.approx(bare.peak_force, rel=0.1)  # of tissue this stiff
