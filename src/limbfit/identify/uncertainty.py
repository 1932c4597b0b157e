"""What the data tell about the parameters, and what they do not.

Linearised at the answer, in logarithms of the parameters. The fit weighs sites by their largest force, not by
their noise, and what is left over is mostly the model's own misfit, which drifts along the trace instead of
scattering. So the covariance is the sandwich of weighted least squares (White 1980; Newey and West 1987 for
correlated residuals): ``H^-1 M H^-1`` with ``H = J' W J`` and ``M = J' W S W J``, where S holds each site's
residual variance and an exponential autocorrelation estimated from its residuals. The bounds enter as the
spread of a uniform distribution between them: where the data say nothing, that is all that is known, and the
interval says so.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import toeplitz
from scipy.special import stdtrit  # Student quantiles; scipy.stats would take half a second to load

from .objective import Measured, SiteResponse
from .parameters import Unknowns

Array = NDArray[np.float64]

DETERMINED, WEAK, UNDETERMINED = "determined", "weakly determined", "not determined by these data"
# A 95 % interval of at most -20 to +25 % is called determined, one of a half to twofold weakly so.
_DETERMINED_FACTOR, _WEAK_FACTOR = 1.25, 2.0
# Whatever the width: an interval that is hardly narrower than the bounds comes from the bounds.
_PRIOR_SHARE = 0.5
_EDGE = 1e-3  # this close to a bound, in the logarithm, is on it


@dataclass(frozen=True)
class Combination:
    """A product of powers of the parameters, ``exp(weights @ log(parameters))``, and how well it is known.

    ``weights`` (p,) has unit length; ``sd_log`` is the standard deviation of its logarithm.
    """

    weights: Array
    sd_log: float
    text: str
    verdict: str


@dataclass(frozen=True)
class SiteNoise:
    """Residuals of a site: standard deviation, correlation of neighbours, and the equivalent free samples."""

    name: str
    sd_N: float
    autocorrelation: float
    effective_samples: float


@dataclass(frozen=True)
class Uncertainty:
    """Linearised uncertainty at the answer.

    ``covariance`` and ``correlation`` (p, p) are of the logarithms; ``intervals_95`` (p, 2) are of the
    parameters, kept between the bounds; ``combinations`` are the principal axes of the covariance, the best
    known first.
    """

    names: tuple[str, ...]
    parameters: Array
    covariance: Array
    correlation: Array
    intervals_95: Array
    verdicts: tuple[str, ...]
    at_bound: tuple[bool, ...]
    combinations: tuple[Combination, ...]
    noise: tuple[SiteNoise, ...]
    degrees_of_freedom: float

    @property
    def sd_log(self) -> Array:
        return np.sqrt(np.diag(self.covariance))

    def to_dict(self) -> dict[str, Any]:
        """JSON-like values."""
        return {
            "intervals_95": dict(zip(self.names, self.intervals_95.tolist())),
            "sd_log": dict(zip(self.names, self.sd_log.tolist())),
            "verdicts": dict(zip(self.names, self.verdicts)),
            "at_bound": dict(zip(self.names, self.at_bound)),
            "correlation": self.correlation.tolist(),
            "covariance_log": self.covariance.tolist(),
            "combinations": [
                {"text": c.text, "weights": c.weights.tolist(), "sd_log": c.sd_log, "verdict": c.verdict}
                for c in self.combinations
            ],
            "noise": {
                n.name: {
                    "sd_N": n.sd_N,
                    "autocorrelation": n.autocorrelation,
                    "effective_samples": n.effective_samples,
                }
                for n in self.noise
            },
            "degrees_of_freedom": self.degrees_of_freedom,
        }


def estimate_uncertainty(
    parameters: Array,
    responses: Sequence[SiteResponse],
    measured: Sequence[Measured],
    unknowns: Unknowns,
) -> Uncertainty:
    """Covariance, intervals and verdicts at calibrated ``parameters`` (p,), all of them free.

    Parameters
    ----------
    responses : forces and derivatives there (``Calibration.responses``).
    """
    left = [response.force_N - site.force_N for response, site in zip(responses, measured, strict=True)]
    noise = _noise(left, [site.name for site in measured], len(parameters))
    scaled = [response.jacobian * parameters for response in responses]
    prior_sd = np.log(unknowns.upper / unknowns.lower) / np.sqrt(12.0)
    covariance = _sandwich(scaled, measured, noise, prior_sd)
    freedom = max(sum(n.effective_samples for n in noise) - len(parameters), 1.0)
    sd = np.sqrt(np.diag(covariance))
    factor = np.exp(np.minimum(stdtrit(freedom, 0.975) * sd, 50.0))
    low, high = (
        np.maximum(parameters / factor, unknowns.lower),
        np.minimum(parameters * factor, unknowns.upper),
    )
    axes = _combinations(covariance, unknowns.names, prior_sd, freedom)
    return Uncertainty(
        names=unknowns.names,
        parameters=parameters,
        covariance=covariance,
        correlation=covariance / np.outer(sd, sd),
        intervals_95=np.stack([low, high], axis=1),
        verdicts=tuple(_verdict(f, s / p) for f, s, p in zip(factor, sd, prior_sd)),
        at_bound=tuple(_at_bound(parameters, unknowns)),
        combinations=axes,
        noise=noise,
        degrees_of_freedom=float(freedom),
    )


def _noise(residuals: Sequence[Array], names: Sequence[str], parameters: int) -> tuple[SiteNoise, ...]:
    """Standard deviation and first-order autocorrelation per site, corrected for what the fit took away."""
    lags = [_autocorrelation(residual, parameters / len(residuals)) for residual in residuals]
    effective = [r.size * (1 - lag) / (1 + lag) for r, lag in zip(residuals, lags)]
    kept = max(1 - parameters / sum(effective), 0.1)
    sd = [float(np.sqrt(residual @ residual / (residual.size * kept))) for residual in residuals]
    return tuple(SiteNoise(*entry) for entry in zip(names, sd, lags, effective))


def _autocorrelation(residual: Array, fitted: float) -> float:
    """Correlation of neighbours; its bias grows with ``fitted`` parameters per site (Marriott and Pope 1954).

    A perfect fit says nothing about it.
    """
    n, squares = residual.size, float(residual @ residual)
    lag = float(residual[1:] @ residual[:-1]) / squares if squares > 0 else 0.0
    return float(np.clip(lag + (1 + 3 * lag) * fitted / n, 0.0, 1 - 2 / n))


def _sandwich(
    scaled: Sequence[Array], measured: Sequence[Measured], noise: Sequence[SiteNoise], prior_sd: Array
) -> Array:
    """Covariance (p, p) of the logarithms; the prior carries the directions that H does not see."""
    weights = [site.scale**2 for site in measured]
    H = sum(w * J.T @ J for w, J in zip(weights, scaled))
    M = sum(w**2 * J.T @ _noise_covariance(n, len(J)) @ J for w, J, n in zip(weights, scaled, noise))
    spread = max(float(np.trace(M) / np.trace(H)), 1e-16 * float(np.trace(H)))
    prior = np.diag(prior_sd**-2)
    inverse = np.linalg.inv(H / spread + prior)
    covariance = inverse @ (M / spread**2 + prior) @ inverse
    return (covariance + covariance.T) / 2


def _noise_covariance(noise: SiteNoise, n: int) -> Array:
    return noise.sd_N**2 * toeplitz(noise.autocorrelation ** np.arange(n))


def _at_bound(parameters: Array, unknowns: Unknowns) -> list[bool]:
    near_low = np.log(parameters / unknowns.lower) < _EDGE
    near_high = np.log(unknowns.upper / parameters) < _EDGE
    return [bool(edge) for edge in near_low | near_high]


def _verdict(factor: float, share_of_prior: float) -> str:
    if factor <= _DETERMINED_FACTOR:
        return DETERMINED
    if factor <= _WEAK_FACTOR and share_of_prior < _PRIOR_SHARE:
        return WEAK
    return UNDETERMINED


def _combinations(
    covariance: Array, names: tuple[str, ...], prior_sd: Array, freedom: float
) -> tuple[Combination, ...]:
    """Principal axes, best known first."""
    values, vectors = np.linalg.eigh(covariance)
    found = []
    for value, weights in zip(values, vectors.T):
        weights = weights * np.sign(weights[np.argmax(np.abs(weights))])
        sd = float(np.sqrt(max(value, 0.0)))
        factor = float(np.exp(min(stdtrit(freedom, 0.975) * sd, 50.0)))
        share = sd / float(np.linalg.norm(weights * prior_sd))
        found.append(Combination(weights, sd, _product(weights, names), _verdict(factor, share)))
    return tuple(found)


def _product(weights: Array, names: tuple[str, ...]) -> str:
    """The combination in words: entries below a tenth are left out."""
    order = [k for k in np.argsort(-np.abs(weights)) if abs(weights[k]) >= 0.1]
    return " · ".join(f"{names[k]}^{weights[k]:.2f}" for k in order)
