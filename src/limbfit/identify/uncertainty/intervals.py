"""Intervals and verdicts from what a calibration simulated anyway: an emulator of it, and a sample on that.

The records leave the answer open along a valley that is bent, and the calibration, which weighs all points
of a record alike, ends somewhere along it: a linearisation there is too sure. The simulations that led there
know the bend. An emulator through their forces and derivatives stands in for the solver, and a few further
simulations are made where noise and misfit say that the parameters are most probable. Where the emulator
knows little its own expected error counts as misfit, so that intervals are wider there.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from ..fit.objective import Measured, Simulate, SiteResponse
from ..fit.parameters import Space, Unknowns
from ..fit.prediction import error_percent
from .emulator import Emulator
from .likelihood import Likelihood
from .posterior import Posterior, principal_axes, sample_posterior, weigh_posterior
from .uncertainty import GIVEN, SAMPLED, Combination, Uncertainty, product_text, verdict_of

Array = NDArray[np.float64]

_FURTHER_SIMULATIONS = 10  # of single records
_MOST_EVALUATIONS = 2  # of all records: further ones hardly changed an interval
_NEAR, _NEAR_PERCENT = 4.0, 3.0  # runs are used whose error is at most so many times the least, plus this
_MOST_RUNS = 24
_STEPS = 1500  # of the sampler, where weighed draws do not do
_THINNED = 8  # draws among which the most probable is looked for
_SAME = 1e-6  # in logarithms: the same point


@dataclass
class KeptRuns:
    """Complete simulations of all sites: ``points`` (p,) and the ``responses`` there."""

    points: list[Array] = field(default_factory=list)
    responses: list[Sequence[SiteResponse]] = field(default_factory=list)

    def add(self, parameters: Array, responses: Sequence[SiteResponse]) -> bool:
        """Whether all sites' simulations completed: what failed is not kept."""
        if not all(response.completed and np.isfinite(response.force_N).all() for response in responses):
            return False
        if not any(np.abs(np.log(parameters / point)).max() < _SAME for point in self.points):
            self.points.append(np.array(parameters))
            self.responses.append(tuple(responses))
        return True

    def of(self, simulate: Simulate) -> Simulate:
        """The same simulation, whose answers are kept."""

        def keeping(parameters: Array) -> Sequence[SiteResponse]:
            found = simulate(parameters)
            self.add(parameters, found)
            return found

        return keeping

    def near(self, measured: Sequence[Measured]) -> KeptRuns:
        """Those whose forces came near the records, the nearest first."""
        errors = [
            float(np.mean([error_percent(r.force_N, site.force_N) for r, site in zip(run, measured)]))
            for run in self.responses
        ]
        order = [i for i in np.argsort(errors) if errors[i] <= _NEAR * min(errors) + _NEAR_PERCENT]
        chosen = order[:_MOST_RUNS]
        return KeptRuns([self.points[i] for i in chosen], [self.responses[i] for i in chosen])


