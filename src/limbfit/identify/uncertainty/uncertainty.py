"""What the data tell about the parameters, and what they do not.

Linearised at the answer, in logarithms of the parameters. The residuals have one covariance C, noise of the
records, error of the mesh and misfit of the model (``noise``, ``discrepancy``), and the covariance is that of
the calibration as it was done, with its own objective and weights, under C (``estimator``). A stated prior is
one more reading: its median is off the truth by its stated deviation. What is most probable under C lies one
generalised least-squares step away; where that step is longer than C explains, the rest of it is one more
deviation. The bounds count as the spread of a uniform distribution between them: where the data are silent,
that is all that is known, and the interval says so. The size of the misfit is itself estimated from few
independent residuals, so intervals take Student's quantiles (Satterthwaite 1946).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import stdtrit  # Student quantiles; scipy.stats would take half a second to load

from ..fit.objective import Measured, SiteResponse
from ..fit.parameters import Grouping, Space, Unknowns, search_space, separate
from ..fit.state import CalibrationSettings
from .beliefs import Beliefs
from .discrepancy import ResidualModel, estimate_discrepancy
from .estimator import Estimator
from .noise import SiteNoise

Array = NDArray[np.float64]

DETERMINED, WEAK, UNDETERMINED = "determined", "weakly determined", "not determined by these data"
GIVEN = "given, not identified"
LINEARISED, SAMPLED = "linearised", "sampled"
NORMAL_95 = 1.959964  # half of a 95 % interval, in standard deviations of a normal distribution
# A 95 % interval of at most -20 to +25 % is called determined, one of a half to twofold weakly so.
_DETERMINED_FACTOR, _WEAK_FACTOR = 1.25, 2.0
# Whatever the width: an interval that is hardly narrower than the bounds comes from the bounds.
_PRIOR_SHARE = 0.5
_MOST_FREEDOM = 1e6


@dataclass(frozen=True)
class Combination:
    """A product of powers of the parameters, ``exp(weights @ log(parameters))``, and how well it is known.

    ``middle_log`` is the middle of the 95 % interval of its logarithm, ``factor_95`` half its width as a
    factor, ``sd_log`` the logarithm's standard deviation.
    """

    weights: Array
    middle_log: float
    sd_log: float
    factor_95: float
    text: str
    verdict: str


@dataclass(frozen=True)
class Uncertainty:
    """What is known of the answer: linearised there, or with intervals that were sampled (``intervals``).

    ``method`` says which. ``centre`` (p,) are the most probable parameters; ``covariance`` (p, p) is that of
    the answer's logarithms about the truth, always linearised, ``about_centre`` (p, p) that of the most
    probable ones, and ``sampling_covariance`` (p, p) the part of it that records cause, the scatter of
    answers to other records with the same priors. ``correlation``
    (p, p) is of the logarithms, ``intervals_95`` (p, 2) are of the parameters and lie between the bounds;
    ``degrees_of_freedom`` (p,) belong to the linearised ones. ``combinations`` are the principal axes, the
    best known first. ``prior_share`` and ``wider_without`` (p,): see `Beliefs.shares`.
    """

    names: tuple[str, ...]
    parameters: Array
    centre: Array
    covariance: Array
    about_centre: Array
    sampling_covariance: Array
    correlation: Array
    intervals_95: Array
    verdicts: tuple[str, ...]
    at_bound: tuple[bool, ...]
    combinations: tuple[Combination, ...]
    residual_model: ResidualModel
    degrees_of_freedom: Array
    prior_share: Array
    wider_without: Array
    method: str = LINEARISED

    @property
    def sd_log(self) -> Array:
        return np.sqrt(np.diag(self.covariance))


def estimate_uncertainty(
    parameters: Array,
    responses: Sequence[SiteResponse],
    measured: Sequence[Measured],
    unknowns: Unknowns,
    noise: Sequence[SiteNoise],
    grouping: Grouping | None = None,
    settings: CalibrationSettings | None = None,
    mesh_N: Sequence[Array] = (),
    site_N: Sequence[Array] = (),
) -> Uncertainty:
    """Covariance, intervals and verdicts at calibrated ``parameters`` (p,).

    Parameters
    ----------
    responses : forces and derivatives there (``Calibration.responses``).
    noise : of each site's record (``record_noise``), or of curves that were not smoothed (``curve_noise``).
    grouping : of the last stage; by default every parameter is free.
    settings : with which the parameters were found: the covariance is that of this estimator.
    mesh_N : (n,) per site, one standard deviation of the mesh's error in the force; none: it is left out.
    site_N : (n,) per site, what its force as a whole is expected to be off by; residuals correct the size.
    """
    left = [response.force_N - site.force_N for response, site in zip(responses, measured, strict=True)]
    space = search_space(unknowns, grouping or separate(unknowns.names))
    scaled = [space.pull_back(response.jacobian, parameters) for response in responses]
    z = space.reduce(np.log(parameters))
    prior = Beliefs.of(unknowns, space)
    peaks = np.array([site.peak_N for site in measured])
    model = estimate_discrepancy(left, scaled, noise, peaks, prior.precision, mesh_N, site_N)
    chosen = settings or CalibrationSettings()
    weights = [one.curvature(chosen.objective, r) for r, one in zip(left, measured, strict=True)]
    estimator = Estimator.at(scaled, weights, prior.rows, (chosen.force_error_percent / 100) ** 2)
    linear = _Linear.at(left, scaled, estimator, model, prior, space, z)
    return _told(np.asarray(parameters), linear, model, unknowns, space, prior)


@dataclass(frozen=True)
class _Linear:
    """Covariance about the calibrated ``z`` (k,), and the parts of it that records and that misfit cause.

    ``centre`` (k,) is where generalised least squares by noise and misfit would go, with covariance ``best``
    (k, k); the calibration's own weights are not those. Where the two are farther apart than noise and misfit
    explain, the rest counts as one more deviation of the answer: its intervals must not say more than two
    readings of the same residuals agree on. ``about_centre`` (k, k) is without that. It is the covariance of
    the calibration's own estimator, which no details of the records make small, and more than that of what
    is most probable (Gauss and Markov).
    """

    z: Array
    centre: Array
    best: Array
    covariance: Array
    about_centre: Array
    by_records: Array
    by_misfit: Array
    known_scale: float

    @classmethod
    def at(
        cls,
        left: Sequence[Array],
        scaled: Sequence[Array],
        estimator: Estimator,
        model: ResidualModel,
        prior: Beliefs,
        space: Space,
        z: Array,
    ) -> _Linear:
        """From residuals (n,), derivatives (n, k) of every site and the calibration's estimator there."""
        best, centre = _most_probable(left, scaled, model, prior, z)
        centre = np.clip(centre, space.lower, space.upper)
        own = [model.own(i) for i in range(len(left))]
        M, H = estimator.by_covariance(own, model.shared), estimator.force_hessian
        # What the bounds say has no place in the estimator: it counts as beside records of the mean noise.
        spread = max(float(np.trace(M) / np.trace(H)), 1e-16 * float(np.trace(H)))
        inverse = np.linalg.inv(estimator.hessian / spread + prior.bounds) / spread
        by_records = inverse @ M @ inverse
        beliefs = estimator.by_medians + spread**2 * prior.bounds
        covariance = by_records + inverse @ beliefs @ inverse
        misfits = [model.discrepancy(i) for i in range(len(left))]
        by_misfit = inverse @ estimator.by_covariance(misfits) @ inverse
        apart = _unexplained(centre - z, covariance - best)
        return cls(
            z=z,
            centre=centre,
            best=best,
            covariance=_symmetric(covariance + apart),
            about_centre=_symmetric(covariance),
            by_records=_symmetric(by_records),
            by_misfit=by_misfit + apart,
            known_scale=model.known_scale,
        )

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


