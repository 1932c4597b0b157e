"""Small numerics that the trace modules share."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import make_interp_spline

from ..arrays import Array

Bools = NDArray[np.bool_]

_GAP = 10.0  # usual steps in time
_COARSE = 0.75  # of the samples: so many have a value that another one has too
_RESTED = 0.2  # of the changes: so many come after two samples alike


def estimate_noise_level(values: Array) -> float:
    """Standard deviation of white noise on a smooth curve, from second differences (robust)."""
    return float(np.median(np.abs(np.diff(values, 2))) / 0.6745 / np.sqrt(6.0))


def find_resolution(values: Array) -> float:
    """The step in which values (n,) come; zero where hardly any of them is there twice, or where they change
    from one to the next without a rest, as even samples of a ramp that is gone in and out."""
    levels, counts = np.unique(values, return_counts=True)
    repeated = counts > 1
    changes = np.diff(values) != 0.0
    rested = np.count_nonzero(changes[1:] & ~changes[:-1])
    if repeated.sum() < 2 or counts[repeated].sum() < _COARSE * len(values):
        return 0.0
    return float(np.median(np.diff(levels[repeated]))) if rested > _RESTED * changes.sum() else 0.0


def split_at_gaps(time: Array, values: Array) -> list[Array]:
    """Values (n,) at times (n,) in parts without gaps of more than ten usual steps between them."""
    steps = np.diff(time)
    return np.split(values, np.flatnonzero(steps > _GAP * np.median(steps)) + 1) if len(steps) else [values]


def find_runs(true: Bools) -> NDArray[np.int64]:
    """First and one beyond the last (k, 2) of every run of what is true (n,)."""
    return np.flatnonzero(np.diff(np.r_[False, true, False])).reshape(-1, 2)


def compute_rms(residual: Array) -> float:
    return float(np.sqrt(np.mean(residual**2)))


def average_in_bins(x: Array, y: Array, most: int, power: float = 1.0) -> tuple[Array, Array, Array]:
    """Averages of x and y over at most ``most`` runs of samples, and how many samples are in each.

    Runs are as long, or with a ``power`` the shorter the nearer to the start.
    """
    edges = np.unique((len(x) * np.linspace(0, 1, min(most, len(x)) + 1) ** power).astype(int))
    n = np.diff(edges).astype(float)
    return np.add.reduceat(x, edges[:-1]) / n, np.add.reduceat(y, edges[:-1]) / n, n


def build_linear_interpolation(at: Array, knots: Array) -> Array:
    """The matrix (m, n) that takes values at ``knots`` (n,) to those at ``at`` (m,), straight in between."""
    k = np.clip(np.searchsorted(knots, at) - 1, 0, len(knots) - 2)
    share = np.clip((at - knots[k]) / (knots[k + 1] - knots[k]), 0.0, 1.0)
    rows, matrix = np.arange(len(at)), np.zeros((len(at), len(knots)))
    matrix[rows, k], matrix[rows, k + 1] = 1.0 - share, share
    return matrix


def build_cubic_interpolation(at: Array, knots: Array) -> Array:
    """The matrix (m, n) that takes values at ``knots`` (n,) to those at ``at`` (m,) of their cubic."""
    return np.asarray(make_interp_spline(knots, np.eye(len(knots)), k=min(3, len(knots) - 1))(at))
