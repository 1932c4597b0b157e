"""Numerics that the trace modules share: noise and its correlation, runs, means and interpolation."""

from dataclasses import dataclass

import numpy as np
from scipy.interpolate import BSpline, make_interp_spline
from scipy.optimize import minimize_scalar

from ..arrays import Array, Indices, Mask
from ..autoregressive import MAX_LAG

_GAP_STEPS = 10.0  # usual steps in time
_REPEATED_SHARE = 0.75  # of the samples: so many have a value that another one has too
_REST_SHARE = 0.2  # of the changes: so many come after two samples alike
# Of a cubic spline along the way in: follows any onset, and no noise faster than a tenth of it.
_MAX_PIECES = 10
_KNOT_POWER = 2.0  # power by which they crowd at its start, where an onset bends most
_MIN_SAMPLES = 8  # samples


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
    if repeated.sum() < 2 or counts[repeated].sum() < _REPEATED_SHARE * len(values):
        return 0.0
    return float(np.median(np.diff(levels[repeated]))) if rested > _REST_SHARE * changes.sum() else 0.0


def split_at_gaps(time: Array, values: Array) -> list[Array]:
    """Values (n,) at times (n,) in parts without gaps of more than ten usual steps between them."""
    steps = np.diff(time)
    if not len(steps):
        return [values]
    return np.split(values, np.flatnonzero(steps > _GAP_STEPS * np.median(steps)) + 1)


def find_runs(mask: Mask) -> Indices:
    """First and one beyond the last (k, 2) of every run of what is true (n,)."""
    return np.flatnonzero(np.diff(np.r_[False, mask, False])).reshape(-1, 2)


def compute_rms(residual: Array) -> float:
    return float(np.sqrt(np.mean(residual**2)))


def average_in_bins(x: Array, y: Array, max_bins: int, power: float = 1.0) -> tuple[Array, Array, Array]:
    """Averages of x and y over at most ``max_bins`` runs of samples, and how many samples are in each.

    Runs are as long, or with a ``power`` the shorter the nearer to the start.
    """
    edges = np.unique((len(x) * np.linspace(0, 1, min(max_bins, len(x)) + 1) ** power).astype(int))
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


@dataclass(frozen=True)
class SampleNoise:
    """Noise of single samples: standard deviation, N, and correlation of neighbours (0: white)."""

    sd_N: float
    lag: float

    def compute_mean_sd(self, samples: int) -> float:
        """Standard deviation of means of so many neighbours, N."""
        alike = self.lag / (1.0 - self.lag)
        longer = samples + 2 * alike * (samples - (1.0 - self.lag**samples) / (1.0 - self.lag))
        return self.sd_N * float(np.sqrt(longer)) / samples


def estimate_noise(*parts: Array) -> SampleNoise:
    """The noise of forces on a smooth curve, in parts (n,) that are smooth each, evenly sampled.

    A spline through each part takes slow noise with it. Restricted maximum likelihood (Patterson and Thompson
    1971) of first-order autoregressive noise on such splines gives it back.
    """
    long = [part for part in parts if len(part) > 2 * _MIN_SAMPLES]
    if not long:
        return SampleNoise(float(np.sqrt(np.mean(np.diff(np.concatenate(parts), 2) ** 2) / 6.0)), 0.0)
    rows = [np.column_stack([_build_spline_basis(len(part)), part]) for part in long]
    n = sum(map(len, rows))
    found = minimize_scalar(
        lambda log: _compute_restricted_likelihood(rows, 1.0 - np.exp(log))[0],
        bounds=(np.log(1.0 - MAX_LAG), 0.0),
        method="bounded",
        options={"xatol": 0.02},
    )
    lag = float(1.0 - np.exp(found.x))
    lag = lag if lag > 2.0 / np.sqrt(n) else 0.0
    innovation = _compute_restricted_likelihood(rows, lag)[1]
    return SampleNoise(float(np.sqrt(innovation / (1.0 - lag**2))), lag)


def _compute_restricted_likelihood(rows: list[Array], lag: float) -> tuple[float, float]:
    """Minus twice the log of the restricted likelihood at its best size of the noise, and the variance of the
    innovations; ``rows`` (n, k + 1) of each part are its basis and its force."""
    squares = determinant = 0.0
    for part in rows:
        white = np.vstack([np.sqrt(1.0 - lag**2) * part[:1], part[1:] - lag * part[:-1]])
        corner = np.diag(np.linalg.qr(white, mode="r"))
        squares += float(corner[-1] ** 2)
        determinant += float(2 * np.log(np.abs(corner[:-1])).sum() - np.log(1.0 - lag**2))
    free = sum(len(part) - part.shape[1] + 1 for part in rows)
    variance = squares / free
    return free * float(np.log(max(variance, 1e-300))) + determinant, variance


def _build_spline_basis(n: int) -> Array:
    """A cubic spline's basis (n, k) along n samples."""
    pieces = int(np.clip(n // _MIN_SAMPLES, 1, _MAX_PIECES))
    knots = np.r_[[0.0] * 4, np.linspace(0, 1, pieces + 1)[1:-1] ** _KNOT_POWER, [1.0] * 4]
    return np.asarray(BSpline.design_matrix(np.linspace(0.0, 1.0, n), knots, 3).toarray())
