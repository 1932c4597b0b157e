"""Fits without some sites, to first order about an answer, and their errors at the sites left out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Literal

import numpy as np

from ...arrays import Array
from ..fit.objective import MeasuredCurve, Simulate, SiteResponse

MAX_STANDARDISED_ERROR = 4.0  # a larger error of a site that is left out is warned of
MAX_ERROR_SHARE = 0.12  # the same for its prediction error as a fraction of the peak
MIN_ERROR_SHARE = 0.02  # prediction error, as a fraction of the peak, below which sites are not told apart
MIN_GAIN = 4.0  # by which a correction must lower the squared misfit of all sites
MIN_SITES = 4  # fewer sites cannot tell which one is wrong
_PRIOR_SD = 0.5  # of log(parameters) about the answer: keeps what few sites leave open where it was
_ASSUMED_ERROR_SHARE = 0.03  # force error, as a fraction of the peak, that data and prior are weighed by
_MAX_STEPS = 6
_MAX_WORST_SITES = 8  # sites of which pairs and units are tried


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

    Parameters
    ----------
    simulate : returns all sites of ``measured``, in order; cheap.
    start : the answer (p,), from which the fits start, and which they keep where the data say nothing.
    """

    def __init__(self, simulate: Simulate, measured: Sequence[MeasuredCurve], start: Array) -> None:
        self.simulate, self.measured, self.start = simulate, tuple(measured), start
        self.peaks = [site.peak_N for site in measured]
        self._fits: dict[tuple[int, ...], Array] = {}

    def fit_without(self, *left_out: int) -> Array:
        """Return the parameters (p,) of the fit without the sites of some records."""
        key = self._of_sites(left_out)
        if key not in self._fits:
            self._fits[key] = self._fit([i for i in range(len(self.measured)) if i not in key])
        return self._fits[key]

    def _of_sites(self, indices: Sequence[int]) -> tuple[int, ...]:
        """Return all records of the sites of some records."""
        sites = {self.measured[i].site_name for i in indices}
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

    def compute_expected_error(self, *left_out: int) -> float:
        """Return the root mean square error of sites predicted without themselves and ``left_out``."""
        out = self._of_sites(left_out)
        rest = [j for j in range(len(self.measured)) if j not in out]
        errors = [self.compute_errors(self.fit_without(*left_out, j))[j] for j in rest]
        return max(float(np.sqrt(np.mean(np.square(errors)))), MIN_ERROR_SHARE)

    def leave_one_out(self) -> tuple[LeaveOneOutError, ...]:
        """Predict every site from all others."""
        whole = [r.force_N for r in self.simulate(self.fit_without())]
        misfit = max(float(np.mean(self.compute_errors(self.fit_without()) ** 2)), (MIN_ERROR_SHARE / 2) ** 2)
        found = []
        for i, site in enumerate(self.measured):
            parameters = self.fit_without(i)
            force = self.simulate(parameters)[i].force_N
            moved = [
                np.mean((r.force_N - w) ** 2) / peak**2
                for r, w, peak in zip(self.simulate(parameters), whole, self.peaks)
            ]
            found.append(
                LeaveOneOutError(
                    site=site.name,
                    error=float(self.compute_errors(parameters)[i]),
                    expected=self.compute_expected_error(i),
                    ratio=float(force @ site.force_N / (force @ force)),
                    cook=float(np.sum(moved) / (len(self.start) * misfit)),
                )
            )
        return tuple(found)


def find_misfitting_sites(
    simulate: Simulate, measured: Sequence[MeasuredCurve], start: Array
) -> tuple[tuple[LeaveOneOutError, ...], tuple[int, ...]]:
    """Leave every site out; return the errors and the indices of the sites that do not fit: none, one or two.

    With fewer than four sites nobody can tell which one is wrong.
    """
    number = count_sites(measured)
    if number < MIN_SITES:
        return (), ()
    sites = LeaveOutFits(simulate, measured, start)
    singles = sites.leave_one_out()
    best = int(np.argmax([single.standardised for single in singles]))
    alone = singles[best].standardised if singles[best].error > MAX_ERROR_SHARE else 0.0
    pair, together = _find_worst_pair(sites, singles)
    if together > MAX_STANDARDISED_ERROR and together > 1.5 * alone and number > MIN_SITES:
        return singles, pair
    return singles, (best,) if alone > MAX_STANDARDISED_ERROR else ()


def _find_worst_pair(
    sites: LeaveOutFits, singles: Sequence[LeaveOneOutError]
) -> tuple[tuple[int, ...], float]:
    """Return the two sites that, both left out, are predicted worst by the rest; 0 if one of them is fine."""
    everyone = sites.compute_errors(sites.fit_without())
    if max(everyone.max(), *(single.error for single in singles)) <= MAX_ERROR_SHARE / 2:
        return (), 0.0
    found: tuple[tuple[int, ...], float] = ((), 0.0)
    for i, j in list_pairs(sites.measured, find_worst_sites(sites, everyone)):
        errors = sites.compute_errors(sites.fit_without(i, j))[[i, j]]
        if errors.min() < MAX_ERROR_SHARE:
            continue
        size = float(np.sqrt(np.mean(errors**2))) / sites.compute_expected_error(i, j)
        if size > found[1]:
            found = ((i, j), size)
    return found


def count_sites(measured: Sequence[MeasuredCurve]) -> int:
    return len({one.site_name for one in measured})


def list_pairs(measured: Sequence[MeasuredCurve], indices: Sequence[int]) -> list[tuple[int, int]]:
    """List pairs of records that are of two sites and compare the same, force or depth."""
    pairs = [(i, j, measured[i], measured[j]) for i, j in combinations(sorted(indices), 2)]
    return [(i, j) for i, j, one, two in pairs if one.site_name != two.site_name and one.unit == two.unit]


def find_worst_sites(sites: LeaveOutFits, before: Array) -> list[int]:
    """Return the sites that are predicted worst, with or without themselves, at most eight."""
    alone = [sites.compute_errors(sites.fit_without(i))[i] for i in range(len(before))]
    return [int(i) for i in np.argsort(-np.maximum(before, alone))[:_MAX_WORST_SITES]]
