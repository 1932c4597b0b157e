"""How the force of a record scatters: how much, and how alike neighbouring samples are."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.interpolate import make_lsq_spline

from ..autoregressive import clip_lag, estimate_lag_one
from .numerics import Array

_PIECES = 10  # of a cubic spline along the way in: follows any onset, and no noise faster than a tenth of it
_CLOSER = 2.0  # power by which they crowd at its start, where an onset bends most
_LEAST_PER_PIECE = 8  # samples


@dataclass(frozen=True)
class Scatter:
    """Noise of single samples: standard deviation, N, and correlation of neighbours (0: white)."""

    sd_N: float
    lag: float

    def of_means(self, samples: int) -> float:
        """Standard deviation of means of so many neighbours, N."""
        alike = self.lag / (1.0 - self.lag)
        longer = samples + 2 * alike * (samples - (1.0 - self.lag**samples) / (1.0 - self.lag))
        return self.sd_N * float(np.sqrt(longer)) / samples


def estimate_scatter(*parts: Array) -> Scatter:
    """The noise of forces on a smooth curve, in parts (n,) that are smooth each, evenly sampled.

    A curve takes some of the noise with it, the slow part above all: as many degrees of freedom as it has
    are given back, for the correlation as well (Bartlett's bias of an estimated autocorrelation).
    """
    residuals = [_compute_residual(part) for part in parts if len(part) > 2 * _LEAST_PER_PIECE]
    if not residuals:
        residuals = [(np.diff(np.concatenate(parts), 2) / np.sqrt(6.0), 0)]
    left, taken = np.concatenate([r for r, _ in residuals]), sum(k for _, k in residuals)
    n = len(left)
    lag = estimate_lag_one(left)
    lag = clip_lag(lag + (taken * (1.0 + lag) + 2.0 * lag) / n) if lag > 2.0 / np.sqrt(n) else 0.0
    new = left[1:] - lag * left[:-1]
    innovation = float(new @ new) / max(n - taken, 1)
    return Scatter(float(np.sqrt(innovation / (1.0 - lag**2))), lag)


def _compute_residual(force: Array) -> tuple[Array, int]:
    """What a cubic spline leaves of a force (n,), and how many coefficients it has."""
    n = len(force)
    pieces = int(np.clip(n // _LEAST_PER_PIECE, 1, _PIECES))
    at = np.linspace(0.0, 1.0, n)
    knots = np.r_[[0.0] * 4, np.linspace(0, 1, pieces + 1)[1:-1] ** _CLOSER, [1.0] * 4]
    return force - make_lsq_spline(at, force, knots)(at), pieces + 3
