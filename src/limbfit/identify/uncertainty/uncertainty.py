"""The linearised uncertainty: what the data tell about the parameters, and what they do not.

It is linearised at the answer, in logarithms of the parameters. The residuals have one covariance C: noise of
the records, error of the mesh and misfit of the model (``noise``, ``discrepancy``). The covariance of the
parameters is that of the calibration as it was done, with its own objective and weights, under C. A stated
prior is one more reading, whose median is off by its stated deviation.

At the answer the gradient of what was minimised is zero. The implicit function theorem therefore gives the
change of the answer from that of the records and of the priors' medians (Huber 1967, the sandwich): ``H^-1 J'
W dy`` and ``H^-1 s^2 R' db``. J are the derivatives of a site's force, W is the curvature of its cost
(`MeasuredCurve.compute_cost_curvature`), s^2 the weight of the priors, R their rows, and ``H = J' W J + s^2
R' R``. The second derivatives of the force are left out: they multiply residuals whose mean is zero.

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
from ..fit.prediction import combine_freedom
from .discrepancy import ResidualModel, estimate_discrepancy, estimate_mesh_misfit, limit_to_mean_square
from .noise import SiteNoise

DETERMINED, WEAK, UNDETERMINED = "determined", "weakly determined", "not determined by these data"
GIVEN = "given, not identified"
LINEARISED, SAMPLED = "linearised", "sampled"
# A 95 % interval of at most -20 to +25 % is called determined, one of a half to twofold weakly so.
_MAX_DETERMINED_FACTOR, _MAX_WEAK_FACTOR = 1.25, 2.0
# Whatever the width: an interval that is hardly narrower than the bounds comes from the bounds.
_MAX_BOUND_SHARE = 0.5


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
        rows, target = unknowns.build_prior_rows()
        return cls(space.bounds_sd, rows @ space.tie, target - rows @ space.fixed_log)

    @property
    def bound_precision(self) -> Array:
        """Precision (k, k) of the bounds."""
        return np.diag(self.sd**-2)

    @property
    def precision(self) -> Array:
        """Precision (k, k) of bounds and priors together."""
        return self.bound_precision + self.rows.T @ self.rows

    def compute_deviations(self, z: Array) -> Array:
        """Return how far z (k,) is off each stated prior's median, in its standard deviations."""
        return self.rows @ z - self.target

    def weigh(self, jacobians: Sequence[Array], model: ResidualModel) -> tuple[Array, list[Array]]:
        """Return the precision (k, k) of records and priors together, ``J' C^-1 J + P``, and ``C^-1 J``.

        ``jacobians`` (n, k) are the derivatives of each record's force in the search space.
        """
        weighted = model.solve(jacobians)
        return self.precision + sum(J.T @ W for J, W in zip(jacobians, weighted)), weighted

    def compute_shares(self, covariance: Array, tie: Array) -> tuple[Array, Array]:
        """Return how much of what is known of each parameter comes from the stated priors.

        ``covariance``: (k, k) of the most probable answer to records, bounds and priors together. ``tie``:
        (p, k) of the space. Returned are (p,) the part of the variance that comes from the deviations of the
        priors' medians, where the rest comes from records and bounds, and (p,) how many times as wide the
        interval of the logarithm would be without priors. Both follow from linear theory; they are 0 and 1
        for a parameter that does not move.
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


class _LinearisedEstimate:
    """Covariance (k, k) about the calibrated z (k,), and the parts of it that records, misfit and sites that
    differ cause.

    ``centre`` (k,) is where generalised least squares by noise and misfit would go, with covariance ``best``
    (k, k); the calibration has other weights. If the two are farther apart than noise and misfit explain, the
    rest counts as one more deviation of the answer: its intervals must not say more than two readings of the
    same residuals agree on. ``about_centre`` (k, k) is without that. It is the covariance of the
    calibration's own estimator, which no details of the records make small, and it is larger than that of the
    most probable parameters (Gauss and Markov). Readings beside the records are not in the calibration's
    cost: they are joined to its estimator with the weights of least variance, so it never knows less by them.
    """

    def __init__(
        self,
        z: Array,
        residuals: Sequence[Array],
        jacobians: Sequence[Array],
        curvatures: Sequence[Array],
        prior_share: float,
        prior: PriorPrecision,
        stated: int,
        model: ResidualModel,
        space: SearchSpace,
    ) -> None:
        """Linearise at z (k,) from residuals (n,), derivatives (n, k) N and the curvature (n, n) of
        the cost per record; ``prior_share`` is the weight of the priors' squares in the cost. The first
        ``stated`` rows of ``prior`` are stated priors, the others readings.
        """
        precision, weighted = prior.weigh(jacobians, model)
        self.model, self.best = model, np.asarray(np.linalg.inv(precision), dtype=np.float64)
        slope = prior.rows.T @ prior.compute_deviations(z) + sum(W.T @ r for r, W in zip(residuals, weighted))
        self.centre = np.clip(z - self.best @ slope, space.lower, space.upper)
        gradients = [J.T @ W for J, W in zip(jacobians, curvatures, strict=True)]
        G = np.hstack(gradients)
        M = G @ model.covariance @ G.T
        H = G @ np.concatenate(jacobians)
        of_priors, of_readings = (rows.T @ rows for rows in np.split(prior.rows, [stated]))
        # What the bounds say has no place in the estimator: it counts as beside records of the mean noise.
        spread = max(float(np.trace(M) / np.trace(H)), 1e-16 * float(np.trace(H)))
        inverse = np.linalg.inv((H + prior_share * of_priors) / spread + prior.bound_precision) / spread
        known_before = prior_share**2 * of_priors + spread**2 * prior.bound_precision
        alone = inverse @ (M + known_before) @ inverse
        joined = np.eye(len(z)) + alone @ of_readings  # its inverse is the weight of the estimator alone
        inverse, self.about_centre = np.linalg.solve(joined, inverse), np.linalg.solve(joined, alone)
        self.by_records = inverse @ M @ inverse.T
        unexplained = _compute_unexplained(self.centre - z, self.about_centre - self.best)
        self.covariance = self.about_centre + unexplained
        of_misfit = sum(own @ model.misfit_covariance(i) @ own.T for i, own in enumerate(gradients))
        self.by_misfit = inverse @ of_misfit @ inverse.T + unexplained
        of_sites = inverse @ G @ np.concatenate(model.site_deviations)
        self.by_sites = of_sites @ of_sites.T

    def judge(self, rows: Array) -> tuple[Array, Array, Array]:
        """Return half the 95 % intervals of ``rows @ z``, rows (m, k), their standard deviations, and the
        degrees of freedom of the variances (Satterthwaite 1946), each (m,)."""
        variance, misfit, sites = (
            np.einsum("mi,ij,mj->m", rows, part, rows)
            for part in (self.covariance, self.by_misfit, self.by_sites)
        )
        sd, variance = np.sqrt(variance), np.maximum(variance, np.finfo(float).tiny)
        parts = (misfit / variance, self.model.known_scale), (sites / variance, self.model.site_freedom)
        freedom = combine_freedom(*parts)
        return np.minimum(stdtrit(freedom, 0.975) * sd, 50.0), sd, freedom


def _compute_unexplained(step: Array, expected: Array) -> Array:
    """Return the part (k, k) of the square of a step (k,) that exceeds its expected covariance."""
    values, vectors = np.linalg.eigh(expected)
    values = np.maximum(values, 1e-3 * max(float(values[-1]), 1e-30))
    ratio = float(np.mean((vectors.T @ step) ** 2 / values))
    return np.outer(step, step) * max(1.0 - 1.0 / max(ratio, 1e-30), 0.0)


@dataclass(frozen=True)
class Combination:
    """A product of powers of the parameters, ``exp(weights @ log(parameters))``, and how well it is known.

    ``middle_log`` is the middle of the 95 % interval of its logarithm, ``factor_95`` half its width as a
    factor.
    """

    weights: Array
    middle_log: float
    factor_95: float
    text: str
    verdict: str


@dataclass(frozen=True)
class Uncertainty:
    """What is known of the answer; ``method`` says whether its intervals are linearised or sampled.

    The answer is that to the ``measured`` curves in the ``space`` of the calibration's last stage.
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

    measured: tuple[MeasuredCurve, ...]
    unknowns: Unknowns
    space: SearchSpace
    residual_model: ResidualModel
    parameters: Array
    centre: Array
    covariance: Array
    about_centre: Array
    sampling_covariance: Array
    site_covariance: Array
    correlation: Array
    intervals_95: Array
    verdicts: tuple[str, ...]
    combinations: tuple[Combination, ...]
    degrees_of_freedom: Array
    prior_share: Array
    wider_without: Array
    minus_2_log_evidence: float
    method: str = LINEARISED

    @property
    def names(self) -> tuple[str, ...]:
        return self.unknowns.names

    @property
    def at_bound(self) -> tuple[bool, ...]:
        """True for each parameter that moved and lies at one of its bounds."""
        return tuple(map(bool, self.unknowns.is_at_bound(self.parameters) & self.space.tie.any(axis=1)))


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
    parameters, settings = np.asarray(parameters), settings or CalibrationSettings()
    space = build_space(unknowns, grouping or group_separately(unknowns.names))
    prior = PriorPrecision.from_unknowns(unknowns, space)
    z = space.reduce(np.log(parameters))
    residuals = [response.force_N - site.force_N for response, site in zip(responses, measured, strict=True)]
    scaled = [space.pull_back(response.jacobian, parameters) for response in responses]
    peaks = np.array([site.peak_N for site in measured])
    misfit = np.zeros(len(peaks))
    model = ResidualModel(tuple(noise), peaks, misfit, mesh_N=tuple(mesh_N), site_N=tuple(site_N))
    mesh_misfit = estimate_mesh_misfit(model, scaled, prior.precision)
    model = estimate_discrepancy(model, residuals, scaled, prior.precision)
    model = replace(limit_to_mean_square(model, residuals, scaled), mesh_misfit=mesh_misfit)
    curvatures = [
        one.compute_cost_curvature(settings.objective, r) for r, one in zip(residuals, measured, strict=True)
    ]
    share = (settings.force_error_percent / 100) ** 2
    stated = len(unknowns.priors)
    estimate = _LinearisedEstimate(z, residuals, scaled, curvatures, share, prior, stated, model, space)

    tie, middle = space.tie, space.to_logarithms(z)
    half, sd, freedom = estimate.judge(tie)
    low, high = np.exp(space.clip(np.stack([middle - half, middle + half])))
    covariance = tie @ estimate.covariance @ tie.T
    axes = compute_principal_axes(covariance, space)
    half_of_axes, sd_of_axes, _ = estimate.judge(axes @ tie)
    share_of_prior, wider = prior.compute_shares(estimate.best, tie)
    off = prior.compute_deviations(z)
    return Uncertainty(
        measured=tuple(measured),
        unknowns=unknowns,
        space=space,
        residual_model=model,
        parameters=parameters,
        centre=np.exp(space.to_logarithms(estimate.centre)),
        covariance=covariance,
        about_centre=tie @ estimate.about_centre @ tie.T,
        sampling_covariance=tie @ estimate.by_records @ tie.T,
        site_covariance=tie @ estimate.by_sites @ tie.T,
        correlation=compute_correlation(covariance),
        intervals_95=np.stack([low, high], axis=1),
        verdicts=choose_verdicts(space, np.eye(len(tie)), np.exp(half), sd),
        combinations=build_combinations(unknowns.names, space, axes, axes @ middle, half_of_axes, sd_of_axes),
        degrees_of_freedom=freedom,
        prior_share=share_of_prior,
        wider_without=wider,
        minus_2_log_evidence=model.criterion
        + float(off @ off)
        - float(np.linalg.slogdet(prior.precision)[1]),
    )


