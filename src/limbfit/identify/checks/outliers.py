"""Sites whose record does not fit the model that the others agree on, found after the calibration.

Each site is left out and predicted from the others. Its standardised error is that prediction's over the
error with which the *other* sites are predicted while both are left out, so that one bad record cannot hide
behind the misfit that it causes. For two bad records, pairs are left out together. The ratio of measured to
predicted force names a unit; Cook's distance says how much a site moves the fit; an exchange of two records
that lowers the misfit of all sites says that names were swapped.

The fits are regularised Gauss-Newton on ``simulate``, which is meant to be cheap: `LogLinearModel` around the
answer, or an emulator.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import combinations
from typing import Literal

import numpy as np

from ...arrays import Array
from ...phases import find_boundaries, find_phases
from ...results.identification import LeftOutRecord
from ..fit.objective import MeasuredCurve, Simulate, SiteResponse, check_responses
from .plausibility import UNITS, RecordWarning

History = tuple[Array, Array]
Exchanged = tuple[SiteResponse, SiteResponse]  # the responses of two sites, each to the other's record
Exchange = Callable[[int, int], Exchanged]

_UNIT_TOLERANCE = 0.25  # of the logarithm of a unit's factor: how near the force ratio must come
_MAX_CORRECTIONS = 3  # corrections that are looked for
_MAX_SIMULATED_EXCHANGES = 3  # exchanges that are simulated
FORCE_UNITS = {name: force for name, (force, travel, time) in UNITS.items() if travel == time == 1.0}
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
        return [self._extrapolate(response, step, parameters) for response in self.responses]

    def _extrapolate(self, response: SiteResponse, step: Array, parameters: Array) -> SiteResponse:
        force, scaled = response.force_N, response.jacobian * self.parameters
        small = force < 0.05 * force.max()
        rate = scaled / np.where(small, 1.0, force)[:, None]
        grown = np.exp(np.clip(rate @ step, -5.0, 5.0))
        slope = np.where(small[:, None], scaled, scaled * grown[:, None])
        return SiteResponse(np.where(small, force + scaled @ step, force * grown), slope / parameters)


class LeaveOutFits:
    """All records with their simulation: regularised fits to some of them, and errors at the others.

    A record is left out with all others of its site, because these tell the same.

    ``simulate``: returns all sites of ``measured``, in order; cheap. ``start``: the answer (p,), from which
    the fits start, and which they keep where the data say nothing. ``tie``: (p, k) as `SearchSpace`, which
    parameters move, and which of them together; None: each by itself.
    """

    def __init__(
        self, simulate: Simulate, measured: Sequence[MeasuredCurve], start: Array, tie: Array | None = None
    ) -> None:
        self.simulate, self.measured, self.start = simulate, tuple(measured), start
        self.tie = np.eye(len(start)) if tie is None else tie
        self.peaks = [site.peak_N for site in measured]
        self._fits: dict[tuple[int, ...], Array] = {}

    def fit_without(self, *left_out: int) -> Array:
        """Return the parameters (p,) of the fit without the sites of some records."""
        key = self._expand_to_sites(left_out)
        if key not in self._fits:
            self._fits[key] = self._fit([i for i in range(len(self.measured)) if i not in key])
        return self._fits[key]

    def _expand_to_sites(self, indices: Sequence[int]) -> tuple[int, ...]:
        """Return all records of the sites of some records."""
        sites = {self.measured[i].site_name for i in indices}
        return tuple(i for i, one in enumerate(self.measured) if one.site_name in sites)

    def convert_force(self, i: int, factor: float) -> LeaveOutFits:
        """Return the same with the force of a record divided by the factor of a unit."""
        measured = list(self.measured)
        measured[i] = replace(measured[i], force_N=measured[i].force_N / factor)
        return LeaveOutFits(self.simulate, measured, self.start, self.tie)

    def exchange_records(self, i: int, j: int, exchanged: Exchanged) -> LeaveOutFits:
        """Return the same with two records in each other's place, and the responses to these at the start."""
        measured, moved = list(self.measured), LogLinearModel(self.start, exchanged)
        measured[i] = replace(self.measured[j], site=self.measured[i].site_name)
        measured[j] = replace(self.measured[i], site=self.measured[j].site_name)

        def respond(parameters: Array) -> list[SiteResponse]:
            responses = list(self.simulate(parameters))
            responses[i], responses[j] = moved(parameters)
            return responses

        return LeaveOutFits(respond, measured, self.start, self.tie)

    def _fit(self, chosen: Sequence[int]) -> Array:
        z = np.zeros(self.tie.shape[1])
        for _ in range(_MAX_STEPS):
            p = self.start * np.exp(self.tie @ z)
            responses = self.simulate(p)
            rows = [self._rows(i, responses[i], p) for i in chosen]
            residual = np.concatenate([r for r, _ in rows])
            slope = np.concatenate([s for _, s in rows])
            H = slope.T @ slope + np.eye(len(z)) / _PRIOR_SD**2
            step = np.linalg.solve(H, -slope.T @ residual - z / _PRIOR_SD**2)
            z = z + np.clip(step, -1.0, 1.0)
            if np.abs(step).max() < 1e-3:
                break
        return self.start * np.exp(self.tie @ z)

    def _rows(self, i: int, response: SiteResponse, parameters: Array) -> tuple[Array, Array]:
        error_N = _ASSUMED_ERROR_SHARE * self.peaks[i]
        weight = np.sqrt(self.measured[i].weight / response.force_N.size) / error_N
        difference = response.force_N - self.measured[i].force_N
        # A record that is many times too strong must not drown the others (Huber's weight).
        size = float(np.sqrt(np.mean(difference**2))) / self.peaks[i]
        weight *= np.sqrt(min(1.0, 5 * _ASSUMED_ERROR_SHARE / max(size, 1e-12)))
        return difference * weight, (response.jacobian * parameters * weight) @ self.tie

    def compute_errors(self, parameters: Array) -> Array:
        """Return the root mean square error (n,) of each site over its peak, simulated or measured, the
        larger one.

        So a record that is too weak by a factor counts as much as one that is too strong by it.
        """
        errors = []
        for response, site, peak in zip(self.simulate(parameters), self.measured, self.peaks):
            error_N = np.sqrt(np.mean((response.force_N - site.force_N) ** 2))
            errors.append(error_N / max(peak, response.force_N.max()))
        return np.array(errors)

    def compute_expected_error(self, *left_out: int) -> float:
        """Return the root mean square error of sites predicted without themselves and ``left_out``."""
        out = self._expand_to_sites(left_out)
        rest = [j for j in range(len(self.measured)) if j not in out]
        errors = [self.compute_errors(self.fit_without(*left_out, j))[j] for j in rest]
        return max(float(np.sqrt(np.mean(np.square(errors)))), MIN_ERROR_SHARE)

    def leave_one_out(self) -> tuple[LeftOutRecord, ...]:
        """Predict every site from all others.

        The error is the root mean square over the site's peak; it is expected to be that of the others when
        the site is left out. Cook's distance is how far the site moves the forces of all sites, compared with
        the misfit.
        """
        whole = [r.force_N for r in self.simulate(self.fit_without())]
        misfit = max(float(np.mean(self.compute_errors(self.fit_without()) ** 2)), (MIN_ERROR_SHARE / 2) ** 2)
        found = []
        for i, site in enumerate(self.measured):
            parameters = self.fit_without(i)
            forces = [r.force_N for r in self.simulate(parameters)]
            force = forces[i]
            moved = [np.mean((f - w) ** 2) / peak**2 for f, w, peak in zip(forces, whole, self.peaks)]
            error, expected = float(self.compute_errors(parameters)[i]), self.compute_expected_error(i)
            found.append(
                LeftOutRecord(
                    site=site.name,
                    error=error,
                    expected=expected,
                    ratio=float(force @ site.force_N / (force @ force)),
                    cook=float(np.sum(moved) / (self.tie.shape[1] * misfit)),
                    standardised=error / expected,
                )
            )
        return tuple(found)


