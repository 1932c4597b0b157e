"""Do 95 % intervals hold the truth in 95 % of cases? Asked of a model whose truth is known, many times."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from bars import storing
from numpy.typing import NDArray
from scipy.special import bdtr

from limbfit.identify.fit.calibration import CalibrationSettings, calibrate
from limbfit.identify.fit.objective import MeasuredCurve, SiteResponse
from limbfit.identify.fit.parameters import Unknowns, group_separately
from limbfit.identify.uncertainty.intervals import EvaluationStore, restate_from_samples, sample_uncertainty
from limbfit.identify.uncertainty.likelihood import Likelihood
from limbfit.identify.uncertainty.noise import SiteNoise
from limbfit.identify.uncertainty.posterior import Posterior, sample_posterior
from limbfit.identify.uncertainty.uncertainty import DETERMINED, Uncertainty, estimate_uncertainty

Array = NDArray[np.float64]

_START_SD = 0.1  # of the logarithms

# From the number of a repeat and the true forces per site to records, and the noise that is claimed of them.
Recording = Callable[[int, Sequence[Array]], tuple[Sequence[MeasuredCurve], Sequence[SiteNoise]]]


@dataclass(frozen=True)
class Coverage:
    """What came of the repeats.

    ``deviations`` (repeats, k) are errors of the combinations over half their 95 % interval, the best known
    first; ``determined`` (repeats, k) says which each repeat calls determined; ``held`` (repeats, p) whether
    the interval of a parameter holds it. ``misfit_percent`` (repeats,) is the misfit that was estimated.
    """

    deviations: Array
    determined: NDArray[np.bool_]
    held: NDArray[np.bool_]
    misfit_percent: Array

    @property
    def share(self) -> float:
        """Of the determined combinations whose interval holds the truth."""
        return float(np.mean(np.abs(self.deviations[self.determined]) < 1))

    @property
    def by_combination(self) -> Array:
        """The share (k,) for every combination, determined or not."""
        return np.mean(np.abs(self.deviations) < 1, axis=0)

    @property
    def by_parameter(self) -> Array:
        return np.mean(self.held, axis=0)

    def limits(self) -> tuple[float, float]:
        """Between which the share of one combination falls in 95 % of such studies if intervals are right."""
        n = len(self.deviations)
        below = bdtr(np.arange(n + 1), n, 0.95)
        return float(np.argmax(below >= 0.025)) / n, float(np.argmax(below >= 0.975)) / n


@dataclass(frozen=True)
class CoverageStudy:
    """Of the intervals that a calibration states, and of two others.

    ``linearised`` ones are of the answer alone; ``sampled`` ones, if they were, of the posterior on the model
    itself, as if the emulator knew all of it. ``further`` is how many simulations of single sites were made
    after the calibration, on average.
    """

    stated: Coverage
    linearised: Coverage
    sampled: Coverage | None
    further: float


# Of one repeat: deviations (k,), what is determined (k,), and whether each parameter is held (p,).
Judged = tuple[Array, NDArray[np.bool_], NDArray[np.bool_]]


# From responses and parameters (p,) to what each site as a whole may be off by, (n,) N.
Deviation = Callable[[Sequence[SiteResponse], Array], Sequence[Array]]


def no_deviation(responses: Sequence[SiteResponse], parameters: Array) -> tuple[Array, ...]:
    """Of sites whose tissue is alike and whose surfaces are right."""
    return ()


def coverage_study(
    simulate: Any,
    truth: Array,
    unknowns: Unknowns,
    record: Recording,
    repeats: int,
    steps: int = 0,
    deviation: Deviation = no_deviation,
    moves: bool = False,
) -> CoverageStudy:
    """Calibrate and judge ``repeats`` records of the forces at ``truth`` (p,), each with noise of its own.

    Each calibration starts about a tenth off the truth; ``deviation`` says what each site as a whole is
    expected to be off by, (n,) N per site; ``moves`` as in ``sample_uncertainty``.
    Every repeat is what a study does: the calibration's own least squares, then ``estimate_uncertainty`` and
    ``sample_uncertainty`` with what was simulated, and with ``steps`` of the sampler the posterior on the
    model itself.
    """
    clean = [response.force_N for response in simulate(truth)]
    settings = CalibrationSettings(relative_tolerance=1e-4, max_iterations=60)
    stages = (group_separately(unknowns.names),)
    linear, stated, sampled, misfit, further = [], [], [], [], []
    for repeat in range(repeats):
        measured, noise = record(repeat, clean)
        off_truth = np.random.default_rng(repeat).normal(0.0, _START_SD, truth.size)
        start = unknowns.with_start(truth * np.exp(off_truth))
        kept = EvaluationStore()
        found = calibrate(storing(kept, simulate), measured, start, settings, stages=stages)
        u = estimate_uncertainty(
            found.parameters, found.responses, measured, unknowns, noise, settings=settings,
            site_N=deviation(found.responses, found.parameters),
        )  # fmt: skip
        linear.append(_judged(u, truth))
        asked = EvaluationStore()
        asking = storing(asked, simulate)
        ours = sample_uncertainty(u, kept, asking, move_answer=moves)
        stated.append(_judged(ours, truth))
        further.append(len(asked.points) * len(measured))
        misfit.append(100 * u.residual_model.misfit_elsewhere)
        if steps:
            samples = _posterior(simulate, u, steps)
            sampled.append(_judged(restate_from_samples(u, samples), truth))
    return CoverageStudy(
        _coverage(stated, misfit),
        _coverage(linear, misfit),
        _coverage(sampled, misfit) if steps else None,
        float(np.mean(further)),
    )


def _coverage(judged: Sequence[Judged], misfit_percent: Sequence[float]) -> Coverage:
    deviations, determined, held = (np.array(column) for column in zip(*judged))
    return Coverage(deviations, determined, held, np.array(misfit_percent))


def _judged(known: Uncertainty, truth: Array) -> Judged:
    deviations = [
        (c.middle_log - c.weights @ np.log(truth)) / np.log(c.factor_95) for c in known.combinations
    ]
    low, high = known.intervals_95.T
    determined = [c.verdict == DETERMINED for c in known.combinations]
    return np.array(deviations), np.array(determined), (low <= truth) & (truth <= high)


def _posterior(
    simulate: Any,
    known: Uncertainty,
    steps: int,
) -> Posterior:
    """Sampled from the most probable parameters on, as ``explore`` does."""
    likelihood = Likelihood(simulate, known.measured, known.residual_model, known.unknowns, known.space)
    best = likelihood.find_best((known.parameters, known.centre))
    return sample_posterior(likelihood, best.z, likelihood.compute_covariance(best.z), steps=steps)
