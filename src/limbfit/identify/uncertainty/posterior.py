"""Samples of the parameters from their joint distribution, given the records, and its exploration in rounds.

The distribution is uniform in the logarithms between the bounds, times stated priors, times the likelihood;
the size of the misfit is sampled with the parameters. The sampler is emcee's ensemble (Goodman and Weare
2010; Foreman-Mackey et al. 2013).

The exploration is of everything that the records leave open. Each round fits the emulator to all simulations
so far, samples the posterior on it, and simulates with the solver where that posterior is and where the runs
so far are farthest away. It ends when the emulator's error over the posterior is below what the records can
tell, or when the allowed runs are used up.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np
from scipy.linalg import block_diag, cholesky, solve_triangular
from scipy.spatial.distance import cdist
from scipy.special import logsumexp, softmax

from ...arrays import Array
from ...results.uncertainty import EmulatorRound, PosteriorSummary, ProfileCheck
from ..fit.objective import SiteResponse
from ..fit.parameters import SearchSpace
from ..fit.prediction import compute_errors_percent
from .emulator import Emulator
from .likelihood import (
    MISFIT_FACTOR_BOUNDS,
    Likelihood,
    Optimum,
    Profile,
    check_profile_ends,
    compute_profile,
)
from .uncertainty import Uncertainty, reduce_covariance

SimulateMany = Callable[[Sequence[Array]], Sequence[Sequence[SiteResponse]]]

_WALKERS_PER_DIMENSION = 4
_MIN_AUTOCORRELATION_TIMES = 50  # autocorrelation times that make a chain long enough (emcee's own rule)
_KEPT_SAMPLES = 4000  # samples
# Of weighed samples; of Student's distribution
_MAX_ROUNDS, _SAMPLES_PER_ROUND, _STUDENT_FREEDOM = 12, 1000, 6.0
_TARGET_EFFECTIVE_SIZE, _MIN_EFFECTIVE_SIZE = 1000, 200
_CANDIDATES, _DESIGN_WIDENING = 400, 1.2  # the first design is this much wider than the linearised posterior
_MAX_DISTANCE = 1.4  # distance of a candidate from their middle, over the root of their dimension
_SHORT_CHAIN_STEPS = 800
_CHECKED_SAMPLES = 150  # samples at which the emulator's error is asked
_ERROR_QUANTILE = 0.9  # of those errors
_MAX_OUTSIDE = 0.05  # share of those samples outside the emulator's runs


@dataclass(frozen=True)
class Posterior:
    """Samples (m, p) of the parameters and (m,) of the misfit's factor, and the quality of the sampling.

    ``autocorrelation_steps`` is the longest of all coordinates, ``independent`` the number of independent
    samples; ``long_enough`` says whether the chain lasted fifty of those times.
    """

    names: tuple[str, ...]
    samples: Array = field(repr=False)
    misfit_factor: Array = field(repr=False)
    acceptance: float
    autocorrelation_steps: float
    independent: float
    long_enough: bool

    @classmethod
    def from_states(cls, likelihood: Likelihood, states: Array, **quality: Any) -> Posterior:
        """Build it from states (m, k) or (m, k + 1) of the sampler and the ``quality`` of the sampling."""
        z, factor = _split_states(likelihood, states)
        return cls(likelihood.unknowns.names, likelihood.to_parameters(z), factor, **quality)

    @property
    def median(self) -> Array:
        return np.median(self.samples, axis=0)

    @property
    def intervals_95(self) -> Array:
        """The 2.5 and 97.5 % quantiles (p, 2)."""
        return np.quantile(self.samples, [0.025, 0.975], axis=0).T

    @property
    def covariance(self) -> Array:
        """Covariance (p, p) of the logarithms."""
        return np.atleast_2d(np.cov(np.log(self.samples).T))

    def summarise(self) -> PosteriorSummary:
        """Return what is stored: all but the samples."""
        return PosteriorSummary(
            median=dict(zip(self.names, self.median.tolist())),
            intervals_95=dict(zip(self.names, self.intervals_95.tolist())),
            covariance_log=self.covariance.tolist(),
            misfit_factor=np.quantile(self.misfit_factor, [0.025, 0.5, 0.975]).tolist(),
            acceptance=self.acceptance,
            autocorrelation_steps=self.autocorrelation_steps,
            independent_draws=self.independent,
            long_enough=self.long_enough,
        )


def sample_posterior(
    likelihood: Likelihood, start: Array, covariance: Array, *, steps: int, seed: int = 0
) -> Posterior:
    """Sample from around ``start`` (k,) in the likelihood's space; the first spread is ``covariance`` (k, k).

    A quarter of the steps is dropped as the approach. The same seed gives the same samples.
    """
    space, extra = likelihood.space, int(likelihood.has_misfit)
    k = len(start) + extra
    walkers = 2 * ((_WALKERS_PER_DIMENSION * k + 1) // 2)
    random = np.random.default_rng(seed)
    inside = np.clip(
        random.multivariate_normal(start, covariance, walkers, method="eigh"),
        space.lower + 1e-6,
        space.upper - 1e-6,
    )
    # Where all walkers share a bound the ensemble has lost a dimension: spread them a little along it.
    inside += 1e-4 * (space.upper - space.lower) * random.uniform(-1, 1, inside.shape)
    inside = np.clip(inside, space.lower, space.upper)
    first = np.hstack([inside, random.uniform(0.7, 1.4, (walkers, extra))])

    import emcee  # a third of a second that only this function is worth

    moves = [(emcee.moves.DEMove(), 0.8), (emcee.moves.DESnookerMove(), 0.2)]
    sampler = emcee.EnsembleSampler(
        walkers, k, partial(_compute_log_probability, likelihood), vectorize=True, moves=moves
    )
    seeded = emcee.State(first, random_state=np.random.RandomState(seed).get_state())
    sampler.run_mcmc(seeded, steps)
    flat = sampler.get_chain(discard=steps // 4, flat=True)
    longest = float(np.nanmax(sampler.get_autocorr_time(discard=steps // 4, tol=0)))
    return Posterior.from_states(
        likelihood,
        flat[np.linspace(0, len(flat) - 1, min(_KEPT_SAMPLES, len(flat))).astype(int)],
        acceptance=float(np.mean(sampler.acceptance_fraction)),
        autocorrelation_steps=longest,
        independent=len(flat) / longest,
        long_enough=len(flat) / walkers > _MIN_AUTOCORRELATION_TIMES * longest,
    )


def _split_states(likelihood: Likelihood, states: Array) -> tuple[Array, Array]:
    """Return z (m, k) and the misfit's factor (m,) of states (m, k), or (m, k + 1) with the factor."""
    k = likelihood.space.lower.size
    return states[:, :k], states[:, k] if states.shape[1] > k else np.ones(len(states))


