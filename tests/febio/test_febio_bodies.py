"""Rigid bodies of any motion, both ways: read from an input, written, and read back with the same forces."""

from dataclasses import replace

import numpy as np
import pytest
from febfiles import FEB, back, changed, export, read_rows, written

from limbfit.bench.timing import build_punched_block
from limbfit.errors import ProblemError
from limbfit.fe import (
    History,
    Indenter,
    Motion,
    NeoHookean,
    OpenSurface,
    Pressure,
    RigidBody,
    SmoothSurface,
    StepControl,
    Support,
    solve,
)
from limbfit.febio import (
    FebSettings,
    read_feb,
    read_log,
    run_feb,
    to_problem,
    turn_to_indenter_frame,
)
from reference import REFERENCE, recorded

STEPS = StepControl(times=(0.5, 1.0, 1.5, 2.0), stress="linear", penalty=20.0, penetration=1.0)
SETTINGS = FebSettings(steps=STEPS, force_file="forces.txt")
TIMES, END = [0.0, 1.0, 2.0], History(np.array([0.0, 2.0]), np.zeros(2))
SIDE = np.array([[x, y, 0.2] for x in (-8.0, 0.0, 8.0) for y in (-8.0, 8.0)])
# Four triangles, counter-clockwise seen from below.
SHEET = OpenSurface(SIDE, np.array([[0, 1, 2], [1, 3, 2], [2, 3, 4], [3, 5, 4]]))


def block(divisions=4, **changes):
    problem = build_punched_block("hex8", divisions)
    soft = {name: NeoHookean(0.006, kappa_ratio=100.0) for name in ("skin", "muscle")}
    return replace(problem.with_materials(soft), indenter=None, history=END, **changes)


def sheet(motion, **changes):
    faces = build_punched_block("hex8", 4).mesh.face_sets["skin"]
    return RigidBody(SHEET, faces, motion, 0.3, pivot=(1.0, 2.0, 4.0), name="sheet", **changes)


MOTIONS = {
    "moved": Motion.of(TIMES, x=[0.0, 0.0, 2.0], z=[0.0, -1.5, -1.5]),
    "turned": Motion.of(TIMES, z=[0.0, -1.5, -1.5], turn_y=[0.0, 0.0, 0.1]),
    "pressed": Motion.of(TIMES, x=[0.0, 0.0, 1.0], force={"z": [0.0, -0.5, -0.5]}),
    "tipped": Motion.of(TIMES, z=[0.0, -1.5, -1.5], force={"turn_x": [0.0, 0.0, 4.0]}),
    "let go": Motion.of(TIMES[:2], z=[0.0, -1.5]).then(Motion.of([0.0, 1.0], force={"z": [-0.6, -0.2]})),
}


@pytest.mark.parametrize("case", MOTIONS)
def test_a_body_is_read_back_as_it_was(tmp_path, case):
    """An open sheet with friction, beside a pressure: every number, and hence the forces (of two of them).

    It comes back with FEBio's law of sticking, in the place of which the forces are taken with limbfit's.
    """
    problem = block(bodies=(sheet(MOTIONS[case]),))
    problem = replace(
        problem,
        supports=(Support(problem.fixed[:3], 1),),
        pressures=(Pressure(problem.mesh.face_sets["skin"][:4], [0.0, 1.5, 2.0], [0.0, 1e-3, 0.0]),),
    )
    found, _ = back(problem, tmp_path, SETTINGS)
    assert found.indenter is None
    (mine,), (theirs,) = problem.bodies, found.bodies
    assert (theirs.name, theirs.friction, theirs.sticking) == ("sheet", 0.3, "stepwise")
    np.testing.assert_array_equal(theirs.pivot, mine.pivot)
    np.testing.assert_array_equal(theirs.faces, mine.faces)
    np.testing.assert_array_equal(theirs.shape.points[theirs.shape.faces], SIDE[SHEET.faces])
    # What a force drives from the beginning is moved in the first step.
    for t in (0.6, 1.0, 1.3, 2.0) if mine.motion.forced[0].any() else (0.0, 0.4, 1.0, 1.3, 2.0):
        (values, forced, _), (expected, under, _) = theirs.motion.at(t), mine.motion.at(t)
        np.testing.assert_allclose(values, expected, atol=1e-14)
        np.testing.assert_array_equal(forced, under)
    (pressed,) = found.pressures
    np.testing.assert_array_equal(pressed.faces, problem.pressures[0].faces)
    assert [pressed.at(t) for t in (0.7, 1.8)] == pytest.approx([7e-4 / 1.5, 4e-4])
    if case not in ("turned", "pressed"):
        return
    alike = replace(found, bodies=(replace(theirs, sticking="anchored"),))
    runs = [solve(one, STEPS, store="none") for one in (problem, alike)]
    assert runs[0].completed, runs[0].reason
    assert np.abs(runs[0].reactions).max() > 0.1
    size = np.abs(runs[0].reactions).max()
    np.testing.assert_allclose(runs[1].reactions, runs[0].reactions, atol=3e-4 * size)
    np.testing.assert_allclose(runs[1].coordinates, runs[0].coordinates, atol=1e-4)


