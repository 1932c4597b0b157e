"""Samples of the parameters from their joint distribution, given the records.

It is uniform in the logarithms between the bounds, times stated priors, times the likelihood; the size of the
misfit is sampled with the parameters. The sampler is emcee's ensemble (Goodman and Weare 2010; Foreman-Mackey
et al. 2013).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np
from scipy.linalg import block_diag, cholesky, solve_triangular
from scipy.special import logsumexp, softmax

from ...arrays import Array
from ...results.uncertainty import PosteriorSummary
from .likelihood import MISFIT_FACTOR_BOUNDS, Likelihood

_WALKERS_PER_DIMENSION = 4
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
