"""How far steps go where not all of them converge.

An equilibrium that can be followed takes few iterations in short steps.  Where even those fail it has come to
its end (tissue snaps past the indenter, or folds); the next one is many iterations away, however short the
step, and they are allowed there.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

# A step that fails is cut to this share; from so many cuts on, so many times the iterations are allowed.
CUT, CUTS_TO_PATIENCE, PATIENCE = 0.3, 2, 5


@dataclass
class StepController:
    """How far the next step goes: to the next time wanted, or a part of the way after one that failed.

    ``usual`` iterations are allowed for an equilibrium as a rule; ``stride``, s, is the longest step now, and
    ``until`` how far steps that failed went; ``cuts`` counts those that are in force.
    """

    usual: int
    stride: float = np.inf
    until: float = 0.0
    cuts: int = 0

    @property
    def patience(self) -> int:
        """Iterations that are allowed for the next step."""
        return self.usual * (PATIENCE if self.cuts >= CUTS_TO_PATIENCE else 1)

    def next_time(self, now: float, target: float) -> float:
        """Where to go from ``now``, s; no step is made that is much shorter than the one before it."""
        left = target - now
        if left <= 1.3 * self.stride:
            return target
        return now + min(self.stride, 0.5 * left)

    def cut(self, now: float, t: float) -> None:
        """The step to ``t`` failed."""
        self.stride, self.until = CUT * (t - now), max(t, self.until)
        self.cuts += 1

    def done(self, now: float, t: float, iterations: int) -> None:
        """The step to ``t`` was made: beyond what had failed, steps grow again."""
        if iterations > self.usual:  # another equilibrium: what was hard before is behind
            self.stride, self.cuts = np.inf, 0
        elif t >= self.until:
            self.stride, self.cuts = 2.0 * max(self.stride, t - now), max(self.cuts - 1, 0)
