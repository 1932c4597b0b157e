"""What moves tissue before it is indented, both ways: clamps, contraction, pre-stretch, later touch-down."""

import re
from dataclasses import replace

import numpy as np
import pytest
from febfiles import back, changed, export, written

from limbfit import OgdenQLV
from limbfit.bench.timing import build_punched_block
from limbfit.errors import ProblemError
from limbfit.fe import (
    Activation,
    ContractileMaterial,
    FibredMaterial,
    History,
    Indenter,
    Motion,
    OpenSurface,
    RigidBody,
    StepControl,
    isochoric_stretch,
    solve,
)
from limbfit.febio import (
    FebSettings,
    RunVerdict,
    build_result,
    check_optimisable,
    read_feb,
    read_log,
    run_feb,
    to_problem,
    write_inp,
)
from limbfit.febio.preparation import Preparation

SKIN, MUSCLE = OgdenQLV(0.009, 6.0, 2.0, 0.5), OgdenQLV(0.004, 4.0, (0.8, 0.3), (0.2, 1.5))
TENSED = ContractileMaterial(FibredMaterial(MUSCLE, 0.012, 2.5), 0.01)
ASKEW = np.array([1.0, -1.0, 0.5])
TIMES = (0.5, 1.0, 2.0, 3.0)
EXACT = StepControl(
    times=TIMES, stress="linear", penalty=20.0, penetration=1.0, hold_penalty=True, tolerance=1e-9
)
UP = np.array([0.0, 0.0, 1.0])
TAUT = isochoric_stretch(UP, 0.9)[0]
STILL = ContractileMaterial(FibredMaterial(OgdenQLV(0.004, 4.0, 0.0, 1.0), 0.0, 1.0), 0.01)


def sheet(motion, x, axis=(0.0, 0.0, 1.0), name="sheet"):
    """Four triangles that look down, in a frame along ``axis``: read back as they are."""
    points = np.array([[x + u, v, 0.2] for u in (-8.0, 0.0, 8.0) for v in (-8.0, 8.0)])
    faces = np.array([[0, 1, 2], [1, 3, 2], [2, 3, 4], [3, 5, 4]])
    shape = OpenSurface(points, faces).place(np.zeros(3), np.array(axis), np.array([0.0, 1.0, 0.0]))
    shape = replace(shape, points=points @ shape.frame.T)
    return RigidBody(shape, build_punched_block("hex8", 6).mesh.face_sets["skin"], motion, name=name)


def block(**changes):
    problem = build_punched_block("hex8", 6)
    end = History(np.array([0.0, TIMES[-1]]), np.zeros(2))
    given = {"indenter": None, "history": end, "materials": {"skin": SKIN, "muscle": MUSCLE}} | changes
    return replace(problem, **given)


def ball(axis=(0.0, 0.0, -1.0), x=0.0, motion=None, name="ball"):
    """A ball that is pressed in, whose facets are all that differs when it is read back."""
    shape = Indenter("sphere", 16.0, centre=(x, 4.0, 0.3), axis=axis, edge=(1.0, 0.0, 0.0))
    down = Motion.of([0.0, 1.0, 2.0, 3.0], z=[0.0, 0.0, 2.0, 1.5]) if motion is None else motion
    return RigidBody(shape, build_punched_block("hex8", 6).mesh.face_sets["skin"], down, name=name)


def pushes(problem, control=EXACT, rest=0.0):
    """Reactions (n, b, 3) in space of every step, N, of a problem that waits for ``rest`` s more."""
    times = tuple(rest + t for t in (0.0, *control.times))
    result = solve(problem, replace(control, times=times if rest else times[1:]), store="none")
    assert result.completed, result.reason
    assert len(result.times) == len(times) + (rest > 0.0)  # none was cut
    frames = np.array([body.shape.frame for body in problem.rigid_bodies])
    return np.einsum("nbi,bij->nbj", result.reactions[-len(control.times) :, :, :3], frames)


def field(problem):
    """A pre-stretch of its own in every cell of the skin, none elsewhere."""
    mesh = problem.mesh
    stretch = np.where(mesh.regions == 0, np.random.default_rng(3).uniform(0.8, 0.95, len(mesh.cells)), 1.0)
    return isochoric_stretch(np.tile(UP + 0.1 * ASKEW, (len(mesh.cells), 1)), stretch)


