"""The exploration of everything that the records leave open, in rounds: emulator, posterior and profiles.

Each round fits the emulator to all simulations so far, samples the posterior on it, and simulates with the
solver where that posterior is and where the runs so far are farthest away. It ends when the emulator's error
over the posterior is below what the records can tell, or when the allowed runs are used up.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

from ...arrays import Array
from ...results.uncertainty import EmulatorRound, ProfileCheck
from ..fit.objective import MeasuredCurve, SiteResponse
from ..fit.parameters import SearchSpace, Unknowns
from .emulator import Emulator
from .likelihood import Likelihood, Optimum
from .posterior import Posterior, sample_posterior
from .profile import Profile, check_profile_ends, compute_profile, select_profiles_to_check
from .uncertainty import Uncertainty

SimulateMany = Callable[[Sequence[Array]], Sequence[Sequence[SiteResponse]]]

_CANDIDATES, _DESIGN_WIDENING = 400, 1.2  # the first design is this much wider than the linearised posterior
_MAX_DISTANCE = 1.4  # distance of a candidate from their middle, over the root of their dimension
_SHORT_CHAIN_STEPS = 800
_CHECKED_SAMPLES = 150  # samples at which the emulator's error is asked
_ERROR_QUANTILE = 0.9  # of those errors


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

    ``runs`` are the simulations that the emulator knows, in the order of its points.
    """

    emulator: Emulator = field(repr=False)
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
    measured: Sequence[MeasuredCurve],
    unknowns: Unknowns,
    space: SearchSpace,
    linearised: Uncertainty,
    points: Sequence[Array],
    settings: ExplorationSettings | None = None,
    report: Callable[[str], None] = lambda text: None,
) -> Exploration:
    """Explore the parameters around a calibration's answer.

    Parameters
    ----------
    simulate : takes several full parameters (p,) and returns the responses of each; failed ones are left out.
    space : of the calibration's last stage.
    linearised : the linearised uncertainty there, whose covariance of the residuals is used.
    points : parameters that were simulated before, which ``simulate`` returns at no cost.
    report : called with sentences on the progress.
    """
    run = _Explorer(
        simulate, measured, unknowns, space, linearised, settings or ExplorationSettings(), report
    )
    run.learn(list(points))
    run.learn(run.build_first_design())
    while not run.run_round():
        run.learn(run.build_next_design())
    return run.build_result()