def compute_correlation(covariance: Array) -> Array:
    """Return the correlation (p, p) of a covariance (p, p); it is 0 for what does not vary."""
    sd = np.sqrt(np.diag(covariance))
    sd = np.where(sd > 0, sd, 1.0)
    return covariance / np.outer(sd, sd)


def reduce_covariance(covariance: Array, space: SearchSpace) -> Array:
    """Return the covariance (k, k) in a search space of that (p, p) of the logarithms."""
    mean = space.tie / space.tie.sum(axis=0)
    return mean.T @ covariance @ mean


def compute_principal_axes(covariance: Array, space: SearchSpace) -> Array:
    """Return the independent combinations of the parameters (k, p), best known first, of a search space.

    A row holds the weights of logarithms: a combination is ``exp(weights @ log(parameters))``; the weight of
    tied parameters is divided among them. The ``covariance`` (p, p) of samples gives the axes of these:
    where samples lie along a bend, the narrowest direction at its middle is not the narrowest of all of them.
    """
    _, vectors = np.linalg.eigh(reduce_covariance(covariance, space))
    signs = np.sign(vectors[np.argmax(np.abs(vectors), axis=0), np.arange(len(vectors))])
    return np.asarray((space.tie @ ((vectors * signs) / space.tie.sum(axis=0)[:, None])).T)