@dataclass(frozen=True)
class RecordCorrection:
    """One change to the records that makes all sites agree better: names exchanged, or a unit converted.

    ``gain`` is the squared misfit of all sites before over after, each refitted. The errors (root mean square
    over the peak) are the largest of ``sites``; ``worst_before`` is that of any site, because a fit may
    follow the bad record and miss the others. ``fits`` are those to the records with the change.
    """

    kind: Literal["swap", "unit"]
    sites: tuple[int, ...]
    cause: str
    gain: float
    error_before: float
    error_after: float
    worst_before: float
    fits: LeaveOutFits = field(repr=False)

    @property
    def is_convincing(self) -> bool:
        worst = self.worst_before
        return self.gain > MIN_GAIN and worst > MAX_ERROR_SHARE / 2 and self.error_after < 0.6 * worst


def find_misfitting_sites(sites: LeaveOutFits) -> tuple[tuple[LeftOutRecord, ...], tuple[int, ...]]:
    """Leave every site out; return the errors, and which sites do not fit: none, one or two."""
    singles = sites.leave_one_out()
    best = int(np.argmax([single.standardised for single in singles]))
    alone = singles[best].standardised if singles[best].error > MAX_ERROR_SHARE else 0.0
    pair, together = _find_worst_pair(sites, singles)
    is_pair = together > max(MAX_STANDARDISED_ERROR, 1.5 * alone)
    if is_pair and count_sites(sites.measured) > MIN_SITES:
        return singles, pair
    return singles, (best,) if alone > MAX_STANDARDISED_ERROR else ()