def test_several_bodies_push_as_hard_when_read_back(tmp_path):
    """A punch under a force, and a ball with friction that is dragged: their facets are all that differs."""
    faces = block(6).contact_faces
    down = History(np.array([0.0, 1.0, 2.0]), force=np.array([0.0, 1.5, 1.0]))
    punch = Indenter("square", 12.0, 2.0, (-10.0, 0.0, 0.3), (0.0, 0.0, -1.0), edge=(1.0, 0.0, 0.0))
    ball = Indenter("sphere", 16.0, centre=(14.0, 0.0, 0.3), axis=(0.0, 0.0, -1.0), edge=(1.0, 0.0, 0.0))
    dragged = RigidBody(ball, faces, Motion.of(TIMES, x=[0.0, 0.0, 1.0], z=[0.0, 2.0, 2.0]), 0.4, name="ball")
    problem = replace(block(6, bodies=(dragged,)), indenter=punch, history=down, start="as-given")
    found, _ = back(problem, tmp_path, SETTINGS)
    assert [body.name for body in found.rigid_bodies] == ["indenter", "ball"]
    assert [body.friction for body in found.rigid_bodies] == ["frictionless", 0.4]
    one, other = (solve(p, STEPS, store="none") for p in (problem, found))
    assert one.completed
    assert other.completed
    forces, depths = [], []
    for run in (one, other):
        kept = [int(np.abs(run.times - t).argmin()) for t in STEPS.times]  # others were cut
        frames = [body.shape.frame for body in run.problem.rigid_bodies]
        forces.append(np.einsum("nbi,bij->nbj", run.reactions[kept, :, :3], frames))
        depths.append(run.coordinates[kept, 0, 2])
    assert abs(forces[0][-1, 1, 0]) > 0.05  # the ball is held back
    np.testing.assert_allclose(forces[1], forces[0], atol=0.02 * np.abs(forces[0]).max())
    np.testing.assert_allclose(depths[1], depths[0], atol=0.02 * depths[0].max())


def test_the_table_of_a_body_that_turns(tmp_path):
    """Place, rotation vector, force and moment about the centre of mass, which is not where it is pressed."""
    text = export(block(bodies=(sheet(MOTIONS["turned"]),)), tmp_path)
    table = "x;y;z;thx;thy;thz;Fx;Fy;Fz;Mx;My;Mz"
    nodes = '<node_data data="x;y;z" file="nodes.txt" delim=","></node_data></logfile>'
    text = text.replace("Fx;Fy;Fz;x;y;z", table).replace("</logfile>", nodes)
    run = run_feb(written(tmp_path, text, "asked.feb"), tmp_path / "out", **{"times": STEPS.times})
    assert run.result.completed
    log, nodes = read_log(tmp_path / "out" / "forces.txt"), read_log(tmp_path / "out" / "nodes.txt")
    np.testing.assert_allclose(log.values[-1, 0, :6], [1.0, 2.0, 2.5, 0.0, 0.1, 0.0], atol=1e-12)
    force, moment = log.values[-1, 0, 6:9], log.values[-1, 0, 9:]
    np.testing.assert_allclose(force, run.result.reactions[-1, 0, :3], rtol=1e-9)
    # Pressed at x = 0 on average and turned down at x > 0: about (1, 2, 2.5) the reaction turns it back.
    arm = moment[1] / -force[2]
    assert -8.0 - 1.0 < -arm < 8.0
    corner = nodes.values[-1, -1]
    c, s = np.cos(0.1), np.sin(0.1)
    x, z = SIDE[-1, 0] - 1.0, SIDE[-1, 2] - 4.0
    np.testing.assert_allclose(corner, [1.0 + c * x + s * z, 8.0, 2.5 - s * x + c * z], atol=1e-9)


