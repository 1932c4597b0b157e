"""A stored simulation as a force for any history of displacement.

    F(t) = max(0, h_0(u(t)) + sum_i int_0^t exp(-(t - s) / tau_i) dh_i(u(s)))

Quasi-linear viscoelasticity with an elastic function of its own for each time constant.  All h_i rise (their
pieces have slopes >= 0, by non-negative least squares), so the force is stable whatever the history; beyond
the depth of the simulation each goes on with its last slope.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import nnls

from ...arrays import Array
from ...errors import TraceError

TAUS_S = np.array([0.03, 0.1, 0.3, 1.0, 3.0])
PIECES = 16
_GRID = 2000
_SMOOTH = 0.02  # weight on differences of neighbouring slopes
_IN_CONTACT = 1e-3  # of the largest force


@dataclass(frozen=True)
class Surrogate:
    """``values`` (1 + len(TAUS_S), PIECES + 1): h_0 and h_i at even displacements up to ``depth_mm``.

    ``error_percent``: largest difference from what it was fitted to, of the largest force.
    """

    depth_mm: float
    values: Array
    error_percent: float

    @property
    def step_mm(self) -> float:
        return self.depth_mm / PIECES

    def force(self, time_s: Array, displacement_mm: Array) -> Array:
        """Forces (n,) N of a history (n,) that starts at rest, stepped as finely as it is given."""
        levels = _split_depth(displacement_mm, self.depth_mm) @ np.diff(self.values, axis=1).T
        return np.maximum(levels[:, 0] + _apply_memory(time_s, levels[:, 1:]).sum(axis=1), 0.0)


def fit_surrogate(time_s: Array, displacement_mm: Array, force_N: Array) -> Surrogate:
    """Fit a surrogate to a simulated indentation, in and out.

    Parameters
    ----------
    time_s, displacement_mm, force_N : (n,) from touch-down.

    Raises
    ------
    TraceError
        Where the curve has no force or no depth.
    """
    depth, peak = float(displacement_mm.max(initial=0.0)), float(force_N.max(initial=0.0))
    if not (len(time_s) > 10 and depth > 0.1 and peak > 0.01 and np.all(np.diff(time_s) > 0)):
        raise TraceError("the simulated curve has no indentation in it")
    fine = np.union1d(np.linspace(time_s[0], time_s[-1], _GRID), time_s)
    at = np.searchsorted(fine, time_s)
    pieces = _split_depth(np.interp(fine, time_s, displacement_mm), depth)
    columns = [pieces] + [_integrate_memory(fine, pieces, tau) for tau in TAUS_S]
    matrix = np.concatenate([column[at] for column in columns], axis=1)
    touching = force_N > _IN_CONTACT * peak
    rough = np.diff(np.eye(PIECES), axis=0)
    smooth = _SMOOTH * np.kron(np.eye(len(columns)), rough)
    rises, _ = nnls(
        np.concatenate([matrix[touching], smooth]),
        np.concatenate([force_N[touching] / peak, np.zeros(len(smooth))]),
        maxiter=20_000,
    )
    miss = np.abs(np.maximum(matrix @ rises, 0.0) - force_N / peak).max()
    values = peak * np.cumsum(rises.reshape(len(columns), PIECES), axis=1)
    return Surrogate(depth, np.pad(values, ((0, 0), (1, 0))), float(100 * miss))


def _split_depth(displacement: Array, depth: float) -> Array:
    """(n, PIECES): how much of each piece of the depth has been gone; the last goes on."""
    gone = np.maximum(displacement, 0.0)[:, None] * (PIECES / depth) - np.arange(PIECES)
    return np.concatenate([np.clip(gone[:, :-1], 0.0, 1.0), np.maximum(gone[:, -1:], 0.0)], axis=1)


def _apply_memory(time: Array, levels: Array) -> Array:
    """Each column of levels as remembered with its own time constant."""
    parts = [_integrate_memory(time, levels[:, k : k + 1], tau)[:, 0] for k, tau in enumerate(TAUS_S)]
    return np.stack(parts, axis=1)


def _integrate_memory(time: Array, levels: Array, tau: float) -> Array:
    """int exp(-(t - s)/tau) dlevel(s), levels straight between times; exact."""
    kept = np.zeros_like(levels)
    steps = np.diff(time)
    for k, step in enumerate(steps):
        fade = np.exp(-step / tau)
        kept[k + 1] = fade * kept[k] + (levels[k + 1] - levels[k]) * (tau / step) * (1 - fade)
    return kept