class _Explorer:
    """An exploration in progress."""

    def __init__(
        self,
        simulate: SimulateMany,
        measured: Sequence[MeasuredCurve],
        unknowns: Unknowns,
        space: SearchSpace,
        linearised: Uncertainty,
        settings: ExplorationSettings,
        report: Callable[[str], None],
    ) -> None:
        self.simulate, self.measured, self.unknowns, self.space = simulate, measured, unknowns, space
        self.linearised, self.settings, self.report = linearised, settings, report
        self.random = np.random.default_rng(settings.seed)
        self.points: list[Array] = []
        self.responses: list[Sequence[SiteResponse]] = []
        self.spent = 0
        self.rounds: list[EmulatorRound] = []
        self.new_percent: tuple[float, ...] = ()
        model = linearised.residual_model
        # Recorded noise, or where the model is wrong by more than that, a third of by how much.
        self.needed = tuple(
            float(100 * max(noise.sd_N / peak, misfit / 3))
            for noise, peak, misfit in zip(model.noise, model.peaks_N, model.misfit)
        )

    def learn(self, points: list[Array]) -> None:
        """Simulate; the emulator's errors at these points are stored before it learns them."""
        found = list(self.simulate(points))
        whole = [i for i, run in enumerate(found) if all(r.completed for r in run)]
        if len(whole) < len(found):
            self.report(f"{len(found) - len(whole)} of {len(found)} simulations failed: they are left out")
        if self.rounds:
            errors = [self.emulator.compute_errors_percent(points[i], found[i]) for i in whole]
            self.new_percent = tuple(np.mean(errors, axis=0).tolist()) if errors else ()
        self.points += [points[i] for i in whole]
        self.responses += [found[i] for i in whole]

    def build_first_design(self) -> list[Array]:
        """Spread points over the linearised posterior, a little wider, inside the bounds."""
        z = self.space.reduce(np.log(self.linearised.centre))
        half = self.space.tie / self.space.tie.sum(axis=0)
        covariance = half.T @ self.linearised.covariance @ half
        drawn = self.random.multivariate_normal(
            z, _DESIGN_WIDENING**2 * covariance, _CANDIDATES, method="eigh"
        )
        drawn = np.clip(drawn, self.space.lower, self.space.upper)
        return self._spread(drawn, min(self.settings.batch, self.settings.runs))

    def build_next_design(self) -> list[Array]:
        """Choose points where the posterior is and where the runs so far are farthest away."""
        drawn = np.log(self.posterior.samples[:: max(len(self.posterior.samples) // _CANDIDATES, 1)])
        z = np.array([self.space.reduce(one) for one in drawn])
        return self._spread(z, min(self.settings.batch, self.settings.runs - self.spent))

    def _spread(self, candidates: Array, count: int) -> list[Array]:
        """Choose ``count`` of the candidates (m, k), each the farthest from all points before it."""
        self.spent += count
        taken = np.array([self.space.reduce(np.log(p)) for p in self.points])
        values, vectors = np.linalg.eigh(np.cov(candidates.T) + 1e-8 * np.eye(candidates.shape[1]))
        whiten = vectors / np.sqrt(values)
        at, known = candidates @ whiten, taken @ whiten
        # Out in the tail simulations are hard, and report of the tail alone.
        far = np.linalg.norm(at - at.mean(axis=0), axis=1) > _MAX_DISTANCE * np.sqrt(at.shape[1])
        distance = np.min(np.linalg.norm(at[:, None] - known[None], axis=2), axis=1)
        distance[far] = -1.0
        chosen = []
        for _ in range(count):
            i = int(np.argmax(distance))
            chosen.append(self.space.expand(candidates[i]))
            distance = np.minimum(distance, np.linalg.norm(at - at[i], axis=1))
        return chosen

    def run_round(self) -> bool:
        """Fit and sample; return True if the emulator is good enough, or if no runs are left."""
        self.emulator = Emulator.fit(self.unknowns.names, np.array(self.points), self.responses)
        model = self.linearised.residual_model
        self.likelihood = Likelihood(self.emulator, self.measured, model, self.unknowns, self.space)
        self.best = self._find_best()
        self.covariance = self.likelihood.compute_covariance(self.best.z)
        self.posterior = self._sample(_SHORT_CHAIN_STEPS)
        samples = self.posterior.samples[:: max(len(self.posterior.samples) // _CHECKED_SAMPLES, 1)]
        stated = np.array([self.emulator.expected_error_percent(p) for p in samples])
        error = np.quantile(stated, _ERROR_QUANTILE, axis=0)
        outside = 1 - float(np.mean([self.emulator.is_inside(p) for p in samples]))
        loo = np.median(self.emulator.loo_percent, axis=0)
        self.rounds.append(
            EmulatorRound(
                runs=len(self.points),
                error_percent=_to_tuple(error),
                loo_percent=_to_tuple(loo),
                new_percent=self.new_percent,
                outside=outside,
            )
        )
        self.good_enough = bool(np.all(error <= self.needed) and outside < 0.05)
        self.report(f"{len(self.points)} runs: emulator within {error.max():.2f} % of the largest force")
        return self.good_enough or self.spent >= self.settings.runs

    def _find_best(self) -> Optimum:
        """Find the best optimum from the calibrated, the most probable and the best simulated parameters."""
        simulated = min(
            range(len(self.points)),
            key=lambda i: self.likelihood.minus_2_log_of(self.responses[i], self.points[i]),
        )
        return self.likelihood.find_best(
            (self.linearised.parameters, self.linearised.centre, self.points[simulated])
        )

    def _sample(self, steps: int) -> Posterior:
        seed = self.settings.seed
        return sample_posterior(self.likelihood, self.best.z, self.covariance, steps=steps, seed=seed)

    def build_result(self) -> Exploration:
        self.report("sampling the posterior")
        posterior = self._sample(self.settings.steps)
        sd = np.sqrt(np.diag(self.covariance))
        freedom = [self.linearised.degrees_of_freedom[np.flatnonzero(tie)[0]] for tie in self.space.tie.T]
        profiles = []
        for k in range(len(sd)):
            self.report(f"profile {k + 1} of {len(sd)}")
            of = self.likelihood, self.best, k, float(sd[k]), float(freedom[k])
            profiles.append(compute_profile(*of, is_inside=lambda p: self.emulator.is_inside(p, margin=0.0)))
        return Exploration(
            emulator=self.emulator,
            likelihood=self.likelihood,
            best=self.best,
            posterior=posterior,
            profiles=tuple(profiles),
            checks=self._check_profiles(profiles),
            rounds=tuple(self.rounds),
            needed_percent=self.needed,
            good_enough=self.good_enough,
            runs=tuple(self.responses),
        )

    def _check_profiles(self, profiles: Sequence[Profile]) -> tuple[ProfileCheck, ...]:
        """Simulate the ends of some profiles with the solver."""
        chosen = select_profiles_to_check(profiles, self.settings.checked)
        if not chosen:
            return ()
        self.report("checking the ends of profiles with the solver")
        wanted = [self.best.parameters, *(end for _, one in chosen for end in one.ends)]
        at_best, *found = self.simulate(wanted)
        if not all(r.completed for r in at_best):
            self.report("warning: the answer's own simulation failed: no end of a profile is checked")
            return ()
        pairs = zip(found[::2], found[1::2], strict=True)
        return tuple(
            check_profile_ends(self.likelihood, self.best, at_best, one, pair, why)
            for (why, one), pair in zip(chosen, pairs, strict=True)
        )


def _to_tuple(values: Array) -> tuple[float, ...]:
    return tuple(float(value) for value in values)