def test_moments_are_about_the_centre_of_mass(tmp_path):
    """The same body with its centre elsewhere: the moment changes by the arm times the force."""
    tables = []
    for pivot in ((1.0, 2.0, 4.0), (-3.0, 5.0, 1.0)):
        body = replace(sheet(MOTIONS["moved"]), pivot=pivot)
        text = export(block(bodies=(body,)), tmp_path).replace("Fx;Fy;Fz;x;y;z", "Fx;Fy;Fz;Mx;My;Mz")
        run_feb(written(tmp_path, text, "asked.feb"), tmp_path / "out", times=(1.0, 2.0))
        tables.append(read_log(tmp_path / "out" / "forces.txt").values[-1, 0])
    np.testing.assert_allclose(tables[1][:3], tables[0][:3], rtol=1e-9)
    arm = np.array([4.0, -3.0, 3.0])  # from the second centre to the first
    change = np.cross(arm, tables[0][:3])
    np.testing.assert_allclose(tables[1][3:] - tables[0][3:], change, rtol=1e-7, atol=1e-9)


def test_a_pressure_alone_is_read_back(tmp_path):
    problem = block()
    faces = problem.mesh.face_sets["skin"][:9]
    problem = replace(problem, pressures=(Pressure(faces, TIMES, [0.0, 2e-3, 0.0]),))
    found, _ = back(problem, tmp_path, SETTINGS)
    np.testing.assert_array_equal(found.pressures[0].faces, faces)
    assert not found.rigid_bodies
    assert found.pressures[0].at(0.5) == pytest.approx(1e-3)


def test_a_force_between_the_axes_beside_a_move_is_refused_and_can_be_turned(tmp_path):
    problem = build_punched_block("tet4", 4)
    oblique = replace(problem.indenter, axis=(0.1, 0.0, -1.0))
    across = np.array([[0.0, 0.0], [0.5, 0.0]])
    history = History(np.array([0.0, 2.0]), force=np.array([0.0, 1.0]), across=across)
    faces = problem.contact_faces
    problem = replace(problem, indenter=oblique, history=history)
    with pytest.raises(ProblemError, match=r"between x, y and z.*turn_to_indenter_frame"):
        export(problem, tmp_path)
    ball = RigidBody(replace(oblique, centre=(5.0, 4.0, 1.0)), faces, history.motion, name="b")
    turned = turn_to_indenter_frame(replace(problem, bodies=(ball,)))
    points = problem.mesh.points[:50]
    before = [body.shape.signed_distance(points) for body in (problem.rigid_bodies[0], ball)]
    after = [body.shape.signed_distance(turned.mesh.points[:50]) for body in turned.rigid_bodies]
    np.testing.assert_allclose(after, before, atol=1e-9)
    found, _ = back(turned, tmp_path, SETTINGS)
    assert [body.motion.free.tolist() for body in found.rigid_bodies] == [
        [False, False, True] + 3 * [False]
    ] * 2


TWICE = Motion.of(TIMES, turn_x=[0.0, 0.1, 0.1], turn_y=[0.0, 0.0, 0.1])
NAMED = "".join(f"<R{x}_dof>1</R{x}_dof>" for x in "xyzuvw")


def test_turns_that_febio_adds_up_another_way_are_refused(tmp_path):
    with pytest.raises(ProblemError, match="sheet: a turn about several axes"):
        export(block(bodies=(sheet(TWICE),)), tmp_path)
    text = export(block(bodies=(sheet(MOTIONS["turned"]),)), tmp_path)
    more = '<rigid_bc type="rigid_rotation"><rb>sheet</rb><dof>Ru</dof><value lc="1">1</value></rigid_bc>'
    with pytest.raises(
        ProblemError, match=r"line \d+: the rigid body 'sheet' turns about more than one axis"
    ):
        to_problem(read_feb(written(tmp_path, text.replace("</Rigid>", more + "</Rigid>"))))


