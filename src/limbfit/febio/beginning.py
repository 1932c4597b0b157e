"""What comes before a problem's own time in a FEBio input, for FEBio knows no such beginnings.

Pre-strained tissue is strained within a second and rests until it has relaxed: a step of the analysis of its
own.  An indenter that meets tissue which has moved before stands clear of it, and is brought to where limbfit
has found that it touches in the last part of the time that it waits.  A body under a force that touches
nothing yet has no stiffness: in limbfit's first step it is moved to where limbfit has found it at its end.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ..fe import History, Motion, Problem, StepControl, System
from ..fe.solution.stepping import FirstStep, onset
from ..fe.solution.touchdown import CLEAR, IndenterStart

STRAINED_S = 1.0  # in which the pre-strain grows
RESTS = 30.0  # of the longest relaxation time: what is left is 1e-13
APPROACH_S = 1.0  # of an indenter that does not wait for anything else
LAST_PART = (
    0.1  # of the time since what moves the tissue last changed, in which the indenter is brought there
)


@dataclass(frozen=True)
class Beginning:
    """How long pre-strained tissue settles, s, and how much later the indenter then touches it, s."""

    settling_s: float = 0.0
    approach_s: float = 0.0

    @classmethod
    def of(cls, problem: Problem) -> Beginning:
        """That of a problem."""
        if problem.prestretch is None:
            return cls()
        times = [tau for law in problem.materials.values() for g, tau in law.table().prony if g != 0.0]
        at_once = IndenterStart.of(problem).waits and not problem.touch_down_s
        return cls(STRAINED_S + RESTS * float(max(times, default=0.0)), APPROACH_S if at_once else 0.0)

    @property
    def seconds(self) -> float:
        """When the problem's own time begins in the file, s."""
        return self.settling_s + self.approach_s


def end_of_file(problem: Problem) -> float:
    """When the file of a problem ends, s of FEBio's time."""
    return Beginning.of(problem).seconds + float(problem.history.times[-1])


def as_written(problem: Problem, steps: StepControl) -> tuple[Problem, tuple[Motion, ...]]:
    """The problem in the time of its file, its indenter clear of the tissue until limbfit's touch-down, and
    the motions of its rigid bodies.

    Parameters
    ----------
    steps : with which limbfit finds the places where the indenter touches, and where bodies under a force are
        at the end of the first step.

    Raises
    ------
    ProblemError
        Where these places are not found.
    """
    beginning, waits = Beginning.of(problem), IndenterStart.of(problem).waits
    motions = [body.motion for body in problem.rigid_bodies]
    if not (waits or any(np.asarray(motion.forced)[0].any() for motion in motions)):
        return problem.later(beginning.settling_s), tuple(m.later(beginning.settling_s) for m in motions)
    begun = onset(problem, steps)
    moved = [_seated(motion, begun, i) for i, motion in enumerate(motions)]
    moved = [motion.later(beginning.approach_s) for motion in moved]
    if waits:
        problem = _approaching(problem, begun.place, beginning.approach_s)
        moved[0] = problem.history.motion
    settled = [_settling(motion, beginning.settling_s) for motion in moved]
    return problem.later(beginning.settling_s), tuple(settled)


def _seated(motion: Motion, begun: FirstStep, body: int) -> Motion:
    """A motion whose first forces are displacements until the end of limbfit's first step."""
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


def _settling(motion: Motion, seconds: float) -> Motion:
    """A motion after so many seconds, in the first of which it goes to where it begins."""
    later = motion.later(seconds) if seconds else motion
    if not seconds or not motion.values[0].any() or np.asarray(motion.forced)[0].any():
        return later
    values, forced = np.asarray(later.values), np.asarray(later.forced)
    return Motion(
        np.concatenate([[0.0, STRAINED_S], later.times[1:]]),
        np.concatenate([np.zeros((1, 6)), values]),
        np.concatenate([forced[:1], forced]),
    )


def _approaching(problem: Problem, place: float, rest: float) -> Problem:
    """A problem after ``rest`` s, whose indenter stands clear and is then brought to ``place``, mm beyond
    where it would touch the tissue at rest."""
    start = System(problem).indenter
    assert start is not None
    clear = CLEAR * start.width
    later, history = problem.later(rest), problem.history.later(rest)
    touch = problem.touch_down_s + rest
    last = max((float(t) for t in later.turns if t < touch * (1.0 - 1e-9)), default=0.0)
    off = touch - LAST_PART * (touch - last)
    inner = history.times[history.times > touch * (1.0 + 1e-9)]
    times = np.concatenate([[0.0, off, touch], inner])
    ways = np.where(times < touch * (1.0 - 1e-9), 0.0, clear + place + history.at(times))
    across = None
    if history.across is not None:
        across = np.column_stack([np.interp(times, history.times, values) for values in history.across.T])
    return replace(
        later,
        indenter=start.moved(-clear),
        start="as-given",
        history=History(times, ways, across),
        touch_down_s=0.0,
    )