def further_evaluations(records: int, spent: int) -> int:
    """How many evaluations of all records may follow ``spent`` simulations: two where ten suffice, else one.

    Without any the emulator may never have seen where noise and misfit say that the answer is.
    """
    return int(np.clip((_FURTHER_SIMULATIONS - spent) // records, 1, _MOST_EVALUATIONS))


def sampled_uncertainty(
    known: Uncertainty,
    measured: Sequence[Measured],
    unknowns: Unknowns,
    space: Space,
    kept: KeptRuns,
    simulate: Simulate,
    evaluations: int = _MOST_EVALUATIONS,
    seed: int = 0,
    moves: bool = False,
) -> Uncertainty:
    """``known`` with sampled intervals, combinations, verdicts and correlations.

    Of the least squares; or of what is most probable, to which the answer ``moves``.

    Parameters
    ----------
    known : linearised (``estimate_uncertainty``); its covariance of the residuals is used, and that of the
        answer, or of what is most probable.
    space : of the calibration's last stage.
    kept : what the calibration simulated.
    simulate : for so many further ``evaluations``; one that fails is tried again half-way.

    Notes
    -----
    Where not even two evaluations completed ``known`` itself comes back, and says that it is linearised.
    """
    runs = kept.near(measured)
    if len(runs.points) < 2:
        _learn(runs, simulate, known.centre)
    if len(runs.points) < 2:
        return known

    def likelihood() -> Likelihood:
        emulator = Emulator.fit(unknowns.names, np.array(runs.points), runs.responses)
        model, doubting = known.residual_model, emulator.forces_and_doubt
        return Likelihood(emulator, measured, model, unknowns, space, doubting)

    for _ in range(evaluations):
        now = likelihood()
        _learn(runs, simulate, _most_probable(now, _sample(now, runs, seed)))
    posterior = _sample(likelihood(), runs, seed, last=True)
    if moves:
        known = moved(known, unknowns, space.expand(space.reduce(np.log(posterior.median))))
    found = both_readings(known, posterior, unknowns, space)
    return replace(found, centre=known.parameters) if moves else found


def _sample(likelihood: Likelihood, runs: KeptRuns, seed: int, last: bool = False) -> Posterior:
    """From the most probable run on; where weighed draws miss much of the last sample, by a longer walk."""
    z = np.array([likelihood.space.reduce(np.log(point)) for point in runs.points])
    best = z[int(np.argmin(likelihood.minus_2_log(z)))]
    covariance = likelihood.covariance(best)
    found = weigh_posterior(likelihood, best, covariance, seed=seed)
    if found.long_enough or not last:
        return found
    return sample_posterior(likelihood, best, covariance, steps=_STEPS, seed=seed)


def _most_probable(likelihood: Likelihood, posterior: Posterior) -> Array:
    """Parameters (p,) from the draws on; least squares knows nothing of doubt, so it may lead astray."""
    tie = likelihood.space.tie
    z = np.log(posterior.draws[::_THINNED]) @ (tie / tie.sum(axis=0))
    drawn = z[int(np.argmin(likelihood.minus_2_log(z)))]
    candidates = np.array([drawn, np.median(z, axis=0), likelihood.optimum(drawn).z])
    return likelihood.space.expand(candidates[int(np.argmin(likelihood.minus_2_log(candidates)))])


def _learn(runs: KeptRuns, simulate: Simulate, point: Array) -> None:
    """Simulate at a point; once more half-way to the best that completed where that fails."""
    point = _six_digits(point)
    if not runs.add(point, simulate(point)):
        half = np.sqrt(point * runs.points[0])
        runs.add(half, simulate(half))


def moved(known: Uncertainty, unknowns: Unknowns, parameters: Array) -> Uncertainty:
    """``known`` about the most probable ``parameters`` (p,), in six digits."""
    answer = _six_digits(parameters)
    at_bound = tuple(map(bool, unknowns.at_bound(answer)))
    return replace(known, parameters=answer, covariance=known.about_centre, at_bound=at_bound)


def _six_digits(point: Array) -> Array:
    """A point that a run taken up again comes to as well."""
    return np.array([float(f"{value:.6g}") for value in point])


def both_readings(
    known: Uncertainty, posterior: Posterior, unknowns: Unknowns, space: Space, seed: int = 0
) -> Uncertainty:
    """``known`` with what two readings of the same records say together, one as likely as the other.

    The posterior weighs the records by noise and misfit, and follows the bend; the linearised answer weighs
    all points alike. Details of the records tell of the mesh too, which only the first believes: an interval
    must not say more than the two agree on.
    """
    linear = np.random.default_rng(seed).multivariate_normal(
        np.log(known.parameters), known.covariance, len(posterior.draws), method="eigh"
    )
    linear = np.clip(linear, *np.log([unknowns.lower, unknowns.upper]))
    pooled = np.vstack([posterior.draws, np.exp(linear)])
    return restated(known, replace(posterior, draws=pooled), unknowns, space)


def restated(known: Uncertainty, posterior: Posterior, unknowns: Unknowns, space: Space) -> Uncertainty:
    """``known`` with what draws of the parameters say in place of its linearisation."""
    logs = np.log(posterior.draws)
    prior_sd = np.log(unknowns.upper / unknowns.lower) / np.sqrt(12.0)
    covariance, intervals = posterior.covariance, posterior.intervals_95
    sd = np.sqrt(np.diag(covariance))
    factors = np.sqrt(intervals[:, 1] / intervals[:, 0])
    verdicts = [
        GIVEN if before == GIVEN else verdict_of(float(factor), float(share))
        for before, factor, share in zip(known.verdicts, factors, sd / prior_sd)
    ]
    moved = np.where(sd > 0, sd, 1.0)
    return replace(
        known,
        method=SAMPLED,
        centre=posterior.median,
        correlation=covariance / np.outer(moved, moved),
        intervals_95=intervals,
        verdicts=tuple(verdicts),
        combinations=tuple(
            _combination(weights, logs @ weights, prior_sd, known.names)
            for weights in principal_axes(posterior, space)
        ),
    )


def _combination(weights: Array, drawn: Array, prior_sd: Array, names: tuple[str, ...]) -> Combination:
    """A product of powers whose logarithm was drawn (m,)."""
    low, high = np.quantile(drawn, [0.025, 0.975])
    sd, factor = float(drawn.std()), float(np.exp((high - low) / 2))
    verdict = verdict_of(factor, sd / float(np.linalg.norm(weights * prior_sd)))
    text = product_text(weights, names)
    return Combination(weights, float(low + high) / 2, sd, factor, text, verdict)