REFUSED = {
    "follows": (
        lambda text: changed(text, "<load_type>LOAD<", "<load_type>FOLLOW<"), "a force that follows the body",
    ),
    "relative": (
        lambda text: changed(text, "</load_type><relative>0", "</load_type><relative>1"),
        "relative displacements",
    ),
    "held after": (
        lambda text: changed(text, r"(?s)(<step id=\"2\">.*?</Rigid>)", lambda m: m[1] + THIRD),
        "the rigid body 'sheet' is held in Rz after it was free",
    ),
    "other friction": (
        lambda text: changed(text, "</Contact>", SECOND + "</Contact>"),
        "the contacts of the rigid body 'sheet' differ",
    ),
    "conditions of steps": (
        lambda text: changed(text, r"<step id=\"1\">", '<step id="1"><Boundary/>'),
        "only <Control> and <Rigid>",
    ),
}  # fmt: skip
THIRD = (
    '</step><step id="3"><Control><time_steps>1</time_steps><step_size>1</step_size></Control><Rigid>'
    f'<rigid_bc type="rigid_fixed"><rb>sheet</rb>{NAMED}</rigid_bc></Rigid>'
)
SECOND = '<contact type="sliding-elastic" surface_pair="sheet_contact"><fric_coeff>0.1</fric_coeff></contact>'


@pytest.fixture(scope="module")
def let_go_text(tmp_path_factory) -> str:
    """What is written of a sheet that goes over from displacement to force."""
    return export(block(bodies=(sheet(MOTIONS["let go"]),)), tmp_path_factory.mktemp("let-go"))


@pytest.mark.parametrize("case", REFUSED)
def test_what_limbfit_has_not_is_refused(tmp_path, let_go_text, case):
    change, words = REFUSED[case]
    with pytest.raises(ProblemError, match=words):
        to_problem(read_feb(written(tmp_path, change(let_go_text))))


@recorded
@pytest.mark.parametrize("case", ["slide", "cone-load", "tube"])
def test_febios_own_inputs_are_written_anew(tmp_path, case):
    """A dragged plate, a socket that goes over to a force, a tube under pressure: read, written, read."""
    problem = to_problem(read_feb(REFERENCE / "socket" / f"{case}.feb"))
    found, _ = back(problem, tmp_path, SETTINGS)
    smooth = [isinstance(body.shape, SmoothSurface) for body in (*problem.rigid_bodies, *found.rigid_bodies)]
    assert smooth == [case == "cone-load"] * len(smooth)  # the hollow of the socket, not the plate
    assert len(found.rigid_bodies) == len(problem.rigid_bodies)
    for mine, theirs in zip(problem.rigid_bodies, found.rigid_bodies):
        assert (theirs.name, theirs.friction) == (mine.name, mine.friction)
        np.testing.assert_array_equal(theirs.pivot, mine.pivot)
        np.testing.assert_array_equal(theirs.faces, mine.faces)
        np.testing.assert_array_equal(theirs.shape.frame, mine.shape.frame)
        near = problem.mesh.points[mine.faces].mean(axis=1)
        np.testing.assert_allclose(theirs.shape.signed_distance(near), mine.shape.signed_distance(near))
        for t in np.linspace(0.0, problem.history.times[-1], 43):
            (values, forced, _), (expected, under, _) = theirs.motion.at(t), mine.motion.at(t)
            np.testing.assert_allclose(values, expected, atol=1e-12)
            np.testing.assert_array_equal(forced, under)
    held = [(s.component, s.factor, s.nodes.tolist()) for s in problem.supports]
    assert [(s.component, s.factor, s.nodes.tolist()) for s in found.supports] == held
    for mine, theirs in zip(problem.pressures, found.pressures, strict=True):
        np.testing.assert_array_equal(theirs.faces, mine.faces)
        np.testing.assert_allclose([theirs.at(t) for t in mine.times], mine.values)


