"""From a calibration to all that its records leave possible: emulator, posterior and profiles, in rounds.

Each round fits the emulator to all simulations so far, samples the posterior on it, and simulates for real
where that posterior lives and the runs so far are farthest. It ends when the emulator's error over the
posterior is below what the records can tell, or when the runs are used up.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..fit.objective import Measured, SiteResponse
from ..fit.parameters import Space, Unknowns
from .emulator import Emulator
from .likelihood import Likelihood, Optimum
from .posterior import Posterior, sample_posterior
from .profile import EndCheck, Profile, check_ends, chosen_for_checks, profile
from .uncertainty import Uncertainty

Array = NDArray[np.float64]
SimulateMany = Callable[[Sequence[Array]], Sequence[Sequence[SiteResponse]]]

_CANDIDATES, _SPREAD = 400, 1.2  # the first design is this much wider than the linearised posterior
_FARTHEST = 1.4  # distance of a candidate from their middle, over the root of their dimension
_SHORT_CHAIN = 800
_LOOKED_AT = 150  # draws at which the emulator's error is asked
_QUANTILE = 0.9  # of those errors


@dataclass(frozen=True)
class ExploreSettings:
    """``runs`` more simulations of all sites at most, ``batch`` of them in a round; ``steps`` of the sampler.

    Of the ``checked`` narrowest profiles and, beside them, the widest the ends are simulated.
    """

    runs: int = 24
    batch: int = 8
    steps: int = 4000
    checked: int = 2
    seed: int = 0


@dataclass(frozen=True)
class ExploreRound:
    """The emulator after a round: its runs, and its stated error (sites,) over the posterior in percent.

    ``new_percent`` (sites,) is its error at the round's runs before it knew them; empty in the first.
    ``outside`` is the share of the posterior beyond the box of the runs.
    """

    runs: int
    error_percent: tuple[float, ...]
    loo_percent: tuple[float, ...]
    new_percent: tuple[float, ...]
    outside: float


@dataclass(frozen=True)
class Explored:
    """What was found; ``good_enough`` says whether the emulator's error came below ``needed_percent``.

    ``runs`` are the simulations that the emulator knows, in the order of its points.
    """

    emulator: Emulator = field(repr=False)
    likelihood: Likelihood = field(repr=False)
    best: Optimum
    posterior: Posterior
    profiles: tuple[Profile, ...]
    checks: tuple[EndCheck, ...]
    rounds: tuple[ExploreRound, ...]
    needed_percent: tuple[float, ...]
    good_enough: bool
    runs: tuple[Sequence[SiteResponse], ...] = field(repr=False)

    def rounds_record(self) -> list[dict[str, Any]]:
        return [asdict(one) for one in self.rounds]


def explore(
    simulate: SimulateMany,
    measured: Sequence[Measured],
    unknowns: Unknowns,
    space: Space,
    known: Uncertainty,
    points: Sequence[Array],
    settings: ExploreSettings | None = None,
    tell: Callable[[str], None] = lambda text: None,
) -> Explored:
    """Explore around a calibration's answer.

    Parameters
    ----------
    simulate : from several full parameters (p,) to the responses of each; failed ones are left out.
    space : of the calibration's last stage.
    known : the linearised uncertainty there, whose covariance of the residuals is used.
    points : parameters that were simulated before, and that ``simulate`` answers at no cost.
    """
    run = _Exploration(simulate, measured, unknowns, space, known, settings or ExploreSettings(), tell)
    run.learn(list(points))
    run.learn(run.first_design())
    while not run.round():
        run.learn(run.next_design())
    return run.result()


class _Exploration:
    """One exploration under way."""

    def __init__(
        self,
        simulate: SimulateMany,
        measured: Sequence[Measured],
        unknowns: Unknowns,
        space: Space,
        known: Uncertainty,
        settings: ExploreSettings,
        tell: Callable[[str], None],
    ) -> None:
        self.simulate, self.measured, self.unknowns, self.space = simulate, measured, unknowns, space
        self.known, self.settings, self.tell = known, settings, tell
        self.random = np.random.default_rng(settings.seed)
        self.points: list[Array] = []
        self.responses: list[Sequence[SiteResponse]] = []
        self.spent = 0
        self.rounds: list[ExploreRound] = []
        self.new_percent: tuple[float, ...] = ()
        model = known.residual_model
        # Recorded noise, or where the model is wrong by more than that, a third of by how much.
        self.needed = tuple(
            float(100 * max(noise.sd_N / peak, misfit / 3))
            for noise, peak, misfit in zip(model.noise, model.peaks_N, model.misfit)
        )

    def learn(self, points: list[Array]) -> None:
        """Simulate; what the emulator expected there is kept beside what came."""
        found = list(self.simulate(points))
        whole = [i for i, run in enumerate(found) if all(r.completed for r in run)]
        if len(whole) < len(found):
            self.tell(f"{len(found) - len(whole)} of {len(found)} simulations failed: they are left out")
        if self.rounds:
            errors = [self.emulator.check(points[i], found[i]) for i in whole]
            self.new_percent = tuple(np.mean(errors, axis=0).tolist()) if errors else ()
        self.points += [points[i] for i in whole]
        self.responses += [found[i] for i in whole]

    def first_design(self) -> list[Array]:
        """Spread over the linearised posterior, a little wider, inside the bounds."""
        z = self.space.reduce(np.log(self.known.centre))
        half = self.space.tie / self.space.tie.sum(axis=0)
        covariance = half.T @ self.known.covariance @ half
        drawn = self.random.multivariate_normal(z, _SPREAD**2 * covariance, _CANDIDATES, method="eigh")
        drawn = np.clip(drawn, self.space.lower, self.space.upper)
        return self._spread(drawn, min(self.settings.batch, self.settings.runs))

    def next_design(self) -> list[Array]:
        """Where the posterior is and the runs so far are farthest."""
        drawn = np.log(self.posterior.draws[:: max(len(self.posterior.draws) // _CANDIDATES, 1)])
        z = np.array([self.space.reduce(one) for one in drawn])
        return self._spread(z, min(self.settings.batch, self.settings.runs - self.spent))

    def _spread(self, candidates: Array, count: int) -> list[Array]:
        """``count`` candidates (m, k), each the farthest from all points so far in their own spread."""
        self.spent += count
        taken = np.array([self.space.reduce(np.log(p)) for p in self.points])
        values, vectors = np.linalg.eigh(np.cov(candidates.T) + 1e-8 * np.eye(candidates.shape[1]))
        whiten = vectors / np.sqrt(values)
        at, known = candidates @ whiten, taken @ whiten
        # Out in the tail simulations are hard, and tell of the tail alone.
        far = np.linalg.norm(at - at.mean(axis=0), axis=1) > _FARTHEST * np.sqrt(at.shape[1])
        distance = np.min(np.linalg.norm(at[:, None] - known[None], axis=2), axis=1)
        distance[far] = -1.0
        chosen = []
        for _ in range(count):
            i = int(np.argmax(distance))
            chosen.append(self.space.expand(candidates[i]))
            distance = np.minimum(distance, np.linalg.norm(at - at[i], axis=1))
        return chosen

    def round(self) -> bool:
        """Fit and sample; whether the emulator is good enough, or nothing is left to spend."""
        self.emulator = Emulator.fit(self.unknowns.names, np.array(self.points), self.responses)
        model = self.known.residual_model
        self.likelihood = Likelihood(self.emulator, self.measured, model, self.unknowns, self.space)
        self.best = self._best()
        self.covariance = self.likelihood.covariance(self.best.z)
        self.posterior = self._sample(_SHORT_CHAIN)
        draws = self.posterior.draws[:: max(len(self.posterior.draws) // _LOOKED_AT, 1)]
        stated = np.array([self.emulator.error_percent(p) for p in draws])
        error = np.quantile(stated, _QUANTILE, axis=0)
        outside = 1 - float(np.mean([self.emulator.inside(p) for p in draws]))
        loo = np.median(self.emulator.loo_percent, axis=0)
        self.rounds.append(
            ExploreRound(len(self.points), _tuple(error), _tuple(loo), self.new_percent, outside)
        )
        self.good_enough = bool(np.all(error <= self.needed) and outside < 0.05)
        self.tell(f"{len(self.points)} runs: emulator within {error.max():.2f} % of the largest force")
        return self.good_enough or self.spent >= self.settings.runs

    def _best(self) -> Optimum:
        """The best of the optima from the calibrated, the most probable and the best simulated parameters."""
        simulated = min(
            range(len(self.points)),
            key=lambda i: self.likelihood.at_responses(self.responses[i], self.points[i]),
        )
        return self.likelihood.best((self.known.parameters, self.known.centre, self.points[simulated]))

    def _sample(self, steps: int) -> Posterior:
        seed = self.settings.seed
        return sample_posterior(self.likelihood, self.best.z, self.covariance, steps=steps, seed=seed)

    def result(self) -> Explored:
        self.tell("sampling the posterior")
        posterior = self._sample(self.settings.steps)
        sd = np.sqrt(np.diag(self.covariance))
        freedom = [self.known.degrees_of_freedom[np.flatnonzero(tie)[0]] for tie in self.space.tie.T]
        profiles = []
        for k in range(len(sd)):
            self.tell(f"profile {k + 1} of {len(sd)}")
            of = self.likelihood, self.best, k, float(sd[k]), float(freedom[k])
            profiles.append(profile(*of, inside=lambda p: self.emulator.inside(p, margin=0.0)))
        return Explored(
            emulator=self.emulator,
            likelihood=self.likelihood,
            best=self.best,
            posterior=posterior,
            profiles=tuple(profiles),
            checks=self._checks(profiles),
            rounds=tuple(self.rounds),
            needed_percent=self.needed,
            good_enough=self.good_enough,
            runs=tuple(self.responses),
        )

    def _checks(self, profiles: Sequence[Profile]) -> tuple[EndCheck, ...]:
        """The solver's word at the ends of profiles."""
        chosen = chosen_for_checks(profiles, self.settings.checked)
        if not chosen:
            return ()
        self.tell("checking the ends of profiles with the solver")
        wanted = [self.best.parameters, *(end for _, one in chosen for end in one.ends)]
        at_best, *found = self.simulate(wanted)
        if not all(r.completed for r in at_best):
            self.tell("warning: the answer's own simulation failed: no end of a profile is checked")
            return ()
        pairs = zip(found[::2], found[1::2], strict=True)
        return tuple(
            check_ends(self.likelihood, self.best, at_best, one, pair, why)
            for (why, one), pair in zip(chosen, pairs, strict=True)
        )


def _tuple(values: Array) -> tuple[float, ...]:
    return tuple(float(value) for value in values)