def _compute_log_probability(likelihood: Likelihood, states: Array) -> Array:
    z, factor = _split_states(likelihood, states)
    found = -0.5 * likelihood.compute_minus_2_log(z, factor)
    return np.where((factor > MISFIT_FACTOR_BOUNDS[0]) & (factor < MISFIT_FACTOR_BOUNDS[1]), found, -np.inf)


def sample_by_importance(likelihood: Likelihood, start: Array, covariance: Array) -> Posterior:
    """Sample the distribution of `sample_posterior` by importance, which is much cheaper where it is compact.

    Adaptive multiple importance sampling (Cornuet, Marin, Mira and Robert 2012): rounds of samples from a
    Student distribution with the mean and covariance of all samples so far. Each sample is weighed by its
    probability over the mixture of all rounds. It ends when the weights are worth a thousand equal ones.
    """
    extra = int(likelihood.has_misfit)
    random = np.random.default_rng(0)
    mean = np.r_[start, np.ones(extra)]
    spread = block_diag(covariance, 0.25 * np.eye(extra))
    drawn, probability = np.zeros((0, len(mean))), np.zeros(0)
    proposals: list[tuple[Array, Array]] = []
    for _ in range(_MAX_ROUNDS):
        root = cholesky(spread + 1e-12 * np.trace(spread) * np.eye(len(mean)), lower=True)
        proposals.append((mean, root))
        normal = random.standard_normal((_SAMPLES_PER_ROUND, len(mean))) @ root.T
        chi_square = random.chisquare(_STUDENT_FREEDOM, (_SAMPLES_PER_ROUND, 1))
        fresh = mean + normal / np.sqrt(chi_square / _STUDENT_FREEDOM)
        drawn = np.vstack([drawn, fresh])
        probability = np.r_[probability, _compute_log_probability(likelihood, fresh)]
        mixture = logsumexp([_compute_log_student(drawn, *one) for one in proposals], axis=0)
        logs = probability - mixture
        weights = softmax(logs)
        if _compute_effective_size(weights) >= _TARGET_EFFECTIVE_SIZE:
            break
        tempered = _temper_weights(logs, 10.0 * len(mean))
        mean = tempered @ drawn
        spread = np.atleast_2d(np.cov(drawn.T, aweights=tempered))
    worth = _compute_effective_size(weights)
    places = (np.arange(_KEPT_SAMPLES) + random.uniform()) / _KEPT_SAMPLES
    kept = drawn[np.minimum(np.searchsorted(np.cumsum(weights), places), len(drawn) - 1)]
    return Posterior.from_states(
        likelihood,
        kept,
        acceptance=float(np.mean(np.isfinite(probability))),
        autocorrelation_steps=len(drawn) / worth,
        independent=worth,
        long_enough=worth >= _MIN_EFFECTIVE_SIZE,
    )