def _most_probable(
    left: Sequence[Array], scaled: Sequence[Array], model: ResidualModel, prior: Beliefs, z: Array
) -> tuple[Array, Array]:
    """Of generalised least squares: the covariance (k, k), the least of any weights, and the answer (k,)."""
    A, g = prior.precision.copy(), prior.rows.T @ (prior.rows @ z - prior.target)
    for r, J, weighted in zip(left, scaled, model.solve(scaled)):
        A += J.T @ weighted
        g += weighted.T @ r
    best = np.asarray(np.linalg.inv(A), dtype=np.float64)
    return best, z - best @ g


def _symmetric(matrix: Array) -> Array:
    return (matrix + matrix.T) / 2


def _unexplained(step: Array, expected: Array) -> Array:
    """The part (k, k) of the square of a step (k,) beyond the covariance that is ``expected`` of it."""
    values, vectors = np.linalg.eigh(_symmetric(expected))
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
    share, wider = prior.shares(linear.best, space.tie)
    sd = np.sqrt(np.where(moved, np.diag(covariance), 1.0))
    return Uncertainty(
        names=unknowns.names,
        parameters=parameters,
        centre=np.exp(space.logarithms(linear.centre)),
        covariance=covariance,
        about_centre=space.tie @ linear.about_centre @ space.tie.T,
        sampling_covariance=space.tie @ linear.by_records @ space.tie.T,
        correlation=covariance / np.outer(sd, sd),
        intervals_95=np.stack([low, high], axis=1),
        verdicts=tuple(verdicts),
        at_bound=tuple(map(bool, unknowns.at_bound(parameters))),
        combinations=_combinations(linear, space, unknowns.names, prior),
        residual_model=model,
        degrees_of_freedom=np.array(
            [linear.freedom(row) if row.any() else _MOST_FREEDOM for row in space.tie]
        ),
        prior_share=share,
        wider_without=wider,
    )


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
        middle = float(weights @ space.logarithms(linear.z))
        found.append(Combination(weights, middle, sd, factor, product_text(weights, names), verdict))
    return tuple(found)


def product_text(weights: Array, names: tuple[str, ...]) -> str:
    """The combination in words: entries below a tenth are left out."""
    order = [k for k in np.argsort(-np.abs(weights)) if abs(weights[k]) >= 0.1]
    return " · ".join(f"{names[k]}^{weights[k]:.2f}" for k in order)
