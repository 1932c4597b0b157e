"""Rigid bodies that turn, that forces drive, and several of them at once."""

from dataclasses import replace

import numpy as np
import pytest
from blocks import (
    OVERLAP,
    TUBE,
    block,
    check_derivatives,
    check_press_fit,
    check_sensitivities,
    punch,
)
from scipy.spatial.transform import Rotation

from limbfit.errors import ProblemError
from limbfit.fe import (
    History,
    Indenter,
    Motion,
    OgdenQLV,
    OpenSurface,
    Problem,
    RigidBody,
    StepControl,
    Support,
    System,
    solve,
)
from limbfit.fe.contact.friction import Coulomb
from limbfit.fe.contact.tool import Pose
from limbfit.fe.motion import Drives
from limbfit.fe.solution.control import schedule_steps
from limbfit.fe.system import Increment

TOOL = Indenter("square", 20.0, 3.0, centre=(0.3, -0.4, 2.0), axis=(0.1, 0.05, -1.0))
FREE = Motion(np.array([0.0, 20.0]), np.zeros((2, 6)), (True,) * 6)
STILL = History(np.array([0.0, 2.0]), np.zeros(2))


def test_a_pose_is_a_rotation_about_the_pivot_and_a_move():
    coordinates = np.array([0.5, -0.2, 3.0, 0.3, -0.2, 0.6])
    pose = Pose(TOOL, np.array([5.0, 3.0, 20.0]), coordinates)
    turn = Rotation.from_rotvec(coordinates[3:] @ TOOL.frame)
    np.testing.assert_allclose(pose.rotation, turn.as_matrix(), atol=1e-14)
    centre = pose.pivot + coordinates[:3] @ TOOL.frame + turn.apply(np.asarray(TOOL.centre) - pose.pivot)
    np.testing.assert_allclose(pose.body.centre, centre, atol=1e-12)
    np.testing.assert_allclose(pose.body.frame, TOOL.frame @ turn.as_matrix().T, atol=1e-12)


@pytest.mark.parametrize("turned", [0.0, 0.4])
def test_derivatives_of_a_pose_are_differences(turned):
    w, h = turned * np.array([0.3, -0.5, 0.8]), 1e-5

    def pose(w):
        return Pose(TOOL, np.zeros(3), np.array([0.0, 0.0, 0.0, *w]))

    for k, unit in enumerate(np.eye(3)):
        ahead, back = pose(w + h * unit), pose(w - h * unit)
        np.testing.assert_allclose(pose(w).slopes[k], (ahead.rotation - back.rotation) / (2 * h), atol=1e-9)
        np.testing.assert_allclose(pose(w).bends[k], (ahead.slopes - back.slopes) / (2 * h), atol=1e-9)


@pytest.mark.parametrize(("mu", "turned"), [(0.0, 0.0), (0.3, 0.15)])
def test_forces_and_stiffness_of_a_free_body_are_derivatives_of_its_energy(mu, turned):
    """All six coordinates unknown: residual, tangent and the border of the matrix, moved and turned."""
    body = RigidBody(TOOL, punch("tet10", 4, 1).contact_faces, FREE, mu, pivot=(3.0, 2.0, 12.0))
    problem = punch("tet10", 4, 1, indenter=None, bodies=(body,))
    system, laws = System(problem), problem.build_laws()
    rest, rng = np.zeros((*system.weights.shape, 6)), np.random.default_rng(1)
    u = np.zeros((system.rows, 3))
    u[: system.nodes] = 0.01 * rng.normal(size=(system.nodes, 3)) * ~system.supported[: system.nodes]
    u[system.nodes :] = [[0.2, -0.1, 3.6], [0.6 * turned, -0.4 * turned, turned]]
    u[system.nodes + 1] *= 10.0  # mm per radian: half the width
    d = rng.normal(size=u.shape) * ~system.supported
    loads = np.array([[0.1, 0.2, -0.4, 3.0, -2.0, 5.0]])
    drives, grips = Drives(loads, np.ones((1, 6), dtype=bool), np.ones(1)), ()
    if mu:
        before = u - 0.05 * d
        grip = Coulomb.begin(mu, system.bodies.first_body.surface).advance(
            system.bodies.tools(before, drives)[0], None
        )
        grips = (grip.renew(system.bodies.tools(u, drives)[0]),)
        assert grips[0].held.any()

    def at(u):
        return system.evaluate(u, laws, Increment(0.0, 0.0, np.zeros(2), rest, 0.5, drives, grips))

    here, (K_d, change) = check_derivatives(system, at, u, d)
    assert here.contact_area > 10.0
    border = np.abs(change[-6:]).max()
    np.testing.assert_allclose(K_d[-6:], change[-6:], atol=1e-5 * border)