def _compute_log_student(points: Array, mean: Array, root: Array) -> Array:
    """Return the log-density at points (m, k) of Student's distribution, up to a constant that all share.

    The lower ``root`` (k, k) is that of its scale.
    """
    off = solve_triangular(root, (points - mean).T, lower=True)
    power = -0.5 * (_STUDENT_FREEDOM + len(mean))
    log_determinant = float(np.log(np.diag(root)).sum())
    return power * np.log1p(np.sum(off**2, axis=0) / _STUDENT_FREEDOM) - log_determinant


def _compute_effective_size(weights: Array) -> float:
    """Return the number of equal weights that tell as much (Kish's effective size)."""
    return float(1 / np.sum(weights**2))


def _temper_weights(logs: Array, least: float) -> Array:
    """Return weights evened out until they are worth at least ``least``: the first rounds may hit little."""
    for power in 0.5 ** np.arange(0, 12):
        weights = softmax(power * logs)
        if _compute_effective_size(weights) >= least:
            break
    return weights


@dataclass(frozen=True)
class ExplorationSettings:
    """At most ``runs`` more simulations of all sites, ``batch`` of them in a round; ``steps`` of the sampler.

    The ends of the ``checked`` narrowest profiles, and of the widest one, are simulated by the solver.
    """

    runs: int = 24
    batch: int = 8
    steps: int = 4000
    checked: int = 2
    seed: int = 0


@dataclass(frozen=True)
class Exploration:
    """The result; ``good_enough`` says whether the emulator's error came below ``needed_percent``.

    ``runs`` are the simulations that the emulator of the ``likelihood`` knows, in the order of its points.
    """

    likelihood: Likelihood = field(repr=False)
    best: Optimum
    posterior: Posterior
    profiles: tuple[Profile, ...]
    checks: tuple[ProfileCheck, ...]
    rounds: tuple[EmulatorRound, ...]
    needed_percent: tuple[float, ...]
    good_enough: bool
    runs: tuple[Sequence[SiteResponse], ...] = field(repr=False)


def explore_posterior(
    simulate: SimulateMany,
    linearised: Uncertainty,
    points: Sequence[Array],
    settings: ExplorationSettings | None = None,
    report: Callable[[str], None] = lambda text: None,
) -> Exploration:
    """Explore the parameters around a calibration's answer.

    ``simulate``: takes several full parameters (p,) and returns the responses of each; failed ones are left
    out. ``linearised``: the linearised uncertainty there, whose covariance of the residuals is used.
    ``points``: parameters that were simulated before, which ``simulate`` returns at no cost. ``report``:
    called with sentences on the progress.
    """
    settings, space, model = settings or ExplorationSettings(), linearised.space, linearised.residual_model
    # Recorded noise, or where the model is wrong by more than that, a third of by how much.
    needed = tuple(
        float(100 * max(noise.sd_N / peak, misfit / 3))
        for noise, peak, misfit in zip(model.noise, model.peaks_N, model.misfit)
    )
    known, runs = _simulate_complete(simulate, points, report)
    candidates = _draw_linearised(linearised, settings.seed)
    emulator: Emulator | None = None
    rounds: list[EmulatorRound] = []
    spent = 0
    while True:
        count = min(settings.batch, settings.runs - spent)
        design = _select_distant(candidates, known, space, count)
        design, found = _simulate_complete(simulate, design, report)
        spent += count
        pairs = zip(design, found, strict=True)
        errors = [compute_errors_percent(emulator(point), run) for point, run in pairs] if emulator else []
        known, runs = known + design, runs + found
        emulator = Emulator(np.array(known), runs)
        likelihood = Likelihood(emulator, linearised.measured, model, linearised.unknowns, space)
        _, simulated = min(zip(runs, known), key=lambda one: likelihood.minus_2_log_of(*one))
        best = likelihood.find_best((linearised.parameters, linearised.centre, simulated))
        covariance = likelihood.compute_covariance(best.z)
        sample = partial(sample_posterior, likelihood, best.z, covariance, seed=settings.seed)
        samples = sample(steps=_SHORT_CHAIN_STEPS).samples
        rounds.append(_assess_emulator(emulator, samples, errors))
        error = np.array(rounds[-1].error_percent)
        report(f"{len(known)} runs: emulator within {error.max():.2f} % of the largest force")
        good_enough = bool(np.all(error <= needed) and rounds[-1].outside < _MAX_OUTSIDE)
        if good_enough or spent >= settings.runs:
            break
        candidates = np.array([space.reduce(one) for one in np.log(_thin(samples, _CANDIDATES))])
    report("sampling the posterior")
    posterior = sample(steps=settings.steps)
    profiles = []
    for k, (tie, sd) in enumerate(zip(space.tie.T, np.sqrt(np.diag(covariance)))):
        report(f"profile {k + 1} of {len(covariance)}")
        freedom = linearised.degrees_of_freedom[np.flatnonzero(tie)[0]]
        profiles.append(compute_profile(likelihood, best, k, float(sd), float(freedom)))
    return Exploration(
        likelihood=likelihood,
        best=best,
        posterior=posterior,
        profiles=tuple(profiles),
        checks=_check_profiles(simulate, likelihood, best, profiles, settings.checked, report),
        rounds=tuple(rounds),
        needed_percent=needed,
        good_enough=good_enough,
        runs=tuple(runs),
    )


