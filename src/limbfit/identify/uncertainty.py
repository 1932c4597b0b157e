"""What the data tell about the parameters, and what they do not.

Linearised at the answer, in logarithms of the parameters. The residuals have one covariance C, noise of the
records plus misfit of the model (``noise``, ``discrepancy``), and the covariance is that of the calibration's
own least squares under C. What is most probable under C lies one generalised least-squares step away; where
that step is longer than C explains, the rest of it is one more deviation. P is what the bounds say, the
spread of a uniform distribution between them, and what stated priors say: where the data are silent, that is
all that is known, and the interval says so. The size of the misfit is itself estimated from few independent
residuals, so intervals take Student's quantiles (Satterthwaite 1946).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import stdtrit  # Student quantiles; scipy.stats would take half a second to load

from .discrepancy import ResidualModel, estimate_discrepancy
from .noise import SiteNoise, curve_noise
from .objective import Measured, SiteResponse
from .parameters import Grouping, Space, Unknowns, search_space, separate

Array = NDArray[np.float64]

DETERMINED, WEAK, UNDETERMINED = "determined", "weakly determined", "not determined by these data"
GIVEN = "given, not identified"
# A 95 % interval of at most -20 to +25 % is called determined, one of a half to twofold weakly so.
_DETERMINED_FACTOR, _WEAK_FACTOR = 1.25, 2.0
# Whatever the width: an interval that is hardly narrower than the bounds comes from the bounds.
_PRIOR_SHARE = 0.5
_EDGE = 1e-3  # this close to a bound, in the logarithm, is on it
_MOST_FREEDOM = 1e6


@dataclass(frozen=True)
class Combination:
    """A product of powers of the parameters, ``exp(weights @ log(parameters))``, and how well it is known.

    ``sd_log`` is the standard deviation of its logarithm, ``factor_95`` the half-width of its 95 % interval
    as a factor.
    """

    weights: Array
    sd_log: float
    factor_95: float
    text: str
    verdict: str


@dataclass(frozen=True)
class Uncertainty:
    """Linearised uncertainty at the answer.

    ``centre`` (p,) are the most probable parameters; ``covariance`` and ``correlation`` (p, p) are of the
    logarithms; ``intervals_95`` (p, 2) are of the parameters, around them and kept between the bounds;
    ``degrees_of_freedom`` (p,) belong to them. ``combinations`` are the principal axes of the covariance, the
    best known first.
    """

    names: tuple[str, ...]
    parameters: Array
    centre: Array
    covariance: Array
    correlation: Array
    intervals_95: Array
    verdicts: tuple[str, ...]
    at_bound: tuple[bool, ...]
    combinations: tuple[Combination, ...]
    residual_model: ResidualModel
    degrees_of_freedom: Array

    @property
    def sd_log(self) -> Array:
        return np.sqrt(np.diag(self.covariance))

    def to_dict(self) -> dict[str, Any]:
        """JSON-like values."""
        model = self.residual_model
        return {
            "centre": dict(zip(self.names, self.centre.tolist())),
            "intervals_95": dict(zip(self.names, self.intervals_95.tolist())),
            "sd_log": dict(zip(self.names, self.sd_log.tolist())),
            "verdicts": dict(zip(self.names, self.verdicts)),
            "at_bound": dict(zip(self.names, self.at_bound)),
            "correlation": self.correlation.tolist(),
            "covariance_log": self.covariance.tolist(),
            "combinations": [
                {
                    "text": c.text,
                    "weights": c.weights.tolist(),
                    "sd_log": c.sd_log,
                    "factor_95": c.factor_95,
                    "verdict": c.verdict,
                }
                for c in self.combinations
            ],
            "degrees_of_freedom": dict(zip(self.names, self.degrees_of_freedom.tolist())),
            "residuals": model.to_dict(),
        }


def estimate_uncertainty(
    parameters: Array,
    responses: Sequence[SiteResponse],
    measured: Sequence[Measured],
    unknowns: Unknowns,
    noise: Sequence[SiteNoise] | None = None,
    grouping: Grouping | None = None,
) -> Uncertainty:
    """Covariance, intervals and verdicts at calibrated ``parameters`` (p,).

    Parameters
    ----------
    responses : forces and derivatives there (``Calibration.responses``).
    noise : of each site's record (``record_noise``); by default white, from the scatter of the residuals
        (``curve_noise``), which suits curves that were not smoothed.
    grouping : of the last stage; by default every parameter is free.
    """
    left = [response.force_N - site.force_N for response, site in zip(responses, measured, strict=True)]
    if noise is None:
        noise = [
            curve_noise(site.name, np.arange(float(r.size)), r, site.force_N)
            for site, r in zip(measured, left)
        ]
    space = search_space(unknowns, grouping or separate(unknowns.names))
    scaled = [space.pull_back(response.jacobian, parameters) for response in responses]
    z = space.reduce(np.log(parameters))
    prior = Beliefs.of(unknowns, space)
    peaks = np.array([site.force_N.max() for site in measured])
    model = estimate_discrepancy(left, scaled, noise, peaks, prior.precision)
    weights = [site.scale**2 for site in measured]
    linear = _Linear.at(left, scaled, weights, model, prior, space, z)
    return _told(np.asarray(parameters), linear, model, unknowns, space, prior)


@dataclass(frozen=True)
class Beliefs:
    """What is known before the data, in the search space: ``precision`` (k, k), ``sd`` (k,) of the bounds.

    ``rows @ z - target`` are the deviations from stated priors in their standard deviations.
    """

    precision: Array
    sd: Array
    rows: Array
    target: Array

    @classmethod
    def of(cls, unknowns: Unknowns, space: Space) -> Beliefs:
        sd = (space.upper - space.lower) / np.sqrt(12.0)
        rows, target = unknowns.prior_rows()
        own = rows @ space.tie
        return cls(np.diag(sd**-2) + own.T @ own, sd, own, target - rows @ space.fixed)


@dataclass(frozen=True)
class _Linear:
    """Covariance about the calibrated ``z`` (k,), and the part of it that misfit causes.

    The calibration weighs all points alike, generalised least squares by noise and misfit; ``centre`` (k,) is
    where the latter would go. Where the two are farther apart than noise and misfit explain, the rest counts
    as one more deviation: intervals must not say more than two readings of the same residuals agree on.
    """

    z: Array
    centre: Array
    covariance: Array
    by_misfit: Array
    known_scale: float

    @classmethod
    def at(
        cls,
        left: Sequence[Array],
        scaled: Sequence[Array],
        weights: Sequence[float],
        model: ResidualModel,
        prior: Beliefs,
        space: Space,
        z: Array,
    ) -> _Linear:
        """From residuals (n,), derivatives (n, k) and the calibration's weight of every site."""
        A, g = prior.precision.copy(), prior.rows.T @ (prior.rows @ z - prior.target)
        H, M, by_misfit = np.zeros_like(A), np.zeros_like(A), np.zeros_like(A)
        for i, (r, J, w) in enumerate(zip(left, scaled, weights)):
            weighted = np.linalg.solve(model.covariance(i), J)
            A += J.T @ weighted
            g += weighted.T @ r
            H += w * J.T @ J
            M += w**2 * J.T @ model.covariance(i) @ J
            by_misfit += w**2 * J.T @ model.discrepancy(i) @ J
        best = np.linalg.inv(A)  # the least covariance that any weights reach
        spread = max(float(np.trace(M) / np.trace(H)), 1e-16 * float(np.trace(H)))
        inverse = np.linalg.inv(H / spread + prior.precision)
        covariance = inverse @ (M / spread**2 + prior.precision) @ inverse
        caused = inverse @ (by_misfit / spread**2) @ inverse
        centre = np.clip(z - best @ g, space.lower, space.upper)
        apart = _unexplained(centre - z, covariance - best)
        total = covariance + apart
        return cls(z, centre, (total + total.T) / 2, caused + apart, model.known_scale)

    def freedom(self, weights: Array) -> float:
        """Degrees of freedom of the variance of ``weights @ z`` (Satterthwaite 1946)."""
        variance, caused = weights @ self.covariance @ weights, weights @ self.by_misfit @ weights
        if caused * np.sqrt(_MOST_FREEDOM) <= variance:
            return _MOST_FREEDOM
        return float(np.clip(self.known_scale * (variance / caused) ** 2, 1.0, _MOST_FREEDOM))

    def sd(self, weights: Array) -> float:
        return float(np.sqrt(weights @ self.covariance @ weights))

    def half_width(self, weights: Array) -> float:
        """Half the 95 % interval of ``weights @ z``."""
        return float(min(stdtrit(self.freedom(weights), 0.975) * self.sd(weights), 50.0))