CONTROL = StepControl(load_steps=5, unload_steps=5, tolerance=1e-9, penalty=200.0, hold_penalty=True)
TIMES = np.array([0.0, 2.0, 4.0])


def test_force_control_gives_back_the_displacement():
    """The forces of a run under displacement, stated as forces at its steps: its displacements come back.

    Both with stresses that are linear in a step: a quadratic course begins anew where what drives turns.
    """
    problem = punch("hex8", 2, 1, history=History(TIMES, np.array([0.0, 4.0, 4.0])))
    linear = replace(CONTROL, stress="linear")
    driven = solve(problem, linear)
    history = History(driven.times, force=driven.force)
    steps = replace(linear, times=tuple(driven.times[1:]))
    found = solve(replace(problem, history=history), steps)
    assert found.completed, found.reason
    np.testing.assert_allclose(found.force, driven.force, atol=1e-7 * driven.force.max())
    np.testing.assert_allclose(found.displacement, driven.displacement, atol=1e-4 * 4.0)


def test_a_held_force_creeps_and_its_displacement_has_sensitivities():
    problem = punch("hex8", 2, 1, history=History(TIMES, force=np.array([0.0, 2.0, 2.0])))
    centre = check_sensitivities(problem, CONTROL, 1e-3, response="displacement")
    loaded = centre.times >= 2.0 - 1e-9
    assert (np.diff(centre.displacement[loaded]) > 0.0).all()
    assert centre.displacement[-1] > 1.05 * centre.displacement[loaded][0]
    np.testing.assert_allclose(centre.force[loaded], 2.0, rtol=1e-6)


def test_tissue_that_comes_back_under_no_force_moves_the_indenter_between_steps_too():
    history = History(np.array([0.0, 1.0, 2.0, 6.0]), force=np.array([0.0, 2.0, 0.0, 0.0]))
    problem, control = punch("hex8", 2, 1, history=history), replace(CONTROL, tolerance=1e-5)
    found = solve(problem, control, sensitivities=True)
    left = found.displacement[found.times == 2.0][0]
    assert 0.0 < found.displacement[-1] < 0.3 * left
    np.testing.assert_allclose(found.displacement_at(found.times), found.displacement, rtol=1e-9)
    between = found.displacement_at(np.linspace(2.0, 6.0, 50))
    assert ((between > 0.0) & (between < 1.05 * left)).all()
    slopes = found.response_sensitivity_at(found.times)
    np.testing.assert_allclose(slopes, found.displacement_sensitivity, rtol=1e-6)


def test_a_force_that_acts_from_the_beginning_deforms_tissue_before_it_relaxes():
    """At time 0 relaxing tissue is as stiff as elastic tissue of its instantaneous modulus."""
    problem = punch("hex8", 2, 1, history=History(np.array([0.0, 4.0]), force=np.array([1.0, 1.0])))
    sudden = {
        name: OgdenQLV(law.c * (1.0 + law.gamma), law.m, 0.0, 1.0, law.kappa_ratio / (1.0 + law.gamma))
        for name, law in problem.materials.items()
    }
    control = replace(CONTROL, tolerance=1e-6)
    elastic, relaxing = solve(problem.with_materials(sudden), control), solve(problem, control)
    assert elastic.displacement[0] == pytest.approx(elastic.displacement[-1], rel=1e-5)
    assert relaxing.displacement[0] == pytest.approx(elastic.displacement[0], rel=1e-5)
    fine = (*np.geomspace(1e-4, 0.05, 8), *np.linspace(0.1, 4.0, 25))
    followed = solve(problem, replace(control, times=fine))
    expected = followed.displacement_at(relaxing.times)
    np.testing.assert_allclose(relaxing.displacement[:4], expected[:4], atol=5e-3 * expected[-1])


