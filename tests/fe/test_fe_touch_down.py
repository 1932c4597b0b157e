"""An indenter that touches tissue which has moved before: where, what it feels, and its derivatives."""

from dataclasses import replace

import numpy as np
import pytest
from blocks import check_sensitivities, punch
from test_fe_fibres import ASKEW, GROUND, TISSUE

from limbfit import History, Indenter, Problem
from limbfit.errors import ProblemError
from limbfit.fe import Activation, ContractileMaterial, Motion, RigidBody, StepControl, solve

HELD_S = 3.0
COURSE = History(np.array([0.0, HELD_S, HELD_S + 5.0, HELD_S + 9.0]), np.array([0.0, 0.0, 5.0, 2.0]))
CONTROL = StepControl(load_steps=3, unload_steps=2, tolerance=1e-10)


def tensed(active: float = 0.006, **changes) -> Problem:
    """A block whose muscle tenses before it is pressed."""
    muscle = ContractileMaterial(TISSUE, active)
    tense = Activation([0.0, 1.0], [0.0, 1.0])
    changes = {"fibres": ASKEW, "activation": tense, "touch_down_s": HELD_S, "history": COURSE} | changes
    return punch("hex8", 2, 1, materials={"skin": GROUND, "muscle": muscle}, **changes)


def clamped(**changes) -> Problem:
    """A block that a second punch presses beside the first one."""
    problem = punch("hex8", 2, 1, history=COURSE, touch_down_s=HELD_S, **changes)
    end = float(COURSE.times[-1])
    pin = Indenter("square", 16.0, 1.0, axis=(0, 0, -1), centre=(20.0, 18.0, 0.0))
    motion = Motion.of([0.0, 1.0, end], force={"z": [0.0, 0.4, 0.4]})
    return replace(problem, bodies=(RigidBody(pin, problem.contact_faces, motion, name="clamp"),))


def test_it_touches_the_tissue_where_that_is_by_then():
    problem = tensed()
    result = solve(problem, CONTROL, store="all")
    assert result.completed, result.reason
    before = result.times <= HELD_S * (1 + 1e-9)
    assert not result.force[before].any()
    met = result.states[int(before.sum()) - 2]  # the first row is rest
    skin = (problem.mesh.points + met.u)[np.unique(problem.contact_faces)]
    own = skin[(np.abs(skin[:, :2]) < 9.0).all(axis=1), 2]
    way = -result.coordinates[before.sum() :, 0, 2]  # height of the face
    advance = result.displacement[before.sum() :]
    np.testing.assert_allclose(np.diff(way), -np.diff(advance), atol=1e-9)
    assert (way + advance)[0] == pytest.approx(own.max(), abs=0.15)  # touching points lie between nodes
    assert abs(own.max()) > 0.3  # tensed tissue has moved
    assert result.force[before.sum()] > 0.0


@pytest.mark.parametrize("how", [{}, {"friction": 0.3, "sticking": "stepwise"}], ids=["plain", "stepwise"])
def test_what_nothing_moves_is_touched_where_it_is(how):
    """A block at rest that waits is indented as one that does not wait."""
    ball = Indenter("sphere", 40.0, axis=(0, 0, -1), centre=(2.0, 0.0, 5.0))
    problem = punch("hex8", 2, 1, history=COURSE, touch_down_s=HELD_S, indenter=ball, **how)
    later = solve(problem, CONTROL)
    history = History(COURSE.times[1:] - HELD_S, np.asarray(COURSE.displacement)[1:])
    at_once = solve(replace(problem, history=history, touch_down_s=0.0), CONTROL)
    np.testing.assert_allclose(
        later.force_at(HELD_S + at_once.times), at_once.force, atol=1e-4 * at_once.peak_force
    )
    own, its = later.reaction[later.times > HELD_S][:3], at_once.reaction[1:4]
    np.testing.assert_allclose(own, its, atol=1e-4 * at_once.peak_force)


def test_derivatives_of_tensed_tissue():
    check_sensitivities(tensed(), CONTROL, 1e-3, ("muscle", "active"), ("skin", "tau"))


def test_derivatives_beside_a_clamp():
    check_sensitivities(clamped(friction=0.3), CONTROL, 1e-3, ("muscle", "c"))


def test_what_cannot_be_is_refused():
    problem = punch("hex8", 2, 1, history=COURSE, touch_down_s=HELD_S)
    for changes, match in (
        ({"touch_down_s": 20.0}, "not within the history"),
        ({"start": "as-given"}, "driven by displacement that starts touching"),
        ({"touch_down_s": 4.0}, "advances before its touch-down"),
    ):
        with pytest.raises(ProblemError, match=match):
            solve(replace(problem, **changes))
