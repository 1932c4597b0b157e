"""What the records leave possible: a sample of the parameters from their joint distribution.

Uniform in the logarithms between the bounds, times stated priors, times the likelihood; the size of the
misfit is sampled along. The sampler is emcee's ensemble (Goodman and Weare 2010; Foreman-Mackey et al. 2013).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from .likelihood import FACTORS, Likelihood
from .parameters import Space

if TYPE_CHECKING:
    import emcee

Array = NDArray[np.float64]

_STEPS, _WALKERS_PER_DIMENSION = 4000, 4
_LEAST_TIMES = 50  # autocorrelation times that make a chain long enough (emcee's own rule)
_KEPT = 4000  # draws


@dataclass(frozen=True)
class Posterior:
    """Draws (m, p) of the parameters and (m,) of the misfit's factor, and how well they were drawn.

    ``autocorrelation_steps`` is the longest of all coordinates; ``independent`` the number of independent
    draws; ``long_enough`` says whether the chain lasted fifty of those times.
    """

    names: tuple[str, ...]
    draws: Array = field(repr=False)
    misfit_factor: Array = field(repr=False)
    acceptance: float
    autocorrelation_steps: float
    independent: float
    long_enough: bool

    @property
    def median(self) -> Array:
        return np.median(self.draws, axis=0)

    @property
    def intervals_95(self) -> Array:
        """(p, 2), between the 2.5 and 97.5 % quantiles."""
        return np.quantile(self.draws, [0.025, 0.975], axis=0).T

    @property
    def covariance(self) -> Array:
        """(p, p), of the logarithms."""
        return np.atleast_2d(np.cov(np.log(self.draws).T))

    def to_dict(self) -> dict[str, Any]:
        """JSON-like values, without the draws."""
        return {
            "median": dict(zip(self.names, self.median.tolist())),
            "intervals_95": dict(zip(self.names, self.intervals_95.tolist())),
            "covariance_log": self.covariance.tolist(),
            "misfit_factor": np.quantile(self.misfit_factor, [0.025, 0.5, 0.975]).tolist(),
            "acceptance": self.acceptance,
            "autocorrelation_steps": self.autocorrelation_steps,
            "independent_draws": self.independent,
            "long_enough": self.long_enough,
        }


def sample_posterior(
    likelihood: Likelihood,
    start: Array,
    covariance: Array,
    *,
    steps: int = _STEPS,
    seed: int = 0,
) -> Posterior:
    """Sample from around ``start`` (k,) in the likelihood's space, first spread by ``covariance`` (k, k).

    A quarter of the steps is dropped as approach. The same seed gives the same draws.
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
        z, factor = state[:, : len(start)], state[:, -1] if extra else np.ones(len(state))
        found = -0.5 * likelihood.minus_2_log(z, factor)
        return np.where((factor > FACTORS[0]) & (factor < FACTORS[1]), found, -np.inf)

    import emcee  # a third of a second that only this function is worth

    moves = [(emcee.moves.DEMove(), 0.8), (emcee.moves.DESnookerMove(), 0.2)]
    sampler = emcee.EnsembleSampler(walkers, k, log_probability, vectorize=True, moves=moves)
    seeded = emcee.State(first, random_state=np.random.RandomState(seed).get_state())
    sampler.run_mcmc(seeded, steps)
    return _told(sampler, likelihood, len(start), steps)


def _told(sampler: emcee.EnsembleSampler, likelihood: Likelihood, k: int, steps: int) -> Posterior:
    dropped = steps // 4
    chain = sampler.get_chain(discard=dropped)
    from emcee.autocorr import integrated_time

    times = integrated_time(chain, tol=0)
    longest = float(np.nanmax(times))
    flat = chain.reshape(-1, chain.shape[2])
    kept = flat[np.linspace(0, len(flat) - 1, min(_KEPT, len(flat))).astype(int)]
    factor = kept[:, k] if kept.shape[1] > k else np.ones(len(kept))
    return Posterior(
        names=likelihood.unknowns.names,
        draws=likelihood.parameters(kept[:, :k]),
        misfit_factor=factor,
        acceptance=float(np.mean(sampler.acceptance_fraction)),
        autocorrelation_steps=longest,
        independent=float(len(flat) / longest),
        long_enough=bool(len(chain) > _LEAST_TIMES * longest),
    )


def principal_axes(posterior: Posterior, space: Space) -> Array:
    """The independent combinations of the parameters (k, p), best known first, of a search space.

    A row holds the weights of logarithms: a combination is ``exp(weights @ log(parameters))``.  The axes are
    those of the draws, not of a linearised covariance: where the draws lie along a bend, the narrowest
    direction at its middle is not the narrowest of all of them.
    """
    members = space.tie.sum(axis=0)
    own = np.log(posterior.draws) @ (space.tie / members)
    _, vectors = np.linalg.eigh(np.atleast_2d(np.cov(own.T)))
    signs = np.sign(vectors[np.argmax(np.abs(vectors), axis=0), np.arange(len(vectors))])
    return np.asarray((space.tie @ ((vectors * signs) / members[:, None])).T)