def test_a_body_goes_over_from_displacement_to_force():
    """Pressed 3 mm and held, then left with the force that it had at the end: it creeps on from there."""
    problem = punch("hex8", 2, 1)
    pressed = Motion.of([0.0, 1.0, 3.0], z=[0.0, 3.0, 3.0])
    tool = RigidBody(problem.indenter.move(1.0), problem.contact_faces, pressed)
    control = replace(CONTROL, times=(0.25, 0.5, 0.75, 1.0, 2.0, 3.0), tolerance=1e-8)
    still = History([0.0, 3.0], [0.0, 0.0])
    plain = solve(replace(problem, indenter=None, bodies=(tool,), history=still), control)
    force = plain.reactions[-1, 0, 2]
    left = Motion.of([0.0, 1.0, 2.0], force={"z": [force, force, 0.0]})
    both = replace(tool, motion=pressed.then(left))
    history = History([0.0, 5.0], [0.0, 0.0])
    control = replace(control, times=(*control.times, 3.2, 3.5, 4.0, 4.5, 4.9))
    found = solve(replace(problem, indenter=None, bodies=(both,), history=history), control)
    assert found.completed, found.reason
    np.testing.assert_allclose(found.coordinates[:7, 0, 2], plain.coordinates[:, 0, 2], atol=1e-4)
    np.testing.assert_allclose(found.reactions[:7, 0, 2], plain.reactions[:, 0, 2], rtol=1e-4)
    np.testing.assert_allclose(found.reactions[7:10, 0, 2], force, rtol=1e-6)
    assert (np.diff(found.coordinates[6:10, 0, 2]) > 0.0).all()
    assert (np.diff(found.coordinates[9:, 0, 2]) < 0.0).all()  # unloaded, it comes out again
    left = Motion.of([0.0, 1.0, 2.0], force={"z": [np.nan, force, 0.0]})  # the force that holds it then
    opened = replace(tool, motion=pressed.then(left))
    again = solve(replace(problem, indenter=None, bodies=(opened,), history=history), control)
    np.testing.assert_allclose(again.reactions[:, 0, 2], found.reactions[:, 0, 2], rtol=1e-3, atol=1e-9)
    with pytest.raises(ProblemError, match="leaves open with which force it begins"):
        solve(replace(problem, indenter=None, bodies=(replace(tool, motion=left),), history=history))
    with pytest.raises(ProblemError, match="no step ends at 3 s, where a body's force is taken over"):
        solve(
            replace(problem, indenter=None, bodies=(opened,), history=history),
            replace(control, times=(1.0, 2.0, 3.2)),
        )


def test_a_force_that_is_taken_over_depends_on_the_parameters():
    """Of a stiffer block: what held the tool was larger, and the force begins with that."""
    problem = punch("hex8", 2, 1)
    pressed = Motion.of([0.0, 1.0, 2.0], z=[0.0, 3.0, 3.0])
    left = Motion.of([0.0, 1.0, 1.5], force={"z": [np.nan, 0.5, 0.5]})
    tool = RigidBody(problem.indenter.move(1.0), problem.contact_faces, pressed.then(left), 0.4)
    problem = replace(problem, indenter=None, bodies=(tool,), history=History([0.0, 3.5], [0.0, 0.0]))
    control = replace(CONTROL, times=(0.5, 1.0, 2.0, 2.5, 3.0, 3.5), penalty=20.0)
    centre = solve(problem, control, sensitivities=True, store="all")
    slopes = np.array([state.bodies[0, 2] for state in centre.states])
    for region, name in (("muscle", "c"), ("skin", "tau")):
        law, ways = problem.materials[region], []
        for sign in (1.0, -1.0):
            other = replace(law, **{name: getattr(law, name) * (1.0 + 1e-3 * sign)})
            changed = problem.with_materials({**problem.materials, region: other})
            ways.append(solve(changed, control, warm_start=centre).coordinates[1:, 0, 2])
        difference = (ways[0] - ways[1]) / (2e-3 * getattr(law, name))
        slope = slopes[:, list(problem.parameter_names).index((region, name))]
        np.testing.assert_allclose(slope, difference, atol=1e-3 * np.abs(difference).max())