def _find_worst_pair(sites: LeaveOutFits, singles: Sequence[LeftOutRecord]) -> tuple[tuple[int, ...], float]:
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


def approximate_response(response: SiteResponse, history: History, other_history: History) -> SiteResponse:
    """Approximate a site's response to another site's record.

    The curve is stretched in time, and by a power law in depth with the exponent of its own loading.

    ``history``, ``other_history``: times (n,) s and depths (n,) mm of its record and of the other one.
    """
    (time, depth), (_, other_depth) = history, other_history
    deep = depth.max()
    rising = np.zeros(len(time), dtype=bool)
    for phase in find_phases(time, depth):
        if phase.kind == "load":
            rising |= (time >= phase.start_s) & (time <= phase.end_s)
    loading, force = depth[rising], response.force_N[rising]
    used = (loading > 0.3 * deep) & (force > 0)
    exponent = float(np.polyfit(np.log(loading[used]), np.log(force[used]), 1)[0]) if used.sum() > 2 else 1.0
    factor = (other_depth.max() / deep) ** np.clip(exponent, 0.5, 4.0)
    at = _match_times(history, other_history)
    columns = [np.interp(at, time, column) for column in response.jacobian.T]
    return SiteResponse(factor * np.interp(at, time, response.force_N), factor * np.stack(columns, axis=1))


def _match_times(history: History, other_history: History) -> Array:
    """Return the times (n,) at which a site's record has come as far as the other one at its times.

    That is as far in the same phase, or in the same share of the whole if their phases differ.
    """
    phases, other_phases = find_phases(*history), find_phases(*other_history)
    if [phase.kind for phase in phases] == [phase.kind for phase in other_phases]:
        return np.asarray(np.interp(other_history[0], find_boundaries(other_phases), find_boundaries(phases)))
    return other_history[0] / other_history[0][-1] * history[0][-1]


def find_best_correction(
    fits: LeaveOutFits, approximate: Exchange, simulate: Exchange
) -> RecordCorrection | None:
    """Find the one change of names or of a unit that lowers the misfit of all sites most, if it is
    convincing.

    ``approximate``: approximates the responses of two sites, each to the other's record, at the start of the
    fits (``approximate_response``). ``simulate``: simulates the same. It is asked for the few exchanges that
    may matter, and then decisive; an exchange whose simulation fails is not considered.
    """
    before = fits.compute_errors(fits.fit_without())
    if before.max() <= MAX_ERROR_SHARE / 2:
        return None  # nothing to explain

    def swap(pair: tuple[int, ...], exchanged: Exchanged) -> RecordCorrection:
        i, j = pair
        swapped = fits.exchange_records(i, j, exchanged)
        return _build_correction("swap", pair, "swapped site names", before, swapped)

    worst = sorted(find_worst_sites(fits, before))
    units = [
        _build_correction("unit", (i,), unit, before, fits.convert_force(i, factor))
        for i in worst
        for unit, factor in FORCE_UNITS.items()
        if fits.measured[i].unit == "N"
    ]
    swaps = [swap(pair, approximate(*pair)) for pair in list_pairs(fits.measured, worst)]
    likely = sorted((s for s in swaps if s.gain > MIN_GAIN / 2), key=lambda s: -s.gain)
    simulated = [(s.sites, simulate(*s.sites)) for s in likely[:_MAX_SIMULATED_EXCHANGES]]
    swaps = [swap(pair, exchanged) for pair, exchanged in simulated if all(r.completed for r in exchanged)]
    convincing = [correction for correction in (*units, *swaps) if correction.is_convincing]
    return max(convincing, key=lambda correction: correction.gain, default=None)


def _build_correction(
    kind: Literal["swap", "unit"], indices: tuple[int, ...], cause: str, before: Array, fits: LeaveOutFits
) -> RecordCorrection:
    """Fit all sites with the change; ``before`` are the errors (n,) without it."""
    after = fits.compute_errors(fits.fit_without())
    gain = float(np.sum(before**2) / max(np.sum(after**2), len(after) * (MIN_ERROR_SHARE / 2) ** 2))
    own = list(indices)
    errors = float(before[own].max()), float(after[own].max())
    return RecordCorrection(kind, indices, cause, gain, *errors, float(before.max()), fits)


