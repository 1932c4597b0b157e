"""Noise whose neighbours are alike: first-order autoregressive, as sensors with their filters make it.

One sample is ``lag`` times the one before plus something new, so that samples k apart have the correlation
``lag^k``. A mean of n of them is known ``(1 + lag) / (1 - lag)`` times worse (in variance) than n that are
independent: a factor of 39 where the correlation of neighbours is 0.95.
"""

import numpy as np

from .arrays import Array, Indices

MAX_LAG = 0.999  # correlation of neighbours beyond which no covariance can be made of it


def compute_block_covariance(sd: float, lag: float, samples: Indices) -> Array:
    """Covariance (n, n) of means of ``samples`` (n,) neighbours of a noise of deviation ``sd``."""
    lags = np.arange(samples.max())
    powers = lag**lags
    sums, moments = np.r_[0.0, np.cumsum(powers)], np.r_[0.0, np.cumsum(lags * powers)]
    own = (2 * (samples * sums[samples] - moments[samples]) - samples) / samples**2
    # Sum over a in one block, b in a later one: powers that factor into two geometric sums.
    shares, ends = sums[samples] / samples, np.cumsum(samples)
    gap = np.maximum((ends - samples)[None, :] - ends[:, None] + 1, 1)
    later = np.triu(np.outer(shares, shares) * lag ** gap.astype(float), 1)
    return np.asarray(sd**2 * (np.diag(own) + later + later.T))


def estimate_lag_one(residual: Array) -> float:
    """Correlation of neighbours in a residual (n,) of mean zero; none where it is negative."""
    squares = float(residual @ residual)
    lag = float(residual[1:] @ residual[:-1]) / squares if squares > 0 else 0.0
    return float(np.clip(lag, 0.0, MAX_LAG))
