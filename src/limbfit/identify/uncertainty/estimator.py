"""The fit as an estimator: how its answer follows the records, the priors and the simulated forces.

At the answer the gradient of what was minimised is zero. The implicit function theorem therefore gives the
change of the answer from that of the records and of the priors' medians (Huber 1967, the sandwich): ``H^-1 J'
W dy`` and ``H^-1 s^2 R' db``. J are the derivatives of a site's force, W is the curvature of its cost
(`MeasuredCurve.compute_cost_curvature`), s^2 the weight of the priors, R their rows, and ``H = J' W J + s^2
R' R``. The second derivatives of the force are left out: they multiply residuals whose mean is zero.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ...arrays import Array
from ..fit.objective import SiteResponse
from ..fit.parameters import SearchSpace, Unknowns
from .discrepancy import ResidualModel


@dataclass(frozen=True)
class Estimator:
    """The linearised calibration in its search space of k coordinates.

    ``force_hessian`` (k, k) is the part of the second derivative of what was minimised that comes from the
    forces, ``prior_hessian`` (k, k) the part from q stated priors. The gradient changes by
    ``record_gradients`` (k, n) times a change of each site's record, and by ``prior_gradient`` (k, q) times a
    change of the priors' medians in their standard deviations.
    """

    force_hessian: Array
    prior_hessian: Array
    record_gradients: tuple[Array, ...]
    prior_gradient: Array

    @classmethod
    def linearise(
        cls,
        scaled: Sequence[Array],
        weights: Sequence[Array],
        rows: Array,
        share: float,
    ) -> Estimator:
        """Build the estimator from derivatives (n, k) N and the cost's curvature (n, n) per site at the
        answer.

        ``rows @ z`` (q, k) are the priors' logarithms in their standard deviations; ``share`` is the weight
        of their squares in the cost.
        """
        record_gradients = tuple(J.T @ W for J, W in zip(scaled, weights, strict=True))
        forces = np.sum([G @ J for G, J in zip(record_gradients, scaled)], axis=0)
        return cls(forces, share * rows.T @ rows, record_gradients, share * rows.T)

    @property
    def hessian(self) -> Array:
        return self.force_hessian + self.prior_hessian

    def propagate_covariance(self, covariances: Sequence[Array]) -> Array:
        """Return the covariance (k, k) of the gradient if that of each record is (n, n) N^2."""
        parts = [G @ C @ G.T for G, C in zip(self.record_gradients, covariances, strict=True)]
        return np.asarray(np.sum(parts, axis=0))

    def propagate_shared(self, deviations: Sequence[Array]) -> Array:
        """Return the covariance (k, k) of the gradient from ``deviations`` (n, q) N of each record that all
        records have in common."""
        common = np.sum([G @ E for G, E in zip(self.record_gradients, deviations, strict=True)], axis=0)
        return np.asarray(common @ common.T)

    @property
    def prior_covariance(self) -> Array:
        """Covariance (k, k) of the gradient if each prior's median is off by its stated deviation."""
        return self.prior_gradient @ self.prior_gradient.T


@dataclass(frozen=True)
class PriorPrecision:
    """What is known before the data, in the search space: the bounds and the stated priors.

    ``sd`` (k,) are the deviations of a uniform distribution between the bounds; ``rows @ z - target`` are the
    deviations from the stated priors in their standard deviations.
    """

    sd: Array
    rows: Array
    target: Array

    @classmethod
    def from_unknowns(cls, unknowns: Unknowns, space: SearchSpace) -> PriorPrecision:
        sd = (space.upper - space.lower) / np.sqrt(12.0)
        rows, target = unknowns.build_prior_rows()
        own = rows @ space.tie
        return cls(sd, own, target - rows @ space.fixed_log)

    @property
    def bound_precision(self) -> Array:
        """Precision (k, k) of the bounds."""
        return np.diag(self.sd**-2)

    @property
    def precision(self) -> Array:
        """Precision (k, k) of bounds and priors together."""
        return self.bound_precision + self.rows.T @ self.rows

    def compute_shares(self, covariance: Array, tie: Array) -> tuple[Array, Array]:
        """Return how much of what is known of each parameter comes from the stated priors.

        Parameters
        ----------
        covariance : (k, k) of the most probable answer to records, bounds and priors together.
        tie : (p, k) of the space.

        Returns
        -------
        share : (p,) the part of the variance that comes from the deviations of the priors' medians; the rest
            comes from records and bounds.
        wider : (p,) how many times as wide the interval of the logarithm would be without priors.

        Both follow from linear theory; they are 0 and 1 for a parameter that does not move.
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


@dataclass(frozen=True)
class FitSensitivity:
    """The change of the linearised fit's answer with the simulated force of each site.

    ``matrices`` are (p, n) per site, per N, for the logarithms of the full parameters: ``-(J' C^-1 J + P)^-1
    J' C^-1``.
    """

    matrices: tuple[Array, ...]

    @classmethod
    def linearise(
        cls,
        parameters: Array,
        responses: Sequence[SiteResponse],
        model: ResidualModel,
        unknowns: Unknowns,
        space: SearchSpace,
    ) -> FitSensitivity:
        """Build the sensitivity of the fit whose answer is ``parameters`` (p,)."""
        scaled = [space.pull_back(response.jacobian, parameters) for response in responses]
        weighted = model.solve(scaled)
        A = PriorPrecision.from_unknowns(unknowns, space).precision + sum(
            J.T @ W for J, W in zip(scaled, weighted)
        )
        return cls(tuple(-space.tie @ np.linalg.solve(A, W.T) for W in weighted))

    def compute_shift(self, changes: Sequence[Array]) -> Array:
        """Return the change (p,) of the logarithms if forces rise by ``changes`` (n,) at all sites."""
        return np.sum([G @ change for G, change in zip(self.matrices, changes, strict=True)], axis=0)

    def compute_covariance(self, changes: Sequence[Array], shared: bool, sites: Sequence[str] = ()) -> Array:
        """Return the covariance (p, p) if ``changes`` are one standard deviation, ``shared`` by all sites or
        not.

        ``sites`` names the site of each change if several belong to one; by default each has its own.
        """
        if shared:
            parts = [self.compute_shift(changes)]
        else:
            moved = [G @ c for G, c in zip(self.matrices, changes)]
            of = list(sites) or [str(i) for i in range(len(moved))]
            parts = [np.sum([m for m, s in zip(moved, of) if s == one], axis=0) for one in dict.fromkeys(of)]
        return np.sum([np.outer(part, part) for part in parts], axis=0)