G, K = 0.01, 0.5
# A cube of 10 mm in two elements, its bottom held, its waist free along z; a rigid plate on its top shares
# its nodes and comes down by 3 mm.
CUBE = f"""<?xml version="1.0"?>
<febio_spec version="4.0"><Module type="solid"/>
<Control><analysis>STATIC</analysis><time_steps>4</time_steps><step_size>0.25</step_size>
<solver type="solid"><dtol>1e-9</dtol></solver></Control>
<Material><material id="1" name="gel" type="incomp neo-Hookean"><G>{G}</G><k>{K}</k></material>
<material id="2" name="plate" type="rigid body"><center_of_mass>5,5,11</center_of_mass></material></Material>
<Mesh><Nodes name="all"><node id="1">0,0,0</node><node id="2">10,0,0</node><node id="3">10,10,0</node>
<node id="4">0,10,0</node><node id="5">0,0,10</node><node id="6">10,0,10</node><node id="7">10,10,10</node>
<node id="8">0,10,10</node><node id="9">0,0,12</node><node id="10">10,0,12</node><node id="11">10,10,12</node>
<node id="12">0,10,12</node><node id="21">0,0,5</node><node id="22">10,0,5</node><node id="23">10,10,5</node>
<node id="24">0,10,5</node></Nodes>
<Elements type="hex8" name="cube"><elem id="1">1,2,3,4,21,22,23,24</elem>
<elem id="3">21,22,23,24,5,6,7,8</elem></Elements>
<Elements type="hex8" name="lid"><elem id="2">5,6,7,8,9,10,11,12</elem></Elements>
<NodeSet name="base">1:4</NodeSet><NodeSet name="waist">21:24</NodeSet>
<NodeSet name="top">5:8</NodeSet></Mesh>
<MeshDomains><SolidDomain name="cube" mat="gel"/><SolidDomain name="lid" mat="plate"/></MeshDomains>
<Boundary><bc node_set="base" type="zero displacement"><x_dof>1</x_dof><y_dof>1</y_dof><z_dof>1</z_dof></bc>
<bc node_set="waist" type="zero displacement"><x_dof>1</x_dof><y_dof>1</y_dof><z_dof>0</z_dof></bc></Boundary>
<Rigid><rigid_bc type="rigid_fixed"><rb>plate</rb><Rx_dof>1</Rx_dof><Ry_dof>1</Ry_dof><Ru_dof>1</Ru_dof>
<Rv_dof>1</Rv_dof><Rw_dof>1</Rw_dof></rigid_bc>
<rigid_bc type="rigid_displacement"><rb>plate</rb><dof>z</dof><value lc="1">-1</value></rigid_bc></Rigid>
<LoadData><load_controller id="1" type="loadcurve"><interpolate>LINEAR</interpolate>
<points><pt>0,0</pt><pt>1,3</pt></points></load_controller></LoadData>
<Output><logfile><rigid_body_data data="Fx;Fy;Fz;z" file="plate.txt" delim=","></rigid_body_data>
<node_data data="z" file="nodes.txt" delim=","></node_data></logfile></Output></febio_spec>
"""
OWN = "5,6,7,8,9,10,11,12"
TIED = '<bc node_set="top" type="rigid"><rb>plate</rb></bc></Boundary>'


def apart() -> str:
    """The plate has nodes of its own, and the top of the cube is tied to it."""
    more = "".join(f'<node id="{n}">{x},{y},10</node>' for n, x, y in
                   ((13, 0, 0), (14, 10, 0), (15, 10, 10), (16, 0, 10)))  # fmt: skip
    text = CUBE.replace("</Nodes>", more + "</Nodes>").replace(OWN, "13,14,15,16,9,10,11,12")
    return text.replace("</Boundary>", TIED)


