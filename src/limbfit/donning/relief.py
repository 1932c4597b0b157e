"""Depths of regions of a socket that lower pressures there: few simulations, each proposed by what is known.

Each region's largest pressure is taken to change with every depth by a constant factor per mm.  The factors
begin as a guess for a region's own depth and none for the others, and follow what was simulated by Broyden's
update (C. G. Broyden, Math. Comput. 19:577, 1965).  A proposal solves the linear program that they make,
within a trust region around the best design so far.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy.optimize import linprog

from ..arrays import Array

GUESSED_SLOPE_PER_MM = 0.15  # guess: by how much a region's own depth changes the logarithm of its pressure
MIN_PRESSURE_KPA = 1.0  # pressures below this count as this
MAX_DEPTH_MM, MIN_DEPTH_MM = 4.0, -8.0  # bounds of the depths
TRUST_MM, MAX_TRUST_MM, MIN_TRUST_MM = 2.0, 4.0, 0.25
MEAN_WEIGHT = 0.1  # of the mean beside the worst, so that regions that are not the worst gain too
LIMIT_WEIGHT = 5.0  # of what is beyond the limits
MIN_GAIN = 0.01  # of the merit: a design with a smaller predicted gain is not simulated
GOOD, POOR = 0.5, 0.1  # share of the predicted gain from, or below, which the trust region changes


@dataclass(frozen=True, eq=False)
class SocketTrial:
    """A simulated design: depths (k,) mm, the largest pressures (r,) kPa of all regions, and its merit.

    ``pressures`` is None where it could not be made or simulated.
    """

    depths: Array
    pressures: Array | None
    merit: float


@dataclass(eq=False)
class Relief:
    """The search: `propose` gives depths, `tell` takes the pressures that they caused.

    Parameters
    ----------
    named : (k,) which of the regions have a depth, and are to be lowered.
    reference : (r,) kPa, of the control: named regions are lowered relative to it.
    limits : (r,) kPa that the others should not exceed.
    start : (r,) kPa, of the design with no depth anywhere.
    """

    named: Sequence[int]
    reference: Array
    limits: Array
    start: Array
    trials: list[SocketTrial] = field(init=False)
    trust_mm: float = field(init=False, default=TRUST_MM)

    def __post_init__(self) -> None:
        depths = np.zeros(len(self.named))
        self._others = np.setdiff1d(np.arange(len(self.start)), self.named)
        self._slopes = np.zeros((len(self.start), len(self.named)))
        self._slopes[list(self.named), np.arange(len(self.named))] = GUESSED_SLOPE_PER_MM
        self.trials = [SocketTrial(depths, self.start, self.merit(self.start))]

    @property
    def best(self) -> SocketTrial:
        return min(self.trials, key=lambda trial: trial.merit)

    def merit(self, pressures: Array) -> float:
        """The goal: the worst and the mean of the named over the control, and the excess, as logarithms."""
        return self._compute_merit(_log(pressures))

    def _compute_merit(self, y: Array) -> float:
        named, others = list(self.named), self._others
        gain = y[named] - _log(self.reference)[named]
        excess = np.maximum(y[others] - np.log(self.limits[others]), 0.0).max(initial=0.0)
        return float(gain.max() + MEAN_WEIGHT * gain.mean() + LIMIT_WEIGHT * excess)

    def propose(self) -> Array | None:
        """Depths (k,) mm to be simulated next; None where no sufficient gain is predicted."""
        if self.trust_mm < MIN_TRUST_MM:
            return None
        depths = self._solve_linear_program()
        predicted = self._compute_merit(self._predict_pressures(depths))
        return None if predicted > self.best.merit - MIN_GAIN else depths

    def tell(self, depths: Array, pressures: Array | None) -> SocketTrial:
        """What the proposed depths gave: pressures (r,) kPa, or None where they could not be simulated."""
        if pressures is None:
            trial = SocketTrial(depths, None, np.inf)
            self.trust_mm /= 2.0
        else:
            trial = SocketTrial(depths, pressures, self.merit(pressures))
            predicted = self.best.merit - self._compute_merit(self._predict_pressures(depths))
            share = (self.best.merit - trial.merit) / predicted
            if share > GOOD:
                self.trust_mm = min(2.0 * self.trust_mm, MAX_TRUST_MM)
            elif share < POOR:
                self.trust_mm /= 2.0
            step = depths - self.best.depths
            wrong = _log(pressures) - self._predict_pressures(depths)
            self._slopes += np.outer(wrong, step) / (step @ step)
        self.trials.append(trial)
        return trial

    def _predict_pressures(self, depths: Array) -> Array:
        """Logarithms (r,) of the pressures at depths (k,)."""
        best = self.best
        assert best.pressures is not None
        return np.asarray(_log(best.pressures) + self._slopes @ (depths - best.depths))

    def _solve_linear_program(self) -> Array:
        """The linear program's depths: unknowns are the depths, the worst gain and the excess."""
        named, others, k = list(self.named), self._others, len(self.named)
        depths, rest = self.best.depths, self._predict_pressures(np.zeros(k))
        gains = np.column_stack([self._slopes[named], -np.ones(k), np.zeros(k)])
        beyond = np.column_stack([self._slopes[others], np.zeros(len(others)), -np.ones(len(others))])
        cost = np.concatenate([MEAN_WEIGHT * self._slopes[named].mean(axis=0), [1.0, LIMIT_WEIGHT]])
        low = np.maximum(depths - self.trust_mm, MIN_DEPTH_MM)
        high = np.minimum(depths + self.trust_mm, MAX_DEPTH_MM)
        found = linprog(
            cost,
            A_ub=np.vstack([gains, beyond]),
            b_ub=np.concatenate([_log(self.reference)[named], np.log(self.limits[others])])
            - np.concatenate([rest[named], rest[others]]),
            bounds=[*zip(low, high, strict=True), (None, None), (0.0, None)],
        )
        assert found.success, found.message  # the excess is free to grow
        return np.asarray(found.x[:k])


def _log(pressures: Array) -> Array:
    return np.log(np.maximum(pressures, MIN_PRESSURE_KPA))
