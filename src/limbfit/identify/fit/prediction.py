"""How far simulated forces are from measured ones, and how far they may be."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import stdtrit

from .objective import SiteResponse, largest

Array = NDArray[np.float64]


def error_percent(simulated_N: Array, measured_N: Array) -> float:
    """Mean absolute error over the trace over the largest measured force, in percent (paper, table 2).

    Of lengths, which may be negative, over the largest without its sign.
    """
    return float(100 * np.mean(np.abs(simulated_N - measured_N)) / largest(measured_N))


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


def prediction_sd(
    jacobian: Array, parameters: Array, covariance_log: Array, noise_N: Array | float = 0.0
) -> Array:
    """Standard deviation (n,) N of a predicted force, linearised.

    Parameters
    ----------
    jacobian : (n, p) derivatives of the force with respect to the parameters.
    covariance_log : (p, p) covariance of the logarithms of the parameters (``Uncertainty.covariance``).
    noise_N : standard deviation, (n,) or one, of what a new record adds: noise, and the model's misfit.
    """
    scaled = jacobian * parameters
    return np.sqrt(np.einsum("ni,ij,nj->n", scaled, covariance_log, scaled) + noise_N**2)


@dataclass(frozen=True)
class Known:
    """What a prediction interval needs of a stored uncertainty (``Uncertainty``, ``ResidualModel.to_dict``).

    ``sites`` are noise and misfit of the fitted sites; ``known_scale`` the independent residuals on which the
    size of the misfit rests; ``site_factor`` how much farther than expected whole sites are off.
    ``most_probable`` (p,): parameters that are so, which those of the least error need not be.
    """

    covariance_log: Array
    most_probable: Array
    sites: dict[str, dict[str, Any]]
    misfit_elsewhere: float
    known_scale: float
    site_factor: float = 1.0

    @classmethod
    def of(cls, uncertainty: dict[str, Any]) -> Known:
        """From the part ``uncertainty`` of ``calibration.json``."""
        residuals = uncertainty["residuals"]
        return cls(
            np.array(uncertainty["covariance_log"]),
            np.array([value for one in uncertainty["most_probable"].values() for value in one.values()]),
            residuals["sites"],
            float(residuals["misfit_elsewhere"]),
            float(residuals["known_scale"]),
            float(residuals.get("site_factor") or 1.0),
        )

    def residual(self, site: str, unit: str = "N") -> tuple[float, float]:
        """Noise (N) and misfit (over the largest force) of a site; of a typical one where not fitted.

        Where no fitted record compares what this one does (``unit``: forces, or depths in mm), its noise is
        not known, and none.
        """
        if site in self.sites:
            return self.sites[site]["compared_noise_sd_N"], self.sites[site]["misfit_share"]
        alike = [found for found in self.sites.values() if found.get("unit", "N") == unit]
        noise = [found["compared_noise_sd_N"] for found in alike]
        return float(np.median(noise)) if noise else 0.0, self.misfit_elsewhere

    def interval_95(
        self,
        response: SiteResponse,
        parameters: Array,
        name: str,
        unit: str = "N",
        site_N: Array | float = 0.0,
    ) -> tuple[Array, Array]:
        """The 95 % interval (n,) N of a new record at a site: parameters, misfit of the model, noise.

        Of a ``response`` at the ``parameters`` (p,) and of that at the most probable ones. In mm for a record
        that compares depths (``unit``). As few residuals as the misfit is known from widen it (Student;
        Satterthwaite's freedom). ``site_N`` (n,) is one standard deviation of what is expected of the
        stiffness of a site that was not fitted.
        """
        noise_N, misfit = self.residual(name, unit)
        misfit_N = misfit * largest(response.force_N)
        own_N = np.hypot(np.hypot(noise_N, misfit_N), self.site_factor * np.abs(site_N))
        sd = prediction_sd(response.jacobian, parameters, self.covariance_log, own_N)
        share = misfit_N**2 / np.maximum(sd, 1e-300) ** 2
        freedom = np.clip(self.known_scale / np.maximum(share, 1e-3) ** 2, 3.0, 1e6)
        half, off = stdtrit(freedom, 0.975) * sd, np.log(self.most_probable / parameters)
        other = response.force_N + response.jacobian @ (parameters * off)
        return np.minimum(response.force_N, other) - half, np.maximum(response.force_N, other) + half