def choose_verdict(factor: float, share_of_prior: float) -> str:
    """Choose the verdict from half a 95 % interval as a factor, and its sd over that of the bounds alone."""
    if factor <= _MAX_DETERMINED_FACTOR:
        return DETERMINED
    if factor <= _MAX_WEAK_FACTOR and share_of_prior < _MAX_BOUND_SHARE:
        return WEAK
    return UNDETERMINED


def choose_verdicts(space: SearchSpace, rows: Array, factors: Array, sd_log: Array) -> tuple[str, ...]:
    """Choose the verdicts (m,) on ``rows @ log(parameters)``, rows (m, p); what does not move is given.

    Known of each are half its 95 % interval as a factor, and its standard deviation.
    """
    by_bounds = np.linalg.norm(rows @ space.tie * space.bounds_sd, axis=1)
    return tuple(
        choose_verdict(factor, sd / most) if most > 0 else GIVEN
        for factor, sd, most in zip(factors.tolist(), sd_log.tolist(), by_bounds.tolist(), strict=True)
    )


def build_combinations(
    names: Sequence[str], space: SearchSpace, axes: Array, middle_log: Array, half_log: Array, sd_log: Array
) -> tuple[Combination, ...]:
    """Build combinations with weights ``axes`` (k, p) from what is known of their logarithms, each (k,).

    These are the middle of the 95 % interval, half its width, and the standard deviation.
    """
    factors = np.exp(half_log)
    verdicts = choose_verdicts(space, axes, factors, sd_log)
    return tuple(
        Combination(row, middle, factor, format_product(row, names), verdict)
        for row, middle, factor, verdict in zip(axes, middle_log.tolist(), factors.tolist(), verdicts)
    )