TENSES = {"materials": {"skin": SKIN, "muscle": TENSED}, "fibres": ASKEW,
          "activation": Activation([0.0, 0.7, 2.0], [0.0, 1.0, 0.4])}  # fmt: skip
CASES = {
    "elastic contraction": TENSES | {"materials": {"skin": SKIN, "muscle": STILL}},
    "pre-stretch": {"prestretch": TAUT},
    "all": TENSES | {"prestretch": field(block())},
}  # fmt: skip


@pytest.mark.parametrize(
    "case", [pytest.param("elastic contraction", marks=pytest.mark.slow), "pre-stretch", "all"]
)
def test_it_pushes_as_hard_when_read_back(tmp_path, case):
    problem = block(bodies=(ball(),), **CASES[case])
    found, model = back(problem, tmp_path, FebSettings(steps=EXACT))
    found = replace(found, indenter=ball().shape)
    assert model.settling_time_s == pytest.approx(Preparation.from_problem(problem).settling_s)
    np.testing.assert_array_equal(found.contact_faces, problem.bodies[0].faces)
    mine, theirs = pushes(problem), pushes(found)
    np.testing.assert_allclose(theirs, mine, atol=1e-6 * np.abs(mine).max())
    slack = None if problem.activation is None else Activation([0.0, 1.0], [0.0, 0.0])
    plain = pushes(replace(problem, activation=slack, prestretch=None))
    assert np.abs(plain - mine).max() > 0.03 * np.abs(mine).max()  # it matters


def test_a_contraction_alone_is_written(tmp_path):
    problem = block(**TENSES)
    found, _ = back(problem, tmp_path, FebSettings(steps=EXACT))
    assert not found.rigid_bodies
    assert found.materials["muscle"] == TENSED
    assert [found.activation.at(t) for t in (0.35, 1.0, 9.0)] == pytest.approx(
        [problem.activation.at(t) for t in (0.35, 1.0, 9.0)]
    )


@pytest.mark.parametrize("axis", [(0.0, 0.0, -1.0), (0.3, 0.1, -1.0)])
def test_bodies_under_force_go_along_their_own_axis(tmp_path, axis):
    """Two, of which at most one could be turned to the axes of space."""
    force = Motion.of([0.0, 1.0, 3.0], force={"z": [0.0, 0.8, 0.5]})
    bodies = (sheet(force, -12.0, axis, "left one"), sheet(force, 12.0, (0.2, 0.0, -1.0), "clamp at 25.7"))
    problem = block(bodies=bodies)
    found, model = back(problem, tmp_path, FebSettings(steps=EXACT))
    assert [body.name for body in found.bodies] == ["left_one", "clamp_at_25_7"]
    assert len(model.rails) == 2 - (axis[0] == 0.0)
    mine, theirs = pushes(problem), pushes(found)
    # In the first step the file moves them; limbfit then holds them by springs 100 times as stiff as contact.
    np.testing.assert_allclose(theirs[0], mine[0], atol=1e-5 * np.abs(mine).max())
    np.testing.assert_allclose(theirs[1:], mine[1:], atol=1e-6 * np.abs(mine).max())
    along = np.einsum("bj,nbj->nb", [b.shape.frame[2] for b in bodies], mine)
    np.testing.assert_allclose(along[2], 0.65, rtol=1e-6)
    if len(model.rails) == 2:
        assert np.abs(mine - along[..., None] * [b.shape.frame[2] for b in bodies]).max() > 0.01


HELD_S = 2.0
COURSE = History(np.array([0.0, HELD_S, 4.0, 5.0]), np.array([0.0, 0.0, 3.0, 1.0]))
LATE = replace(EXACT, times=(0.5, 1.0, 1.5, 2.0, 2.5, 3.0, 4.0, 4.5, 5.0))
PUNCH = Indenter("square", 20.0, 2.0, (-6.0, 0.0, 1.0), (0.2, 0.1, -1.0))
PRESSED = Motion.of([0.0, 1.0, 5.0], force={"z": [0.0, 0.5, 0.5]})
CLAMP = ball((0.2, 0.0, -1.0), 18.0, PRESSED, "clamp")
TENSED_EARLY = TENSES | {"activation": Activation([0.0, 1.0], [0.0, 1.0])}
LATER = {
    "tensed": TENSED_EARLY | {"touch_down_s": HELD_S},
    "taut": {"prestretch": TAUT, "history": History(COURSE.times[1:] - HELD_S, COURSE.driver[1:])},
    "taut and clamped": {"prestretch": TAUT, "touch_down_s": HELD_S, "bodies": (CLAMP,)},
}  # fmt: skip


