"""What a simulation returns: the force over time, its sensitivities, states and statistics."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import make_interp_spline

from .history import Memory
from .problem import Problem

Array = NDArray[np.float64]

SLIP = 0.9  # force over the one before, in an advancing step, that is no relaxation


@dataclass(frozen=True)
class State:
    """An accepted step: ``u (n, 3)`` mm at ``time`` s; ``sensitivity (n, 3, p)``; stresses in ``memory``."""

    time: float
    displacement: float
    u: Array
    penalty: float
    sensitivity: Array | None = None
    memory: Memory | None = None


@dataclass(frozen=True)
class Step:
    """What `iterate` yields: one accepted step."""

    time: float
    displacement: float
    force: float
    penetration: float
    contact_area: float
    newton_iterations: int
    force_sensitivity: Array | None
    state: State


def slipped(rows: Sequence[Step]) -> tuple[str, ...]:
    """A warning where the force falls while the indenter advances: the tissue has lost its equilibrium."""
    deepest = max((row.displacement for row in rows), default=0.0)
    for before, row in pairwise(rows):
        advance = row.displacement - before.displacement
        if advance > 1e-2 * deepest and row.force < SLIP * before.force:
            return (
                f"the force falls from {before.force:.3g} N to {row.force:.3g} N while the indenter advances "
                f"from {before.displacement:.3g} to {row.displacement:.3g} mm: tissue folds, or slips past "
                "the indenter between contact points; use a finer mesh there",
            )
    return ()


@dataclass(frozen=True)
class Result:
    """A simulation, complete or not.

    Parameters
    ----------
    times, displacement, force : (n,) s, mm, N (positive when pushing); the first is rest.
    force_sensitivity : (n, p) derivative of the force with respect to each parameter (mm, N, s, MPa).
    parameter_names : (region, parameter) per column.
    penetration, contact_area : (n,) mm, mm^2 (reference).
    states : kept steps.
    completed, reason : False and why where the end of the history was not reached.
    warnings : what is doubtful about the kept states.
    statistics : steps, newton_iterations, factorisations, multigrids (made, one for each matrix), solves,
        linear_solver, whether its factors had to be in ``double_precision``, element, unknowns, seconds by
        part.
    """

    problem: Problem
    times: Array
    displacement: Array
    force: Array
    force_sensitivity: Array | None
    parameter_names: tuple[tuple[str, str], ...]
    penetration: Array
    contact_area: Array
    states: tuple[State, ...]
    completed: bool
    reason: str
    statistics: Mapping[str, Any]
    warnings: tuple[str, ...] = ()
    system: Any = field(default=None, repr=False, compare=False)

    def __getstate__(self) -> dict[str, Any]:
        """Results travel between processes without the discretisation, which is rebuilt where needed."""
        return {**self.__dict__, "system": None}

    @property
    def peak_force(self) -> float:
        """Largest force, N."""
        return float(self.force.max())

    @cached_property
    def _phases(self) -> tuple[slice, ...]:
        """Loading up to the peak of the displacement, unloading until contact is lost, the rest."""
        n, peak = len(self.times), int(np.argmax(self.displacement))
        lost = np.flatnonzero(self.force[peak:] <= 0.0)
        last = peak + int(lost[0]) if len(lost) and self.force[peak] > 0 else n - 1
        ends = [0, peak, last, n - 1]
        return tuple(slice(a, b + 1) for a, b in pairwise(ends) if b > a)

    def _interpolate(self, values: Array, t: Array) -> Array:
        """Cubic splines over each phase of the steps: one operator, linear in the nodal values."""
        out = np.zeros((len(t), *values.shape[1:]))
        for phase in self._phases:
            x, y = self.times[phase], values[phase]
            inside = (t >= x[0]) & (t <= x[-1])
            out[inside] = make_interp_spline(x, y, k=min(3, len(x) - 1))(t[inside])
        return out

    def _inside(self, t: Array) -> Array:
        return np.clip(t, self.times[0], self.times[-1])

    def force_at(self, t: Array) -> Array:
        """Force (k,) at times ``t (k,)``, N; interpolated between steps, never negative."""
        at = self._inside(np.asarray(t, dtype=float))
        return np.maximum(self._interpolate(self.force, at), 0.0)

    def sensitivity_at(self, t: Array) -> Array:
        """Derivative (k, p) of `force_at` with respect to the parameters."""
        if self.force_sensitivity is None:
            raise ValueError("the simulation ran without sensitivities")
        at = self._inside(np.asarray(t, dtype=float))
        pushing = self._interpolate(self.force, at) > 0.0
        return np.where(pushing[:, None], self._interpolate(self.force_sensitivity, at), 0.0)
