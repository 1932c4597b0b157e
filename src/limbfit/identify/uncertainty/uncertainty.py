"""The linearised uncertainty: what the data tell about the parameters, and what they do not.

It is linearised at the answer, in logarithms of the parameters. The residuals have one covariance C: noise of
the records, error of the mesh and misfit of the model (``noise``, ``discrepancy``). The covariance of the
parameters is that of the calibration as it was done, with its own objective and weights, under C
(``estimator``). A stated prior is one more reading, whose median is off by its stated deviation.

The most probable parameters under C lie one generalised least-squares step away. If that step is longer than
C explains, the rest of it is one more deviation. The bounds count as a uniform distribution between them:
where the data say nothing, that is all that is known, and the interval shows it. The size of the misfit is
itself estimated from few independent residuals, so intervals take Student's quantiles (Satterthwaite 1946).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import stdtrit  # Student quantiles; scipy.stats would take half a second to load

from ...arrays import Array
from ..fit.calibration import CalibrationSettings
from ..fit.objective import MeasuredCurve, SiteResponse
from ..fit.parameters import Grouping, SearchSpace, Unknowns, build_space, group_separately
from ..fit.prediction import MAX_FREEDOM, combine_freedom
from .discrepancy import ResidualModel, estimate_discrepancy, estimate_mesh_misfit
from .estimator import Estimator, PriorPrecision
from .noise import SiteNoise

DETERMINED, WEAK, UNDETERMINED = "determined", "weakly determined", "not determined by these data"
GIVEN = "given, not identified"
LINEARISED, SAMPLED = "linearised", "sampled"
NORMAL_95 = 1.959964  # half of a 95 % interval, in standard deviations of a normal distribution
# A 95 % interval of at most -20 to +25 % is called determined, one of a half to twofold weakly so.
_MAX_DETERMINED_FACTOR, _MAX_WEAK_FACTOR = 1.25, 2.0
# Whatever the width: an interval that is hardly narrower than the bounds comes from the bounds.
_MAX_BOUND_SHARE = 0.5


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
    """What is known of the answer; ``method`` says whether its intervals are linearised or sampled.

    ``centre`` (p,) are the most probable parameters. ``covariance`` (p, p) is that of the answer's logarithms
    about the truth, always linearised, and ``about_centre`` (p, p) that of the most probable ones.
    ``sampling_covariance`` (p, p) is the part that the records cause: the scatter of answers to other records
    with the same priors. ``site_covariance`` (p, p) is the part that comes from sites that
    differ as a whole. ``correlation`` (p, p) is of the logarithms. ``intervals_95`` (p, 2) are of the
    parameters and lie between the bounds; ``degrees_of_freedom`` (p,) belong to the linearised ones.
    ``combinations`` are the principal axes, the best known first. ``prior_share`` and ``wider_without`` (p,):
    see `PriorPrecision.compute_shares`. ``minus_2_log_evidence`` compares models of the same records:
    Laplace's approximation, with the priors and with a misfit that each model estimates from its own
    residuals.
    """

    names: tuple[str, ...]
    parameters: Array
    centre: Array
    covariance: Array
    about_centre: Array
    sampling_covariance: Array
    site_covariance: Array
    correlation: Array
    intervals_95: Array
    verdicts: tuple[str, ...]
    at_bound: tuple[bool, ...]
    combinations: tuple[Combination, ...]
    residual_model: ResidualModel
    degrees_of_freedom: Array
    prior_share: Array
    wider_without: Array
    minus_2_log_evidence: float = float("nan")
    method: str = LINEARISED

    @property
    def sd_log(self) -> Array:
        return np.sqrt(np.diag(self.covariance))


def estimate_uncertainty(
    parameters: Array,
    responses: Sequence[SiteResponse],
    measured: Sequence[MeasuredCurve],
    unknowns: Unknowns,
    noise: Sequence[SiteNoise],
    grouping: Grouping | None = None,
    settings: CalibrationSettings | None = None,
    mesh_N: Sequence[Array] = (),
    site_N: Sequence[Array] = (),
) -> Uncertainty:
    """Estimate covariance, intervals and verdicts at calibrated ``parameters`` (p,).

    Parameters
    ----------
    responses : forces and derivatives there (``Calibration.responses``).
    noise : of each site's record (``estimate_record_noise``), or of curves that were not smoothed
        (``estimate_curve_noise``).
    grouping : of the last stage; by default every parameter is free.
    settings : with which the parameters were found, because the covariance is that of this estimator.
    mesh_N : (n,) per site, one standard deviation of the mesh's error in the force; empty: it is left out.
    site_N : (n,) per site, the expected deviation of the site's force as a whole; residuals correct its size.
    """
    residuals = [response.force_N - site.force_N for response, site in zip(responses, measured, strict=True)]
    space = build_space(unknowns, grouping or group_separately(unknowns.names))
    scaled = [space.pull_back(response.jacobian, parameters) for response in responses]
    z = space.reduce(np.log(parameters))
    prior = PriorPrecision.from_unknowns(unknowns, space)
    peaks = np.array([site.peak_N for site in measured])
    model = estimate_discrepancy(residuals, scaled, noise, peaks, prior.precision, mesh_N, site_N)
    of_mesh = estimate_mesh_misfit(mesh_N, scaled, noise, peaks, prior.precision, site_N)
    model = replace(model, mesh_misfit=of_mesh)
    chosen = settings or CalibrationSettings()
    weights = [
        one.compute_cost_curvature(chosen.objective, r) for r, one in zip(residuals, measured, strict=True)
    ]
    estimator = Estimator.linearise(scaled, weights, prior.rows, (chosen.force_error_percent / 100) ** 2)
    estimate = _LinearisedEstimate.linearise(residuals, scaled, estimator, model, prior, space, z)
    found = _build_uncertainty(np.asarray(parameters), estimate, model, unknowns, space, prior)
    stated = prior.rows @ z - prior.target
    evidence = model.criterion + float(stated @ stated) - float(np.linalg.slogdet(prior.precision)[1])
    return replace(found, minus_2_log_evidence=evidence)


@dataclass(frozen=True)
class _LinearisedEstimate:
    """Covariance about the calibrated ``z`` (k,), and the parts of it that records, misfit and sites that
    differ cause.

    ``centre`` (k,) is where generalised least squares by noise and misfit would go, with covariance ``best``
    (k, k); the calibration has other weights. If the two are farther apart than noise and misfit explain, the
    rest counts as one more deviation of the answer: its intervals must not say more than two readings of the
    same residuals agree on. ``about_centre`` (k, k) is without that. It is the covariance of the
    calibration's own estimator, which no details of the records make small, and it is larger than that of the
    most probable parameters (Gauss and Markov).
    """

    z: Array
    centre: Array
    best: Array
    covariance: Array
    about_centre: Array
    by_records: Array
    by_misfit: Array
    by_sites: Array
    known_scale: float
    site_freedom: float

    @classmethod
    def linearise(
        cls,
        residuals: Sequence[Array],
        scaled: Sequence[Array],
        estimator: Estimator,
        model: ResidualModel,
        prior: PriorPrecision,
        space: SearchSpace,
        z: Array,
    ) -> _LinearisedEstimate:
        """Build the estimate from residuals (n,) and derivatives (n, k) per site and the estimator there."""
        best, centre = _solve_most_probable(residuals, scaled, model, prior, z)
        centre = np.clip(centre, space.lower, space.upper)
        own_covariances = [model.own_covariance(i) for i in range(len(residuals))]
        M = estimator.propagate_covariance(own_covariances) + estimator.propagate_shared(
            model.shared_deviations
        )
        H = estimator.force_hessian
        # What the bounds say has no place in the estimator: it counts as beside records of the mean noise.
        spread = max(float(np.trace(M) / np.trace(H)), 1e-16 * float(np.trace(H)))
        inverse = np.linalg.inv(estimator.hessian / spread + prior.bound_precision) / spread
        by_records = inverse @ M @ inverse
        prior_covariance = estimator.prior_covariance + spread**2 * prior.bound_precision
        covariance = by_records + inverse @ prior_covariance @ inverse
        misfits = [model.misfit_covariance(i) for i in range(len(residuals))]
        by_misfit = inverse @ estimator.propagate_covariance(misfits) @ inverse
        by_sites = inverse @ estimator.propagate_shared(model.site_deviations) @ inverse
        unexplained = _compute_unexplained(centre - z, covariance - best)
        return cls(
            z=z,
            centre=centre,
            best=best,
            covariance=_symmetrise(covariance + unexplained),
            about_centre=_symmetrise(covariance),
            by_records=_symmetrise(by_records),
            by_misfit=by_misfit + unexplained,
            by_sites=_symmetrise(by_sites),
            known_scale=model.known_scale,
            site_freedom=model.site_freedom,
        )

    def freedom(self, weights: Array) -> float:
        """Degrees of freedom of the variance of ``weights @ z`` (Satterthwaite 1946)."""
        variance = max(float(weights @ self.covariance @ weights), np.finfo(float).tiny)
        misfit, sites = (
            float(weights @ part @ weights) / variance for part in (self.by_misfit, self.by_sites)
        )
        return float(combine_freedom((misfit, self.known_scale), (sites, self.site_freedom)))

    def sd(self, weights: Array) -> float:
        return float(np.sqrt(weights @ self.covariance @ weights))

    def half_width(self, weights: Array) -> float:
        """Half the 95 % interval of ``weights @ z``."""
        return float(min(stdtrit(self.freedom(weights), 0.975) * self.sd(weights), 50.0))


def _solve_most_probable(
    residuals: Sequence[Array], scaled: Sequence[Array], model: ResidualModel, prior: PriorPrecision, z: Array
) -> tuple[Array, Array]:
    """Solve the generalised least squares; return the smallest covariance (k, k) and the answer (k,)."""
    A, g = prior.precision.copy(), prior.rows.T @ (prior.rows @ z - prior.target)
    for r, J, weighted in zip(residuals, scaled, model.solve(scaled)):
        A += J.T @ weighted
        g += weighted.T @ r
    best = np.asarray(np.linalg.inv(A), dtype=np.float64)
    return best, z - best @ g


def _symmetrise(matrix: Array) -> Array:
    return (matrix + matrix.T) / 2


def _compute_unexplained(step: Array, expected: Array) -> Array:
    """Return the part (k, k) of the square of a step (k,) that exceeds its expected covariance."""
    values, vectors = np.linalg.eigh(_symmetrise(expected))
    values = np.maximum(values, 1e-3 * max(float(values[-1]), 1e-30))
    ratio = float(np.mean((vectors.T @ step) ** 2 / values))
    return np.outer(step, step) * max(1.0 - 1.0 / max(ratio, 1e-30), 0.0)


def _build_uncertainty(
    parameters: Array,
    estimate: _LinearisedEstimate,
    model: ResidualModel,
    unknowns: Unknowns,
    space: SearchSpace,
    prior: PriorPrecision,
) -> Uncertainty:
    """Express the answer in the search space as an answer about every parameter."""
    moves = np.asarray(space.tie.any(axis=1))
    middle = space.to_logarithms(estimate.z)
    half = np.array([estimate.half_width(row) for row in space.tie])
    low = np.maximum(np.exp(middle - half), np.where(moves, unknowns.lower, 0.0))
    high = np.minimum(np.exp(middle + half), np.where(moves, unknowns.upper, np.inf))
    shares = [estimate.sd(row) / max(float(row @ prior.sd), 1e-300) for row in space.tie]
    verdicts = [
        choose_verdict(float(np.exp(h)), share) if free else GIVEN
        for h, share, free in zip(half, shares, moves)
    ]
    covariance = space.tie @ estimate.covariance @ space.tie.T
    share, wider = prior.compute_shares(estimate.best, space.tie)
    sd = np.sqrt(np.where(moves, np.diag(covariance), 1.0))
    return Uncertainty(
        names=unknowns.names,
        parameters=parameters,
        centre=np.exp(space.to_logarithms(estimate.centre)),
        covariance=covariance,
        about_centre=space.tie @ estimate.about_centre @ space.tie.T,
        sampling_covariance=space.tie @ estimate.by_records @ space.tie.T,
        site_covariance=space.tie @ estimate.by_sites @ space.tie.T,
        correlation=covariance / np.outer(sd, sd),
        intervals_95=np.stack([low, high], axis=1),
        verdicts=tuple(verdicts),
        at_bound=tuple(map(bool, unknowns.is_at_bound(parameters))),
        combinations=_build_combinations(estimate, space, unknowns.names, prior),
        residual_model=model,
        degrees_of_freedom=np.array(
            [estimate.freedom(row) if row.any() else MAX_FREEDOM for row in space.tie]
        ),
        prior_share=share,
        wider_without=wider,
    )


def choose_verdict(factor: float, share_of_prior: float) -> str:
    """Choose the verdict from half a 95 % interval as a factor, and its sd over that of the bounds alone."""
    if factor <= _MAX_DETERMINED_FACTOR:
        return DETERMINED
    if factor <= _MAX_WEAK_FACTOR and share_of_prior < _MAX_BOUND_SHARE:
        return WEAK
    return UNDETERMINED


def _build_combinations(
    estimate: _LinearisedEstimate, space: SearchSpace, names: tuple[str, ...], prior: PriorPrecision
) -> tuple[Combination, ...]:
    """Return the principal axes, best known first; the weight of tied parameters is divided among them."""
    values, vectors = np.linalg.eigh(estimate.covariance)
    members = space.tie.sum(axis=0)
    found = []
    for value, axis in zip(values, vectors.T):
        axis = axis * np.sign(axis[np.argmax(np.abs(axis))])
        sd = float(np.sqrt(max(value, 0.0)))
        factor = float(np.exp(estimate.half_width(axis)))
        verdict = choose_verdict(factor, sd / float(np.linalg.norm(axis * prior.sd)))
        weights = space.tie @ (axis / members)
        middle = float(weights @ space.to_logarithms(estimate.z))
        found.append(Combination(weights, middle, sd, factor, format_product(weights, names), verdict))
    return tuple(found)


def format_product(weights: Array, names: tuple[str, ...]) -> str:
    """Write a combination as text; entries below a tenth are left out."""
    order = [k for k in np.argsort(-np.abs(weights)) if abs(weights[k]) >= 0.1]
    return " · ".join(f"{names[k]}^{weights[k]:.2f}" for k in order)
