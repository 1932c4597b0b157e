"""Intervals and verdicts from the simulations of a calibration: an emulator of them, and a sample on that.

The records leave the answer open along a bent valley. The calibration, which weighs all points of a record
alike, ends somewhere along it, and a linearisation there is too narrow. The simulations of the search know
the bend. An emulator of their forces and derivatives replaces the solver, and a few further simulations are
made at the parameters that are most probable by noise and misfit. The expected error of the emulator counts
as misfit, so intervals are wider where it knows little.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from ...arrays import Array
from ..fit.objective import MeasuredCurve, Simulate, SiteResponse
from ..fit.prediction import compute_errors_percent
from .emulator import Emulator
from .likelihood import Likelihood
from .posterior import Posterior, sample_by_importance, sample_posterior
from .uncertainty import (
    SAMPLED,
    Uncertainty,
    build_combinations,
    choose_verdicts,
    compute_correlation,
    compute_principal_axes,
)

_MAX_FURTHER_SIMULATIONS = 10  # of single records
_MAX_FURTHER_EVALUATIONS = 2  # of all records: further ones hardly changed an interval
# Runs are used whose error is at most so many times the least, plus this
_NEAR_FACTOR, _NEAR_PERCENT = 4.0, 3.0
_MAX_EVALUATIONS = 24
_WALK_STEPS = 1500  # of the sampler, where weighed samples do not do
_THINNING = 8  # samples among which the most probable is looked for
_SAME_POINT_LOG = 1e-6  # in logarithms: the same point


@dataclass
class EvaluationStore:
    """Complete evaluations of all sites: ``points`` (p,) and the ``responses`` there."""

    points: list[Array] = field(default_factory=list)
    responses: list[Sequence[SiteResponse]] = field(default_factory=list)

    def add(self, parameters: Array, responses: Sequence[SiteResponse]) -> bool:
        """Store an evaluation if all its simulations completed, and return True if they did."""
        if not all(response.completed and np.isfinite(response.force_N).all() for response in responses):
            return False
        if not any(np.abs(np.log(parameters / point)).max() < _SAME_POINT_LOG for point in self.points):
            self.points.append(np.array(parameters))
            self.responses.append(tuple(responses))
        return True

    def select_near(self, measured: Sequence[MeasuredCurve]) -> EvaluationStore:
        """Return the evaluations whose forces came near the records, the nearest first."""
        errors = [float(np.mean(compute_errors_percent(run, measured))) for run in self.responses]
        order = [i for i in np.argsort(errors) if errors[i] <= _NEAR_FACTOR * min(errors) + _NEAR_PERCENT]
        chosen = order[:_MAX_EVALUATIONS]
        return EvaluationStore([self.points[i] for i in chosen], [self.responses[i] for i in chosen])


def count_further_evaluations(records: int, spent: int) -> int:
    """Return how many evaluations of all records may follow ``spent`` simulations: one or two.

    Without any, the emulator may never have seen the parameters that are most probable by noise and misfit.
    """
    return int(np.clip((_MAX_FURTHER_SIMULATIONS - spent) // records, 1, _MAX_FURTHER_EVALUATIONS))


def sample_uncertainty(
    linearised: Uncertainty,
    evaluations: EvaluationStore,
    simulate: Simulate,
    further: int = _MAX_FURTHER_EVALUATIONS,
    move_answer: bool = False,
) -> Uncertainty:
    """Replace intervals, combinations, verdicts and correlations of a linearised uncertainty by sampled ones.

    If not even two evaluations completed, ``linearised`` itself is returned; its ``method`` says so.

    ``linearised``: of ``estimate_uncertainty``. Its covariance of the residuals is used, and that of the
    answer, or of the most probable parameters. ``evaluations``: of the calibration. ``simulate``: called for
    at most ``further`` more evaluations; one that fails is tried again half-way. ``move_answer``: True if the
    answer moves from the least squares to the most probable parameters.
    """
    runs = evaluations.select_near(linearised.measured)
    if len(runs.points) < 2:
        _add_evaluation(runs, simulate, linearised.centre)
    if len(runs.points) < 2:
        return linearised
    for _ in range(further):
        likelihood = _build_likelihood(linearised, runs)
        _add_evaluation(runs, simulate, _find_most_probable(likelihood, _sample(likelihood, runs)))
    posterior = _sample(_build_likelihood(linearised, runs), runs, last=True)
    if not move_answer:
        return pool_linearised_samples(linearised, posterior)
    space = linearised.space
    answer = _round_to_six_digits(space.expand(space.reduce(np.log(posterior.median))))
    moved = replace(linearised, parameters=answer, covariance=linearised.about_centre)
    return replace(pool_linearised_samples(moved, posterior), centre=answer)


def _build_likelihood(known: Uncertainty, runs: EvaluationStore) -> Likelihood:
    emulator = Emulator(np.array(runs.points), runs.responses)
    return Likelihood(emulator, known.measured, known.residual_model, known.unknowns, known.space, True)


def _sample(likelihood: Likelihood, runs: EvaluationStore, last: bool = False) -> Posterior:
    """Sample from the most probable evaluation on, the ``last`` time by a longer walk if it needs one."""
    z = np.array([likelihood.space.reduce(np.log(point)) for point in runs.points])
    best = z[int(np.argmin(likelihood.compute_minus_2_log(z)))]
    covariance = likelihood.compute_covariance(best)
    found = sample_by_importance(likelihood, best, covariance)
    if found.long_enough or not last:
        return found
    return sample_posterior(likelihood, best, covariance, steps=_WALK_STEPS)


def _find_most_probable(likelihood: Likelihood, posterior: Posterior) -> Array:
    """Return the most probable parameters (p,), from the samples on.

    Least squares alone does not know the emulator's expected error, so it may lead astray.
    """
    tie = likelihood.space.tie
    z = np.log(posterior.samples[::_THINNING]) @ (tie / tie.sum(axis=0))
    drawn = z[int(np.argmin(likelihood.compute_minus_2_log(z)))]
    candidates = np.array([drawn, np.median(z, axis=0), likelihood.find_optimum(drawn).z])
    return likelihood.space.expand(candidates[int(np.argmin(likelihood.compute_minus_2_log(candidates)))])


def _add_evaluation(runs: EvaluationStore, simulate: Simulate, point: Array) -> None:
    """Simulate at a point; if that fails, once more half-way to the best evaluation."""
    point = _round_to_six_digits(point)
    if not runs.add(point, simulate(point)):
        half = np.sqrt(point * runs.points[0])
        runs.add(half, simulate(half))


def _round_to_six_digits(point: Array) -> Array:
    """Round a point, so that a continued run comes to the same one."""
    return np.array([float(f"{value:.6g}") for value in point])


def pool_linearised_samples(linearised: Uncertainty, posterior: Posterior) -> Uncertainty:
    """Pool the posterior with samples of the linearised answer: two readings of the same records, equally
    likely.

    The posterior weighs the records by noise and misfit, and follows the bend; the linearised answer weighs
    all points alike. Details of the records also contain errors of the mesh, which only the posterior
    believes. An interval must not say more than both readings agree on. How far sites differ is drawn, too.
    """
    random, model, draws = np.random.default_rng(0), linearised.residual_model, len(posterior.samples)
    zero = np.zeros(len(linearised.parameters))
    others = linearised.covariance - linearised.site_covariance
    drawn = random.multivariate_normal(np.log(linearised.parameters), others, draws, method="eigh")
    of_sites = random.multivariate_normal(zero, linearised.site_covariance, draws, method="eigh")
    drawn += random.choice(model.site_factors, (draws, 1)) / model.site_factor * of_sites
    pooled = np.vstack([posterior.samples, np.exp(linearised.space.clip(drawn))])
    return restate_from_samples(linearised, replace(posterior, samples=pooled))


def restate_from_samples(known: Uncertainty, posterior: Posterior) -> Uncertainty:
    """Return the uncertainty with what samples of the parameters say in place of its linearisation."""
    covariance, intervals = posterior.covariance, posterior.intervals_95
    factors = np.sqrt(intervals[:, 1] / intervals[:, 0])
    sd, rows = np.sqrt(np.diag(covariance)), np.eye(len(covariance))
    axes = compute_principal_axes(covariance, known.space)
    along = np.log(posterior.samples) @ axes.T
    low, high = np.quantile(along, [0.025, 0.975], axis=0)
    return replace(
        known,
        method=SAMPLED,
        centre=posterior.median,
        correlation=compute_correlation(covariance),
        intervals_95=intervals,
        verdicts=choose_verdicts(known.space, rows, factors, sd),
        combinations=build_combinations(
            known.names, known.space, axes, (low + high) / 2, (high - low) / 2, along.std(axis=0)
        ),
    )