def test_the_force_of_a_body_that_turned_with_friction_has_derivatives():
    """Along the axis at its start, whereto its anchors turn with it."""
    problem = punch("hex8", 2, 1)
    ball = Indenter("sphere", 20.0, centre=(0.0, 0.0, 0.05), axis=(0, 0, -1))
    motion = Motion.of(
        [0.0, 1.0, 2.0], z=[0.0, 2.5, 2.5], x=[0, 0, 1.5], turn_x=[0, 0, 0.5], turn_y=[0, 0, 0.4]
    )
    body = RigidBody(ball, problem.contact_faces, motion, 0.3, pivot=(0.0, 0.0, 10.0))
    problem = replace(problem, indenter=None, bodies=(body,), history=STILL)
    control = replace(CONTROL, times=(0.5, 1.0, 1.5, 2.0))
    check_sensitivities(problem, control, 1e-4, ("muscle", "c"))


def test_steps_go_on_for_what_moves_when_the_indenter_has_left():
    """A second body that comes down meanwhile is met; what supports move is stepped through as asked."""
    up = History(np.array([0.0, 2.0, 4.0]), np.array([0.0, 2.0, 0.0]))
    problem = punch("hex8", 2, 1, history=up)
    pin = Indenter("square", 16.0, 1.0, axis=(0, 0, -1), centre=(20.0, 18.0, 0.0))
    down = Motion.of([0.0, 3.5, 3.8, 4.0], z=[0.0, 0.0, 2.0, 0.0])
    steps = StepControl(load_steps=3, unload_steps=5)
    other = RigidBody(pin, problem.contact_faces, down, name="pin")
    found = solve(replace(problem, bodies=(other,)), steps)
    assert found.completed, found.reason
    assert np.isclose(found.times[:, None], down.times[1:]).any(axis=0).all()
    assert found.reactions[:, 1, 2].max() > 0.2
    top = Support(np.unique(problem.contact_faces), 2, -1.0)
    pulled = solve(
        replace(problem, indenter=None, contact_faces=problem.contact_faces[:0], supports=(top,)), steps
    )
    assert (pulled.times > 2.0).sum() == len(schedule_steps(up, steps)) - 3


def test_a_free_plate_lies_down_on_what_is_askew():
    """A plate pressed by a force and free to turn rests without moment, turned towards the softer side."""
    problem = punch("hex8", 2, 1)
    motion = Motion.of([0.0, 1.0, 2.0], force={"z": [0.0, 2.0, 2.0], "turn_x": 0.0, "turn_y": 0.0})
    plate = RigidBody(
        Indenter("square", 20.0, centre=(22.0, 0.0, 0.0), axis=(0, 0, -1)), problem.contact_faces, motion
    )
    free = replace(
        problem, indenter=None, bodies=(plate,), history=History(np.array([0.0, 2.0]), np.zeros(2))
    )
    found = solve(free, replace(CONTROL, times=(0.5, 1.0, 2.0), tolerance=1e-7))
    assert found.completed, found.reason
    assert found.reactions[-1, 0, 2] == pytest.approx(2.0, rel=1e-4)
    np.testing.assert_allclose(found.reactions[-1, 0, 3:5], 0.0, atol=1e-4)
    turn = found.coordinates[-1, 0, 3:] @ plate.shape.frame
    assert abs(turn[1]) > 10.0 * abs(turn[0])
    assert abs(turn[1]) > 0.01
    # the unbacked edge of the block at x = 30 gives way more
    deepest = np.cross(turn, [1.0, 0.0, 0.0])
    assert deepest[2] < 0.0


