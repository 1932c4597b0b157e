"""The calibration as an estimator: how its answer follows the records and the priors that it was given.

At the answer the gradient of what was minimised is zero, so the implicit function theorem gives the change of
the answer from that of the records and of the priors' medians (Huber 1967, the sandwich): ``H^-1 J' W dy``
and ``H^-1 s^2 R' db``, with J the derivatives of a site's force, W the curvature of its cost
(`Measured.curvature`), s^2 the weight of the priors, R their rows, ``H = J' W J + s^2 R' R``. The force's
own second derivatives are left out: they meet residuals whose mean is zero.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Estimator:
    """The linearised calibration in its search space of k coordinates.

    ``force_hessian`` (k, k) is what the forces add to the second derivative of what was minimised,
    ``prior_hessian`` (k, k) what q stated priors add; ``by_record`` (k, n), per site, is how its gradient
    changes with the record, and ``by_prior`` (k, q) with the priors' medians, in their standard deviations.
    """

    force_hessian: Array
    prior_hessian: Array
    by_record: tuple[Array, ...]
    by_prior: Array

    @classmethod
    def at(
        cls,
        scaled: Sequence[Array],
        weights: Sequence[Array],
        rows: Array,
        share: float,
    ) -> Estimator:
        """From derivatives (n, k) N and the cost's curvature (n, n) per site at the answer.

        ``rows @ z`` (q, k) are the priors' logarithms in their standard deviations, ``share`` is how much the
        squares of these count in the cost.
        """
        by_record = tuple(J.T @ W for J, W in zip(scaled, weights, strict=True))
        forces = np.sum([G @ J for G, J in zip(by_record, scaled)], axis=0)
        return cls(forces, share * rows.T @ rows, by_record, share * rows.T)

    @property
    def hessian(self) -> Array:
        return self.force_hessian + self.prior_hessian

    def by_covariance(self, covariances: Sequence[Array], shared: Sequence[Array] = ()) -> Array:
        """Covariance (k, k) of the gradient where that of each record is (n, n) N^2.

        ``shared`` (n, q) N of each record are deviations that all have in common.
        """
        parts = [G @ C @ G.T for G, C in zip(self.by_record, covariances, strict=True)]
        common = np.sum([G @ E for G, E in zip(self.by_record, shared)], axis=0)
        return np.asarray(np.sum(parts, axis=0)) + (common @ common.T if len(shared) else 0.0)

    @property
    def by_medians(self) -> Array:
        """Covariance (k, k) of the gradient by the priors: each median off by its stated deviation."""
        return self.by_prior @ self.by_prior.T
