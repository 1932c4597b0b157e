"""What comes before a problem's own time in a FEBio input, for FEBio knows no such beginnings.

Pre-strained tissue is strained within a second and rests until it has relaxed: a step of the analysis of its
own.  An indenter that meets tissue which has moved before stands clear of it, and is brought to where limbfit
has found that it touches in the last part of the time that it waits.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ..fe import History, Problem, StepControl, System
from ..fe.solution.stepping import touching_place
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


def as_written(problem: Problem, steps: StepControl) -> Problem:
    """The problem in the time of its file, its indenter clear of the tissue until limbfit's touch-down.

    Parameters
    ----------
    steps : with which limbfit finds the place where the indenter touches.

    Raises
    ------
    ProblemError
        Where that place is not found.
    """
    beginning = Beginning.of(problem)
    if IndenterStart.of(problem).waits:
        problem = _approaching(problem, touching_place(problem, steps), beginning.approach_s)
    return problem.later(beginning.settling_s)


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
