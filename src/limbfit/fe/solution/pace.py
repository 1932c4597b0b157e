"""How far steps go where not all of them converge.

An equilibrium that can be followed takes few iterations in short steps.  Where even those fail it has come to
its end (tissue snaps past the indenter, or folds); the next one is many iterations away, however short the
step, and they are allowed there.
"""

from __future__ import annotations

import numpy as np

# A step that fails is cut to this share; from so many cuts on, so many times the iterations are allowed.
CUT, CUTS_TO_PATIENCE, PATIENCE = 0.3, 2, 5


class Pace:
    """How far the next step goes: to the next time wanted, or a part of the way after one that failed.

    ``max_iterations`` are allowed for an equilibrium as a rule; ``cuts`` counts those that are in force.
    """

    def __init__(self, max_iterations: int) -> None:
        self._usual = max_iterations
        self._stride, self._until, self.cuts = np.inf, 0.0, 0

    @property
    def patience(self) -> int:
        """Iterations that are allowed for the next step."""
        return self._usual * (PATIENCE if self.cuts >= CUTS_TO_PATIENCE else 1)

    def next_time(self, now: float, target: float) -> float:
        """Where to go from ``now``, s; no step is made that is much shorter than the one before it."""
        left = target - now
        if left <= 1.3 * self._stride:
            return target
        return now + min(self._stride, 0.5 * left)

    def cut(self, now: float, t: float) -> None:
        """The step to ``t`` failed."""
        self._stride, self._until = CUT * (t - now), max(t, self._until)
        self.cuts += 1

    def done(self, now: float, t: float, iterations: int) -> None:
        """The step to ``t`` was made: beyond what had failed, steps grow again."""
        if iterations > self._usual:  # another equilibrium: what was hard before is behind
            self._stride, self.cuts = np.inf, 0
        elif t >= self._until:
            self._stride, self.cuts = 2.0 * max(self._stride, t - now), max(self.cuts - 1, 0)
