"""Fits without some sites, to first order about an answer, and their errors at the sites left out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from ..fit.objective import MeasuredCurve, Simulate, SiteResponse

Array = NDArray[np.float64]

MAX_STANDARDISED_ERROR, MAX_ERROR_SHARE = (
    4.0,
    0.12,
)  # standardised error and prediction error over the peak that are warned of
MIN_GAIN = 4.0  # by which a correction must lower the squared misfit of all sites

_PRIOR_SD = 0.5  # of log(parameters) about the answer: keeps what few sites leave open where it was


_ASSUMED_ERROR_SHARE = 0.03  # force error, as a fraction of the peak, that data and prior are weighed by


_MAX_STEPS = 6


MIN_ERROR_SHARE = 0.02  # prediction error, as a fraction of the peak, below which sites are not told apart


class LogLinearModel:
    """A simulation expanded about one point: log(force) to first order in log(parameters).

    A force scales with the moduli, which this form keeps exactly; where the force is small, it is linear.
    """

    def __init__(self, parameters: Array, responses: Sequence[SiteResponse]) -> None:
        self.parameters, self.responses = parameters, tuple(responses)

    def __call__(self, parameters: Array) -> list[SiteResponse]:
        step = np.log(parameters / self.parameters)
        return [self._moved(response, step, parameters) for response in self.responses]

    def _moved(self, response: SiteResponse, step: Array, parameters: Array) -> SiteResponse:
        force, scaled = response.force_N, response.jacobian * self.parameters
        small = force < 0.05 * force.max()
        rate = scaled / np.where(small, 1.0, force)[:, None]
        grown = np.exp(np.clip(rate @ step, -5.0, 5.0))
        moved = np.where(small, force + scaled @ step, force * grown)
        slope = np.where(small[:, None], scaled, scaled * grown[:, None])
        return SiteResponse(moved, slope / parameters)


@dataclass(frozen=True)
class LeaveOneOutError:
    """A site predicted without itself.

    ``error`` is the root mean square of its prediction error over its peak, ``expected`` that of the others
    when the site is left out, ``ratio`` the best factor from predicted to measured force, and ``cook`` Cook's
    distance: how far the site moves the forces of all sites, compared with the misfit.
    """

    site: str
    error: float
    expected: float
    ratio: float
    cook: float

    @property
    def standardised(self) -> float:
        return self.error / self.expected


@dataclass(frozen=True)
class RecordCorrection:
    """One change to the records that makes all sites agree better: names exchanged, or a unit converted.

    ``gain`` is the squared misfit of all sites before over after, each refitted. The errors (root mean square
    over the peak) are those of ``sites``; ``worst_before`` is the largest of any site, because a fit may
    follow the bad record and miss the others.
    """

    kind: Literal["swap", "unit"]
    sites: tuple[int, ...]
    cause: str
    gain: float
    errors_before: tuple[float, ...]
    errors_after: tuple[float, ...]
    worst_before: float

    @property
    def is_convincing(self) -> bool:
        worst = self.worst_before
        return self.gain > MIN_GAIN and worst > MAX_ERROR_SHARE / 2 and max(self.errors_after) < 0.6 * worst


class LeaveOutFits:
    """All records with their simulation: regularised fits to some of them, and errors at the others.

    A record is left out with all others of its site, because these tell the same.
    """

    def __init__(self, simulate: Simulate, measured: Sequence[MeasuredCurve], start: Array) -> None:
        self.simulate, self.measured, self.start = simulate, tuple(measured), start
        self.peaks = [site.peak_N for site in measured]
        self._fits: dict[tuple[int, ...], Array] = {}

    def fit_without(self, *left: int) -> Array:
        """Return the parameters (p,) of the fit without the sites of some records."""
        key = self._of_sites(left)
        if key not in self._fits:
            self._fits[key] = self._fit([i for i in range(len(self.measured)) if i not in key])
        return self._fits[key]

    def _of_sites(self, some: Sequence[int]) -> tuple[int, ...]:
        """Return all records of the sites of some."""
        sites = {self.measured[i].site_name for i in some}
        return tuple(i for i, one in enumerate(self.measured) if one.site_name in sites)

    def _fit(self, chosen: Sequence[int]) -> Array:
        z = np.zeros(len(self.start))
        for _ in range(_MAX_STEPS):
            p = self.start * np.exp(z)
            responses = self.simulate(p)
            rows = [self._rows(i, responses[i], p) for i in chosen]
            residual = np.concatenate([r for r, _ in rows])
            slope = np.concatenate([s for _, s in rows])
            H = slope.T @ slope + np.eye(len(z)) / _PRIOR_SD**2
            step = np.linalg.solve(H, -slope.T @ residual - z / _PRIOR_SD**2)
            z = z + np.clip(step, -1.0, 1.0)
            if np.abs(step).max() < 1e-3:
                break
        return self.start * np.exp(z)

    def _rows(self, i: int, response: SiteResponse, parameters: Array) -> tuple[Array, Array]:
        weight = np.sqrt(self.measured[i].weight / response.force_N.size) / (
            _ASSUMED_ERROR_SHARE * self.peaks[i]
        )
        difference = response.force_N - self.measured[i].force_N
        # A record that is many times too strong must not drown the others (Huber's weight).
        size = float(np.sqrt(np.mean(difference**2))) / self.peaks[i]
        weight *= np.sqrt(min(1.0, 5 * _ASSUMED_ERROR_SHARE / max(size, 1e-12)))
        return difference * weight, response.jacobian * parameters * weight

    def compute_errors(self, parameters: Array) -> Array:
        """Return the root mean square error (n,) of each site over its peak, simulated or measured, the
        larger one.

        So a record that is too weak by a factor counts as much as one that is too strong by it.
        """
        triples = zip(self.simulate(parameters), self.measured, self.peaks)
        return np.array(
            [
                np.sqrt(np.mean((r.force_N - m.force_N) ** 2)) / max(peak, r.force_N.max())
                for r, m, peak in triples
            ]
        )

    def compute_ratio(self, i: int, parameters: Array) -> float:
        force = self.simulate(parameters)[i].force_N
        return float(force @ self.measured[i].force_N / (force @ force))

    def compute_expected_error(self, *left: int) -> float:
        """Return the root mean square error of sites predicted without themselves and ``left``."""
        out = self._of_sites(left)
        rest = [j for j in range(len(self.measured)) if j not in out]
        errors = [self.compute_errors(self.fit_without(*left, j))[j] for j in rest]
        return max(float(np.sqrt(np.mean(np.square(errors)))), MIN_ERROR_SHARE)