def _unexplained(step: Array, expected: Array) -> Array:
    """The part (k, k) of the square of a step (k,) beyond the covariance that is ``expected`` of it."""
    values, vectors = np.linalg.eigh((expected + expected.T) / 2)
    values = np.maximum(values, 1e-3 * max(float(values[-1]), 1e-30))
    ratio = float(np.mean((vectors.T @ step) ** 2 / values))
    return np.outer(step, step) * max(1.0 - 1.0 / max(ratio, 1e-30), 0.0)


def _told(
    parameters: Array, linear: _Linear, model: ResidualModel, unknowns: Unknowns, space: Space, prior: Beliefs
) -> Uncertainty:
    """The answer in the search space as an answer about every parameter."""
    moved = np.asarray(space.tie.any(axis=1))
    middle = space.logarithms(linear.z)
    half = np.array([linear.half_width(row) for row in space.tie])
    low = np.maximum(np.exp(middle - half), np.where(moved, unknowns.lower, 0.0))
    high = np.minimum(np.exp(middle + half), np.where(moved, unknowns.upper, np.inf))
    shares = [linear.sd(row) / max(float(row @ prior.sd), 1e-300) for row in space.tie]
    verdicts = [
        verdict_of(float(np.exp(h)), share) if free else GIVEN for h, share, free in zip(half, shares, moved)
    ]
    covariance = space.tie @ linear.covariance @ space.tie.T
    sd = np.sqrt(np.where(moved, np.diag(covariance), 1.0))
    return Uncertainty(
        names=unknowns.names,
        parameters=parameters,
        centre=np.exp(space.logarithms(linear.centre)),
        covariance=covariance,
        correlation=covariance / np.outer(sd, sd),
        intervals_95=np.stack([low, high], axis=1),
        verdicts=tuple(verdicts),
        at_bound=tuple(_at_bound(parameters, unknowns)),
        combinations=_combinations(linear, space, unknowns.names, prior),
        residual_model=model,
        degrees_of_freedom=np.array(
            [linear.freedom(row) if row.any() else _MOST_FREEDOM for row in space.tie]
        ),
    )