@pytest.mark.parametrize("case", [pytest.param("tensed", marks=pytest.mark.slow), "taut", "taut and clamped"])
def test_an_indenter_touches_where_limbfit_has_found_it(tmp_path, case):
    """With its own shape in the place of its facets: FEBio's indenter comes from afar, and pushes as hard."""
    problem = block(indenter=PUNCH, **{"history": COURSE, **LATER[case]})
    control = LATE if problem.touch_down_s else replace(LATE, times=tuple(t - 2.0 for t in LATE.times[4:]))
    found, model = back(problem, tmp_path, FebSettings(steps=control))
    own, rest = Preparation.from_problem(problem), 0.0 if problem.touch_down_s else 1.0
    assert own.seconds == pytest.approx(model.settling_time_s + rest)
    if found.indenter is not None:
        found = replace(found, indenter=replace(PUNCH, centre=found.indenter.centre))
    else:
        tool, *others = found.bodies
        ways = tool.motion.values[:, :3] @ tool.shape.frame @ PUNCH.frame.T
        motion = Motion(tool.motion.times, np.hstack([ways, np.zeros_like(ways)]))
        tool = replace(tool, shape=replace(PUNCH, centre=tool.pivot), motion=motion)
        others = [replace(body, shape=CLAMP.shape) for body in others]
        found = replace(found, bodies=(tool, *others))
    mine, theirs = pushes(problem, control), pushes(found, control, rest)
    np.testing.assert_allclose(theirs, mine, atol=1e-6 * np.abs(mine).max())


def test_tables_and_results_tell_the_time_of_each(tmp_path):
    """FEBio's time in its own tables, that of the problem in its result, whose way is from touch-down."""
    problem = block(indenter=PUNCH, history=COURSE, **LATER["taut and clamped"])
    text = export(problem, tmp_path, FebSettings(steps=LATE))
    for words in ("<!-- pre-strain: grows in 1 s", "<!-- touch-down: where limbfit", "<!-- guides: bodies"):
        assert text.count(words) == 1
    begun = Preparation.from_problem(problem).seconds
    run = run_feb(tmp_path / "model.feb", tmp_path / "out", times=LATE.times, penalty=20.0, penetration=1.0)
    assert run.result.completed, run.result.reason
    log = read_log(tmp_path / "out" / "forces.txt")
    np.testing.assert_allclose(log.times[-9:], begun + np.array(LATE.times), rtol=1e-8)
    found = build_result(problem, log, RunVerdict("normal", "", log.times[-1], "4.11"))
    np.testing.assert_allclose(found.times[-9:], LATE.times, rtol=1e-6)
    assert found.displacement[-1] == pytest.approx(1.0)
    assert not found.force[found.times < HELD_S].any()
    along = run.result.reactions[:, 0, :3] @ run.result.problem.bodies[0].shape.frame @ PUNCH.frame[2]
    np.testing.assert_allclose(found.force[-9:], along[-9:], atol=1e-8)
    assert found.peak_force > 0.5
    early = replace(log, times=log.times[:1], values=log.values[:1])
    assert build_result(problem, early, RunVerdict("partial", "stopped", 0.1, "4.11")).times.tolist() == [0.0]


def stepping(text):
    """The number of the curve of the largest steps, which changes where the pre-strain rests."""
    return re.search(r'id="(\d+)" name="must_points"', text)[1]


