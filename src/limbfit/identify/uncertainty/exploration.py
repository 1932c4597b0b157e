"""The exploration of everything that the records leave open, in rounds: emulator, posterior and profiles.

Each round fits the emulator to all simulations so far, samples the posterior on it, and simulates with the
solver where that posterior is and where the runs so far are farthest away. It ends when the emulator's error
over the posterior is below what the records can tell, or when the allowed runs are used up.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial

import numpy as np
from scipy.spatial.distance import cdist

from ...arrays import Array
from ...results.uncertainty import EmulatorRound, ProfileCheck
from ..fit.objective import SiteResponse
from ..fit.parameters import SearchSpace
from ..fit.prediction import compute_errors_percent
from .emulator import Emulator
from .likelihood import Likelihood, Optimum, Profile, check_profile_ends, compute_profile
from .posterior import Posterior, sample_posterior
from .uncertainty import Uncertainty, reduce_covariance

SimulateMany = Callable[[Sequence[Array]], Sequence[Sequence[SiteResponse]]]

_CANDIDATES, _DESIGN_WIDENING = 400, 1.2  # the first design is this much wider than the linearised posterior
_MAX_DISTANCE = 1.4  # distance of a candidate from their middle, over the root of their dimension
_SHORT_CHAIN_STEPS = 800
_CHECKED_SAMPLES = 150  # samples at which the emulator's error is asked
_ERROR_QUANTILE = 0.9  # of those errors
_MAX_OUTSIDE = 0.05  # share of those samples outside the emulator's runs


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

    Parameters
    ----------
    simulate : takes several full parameters (p,) and returns the responses of each; failed ones are left out.
    linearised : the linearised uncertainty there, whose covariance of the residuals is used.
    points : parameters that were simulated before, which ``simulate`` returns at no cost.
    report : called with sentences on the progress.
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
