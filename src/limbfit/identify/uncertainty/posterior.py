"""Samples of the parameters from their joint distribution, given the records.

It is uniform in the logarithms between the bounds, times stated priors, times the likelihood; the size of the
misfit is sampled with the parameters. The sampler is emcee's ensemble (Goodman and Weare 2010; Foreman-Mackey
et al. 2013).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
from scipy.linalg import cholesky, solve_triangular
from scipy.special import logsumexp

from ...arrays import Array
from ...results.uncertainty import PosteriorSummary
from ..fit.parameters import SearchSpace
from .likelihood import MISFIT_FACTOR_BOUNDS, Likelihood

if TYPE_CHECKING:
    import emcee


_DEFAULT_STEPS, _WALKERS_PER_DIMENSION = 4000, 4
_MIN_AUTOCORRELATION_TIMES = 50  # autocorrelation times that make a chain long enough (emcee's own rule)
_KEPT_SAMPLES = 4000  # samples
# Of weighed samples; of Student's distribution
_MAX_ROUNDS, _SAMPLES_PER_ROUND, _STUDENT_FREEDOM = 12, 1000, 6.0
_TARGET_EFFECTIVE_SIZE, _MIN_EFFECTIVE_SIZE = 1000, 200


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
    likelihood: Likelihood,
    start: Array,
    covariance: Array,
    *,
    steps: int = _DEFAULT_STEPS,
    seed: int = 0,
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

    def log_probability(state: Array) -> Array:
        return _log_probability(likelihood, state)

    import emcee  # a third of a second that only this function is worth

    moves = [(emcee.moves.DEMove(), 0.8), (emcee.moves.DESnookerMove(), 0.2)]
    sampler = emcee.EnsembleSampler(walkers, k, log_probability, vectorize=True, moves=moves)
    seeded = emcee.State(first, random_state=np.random.RandomState(seed).get_state())
    sampler.run_mcmc(seeded, steps)
    return _summarise_chain(sampler, likelihood, len(start), steps)


def _log_probability(likelihood: Likelihood, state: Array) -> Array:
    """Return the log-probability (m,) of state (m, k) of z, or (m, k + 1) with the misfit's factor."""
    k = likelihood.space.lower.size
    factor = state[:, k] if state.shape[1] > k else np.ones(len(state))
    found = -0.5 * likelihood.compute_minus_2_log(state[:, :k], factor)
    return np.where((factor > MISFIT_FACTOR_BOUNDS[0]) & (factor < MISFIT_FACTOR_BOUNDS[1]), found, -np.inf)


def sample_by_importance(
    likelihood: Likelihood, start: Array, covariance: Array, *, seed: int = 0
) -> Posterior:
    """Sample the distribution of `sample_posterior` by importance, which is much cheaper where it is compact.

    Adaptive multiple importance sampling (Cornuet, Marin, Mira and Robert 2012): rounds of samples from a
    Student distribution with the mean and covariance of all samples so far. Each sample is weighed by its
    probability over the mixture of all rounds. It ends when the weights are worth a thousand equal ones. The
    same seed gives the same samples.
    """
    k, extra = len(start), int(likelihood.has_misfit)
    random = np.random.default_rng(seed)
    mean = np.r_[start, np.ones(extra)]
    spread = np.zeros((k + extra, k + extra))
    spread[:k, :k] = covariance
    spread[k:, k:] = 0.25
    drawn, probability = np.zeros((0, k + extra)), np.zeros(0)
    proposals: list[_StudentProposal] = []
    for _ in range(_MAX_ROUNDS):
        proposals.append(_StudentProposal.from_covariance(mean, spread))
        fresh = proposals[-1].draw(random, _SAMPLES_PER_ROUND)
        drawn = np.vstack([drawn, fresh])
        probability = np.r_[probability, _log_probability(likelihood, fresh)]
        mixture = logsumexp([proposal.log_density(drawn) for proposal in proposals], axis=0)
        logs = probability - mixture
        weights = _normalise(logs)
        if _compute_effective_size(weights) >= _TARGET_EFFECTIVE_SIZE:
            break
        tempered = _temper_weights(logs, 10.0 * (k + extra))
        mean = tempered @ drawn
        spread = np.cov(drawn.T, aweights=tempered).reshape(k + extra, k + extra)
    worth = _compute_effective_size(weights)
    places = (np.arange(_KEPT_SAMPLES) + random.uniform()) / _KEPT_SAMPLES
    kept = drawn[np.minimum(np.searchsorted(np.cumsum(weights), places), len(drawn) - 1)]
    return Posterior(
        names=likelihood.unknowns.names,
        samples=likelihood.to_parameters(kept[:, :k]),
        misfit_factor=kept[:, k] if extra else np.ones(_KEPT_SAMPLES),
        acceptance=float(np.mean(np.isfinite(probability))),
        autocorrelation_steps=float(len(drawn) / worth),
        independent=worth,
        long_enough=bool(worth >= _MIN_EFFECTIVE_SIZE),
    )