def test_two_bodies_are_each_other_s_mirror():
    """Two equal bodies on either side press as two halves of a symmetric problem; one of them by force."""
    problem = punch("hex8", 4, 1)
    left, right = (Indenter("sphere", 16.0, centre=(x, 0.0, 0.0), axis=(0, 0, -1)) for x in (-13.0, 13.0))
    times = [0.0, 1.0, 2.0]
    down = RigidBody(left, problem.contact_faces, Motion.of(times, z=[0.0, 3.0, 3.0]), name="left")
    both = tuple(replace(down, shape=shape) for shape in (left, right))
    control = replace(CONTROL, times=(0.25, 0.5, 0.75, 1.0, 1.5, 2.0), tolerance=1e-8, stress="linear")
    found = solve(replace(problem, indenter=None, bodies=both, history=STILL), control)
    assert found.completed, found.reason
    np.testing.assert_allclose(found.reactions[:, 0, 2], found.reactions[:, 1, 2], rtol=1e-6)
    alone = solve(replace(problem, indenter=None, bodies=both[:1], history=STILL), control)
    assert found.reactions[3, 0, 2] != pytest.approx(alone.reactions[3, 0, 2], rel=1e-3)
    force = Motion.of(found.times, force={"z": found.reactions[:, 1, 2]})
    mixed = (both[0], replace(both[1], motion=force))
    driven = solve(replace(problem, indenter=None, bodies=mixed, history=STILL), control)
    assert driven.completed, driven.reason
    np.testing.assert_allclose(driven.coordinates[:, 1, 2], found.coordinates[:, 1, 2], atol=1e-4 * 3.0)


def test_a_rotation_of_everything_changes_nothing():
    """Block, supports and tool turned together: the same forces."""
    problem = punch("hex8", 2, 1, history=History(TIMES, np.array([0.0, 3.0, 3.0])))
    plain = solve(problem, CONTROL)
    turn = Rotation.from_rotvec([0.4, -0.8, 1.1])
    tool = problem.indenter
    turned = replace(
        problem,
        mesh=replace(problem.mesh, points=turn.apply(problem.mesh.points)),
        indenter=replace(
            tool, centre=turn.apply(tool.centre), axis=turn.apply(tool.axis), edge=turn.apply(tool.frame[0])
        ),
    )
    np.testing.assert_allclose(solve(turned, CONTROL).force, plain.force, rtol=1e-6, atol=1e-8)


PUNCHED, SHORT = punch("hex8", 2, 1).contact_faces, Motion.of([0.0, 1.0])


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"history": History(TIMES, force=[0.0, 1.0, 0.0]), "indenter": None}, "not supports"),
        (
            {"bodies": (RigidBody(TOOL, np.zeros((0, 6), dtype=int), FREE, name="pin"),)},
            "contact faces of pin",
        ),
        ({"bodies": (RigidBody(TOOL, PUNCHED, SHORT, name="pin"),)}, "motion of pin ends at 1 s"),
    ],
)
def test_what_cannot_be_is_refused(change, said):
    with pytest.raises(ProblemError, match=said):
        solve(punch("hex8", 2, 1, **change), CONTROL)


def test_a_motion_is_told_what_is_wrong():
    with pytest.raises(ProblemError, match="no coordinate 'w'"):
        Motion.of([0.0, 1.0], w=1.0)
    with pytest.raises(ProblemError, match="by displacement and by force"):
        Motion.of([0.0, 1.0], z=1.0, force={"z": 1.0})
    with pytest.raises(ProblemError, match="one for each time"):
        Motion.of([0.0, 1.0], z=[1.0, 2.0, 3.0])
    with pytest.raises(ProblemError, match="displacement or one of force"):
        History(TIMES)


def test_an_open_surface_has_one_side():
    good = ring(20.0, 21.0, 4, 10.0)
    turned = good.faces.copy()
    turned[0] = turned[0, ::-1]
    with pytest.raises(ProblemError, match="do not agree on a side"):
        OpenSurface(good.points, turned)
    with pytest.raises(ProblemError, match="refer to points"):
        OpenSurface(good.points[:5], good.faces)