def find_outliers(
    simulate: Simulate,
    measured: Sequence[MeasuredCurve],
    start: Array,
    histories: Sequence[History],
    simulate_exchange: Callable[[Array, int, int], Exchanged],
    neutral: Array,
    tie: Array | None = None,
) -> tuple[tuple[LeftOutRecord, ...], tuple[RecordWarning, ...]]:
    """Look for names exchanged, wrong units of force, and sites that do not fit, one after the other.

    Returns the errors of all sites left out, with the records named as given, and the warnings.

    A convincing correction becomes a warning, and is applied before the next one is looked for, so that the
    rest is judged by correct records. With fewer than four sites there is no warning.

    If the fit at ``start`` followed a wrong record, sites are off everywhere, because several materials end
    at bounds to fit that record. Then the sites are judged from ``neutral``, the answer with one material,
    which cannot follow a wrong record as far.

    ``simulate``: returns all sites; called at ``start``, and at ``neutral`` if that is needed. ``histories``:
    times (n,) s and depths (n,) mm of each record. ``simulate_exchange``: simulates two sites with parameters
    (p,), each with the other's record. ``tie``: as `LeaveOutFits`.
    """
    if count_sites(measured) < MIN_SITES:
        return (), ()
    model = LogLinearModel(start, simulate(start))
    fits = LeaveOutFits(model, measured, start, tie)
    errors = fits.leave_one_out()
    if fits.compute_errors(start).max() > MAX_ERROR_SHARE:
        responses = simulate(neutral)
        if not check_responses(responses, measured, len(neutral)):
            model = LogLinearModel(neutral, responses)
            fits = LeaveOutFits(model, measured, neutral, tie)

    def approximate(i: int, j: int) -> Exchanged:
        one, two = histories[i], histories[j]
        responses = model.responses
        return approximate_response(responses[i], one, two), approximate_response(responses[j], two, one)

    warnings, exchange = list[RecordWarning](), partial(simulate_exchange, model.parameters)
    for _ in range(_MAX_CORRECTIONS):
        correction = find_best_correction(fits, approximate, exchange)
        if correction is None:
            break
        fits = correction.fits
        warnings.append(warn_of_correction(correction, [site.name for site in measured]))
    singles, misfitting = find_misfitting_sites(fits)
    corrected_sites = {site for warning in warnings for site in warning.sites}
    others = (i for i in misfitting if measured[i].name not in corrected_sites)
    return errors, (*warnings, *(warn_of_outlier(singles[i], measured[i].unit) for i in others))


def warn_of_outlier(error: LeftOutRecord, unit: str) -> RecordWarning:
    """Build the warning about a site that does not fit, with the unit that its force ratio is near.

    ``unit`` is that of what is compared; for a depth, another unit was found before.
    """
    numbers = {
        "prediction_error_percent": 100 * error.error,
        "expected_error_percent": 100 * error.expected,
        "standardised_error": error.standardised,
        "force_ratio": error.ratio,
        "cooks_distance": error.cook,
    }
    what = (
        f"predicted from the other sites, it is off by {100 * error.error:.0f} % of its peak, "
        f"{error.standardised:.1f} times as much as they are (measured {error.ratio:.2f} times predicted)"
    )
    force_unit = guess_force_unit(error.ratio) if unit == "N" else ""
    if force_unit:
        return RecordWarning((error.site,), "unit", what, numbers, force_unit, "convert the force to N")
    cause = "another place, axis, limb or name, or tissue that differs there"
    remedy = "check the record, position and axis of this site; leave it out of the fit until then"
    return RecordWarning((error.site,), "outlier", what, numbers, cause, remedy)


def warn_of_correction(correction: RecordCorrection, names: Sequence[str]) -> RecordWarning:
    sites = tuple(names[i] for i in correction.sites)
    numbers = {
        "misfit_ratio": correction.gain,
        "error_before_percent": 100 * correction.error_before,
        "error_after_percent": 100 * correction.error_after,
    }
    done, remedy = {
        "swap": ("their records exchanged", "exchange the traces of the two sites, or their names"),
        "unit": ("its force converted", "convert the force to N"),
    }[correction.kind]
    what = (
        f"with {done}, the squared misfit of all sites falls {correction.gain:.1f} times and the error here "
        f"from {numbers['error_before_percent']:.0f} to {numbers['error_after_percent']:.0f} % of the peak"
    )
    return RecordWarning(sites, correction.kind, what, numbers, correction.cause, remedy)


def guess_force_unit(ratio: float) -> str:
    """Return the unit of force that a ratio of measured to predicted force comes near, or an empty text."""
    if ratio <= 0:
        return ""
    name = min(FORCE_UNITS, key=lambda unit: abs(np.log(ratio / FORCE_UNITS[unit])))
    distance = abs(np.log(ratio / FORCE_UNITS[name]))
    return name if distance < min(_UNIT_TOLERANCE * abs(np.log(FORCE_UNITS[name])), 0.5) else ""
