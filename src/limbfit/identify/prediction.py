"""How far simulated forces are from measured ones, and how far they may be."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def error_percent(simulated_N: Array, measured_N: Array) -> float:
    """Mean absolute error over the trace over the largest measured force, in percent (paper, table 2)."""
    return float(100 * np.mean(np.abs(simulated_N - measured_N)) / np.max(measured_N))


@dataclass(frozen=True)
class Summary:
    """Mean and standard deviation (n - 1) of errors in percent; nan where there are too few sites."""

    sites: int
    mean_percent: float
    sd_percent: float
    largest_percent: float


def summarise(errors_percent: Sequence[float]) -> Summary:
    """Errors of a group of sites in short."""
    errors = np.asarray(errors_percent, dtype=float)
    if errors.size == 0:
        return Summary(0, np.nan, np.nan, np.nan)
    sd = float(errors.std(ddof=1)) if errors.size > 1 else np.nan
    return Summary(errors.size, float(errors.mean()), sd, float(errors.max()))


def prediction_sd(jacobian: Array, parameters: Array, covariance_log: Array, noise_N: float = 0.0) -> Array:
    """Standard deviation (n,) N of a predicted force, linearised.

    Parameters
    ----------
    jacobian : (n, p) derivatives of the force with respect to the parameters.
    covariance_log : (p, p) covariance of the logarithms of the parameters (``Uncertainty.covariance``).
    noise_N : standard deviation of what a new record adds: sensor noise and the model's own misfit.
    """
    scaled = jacobian * parameters
    return np.sqrt(np.einsum("ni,ij,nj->n", scaled, covariance_log, scaled) + noise_N**2)
