"""First guesses of a step: from the last steps of the run, or from those of another simulation."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ...arrays import Array
from ..bodies import count_body_rows
from ..problem import Problem
from ..result import Result

_SAME_S = 1e-9


def compute_extrapolation(travels: Sequence[float], travel: float) -> Array:
    """Weights (k,) of the last states' fields, at ``travels (k,)`` of the indenter, that predict the field at
    ``travel`` mm.

    Quadratic in the travel while it goes on steadily; linear where it has just turned or leaps.
    """
    d = np.asarray(travels, dtype=float)
    weights = np.zeros(len(d))
    weights[-1] = 1.0
    moved = np.diff(d)
    if len(d) < 2 or moved[-1] == 0.0:
        return weights
    slope = float(np.clip((travel - d[-1]) / moved[-1], -2.0, 8.0))
    step = slope * moved[-1]
    weights[-2:] += -slope, slope
    if len(d) > 2 and 0.0 < slope <= 2.0 and moved[0] * moved[1] > 0.0:
        bend = step * (step + moved[1]) / (d[2] - d[0])
        weights += bend * np.array([1.0 / moved[0], -1.0 / moved[0] - 1.0 / moved[1], 1.0 / moved[1]])
    return weights


@dataclass(frozen=True)
class WarmStart:
    """The displacements ``u`` (r, 3), rows of bodies included, of another simulation at ``times`` (k,) s."""

    times: Array
    u: tuple[Array, ...]

    @classmethod
    def of(cls, problem: Problem, result: Result | None) -> WarmStart:
        """The states of a result on the same mesh, moved to the new parameters along their sensitivities."""
        rows = count_body_rows(problem.rigid_bodies)
        shapes = [(state.u.shape, len(state.coordinates)) for state in result.states[:1]] if result else []
        if result is None or shapes != [(problem.mesh.points.shape, rows)]:
            return cls(np.zeros(0), ())
        times = np.array([state.time for state in result.states])
        if all(state.sensitivity is None for state in result.states):  # of whatever law and parameters
            return cls(times, tuple(state.rows for state in result.states))
        new, old = problem.parameters, result.problem.parameters
        with np.errstate(all="ignore"):  # moduli act by their ratio
            change = np.where(new * old > 0.0, old * np.log(new / old), new - old)
        moved = [
            state.rows if state.sensitivity is None else state.rows + state.slopes @ change
            for state in result.states
        ]
        return cls(times, tuple(moved))

    def at(self, t: float) -> Array | None:
        """Displacement (n, 3) at a time, linear between the states; None outside of them."""
        if not len(self.times) or not self.times[0] - _SAME_S <= t <= self.times[-1] + _SAME_S:
            return None
        after = min(int(np.searchsorted(self.times, t - _SAME_S)), len(self.times) - 1)
        before = max(after - 1, 0)
        if after == before or abs(self.times[after] - t) <= _SAME_S:
            return self.u[after]
        share = (t - self.times[before]) / (self.times[after] - self.times[before])
        return self.u[before] + share * (self.u[after] - self.u[before])