@pytest.mark.slow
def test_a_bar_under_a_held_force_creeps_as_the_closed_form():
    """Small strain, one Prony term: 1/E creeps as a standard linear solid in shear over a constant bulk."""
    mu, gamma, tau, seconds = 0.01, 2.0, 0.5, 0.05
    law = OgdenQLV(mu, 2.0, gamma, tau)
    lines = np.linspace(0.0, 10.0, 3)
    mesh = block("hex8", lines, lines, lines - 10.0)
    shear, bulk = law.shear_modulus, law.kappa_ratio * mu
    force = 1e-3 * 3.0 * shear * 100.0
    on = np.abs(mesh.points) < 1e-9
    planes = (Support(np.flatnonzero(on[:, 0]), 0), Support(np.flatnonzero(on[:, 1]), 1))
    planes += (Support(mesh.node_sets["bottom"], 2),)
    times = np.array([0.0, seconds, 3.0])
    plate = Indenter("square", 60.0, centre=(5.0, 5.0, 0.0), axis=(0, 0, -1), edge=(1, 0, 0))
    problem = Problem(
        mesh, {"skin": law, "muscle": law}, np.zeros(0, int), mesh.face_sets["top"], plate,
        History(times, force=np.array([0.0, force, force])), supports=planes,
    )  # fmt: skip
    creeping = seconds + (times[-1] - seconds) * (np.arange(1, 17) / 16) ** 2
    steps = (*np.linspace(0.0, seconds, 4)[1:], *creeping)
    found = solve(problem, StepControl(times=steps, penalty=1e6, hold_penalty=True, tolerance=1e-8))
    assert found.completed, found.reason

    def compliance(t):
        """Strain per stress after a step of stress, integrated over a ramp of ``seconds``."""
        slow = tau * (1.0 + gamma)
        ramped = slow / seconds * (np.exp(-(t - seconds) / slow) - np.exp(-t / slow))
        return (1.0 - gamma / (1.0 + gamma) * ramped) / (3.0 * shear) + 1.0 / (9.0 * bulk)

    held = found.times >= seconds - 1e-9
    expected = 10.0 * force / 100.0 * compliance(found.times[held])
    assert expected[-1] > 2.0 * expected[0]
    np.testing.assert_allclose(found.displacement[held], expected, rtol=5e-3)


def ring(radius: float, wide: float, n: int, length: float) -> OpenSurface:
    """A quarter of a rigid ring seen from inside, ``length`` mm long, and a cone as long before it."""
    angles = np.linspace(0.0, np.pi / 2, n + 1)
    rows = [(-length, radius), (0.0, radius), (length, wide)]
    points = np.array([(r * np.cos(a), r * np.sin(a), z) for z, r in rows for a in angles])
    quads = [(i * (n + 1) + j, i * (n + 1) + j + 1) for i in range(2) for j in range(n)]
    faces = [t for a, b in quads for t in ((a, a + n + 1, b), (b, a + n + 1, b + n + 1))]
    return OpenSurface(points, np.array(faces))


def test_distances_from_an_open_surface_are_those_of_its_triangles():
    """Behind the wall, where contact is: gradient and hessian by differences; nothing beyond the brim."""
    surface = ring(20.0, 21.0, 24, 10.0)
    rng, h = np.random.default_rng(0), 1e-6
    angle, height = rng.uniform(0.05, 1.5, 60), rng.uniform(-9.5, 9.5, 60)
    wall = np.where(height < 0.0, 20.0, 20.0 + height / 10.0)
    for off in (-0.8, 0.5):  # in the cavity, and in the wall
        radius = wall + off
        points = np.column_stack([radius * np.cos(angle), radius * np.sin(angle), height])
        values, slopes, bends = surface.local_distance(points)
        np.testing.assert_allclose(values, -off, atol=0.06)
        for i, d in enumerate(h * np.eye(3)):
            ahead, back = surface.local_distance(points + d), surface.local_distance(points - d)
            np.testing.assert_allclose((ahead[0] - back[0]) / (2 * h), slopes[:, i], atol=1e-4)
            np.testing.assert_allclose((ahead[1] - back[1]) / (2 * h), bends[..., i], atol=1e-3)
    beyond = np.array([[21.5 * np.cos(0.7), 21.5 * np.sin(0.7), 14.0]])
    assert np.isinf(surface.signed_distance(beyond)).all()


def test_a_press_fit_is_lames_and_comes_off_by_its_friction():
    """A rigid ring is pushed over a tube."""
    height = float(TUBE.points[:, 2].max())
    shape = ring(20.0 - OVERLAP, 20.0 + OVERLAP, 24, 4.0 * height).move(-4.5 * height)
    push = Motion.of([0.0, 1.0, 2.0], z=[0.0, 6.5 * height, 7.0 * height])
    check_press_fit(shape, push, (*np.linspace(0.0, 1.0, 21)[1:], 1.25, 1.5, 2.0))