@pytest.mark.parametrize("text", [CUBE, apart()], ids=["shared nodes", "tied nodes"])
def test_tissue_goes_with_the_rigid_body_that_carries_it(tmp_path, text):
    """Uniaxial strain: J = lambda, sigma = 2/3 G J^(-5/3) (lambda^2 - 1) + k ln J / J over 100 mm^2."""
    assert run_feb(written(tmp_path, text), tmp_path / "out").result.completed
    log = read_log(tmp_path / "out" / "plate.txt")
    J = 1.0 - 0.3 * log.times
    stress = 2.0 / 3.0 * G * J ** (-5.0 / 3.0) * (J**2 - 1.0) + K * np.log(J) / J
    np.testing.assert_allclose(log.column("Fz"), 100.0 * stress, rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(log.column("z"), 11.0 - 3.0 * log.times)
    assert np.abs(log.column("Fx")).max() < 1e-9 * np.abs(log.column("Fz")).max()  # N, by symmetry
    heights = dict(read_rows(tmp_path / "out" / "nodes.txt")[-1])
    assert [heights[node] for node in (5, 6, 7, 8)] == pytest.approx([7.0] * 4)
    assert [heights[node] for node in (9, 10, 11, 12)] == pytest.approx([9.0] * 4)
    assert [heights[node] for node in (21, 22, 23, 24)] == pytest.approx([3.5] * 4, rel=1e-6)


def test_a_body_that_is_held_holds_what_it_carries(tmp_path):
    zero = 'node_set="base" type="zero displacement"><x_dof>1</x_dof><y_dof>1</y_dof><z_dof>1</z_dof>'
    assert zero in CUBE
    text = CUBE.replace(zero, 'node_set="base" type="rigid"><rb>bone</rb>').replace("</Material>", BONE)
    held = "".join(f"<R{x}_dof>1</R{x}_dof>" for x in "xyzuvw")
    text = text.replace("<Rigid>", f'<Rigid><rigid_bc type="rigid_fixed"><rb>bone</rb>{held}</rigid_bc>')
    problem = to_problem(read_feb(written(tmp_path, text)))
    np.testing.assert_array_equal(problem.fixed, [0, 1, 2, 3])
    moved = [(s.component, s.factor) for s in problem.supports if s.nodes.tolist() == [4, 5, 6, 7]]
    assert moved == [(0, 0.0), (1, 0.0), (2, -1.0)]


BONE = '<material id="3" name="bone" type="rigid body"/></Material>'
TWO = '<bc node_set="top" type="rigid"><rb>bone</rb></bc></Boundary>'
ELSEWHERE = '<bc node_set="top" type="zero displacement"><z_dof>1</z_dof></bc></Boundary>'
FORCE = (
    '<rigid_load type="rigid_force"><rb>plate</rb><dof>Rx</dof><value lc="1">1</value></rigid_load></Rigid>'
)
TURN = '<rigid_bc type="rigid_rotation"><rb>plate</rb><dof>Ru</dof><value lc="1">1</value></rigid_bc></Rigid>'
LOCK = '<rigid_connector type="rigid lock"/></Rigid>'
REFUSED_OF_BODIES = {
    "free to turn": (
        CUBE.replace("<Ru_dof>1</Ru_dof>", ""),
        r"line \d+, <material>: the rigid body 'plate' is neither fixed nor displaced in Ru; limbfit solves",
    ),
    "free to move": (CUBE.replace("<Rx_dof>1</Rx_dof>", ""), "neither fixed nor displaced in Rx"),
    "turned": (
        CUBE.replace("<Ru_dof>1</Ru_dof>", "").replace("</Rigid>", TURN),
        r"line \d+: the rigid body 'plate' carries tissue, and turns",
    ),
    "pushed": (
        CUBE.replace("<Rx_dof>1</Rx_dof>", "").replace("</Rigid>", FORCE),
        "neither fixed nor displaced in Rx; limbfit solves only for bodies that carry no tissue",
    ),
    "joined": (CUBE.replace("</Rigid>", LOCK), "<rigid_connector>: 'rigid lock' is not supported"),
    "held elsewhere": (
        CUBE.replace("</Boundary>", ELSEWHERE),
        r"line \d+: node 5 of 'top' moves with the rigid body 'plate', which goes elsewhere",
    ),
    "of two bodies": (
        CUBE.replace("</Boundary>", TWO).replace("</Material>", BONE),
        "node 5 is of two rigid bodies, 'plate' and 'bone'",
    ),
    "carries nothing": (
        apart().replace(TIED, "</Boundary>"),
        r"line \d+: the rigid body 'plate' moves, and neither touches nor carries tissue",
    ),
}


@pytest.mark.parametrize("case", REFUSED_OF_BODIES)
def test_what_limbfit_cannot_do_with_a_body_is_refused(tmp_path, case):
    text, words = REFUSED_OF_BODIES[case]
    assert text != CUBE
    with pytest.raises(ProblemError, match=words):
        run_feb(written(tmp_path, text), tmp_path / "out")


def test_a_rotation_by_nothing_holds(tmp_path):
    zero = '<rigid_bc type="rigid_rotation"><rb>steel</rb><dof>Ru</dof><value>0</value></rigid_bc></Rigid>'
    read_feb(written(tmp_path, FEB.replace("<Ru_dof>1</Ru_dof>", "").replace("</Rigid>", zero)))
