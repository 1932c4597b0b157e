"""How the force of a record scatters: how much, and how alike neighbouring samples are."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.interpolate import BSpline
from scipy.optimize import minimize_scalar

from ..autoregressive import clip_lag
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

    A spline through each part takes slow noise with it. Restricted maximum likelihood (Patterson and Thompson
    1971) of first-order autoregressive noise on such splines gives it back.
    """
    long = [part for part in parts if len(part) > 2 * _LEAST_PER_PIECE]
    if not long:
        return Scatter(float(np.sqrt(np.mean(np.diff(np.concatenate(parts), 2) ** 2) / 6.0)), 0.0)
    rows = [np.column_stack([_build_spline_basis(len(part)), part]) for part in long]
    n = sum(map(len, rows))
    found = minimize_scalar(
        lambda log: _compute_restricted_likelihood(rows, 1.0 - np.exp(log))[0],
        bounds=(np.log(1.0 - clip_lag(1.0)), 0.0),
        method="bounded",
        options={"xatol": 0.02},
    )
    lag = float(1.0 - np.exp(found.x))
    lag = lag if lag > 2.0 / np.sqrt(n) else 0.0
    innovation = _compute_restricted_likelihood(rows, lag)[1]
    return Scatter(float(np.sqrt(innovation / (1.0 - lag**2))), lag)


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
    pieces = int(np.clip(n // _LEAST_PER_PIECE, 1, _PIECES))
    knots = np.r_[[0.0] * 4, np.linspace(0, 1, pieces + 1)[1:-1] ** _CLOSER, [1.0] * 4]
    return np.asarray(BSpline.design_matrix(np.linspace(0.0, 1.0, n), knots, 3).toarray())
