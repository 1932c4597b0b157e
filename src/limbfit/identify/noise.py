"""What a record adds to the force: sensor noise as its own scatter shows it, and the doubt about touch-down.

The forces compared are a smoothed record at a few points. Slow noise passes the smoothing unchanged, fast
noise does not. So the compared points are given the covariance that means of the same number of samples have,
which keeps what the smoothing keeps and claims no knowledge of what it removed.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import toeplitz

Array = NDArray[np.float64]

_LEAST_SHARE = 1e-4  # of the largest force: a smaller sd than this no simulation has
_MOST_CORRELATED = 0.999


@dataclass(frozen=True)
class SiteNoise:
    """Noise of a site's record at the n times of comparison.

    ``covariance`` (n, n) N^2; ``sd_N`` and ``autocorrelation`` of neighbours are those of the samples as
    recorded; ``touch_down_mm`` is the standard deviation of the touch-down that is part of the covariance.
    """

    name: str
    times_s: Array
    covariance: Array
    sd_N: float
    autocorrelation: float
    touch_down_mm: float = 0.0


def record_noise(
    name: str,
    times_s: Array,
    residual_N: Array,
    force_N: Array,
    displacement_mm: Array,
    touch_down_sd_mm: float = 0.0,
    smoothing: Array | None = None,
) -> SiteNoise:
    """Noise of a record with ``residual_N`` (samples,), raw minus smoothed force.

    Parameters
    ----------
    times_s, force_N, displacement_mm : the compared curve (n,).
    touch_down_sd_mm : a depth counted from elsewhere moves the whole curve along its own slope.
    smoothing : (n, n) of the curve, which that slope passes too; by default none.
    """
    residual = residual_N - residual_N.mean()
    n, sd = len(times_s), float(residual.std())
    lag = _lag_one(residual)
    samples = max(round(residual.size / n), 1)
    slope = touch_down_sd_mm * depth_slope(displacement_mm, force_N)
    slope = slope if smoothing is None else smoothing @ slope
    floor = (_LEAST_SHARE * force_N.max()) ** 2
    covariance = block_covariance(sd, lag, samples, n) + np.outer(slope, slope) + floor * np.eye(n)
    return SiteNoise(name, times_s, covariance, sd, lag, touch_down_sd_mm)


def curve_noise(name: str, times_s: Array, residual_N: Array, force_N: Array) -> SiteNoise:
    """White noise of a curve that was never smoothed, from how neighbouring residuals (n,) scatter.

    Second differences take what is smooth out of them.
    """
    differences = np.diff(residual_N, 2)
    sd = float(np.sqrt(np.mean(differences**2) / 6.0)) if differences.size else 0.0
    sd = float(np.hypot(sd, _LEAST_SHARE * force_N.max()))
    return SiteNoise(name, times_s, sd**2 * np.eye(len(times_s)), sd, 0.0)


def block_covariance(sd: float, autocorrelation: float, samples: int, n: int) -> Array:
    """Covariance (n, n) of means of ``samples`` neighbours of a first-order autoregressive noise."""
    lags = np.arange(samples)
    powers = autocorrelation**lags
    own = (samples + 2 * float(((samples - lags) * powers)[1:].sum())) / samples**2
    # Sum over a in one block, b in the next but j: powers that factor into two geometric sums.
    between = autocorrelation * (float(powers.sum()) / samples) ** 2
    row = np.r_[own, between * autocorrelation ** (samples * np.arange(n - 1, dtype=float))]
    return sd**2 * toeplitz(row)


def depth_slope(displacement_mm: Array, force_N: Array) -> Array:
    """dF/dd (n,) N/mm at every point.

    On the way out it is that of the same depth on the way in, as much smaller as the force is, and none where
    the tissue has let go.
    """
    top = int(np.argmax(displacement_mm)) + 1
    depth, force = displacement_mm[:top], force_N[:top]
    slope = np.interp(displacement_mm, depth, np.gradient(force, depth))
    entering = np.interp(displacement_mm, depth, force)
    share = np.clip(force_N / np.maximum(entering, 1e-6 * force_N.max()), 0.0, 1.0)
    return np.where(np.arange(len(slope)) < top, slope, share * slope)


def _lag_one(residual: Array) -> float:
    squares = float(residual @ residual)
    lag = float(residual[1:] @ residual[:-1]) / squares if squares > 0 else 0.0
    return float(np.clip(lag, 0.0, _MOST_CORRELATED))
