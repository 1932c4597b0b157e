"""The time before a problem's own history in a FEBio input, which FEBio has to be given as steps or motions.

Pre-strained tissue is strained within a second and rests until it has relaxed, in a step of the analysis of
its own. An indenter that meets tissue which has moved before stands clear of it; in the last part of its
waiting time it is brought to where limbfit has found that it touches. A body under a force that touches
nothing yet has no stiffness, so in limbfit's first step it is moved to where limbfit has found it at the end
of that step.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ..fe import History, Motion, Problem, StepControl, System
from ..fe.solution.start import CLEARANCE_WIDTHS, IndenterStart
from ..fe.solution.stepping import FirstStep, solve_until_onset

PRESTRAIN_S = 1.0  # in which the pre-strain grows
RELAXATION_TIMES = 30.0  # of the longest relaxation time: what is left is 1e-13
APPROACH_S = 1.0  # of an indenter that does not wait for anything else
# Share of the time since the tissue's drive last changed, in which the indenter is brought to the tissue.
APPROACH_SHARE = 0.1


@dataclass(frozen=True)
class Preparation:
    """The time in which pre-strained tissue settles, and that until the indenter then touches it, s."""

    settling_s: float = 0.0
    approach_s: float = 0.0

    @classmethod
    def from_problem(cls, problem: Problem) -> Preparation:
        """Find the preparation of a problem."""
        if problem.prestretch is None:
            return cls()
        times = [tau for law in problem.materials.values() for g, tau in law.table().prony if g != 0.0]
        at_once = IndenterStart.from_problem(problem).waits and not problem.touch_down_s
        return cls(
            PRESTRAIN_S + RELAXATION_TIMES * float(max(times, default=0.0)), APPROACH_S if at_once else 0.0
        )

    @property
    def seconds(self) -> float:
        """The time, s, at which the problem's own time begins in the file."""
        return self.settling_s + self.approach_s


def compute_end_time(problem: Problem) -> float:
    """Return the end of a problem's file, s of FEBio's time."""
    return Preparation.from_problem(problem).seconds + float(problem.history.times[-1])


def prepare_problem(problem: Problem, steps: StepControl) -> tuple[Problem, tuple[Motion, ...]]:
    """Return the problem in the time of its file, and the motions of its rigid bodies.

    The indenter stands clear of the tissue until limbfit's touch-down.

    Raises `ProblemError` if these places are not found.

    ``steps``: step control with which limbfit finds where the indenter touches, and where bodies under a
    force are at the end of the first step.
    """
    preparation, waits = Preparation.from_problem(problem), IndenterStart.from_problem(problem).waits
    motions = [body.motion for body in problem.rigid_bodies]
    if not (waits or any(np.asarray(motion.forced)[0].any() for motion in motions)):
        return problem.delay(preparation.settling_s), tuple(m.delay(preparation.settling_s) for m in motions)
    begun = solve_until_onset(problem, steps)
    moved = [_replace_first_force(motion, begun, i) for i, motion in enumerate(motions)]
    moved = [motion.delay(preparation.approach_s) for motion in moved]
    if waits:
        problem = _approach_tissue(problem, begun.place, preparation.approach_s)
        moved[0] = problem.history.motion
    settled = [_delay_motion(motion, preparation.settling_s) for motion in moved]
    return problem.delay(preparation.settling_s), tuple(settled)


def _replace_first_force(motion: Motion, begun: FirstStep, body: int) -> Motion:
    """Replace the first forces of a motion by displacements until the end of limbfit's first step."""
    first = np.asarray(motion.forced)[0]
    if not first.any() or first[3:].sum() > 1:  # FEBio adds turns about several axes up in another way
        return motion
    (start, end), (there, then) = begun.times, begun.coordinates[:, body]
    inner = np.asarray(motion.times) > end * (1.0 + 1e-9)
    values = np.where(first, [there, then], [motion.at(start)[0], motion.at(end)[0]])
    forces = motion.at(end)[0]
    intervals = np.asarray(motion.forced)[np.flatnonzero(inner) - 1]
    return Motion(
        np.concatenate([[start, end, end], np.asarray(motion.times)[inner]]),
        np.concatenate([values, forces[None], motion.values[inner]]),
        np.concatenate([np.zeros((1, 6), dtype=bool), first[None], intervals]),
    )


def _delay_motion(motion: Motion, seconds: float) -> Motion:
    """Return a motion so many seconds later, which goes to its beginning in the first of them."""
    later = motion.delay(seconds) if seconds else motion
    if not seconds or not motion.values[0].any() or np.asarray(motion.forced)[0].any():
        return later
    values, forced = np.asarray(later.values), np.asarray(later.forced)
    return Motion(
        np.concatenate([[0.0, PRESTRAIN_S], later.times[1:]]),
        np.concatenate([np.zeros((1, 6)), values]),
        np.concatenate([forced[:1], forced]),
    )


def _approach_tissue(problem: Problem, place: float, wait_s: float) -> Problem:
    """Return a problem ``wait_s`` later, whose indenter stands clear and is then brought to ``place``, mm.

    The place is counted from where the indenter would touch the tissue at rest.
    """
    start = System(problem).indenter
    assert start is not None
    clear = CLEARANCE_WIDTHS * start.width
    later, history = problem.delay(wait_s), problem.history.delay(wait_s)
    touch = problem.touch_down_s + wait_s
    last = max((float(t) for t in later.turns if t < touch * (1.0 - 1e-9)), default=0.0)
    off = touch - APPROACH_SHARE * (touch - last)
    inner = history.times[history.times > touch * (1.0 + 1e-9)]
    times = np.concatenate([[0.0, off, touch], inner])
    ways = np.where(times < touch * (1.0 - 1e-9), 0.0, clear + place + history.at(times))
    across = None
    if history.across is not None:
        across = np.column_stack([np.interp(times, history.times, values) for values in history.across.T])
    return replace(
        later,
        indenter=start.move(-clear),
        start="as-given",
        history=History(times, ways, across),
        touch_down_s=0.0,
    )