def format_product(weights: Array, names: Sequence[str]) -> str:
    """Write a combination as text; entries below a tenth are left out."""
    order = [k for k in np.argsort(-np.abs(weights)) if abs(weights[k]) >= 0.1]
    return " · ".join(f"{names[k]}^{weights[k]:.2f}" for k in order)


@dataclass(frozen=True)
class FitSensitivity:
    """The change of the linearised fit's answer with the simulated force of each site.

    ``matrices`` are (p, n) per site, per N, for the logarithms of the full parameters: ``-(J' C^-1 J + P)^-1
    J' C^-1``.
    """

    matrices: tuple[Array, ...]

    @classmethod
    def linearise(cls, known: Uncertainty, responses: Sequence[SiteResponse]) -> FitSensitivity:
        """Build the sensitivity of the fit from the responses at its answer."""
        space = known.space
        scaled = [space.pull_back(response.jacobian, known.parameters) for response in responses]
        prior = PriorPrecision.from_unknowns(known.unknowns, space)
        precision, weighted = prior.weigh(scaled, known.residual_model)
        return cls(tuple(-space.tie @ np.linalg.solve(precision, W.T) for W in weighted))

    def compute_shift(self, changes: Sequence[Array]) -> Array:
        """Return the change (p,) of the logarithms if forces rise by ``changes`` (n,) at all sites."""
        return np.sum([G @ change for G, change in zip(self.matrices, changes, strict=True)], axis=0)

    def compute_covariance(self, changes: Sequence[Array], shared: bool, sites: Sequence[str] = ()) -> Array:
        """Return the covariance (p, p) if ``changes`` are one standard deviation, ``shared`` by all sites or
        not.

        ``sites`` names the site of each change if several belong to one; by default each has its own.
        """
        moved = np.array([G @ change for G, change in zip(self.matrices, changes, strict=True)])
        names = np.array(list(sites) or range(len(moved)))
        together = shared | (names[:, None] == names)
        return np.asarray(moved.T @ together @ moved)