def _at_bound(parameters: Array, unknowns: Unknowns) -> list[bool]:
    near_low = np.log(parameters / unknowns.lower) < _EDGE
    near_high = np.log(unknowns.upper / parameters) < _EDGE
    return [bool(edge) for edge in near_low | near_high]


def verdict_of(factor: float, share_of_prior: float) -> str:
    """In words: from half a 95 % interval as a factor, and its deviation over that of the bounds alone."""
    if factor <= _DETERMINED_FACTOR:
        return DETERMINED
    if factor <= _WEAK_FACTOR and share_of_prior < _PRIOR_SHARE:
        return WEAK
    return UNDETERMINED


def _combinations(
    linear: _Linear, space: Space, names: tuple[str, ...], prior: Beliefs
) -> tuple[Combination, ...]:
    """Principal axes, best known first; the weight of tied parameters is shared among them."""
    values, vectors = np.linalg.eigh(linear.covariance)
    members = space.tie.sum(axis=0)
    found = []
    for value, axis in zip(values, vectors.T):
        axis = axis * np.sign(axis[np.argmax(np.abs(axis))])
        sd = float(np.sqrt(max(value, 0.0)))
        factor = float(np.exp(linear.half_width(axis)))
        verdict = verdict_of(factor, sd / float(np.linalg.norm(axis * prior.sd)))
        weights = space.tie @ (axis / members)
        found.append(Combination(weights, sd, factor, product_text(weights, names), verdict))
    return tuple(found)


def product_text(weights: Array, names: tuple[str, ...]) -> str:
    """The combination in words: entries below a tenth are left out."""
    order = [k for k in np.argsort(-np.abs(weights)) if abs(weights[k]) >= 0.1]
    return " · ".join(f"{names[k]}^{weights[k]:.2f}" for k in order)
