"""Readings beside the records, such as pressures in a socket, that count in the fit by their derivatives.

Where a simulation takes minutes, a search cannot repeat it at every step. It follows the readings as they are
to first order about the last simulation; the next one is made where the search ends (Gauss and Newton).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import cholesky, solve_triangular

from ...arrays import Array


@dataclass(frozen=True, eq=False)
class LinearisedReadings:
    """What readings tell of p parameters to first order.

    ``rows (k, p) @ log(parameters) - target (k,)`` are deviations, independent, in standard deviations; k is
    p at most.
    """

    rows: Array
    target: Array

    @classmethod
    def weigh(
        cls, off: Array, derivatives: Array, covariance: Array, logarithms: Array
    ) -> LinearisedReadings:
        """Weigh n readings by their covariance, and keep what they tell of the parameters.

        Parameters
        ----------
        off : (n,) readings less simulated ones at ``logarithms`` (p,) of the parameters.
        derivatives : (n, p) of the simulated ones with respect to these.
        covariance : (n, n) of the readings, positive definite.
        """
        both = np.column_stack([derivatives, derivatives @ logarithms + off])
        weighted = solve_triangular(cholesky(covariance, lower=True), both, lower=True)
        reduced = np.asarray(np.linalg.qr(weighted, mode="r"))[: derivatives.shape[1]]
        return cls(reduced[:, :-1], reduced[:, -1])


def add_scatter(covariance: Array, off: Array, places: Array, length_mm: float) -> tuple[Array, float]:
    """Add to a covariance (n, n) of readings what a simulation lacks, and return its standard deviation too.

    Readings are ``off`` (n,) from the simulation. Their mean is taken for an error of it that all of them
    share. What their own errors do not explain of the scatter about that mean is alike in ``places`` (n, 3),
    mm, closer than ``length_mm``: its correlation falls exponentially.
    """
    bias = float(off.mean())
    scatter = max(float(off.var() - np.trace(covariance) / len(off)), 0.0)
    distance = np.linalg.norm(places[:, None] - places, axis=2)
    missed = bias**2 + scatter * np.exp(-distance / length_mm)
    return covariance + missed, float(np.sqrt(bias**2 + scatter))