RAMP = r'<ramp lc="\d+">1</ramp>'
FORCED = (
    '<solid type="uncoupled active fiber stress"><smax>0.01</smax><activation lc="2">1</activation></solid>'
)
REFUSED = {
    "at once": (lambda t: changed(t, RAMP, "<ramp>1</ramp>"), "acts at once in tissue that relaxes"),
    "no rest": (
        lambda t: changed(t, r"<pt>1.0,1.0</pt></points>|<pt>1.0,1.0</pt>", "<pt>30.0,1.0</pt>"),
        r"rests for 16 s in the first step.*let it rest for 30 s",
    ),
    "stretch": (lambda t: changed(t, "prestrain gradient", "in-situ stretch"), "'prestrain gradient' only"),
    "volume": (
        lambda t: changed(t, r"(<F0>)[^,]*", r"\g<1>2.0"), "changes the volume, which FEBio's pressure"
    ),
    "drawn": (lambda t: changed(t, "<translation_axis>[^<]*", "<translation_axis>0,0,0"), "needs an axis"),
    "joint with a force": (
        lambda t: changed(t, "<prescribed_translation>0", "<force>1</force><prescribed_translation>0"),
        "a joint that moves its body",
    ),
    "held and guided": (
        lambda t: changed(t, "</Rigid>", HOLDS + "</Rigid>"), "'clamp' is guided by a joint, and held"
    ),
    "loose base": (
        lambda t: changed(t, r'<rigid_bc name="frame_guide".*?</rigid_bc>', ""),
        "'frame', to which the joint is fixed, is not held still",
    ),
    "moves meanwhile": (
        lambda t: changed(t, "</Rigid>", PUSHES.replace("LC", stepping(t)) + "</Rigid>"),
        "settles while the rigid body 'clamp' changes; let it change after the first step",
    ),
}  # fmt: skip
PUSHES = '<rigid_load type="rigid_force"><rb>clamp</rb><dof>Rx</dof><value lc="LC">0.1</value></rigid_load>'
HOLDS = '<rigid_bc type="rigid_fixed"><rb>clamp</rb><Rx_dof>1</Rx_dof></rigid_bc>'


@pytest.fixture(scope="module")
def taut_text(tmp_path_factory) -> str:
    """What is written of a clamped block with a pre-stretch."""
    problem = block(bodies=(CLAMP,), history=COURSE, prestretch=TAUT)
    return export(problem, tmp_path_factory.mktemp("taut"), FebSettings(steps=LATE))


@pytest.mark.parametrize("case", REFUSED)
def test_what_limbfit_has_not_is_refused_with_its_line(tmp_path, taut_text, case):
    change, words = REFUSED[case]
    with pytest.raises(ProblemError, match=rf"(?s)line \d+.*{words}|{words}"):
        to_problem(read_feb(written(tmp_path, change(taut_text))))


CONTRACTIONS = {
    "relaxes": (
        lambda t: changed(t, '(<solid type="Ogden">)', FORCED + r"\1"),
        "an active stress that relaxes is not read",
    ),
    "twice": (lambda t: changed(t, FORCED, 2 * FORCED), "read with one contraction"),
    "no curve": (lambda t: changed(t, 'activation lc="2"', 'activation lc="9"'), "no load curve '9'"),
    "two courses": (
        lambda t: changed(t, '(?s)(name="muscle".*?)activation lc="2"', r'\1activation lc="1"'),
        "has another course than that of",
    ),
}


@pytest.fixture(scope="module")
def tensed_text(tmp_path_factory) -> str:
    """What is written of a block of which both tissues contract."""
    both = TENSES | {"materials": {"skin": TENSED, "muscle": TENSED}}
    return export(block(**both), tmp_path_factory.mktemp("tensed"), FebSettings(steps=EXACT))


@pytest.mark.parametrize("case", CONTRACTIONS)
def test_contractions_that_limbfit_has_not_are_refused(tmp_path, tensed_text, case):
    change, words = CONTRACTIONS[case]
    with pytest.raises(ProblemError, match=rf"line \d+.*{words}|{words}.*line \d+|{words}"):
        to_problem(read_feb(written(tmp_path, change(tensed_text))))


def test_what_febio_cannot_express_is_refused(tmp_path):
    squeezed = block(prestretch=0.9 * np.eye(3), bodies=(ball(),))
    with pytest.raises(ProblemError, match="its volume, which FEBio's pressure does not see; give one"):
        export(squeezed, tmp_path)
    dragged = Motion.of([0.0, 1.0, 3.0], x=[0.0, 0.0, 1.0], force={"z": [0.0, 0.8, 0.5]})
    with pytest.raises(ProblemError, match=r"between x, y and z.*turn_to_indenter_frame"):
        export(block(bodies=(ball((0.2, 0.0, -1.0), motion=dragged),)), tmp_path)
    late = replace(build_punched_block("tet4", 4), history=COURSE, touch_down_s=HELD_S)
    for held in (late, block(prestretch=TAUT), block(bodies=(ball(),))):
        with pytest.raises(ProblemError, match="cannot follow where a clamped, tensed or pre-strained limb"):
            check_optimisable(held)
    check_optimisable(block(indenter=PUNCH))
    with pytest.raises(ProblemError, match="pre-stretch move first is not written for Abaqus"):
        write_inp(late, tmp_path / "m.inp", "abaqus", FebSettings())
