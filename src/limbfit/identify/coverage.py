"""Do 95 % intervals hold the truth in 95 % of cases? Asked of a model whose truth is known, many times."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import bdtr

from .calibration import CalibrationSettings, calibrate
from .noise import SiteNoise
from .objective import Measured, Simulate
from .parameters import Unknowns, separate
from .uncertainty import DETERMINED, estimate_uncertainty

Array = NDArray[np.float64]

_START_SD = 0.1  # of the logarithms

# From the number of a repeat and the true forces per site to records, and the noise that is claimed of them.
Recording = Callable[[int, Sequence[Array]], tuple[Sequence[Measured], Sequence[SiteNoise]]]


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


def coverage_study(
    simulate: Simulate, truth: Array, unknowns: Unknowns, record: Recording, repeats: int
) -> Coverage:
    """Calibrate and judge ``repeats`` records of the forces at ``truth`` (p,), each with noise of its own.

    Each calibration starts about a tenth off the truth.
    Every repeat is what a study does: the calibration's own least squares, then ``estimate_uncertainty``.
    """
    clean = [response.force_N for response in simulate(truth)]
    settings = CalibrationSettings(relative_tolerance=1e-4, max_iterations=60)
    deviations, determined, held, misfit = [], [], [], []
    for repeat in range(repeats):
        measured, noise = record(repeat, clean)
        off_truth = np.random.default_rng(repeat).normal(0.0, _START_SD, truth.size)
        start = unknowns.from_start(truth * np.exp(off_truth))
        found = calibrate(simulate, measured, start, settings, stages=(separate(unknowns.names),))
        u = estimate_uncertainty(found.parameters, found.responses, measured, unknowns, noise)
        off = np.log(found.parameters / truth)
        deviations.append([c.weights @ off / np.log(c.factor_95) for c in u.combinations])
        determined.append([c.verdict == DETERMINED for c in u.combinations])
        low, high = u.intervals_95.T
        held.append((low <= truth) & (truth <= high))
        misfit.append(100 * u.residual_model.misfit_elsewhere)
    return Coverage(np.array(deviations), np.array(determined), np.array(held), np.array(misfit))
