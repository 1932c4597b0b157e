"""What is known before the data, and how much of an interval comes from it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..fit.parameters import Space, Unknowns

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Beliefs:
    """What is known before the data, in the search space: ``bounds`` (k, k) is the precision of theirs.

    ``sd`` (k,) are the deviations of a uniform distribution between them; ``rows @ z - target`` are the
    deviations from stated priors in their standard deviations.
    """

    sd: Array
    rows: Array
    target: Array

    @classmethod
    def of(cls, unknowns: Unknowns, space: Space) -> Beliefs:
        sd = (space.upper - space.lower) / np.sqrt(12.0)
        rows, target = unknowns.prior_rows()
        own = rows @ space.tie
        return cls(sd, own, target - rows @ space.fixed)

    @property
    def bounds(self) -> Array:
        return np.diag(self.sd**-2)

    @property
    def precision(self) -> Array:
        """Of bounds and priors together (k, k)."""
        return self.bounds + self.rows.T @ self.rows

    def shares(self, covariance: Array, tie: Array) -> tuple[Array, Array]:
        """How much of what is known of each parameter its stated priors, and those of the others, give.

        Parameters
        ----------
        covariance : (k, k) of the most probable answer to records, bounds and priors together.
        tie : (p, k) of the space.

        Returns
        -------
        share : (p,) of the variance, what comes of the priors' medians being off by their deviations; the
            rest is that of records and bounds.
        wider : (p,) how many times as wide the interval of the logarithm is where no prior is stated.

        Both are linear theory's; 0 and 1 for a parameter that does not move.
        """
        given = self.rows.T @ self.rows
        alone = np.linalg.inv(np.linalg.inv(covariance) - given)
        variance, caused, without = (
            np.einsum("pi,ij,pj->p", tie, part, tie)
            for part in (covariance, covariance @ given @ covariance, alone)
        )
        moved = variance > 0
        variance = np.where(moved, variance, 1.0)
        return np.where(moved, caused / variance, 0.0), np.sqrt(np.where(moved, without / variance, 1.0))