@dataclass(frozen=True)
class _StudentProposal:
    """Student's distribution of many variables: ``mean`` (k,) and the lower ``root`` (k, k) of its scale."""

    mean: Array
    root: Array

    @classmethod
    def from_covariance(cls, mean: Array, covariance: Array) -> _StudentProposal:
        least = 1e-12 * np.trace(covariance) * np.eye(len(mean))
        return cls(mean, cholesky(covariance + least, lower=True))

    def draw(self, random: np.random.Generator, count: int) -> Array:
        normal = random.standard_normal((count, len(self.mean))) @ self.root.T
        return self.mean + normal / np.sqrt(random.chisquare(_STUDENT_FREEDOM, (count, 1)) / _STUDENT_FREEDOM)

    def log_density(self, points: Array) -> Array:
        """Return the log-density at (m, k), up to a constant that all such distributions share."""
        off = solve_triangular(self.root, (points - self.mean).T, lower=True)
        power = -0.5 * (_STUDENT_FREEDOM + len(self.mean))
        return power * np.log1p(np.sum(off**2, axis=0) / _STUDENT_FREEDOM) - float(
            np.log(np.diag(self.root)).sum()
        )


def _normalise(logs: Array) -> Array:
    weights = np.exp(logs - logs.max())
    return np.asarray(weights / weights.sum())


def _compute_effective_size(weights: Array) -> float:
    """Return the number of equal weights that tell as much (Kish's effective size)."""
    return float(1 / np.sum(weights**2))


def _temper_weights(logs: Array, least: float) -> Array:
    """Return weights evened out until they are worth at least ``least``: the first rounds may hit little."""
    for power in 0.5 ** np.arange(0, 12):
        weights = _normalise(power * logs)
        if _compute_effective_size(weights) >= least:
            break
    return weights


def _summarise_chain(sampler: emcee.EnsembleSampler, likelihood: Likelihood, k: int, steps: int) -> Posterior:
    dropped = steps // 4
    chain = sampler.get_chain(discard=dropped)
    from emcee.autocorr import integrated_time

    times = integrated_time(chain, tol=0)
    longest = float(np.nanmax(times))
    flat = chain.reshape(-1, chain.shape[2])
    kept = flat[np.linspace(0, len(flat) - 1, min(_KEPT_SAMPLES, len(flat))).astype(int)]
    factor = kept[:, k] if kept.shape[1] > k else np.ones(len(kept))
    return Posterior(
        names=likelihood.unknowns.names,
        samples=likelihood.to_parameters(kept[:, :k]),
        misfit_factor=factor,
        acceptance=float(np.mean(sampler.acceptance_fraction)),
        autocorrelation_steps=longest,
        independent=float(len(flat) / longest),
        long_enough=bool(len(chain) > _MIN_AUTOCORRELATION_TIMES * longest),
    )


def compute_principal_axes(posterior: Posterior, space: SearchSpace) -> Array:
    """Return the independent combinations of the parameters (k, p), best known first, of a search space.

    A row holds the weights of logarithms: a combination is ``exp(weights @ log(parameters))``. The axes are
    those of the samples, not of a linearised covariance: where samples lie along a bend, the narrowest
    direction at its middle is not the narrowest of all of them.
    """
    members = space.tie.sum(axis=0)
    own = np.log(posterior.samples) @ (space.tie / members)
    _, vectors = np.linalg.eigh(np.atleast_2d(np.cov(own.T)))
    signs = np.sign(vectors[np.argmax(np.abs(vectors), axis=0), np.arange(len(vectors))])
    return np.asarray((space.tie @ ((vectors * signs) / members[:, None])).T)