def _simulate_complete(
    simulate: SimulateMany, points: Sequence[Array], report: Callable[[str], None]
) -> tuple[list[Array], list[Sequence[SiteResponse]]]:
    """Simulate, and return the points and responses of the simulations that completed."""
    found = simulate(points)
    pairs = [pair for pair in zip(points, found, strict=True) if all(one.completed for one in pair[1])]
    if len(pairs) < len(found):
        report(f"{len(found) - len(pairs)} of {len(found)} simulations failed: they are left out")
    return [point for point, _ in pairs], [run for _, run in pairs]


def _draw_linearised(linearised: Uncertainty, seed: int) -> Array:
    """Draw candidates (m, k) from the linearised posterior, a little wider, inside the bounds."""
    space = linearised.space
    z = space.reduce(np.log(linearised.centre))
    covariance = _DESIGN_WIDENING**2 * reduce_covariance(linearised.covariance, space)
    drawn = np.random.default_rng(seed).multivariate_normal(z, covariance, _CANDIDATES, method="eigh")
    return np.clip(drawn, space.lower, space.upper)


def _select_distant(
    candidates: Array, points: Sequence[Array], space: SearchSpace, count: int
) -> list[Array]:
    """Select ``count`` of the candidates (m, k), each the farthest from ``points`` (p,) and all before it."""
    taken = np.array([space.reduce(np.log(p)) for p in points])
    values, vectors = np.linalg.eigh(np.cov(candidates.T) + 1e-8 * np.eye(candidates.shape[1]))
    whiten = vectors / np.sqrt(values)
    at, known = candidates @ whiten, taken @ whiten
    # Out in the tail simulations are hard, and report of the tail alone.
    far = np.linalg.norm(at - at.mean(axis=0), axis=1) > _MAX_DISTANCE * np.sqrt(at.shape[1])
    chosen: list[Array] = []
    for _ in range(count):
        i = int(np.argmax(np.where(far, -1.0, cdist(at, known).min(axis=1))))
        known = np.vstack([known, at[i]])
        chosen.append(space.expand(candidates[i]))
    return chosen


def _thin(samples: Array, count: int) -> Array:
    """Return about ``count`` of the samples (m, p), evenly spread."""
    return samples[:: max(len(samples) // count, 1)]


def _assess_emulator(
    emulator: Emulator, samples: Array, new_errors: Sequence[Sequence[float]]
) -> EmulatorRound:
    """Assess the emulator over samples (m, p); ``new_errors`` (sites,) are those at runs it did not know."""
    asked = _thin(samples, _CHECKED_SAMPLES)
    stated = np.array([emulator.expected_error_percent(p) for p in asked])
    return EmulatorRound(
        runs=len(emulator.points),
        error_percent=np.quantile(stated, _ERROR_QUANTILE, axis=0).tolist(),
        loo_percent=np.median(emulator.loo_percent, axis=0).tolist(),
        new_percent=np.mean(new_errors, axis=0).tolist() if new_errors else (),
        outside=1 - float(np.mean([emulator.is_inside(p) for p in asked])),
    )


def _check_profiles(
    simulate: SimulateMany,
    likelihood: Likelihood,
    best: Optimum,
    profiles: Sequence[Profile],
    narrowest: int,
    report: Callable[[str], None],
) -> tuple[ProfileCheck, ...]:
    """Simulate the ends of some profiles with the solver."""
    if not narrowest:
        return ()
    # Verdicts rest on the narrowest profiles; the widest extrapolates most.
    order = sorted(profiles, key=lambda one: np.log(one.interval_95[1] / one.interval_95[0]))
    chosen = [("narrowest", one) for one in order[:narrowest]]
    chosen += [("widest", one) for one in order[narrowest:][-1:]]
    report("checking the ends of profiles with the solver")
    at_best, *found = simulate([best.parameters, *(end for _, one in chosen for end in one.ends)])
    if not all(one.completed for one in at_best):
        report("warning: the answer's own simulation failed: no end of a profile is checked")
        return ()
    pairs = zip(found[::2], found[1::2], strict=True)
    return tuple(
        check_profile_ends(likelihood, best, at_best, one, pair, why)
        for (why, one), pair in zip(chosen, pairs, strict=True)
    )
