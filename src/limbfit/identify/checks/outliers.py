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
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from ...phases import boundaries, find_phases
from ..fit.objective import MeasuredCurve, Simulate, SiteResponse, check_responses
from .leave_one_out import (
    MAX_ERROR_SHARE,
    MAX_STANDARDISED_ERROR,
    MIN_ERROR_SHARE,
    MIN_GAIN,
    LeaveOneOutError,
    LeaveOutFits,
    LogLinearModel,
    RecordCorrection,
)
from .plausibility import UNITS, RecordWarning

Array = NDArray[np.float64]
History = tuple[Array, Array]

_UNIT_TOLERANCE = 0.25  # of the logarithm of a unit's factor: how near the force ratio must come
_MAX_CORRECTIONS = 3  # corrections that are looked for
_MAX_SIMULATED_EXCHANGES = 3  # exchanges that are simulated
_MAX_WORST_SITES = 8  # sites of which pairs and units are tried
MIN_SITES = 4
FORCE_UNITS = {name: force for name, (force, travel, time) in UNITS.items() if travel == time == 1.0}


def leave_one_out(
    simulate: Simulate, measured: Sequence[MeasuredCurve], start: Array
) -> tuple[LeaveOneOutError, ...]:
    """Predict every site from all others.

    Parameters
    ----------
    simulate : returns all sites of ``measured``, in order; cheap.
    start : the answer (p,), from which the fits start, and which they keep where the data say nothing.
    """
    return tuple(_predict_left_out(LeaveOutFits(simulate, measured, start)))


def _predict_left_out(sites: LeaveOutFits) -> list[LeaveOneOutError]:
    whole = [r.force_N for r in sites.simulate(sites.fit_without())]
    misfit = max(float(np.mean(sites.compute_errors(sites.fit_without()) ** 2)), (MIN_ERROR_SHARE / 2) ** 2)
    found = []
    for i, site in enumerate(sites.measured):
        parameters = sites.fit_without(i)
        moved = [
            np.mean((r.force_N - w) ** 2) / peak**2
            for r, w, peak in zip(sites.simulate(parameters), whole, sites.peaks)
        ]
        found.append(
            LeaveOneOutError(
                site=site.name,
                error=float(sites.compute_errors(parameters)[i]),
                expected=sites.compute_expected_error(i),
                ratio=sites.compute_ratio(i, parameters),
                cook=float(np.sum(moved) / (len(sites.start) * misfit)),
            )
        )
    return found


def find_misfitting_sites(
    simulate: Simulate, measured: Sequence[MeasuredCurve], start: Array
) -> tuple[tuple[LeaveOneOutError, ...], tuple[int, ...]]:
    """Leave every site out; return the errors and the indices of the sites that do not fit: none, one or two.

    With fewer than four sites nobody can tell which one is wrong.
    """
    number = _count_sites(measured)
    if number < MIN_SITES:
        return (), ()
    sites = LeaveOutFits(simulate, measured, start)
    singles = _predict_left_out(sites)
    best = int(np.argmax([single.standardised for single in singles]))
    alone = singles[best].standardised if singles[best].error > MAX_ERROR_SHARE else 0.0
    pair, together = _find_worst_pair(sites, singles)
    if together > MAX_STANDARDISED_ERROR and together > 1.5 * alone and number > MIN_SITES:
        return tuple(singles), pair
    return tuple(singles), (best,) if alone > MAX_STANDARDISED_ERROR else ()


def _find_worst_pair(
    sites: LeaveOutFits, singles: Sequence[LeaveOneOutError]
) -> tuple[tuple[int, ...], float]:
    """Return the two sites that, both left out, are predicted worst by the rest; 0 if one of them is fine."""
    everyone = sites.compute_errors(sites.fit_without())
    if max(everyone.max(), *(single.error for single in singles)) <= MAX_ERROR_SHARE / 2:
        return (), 0.0
    found: tuple[tuple[int, ...], float] = ((), 0.0)
    for i, j in _list_pairs(sites.measured, _find_worst_sites(sites, everyone)):
        errors = sites.compute_errors(sites.fit_without(i, j))[[i, j]]
        if errors.min() < MAX_ERROR_SHARE:
            continue
        size = float(np.sqrt(np.mean(errors**2))) / sites.compute_expected_error(i, j)
        if size > found[1]:
            found = ((i, j), size)
    return found


Exchange = Callable[[Array, int, int], tuple[SiteResponse, SiteResponse]]


def approximate_response(response: SiteResponse, own: History, other: History) -> SiteResponse:
    """Approximate a site's response to another site's record.

    The curve is stretched in time, and by a power law in depth with the exponent of its own loading.

    Parameters
    ----------
    own, other : times (n,) s and depths (n,) mm of its record and of the other one.
    """
    (time, depth), (_, other_depth) = own, other
    deep = depth.max()
    rising = np.zeros(len(time), dtype=bool)
    for phase in find_phases(time, depth):
        if phase.kind == "load":
            rising |= (time >= phase.start_s) & (time <= phase.end_s)
    loading, force = depth[rising], response.force_N[rising]
    used = (loading > 0.3 * deep) & (force > 0)
    exponent = float(np.polyfit(np.log(loading[used]), np.log(force[used]), 1)[0]) if used.sum() > 2 else 1.0
    factor = (other_depth.max() / deep) ** np.clip(exponent, 0.5, 4.0)
    at = _match_times(own, other)
    columns = [np.interp(at, time, column) for column in response.jacobian.T]
    return SiteResponse(factor * np.interp(at, time, response.force_N), factor * np.stack(columns, axis=1))


def _match_times(own: History, other: History) -> Array:
    """Return the times (n,) at which a site's record has come as far as the other one at its times.

    That is as far in the same phase, or in the same share of the whole if their phases differ.
    """
    mine, theirs = find_phases(*own), find_phases(*other)
    if [phase.kind for phase in mine] == [phase.kind for phase in theirs]:
        return np.asarray(np.interp(other[0], boundaries(theirs), boundaries(mine)))
    return other[0] / other[0][-1] * own[0][-1]


def find_best_correction(
    simulate: Simulate,
    measured: Sequence[MeasuredCurve],
    start: Array,
    exchange: Exchange,
    exactly: Exchange | None = None,
) -> RecordCorrection | None:
    """Find the one change of names or of a unit that lowers the misfit of all sites most, if it is
    convincing.

    Parameters
    ----------
    exchange : takes parameters (p,) and two sites, and returns the response of each to the other's record, at
        the times of the record; it may be an approximation (``approximate_response``).
    exactly : the same by simulation, asked for the few exchanges that may matter, and then decisive; an
        exchange whose simulation fails is not considered.
    """
    fits = LeaveOutFits(simulate, measured, start)
    before = fits.compute_errors(fits.fit_without())
    if before.max() <= MAX_ERROR_SHARE / 2:
        return None  # nothing to explain
    worst = sorted(_find_worst_sites(fits, before))
    forces = [i for i in worst if measured[i].unit == "N"]
    units = [
        fit_with_conversion(simulate, measured, start, i, unit, before)
        for i in forces
        for unit in FORCE_UNITS
    ]
    pairs = _list_pairs(measured, worst)
    swaps = [fit_with_exchange(simulate, measured, start, pair, exchange, before) for pair in pairs]
    if exactly is not None:
        likely = sorted((s for s in swaps if s.gain > MIN_GAIN / 2), key=lambda s: -s.gain)[
            :_MAX_SIMULATED_EXCHANGES
        ]
        known = [_get_pair(s) for s in likely if all(r.completed for r in exactly(start, *_get_pair(s)))]
        swaps = [fit_with_exchange(simulate, measured, start, pair, exactly, before) for pair in known]
    convincing = [correction for correction in (*units, *swaps) if correction.is_convincing]
    return max(convincing, key=lambda correction: correction.gain, default=None)


def _count_sites(measured: Sequence[MeasuredCurve]) -> int:
    return len({one.site_name for one in measured})


def _list_pairs(measured: Sequence[MeasuredCurve], some: Sequence[int]) -> list[tuple[int, int]]:
    """List pairs of records that are of two sites and compare the same, force or depth."""
    pairs = [(i, j, measured[i], measured[j]) for i, j in combinations(sorted(some), 2)]
    return [(i, j) for i, j, one, two in pairs if one.site_name != two.site_name and one.unit == two.unit]


def _exchange_records(measured: Sequence[MeasuredCurve], i: int, j: int) -> list[MeasuredCurve]:
    """Return the records with two of them in each other's place."""
    found = list(measured)
    found[i] = replace(measured[j], site=measured[i].site_name)
    found[j] = replace(measured[i], site=measured[j].site_name)
    return found


def _get_pair(correction: RecordCorrection) -> tuple[int, int]:
    i, j = correction.sites
    return i, j


def _find_worst_sites(sites: LeaveOutFits, before: Array) -> list[int]:
    """Return the sites that are predicted worst, with or without themselves, at most eight."""
    alone = [sites.compute_errors(sites.fit_without(i))[i] for i in range(len(before))]
    return [int(i) for i in np.argsort(-np.maximum(before, alone))[:_MAX_WORST_SITES]]


@dataclass(frozen=True)
class OutlierReport:
    """The errors of all sites left out, with the records named as given, and the warnings."""

    left_out: tuple[LeaveOneOutError, ...]
    warnings: tuple[RecordWarning, ...]


def find_outliers(
    simulate: Simulate,
    measured: Sequence[MeasuredCurve],
    start: Array,
    exchange: Callable[[LogLinearModel], Exchange],
    exactly: Exchange | None = None,
    neutral: Array | None = None,
) -> OutlierReport:
    """Look for names exchanged, wrong units of force, and sites that do not fit, one after the other.

    A convincing correction becomes a warning, and is applied before the next one is looked for, so that the
    rest is judged by correct records. With fewer than four sites there is no warning.

    If the fit at ``start`` followed a wrong record, sites are off everywhere, because several materials end
    at bounds to fit that record. Then the sites are judged from ``neutral``, the answer with one material,
    which cannot follow a wrong record as far.

    Parameters
    ----------
    simulate : returns all sites; called at ``start``, and at ``neutral`` if that is needed.
    exchange : takes the expansion of all sites and returns the approximate exchange of two records.
    exactly : the same by simulation.
    """
    if _count_sites(measured) < MIN_SITES:
        return OutlierReport((), ())
    model = LogLinearModel(start, simulate(start))
    errors = leave_one_out(model, measured, start)
    if (
        neutral is not None
        and LeaveOutFits(model, measured, start).compute_errors(start).max() > MAX_ERROR_SHARE
    ):
        responses = simulate(neutral)
        if not check_responses(responses, measured, len(neutral)):
            model = LogLinearModel(neutral, responses)
    return OutlierReport(errors, _find_warnings(model, measured, exchange(model), exactly))


def _find_warnings(
    model: LogLinearModel, measured: Sequence[MeasuredCurve], exchange: Exchange, exactly: Exchange | None
) -> tuple[RecordWarning, ...]:
    start = model.parameters
    simulate: Simulate = model
    warnings, corrected = [], list(measured)
    for _ in range(_MAX_CORRECTIONS):
        correction = find_best_correction(simulate, corrected, start, exchange, exactly)
        if correction is None:
            break
        if correction.kind == "unit":
            i = correction.sites[0]
            factor = FORCE_UNITS[correction.cause]
            corrected[i] = replace(corrected[i], force_N=corrected[i].force_N / factor)
        else:
            i, j = correction.sites
            simulate = _simulate_exchanged(simulate, start, (i, j), exactly or exchange)
            corrected = _exchange_records(corrected, i, j)
        warnings.append(warn_of_correction(correction, [site.name for site in measured]))
    singles, misfitting = find_misfitting_sites(simulate, corrected, start)
    warnings += [
        warn_of_outlier(singles[i], measured[i].unit)
        for i in misfitting
        if not _is_named(warnings, measured[i].name)
    ]
    return tuple(warnings)


def _is_named(warnings: Sequence[RecordWarning], site: str) -> bool:
    return any(site in warning.sites for warning in warnings)


def _simulate_exchanged(
    simulate: Simulate, start: Array, pair: tuple[int, int], exchange: Exchange
) -> Simulate:
    """Return the simulation with two sites driven by each other's record."""
    i, j = pair
    moved = LogLinearModel(start, exchange(start, i, j))

    def respond(parameters: Array) -> list[SiteResponse]:
        responses = list(simulate(parameters))
        responses[i], responses[j] = moved(parameters)
        return responses

    return respond


def fit_with_conversion(
    simulate: Simulate, measured: Sequence[MeasuredCurve], start: Array, i: int, unit: str, before: Array
) -> RecordCorrection:
    """Fit all sites with the force of one converted; ``before`` are the errors without the conversion."""
    renamed = list(measured)
    renamed[i] = replace(measured[i], force_N=measured[i].force_N / FORCE_UNITS[unit])
    return _build_correction("unit", (i,), unit, before, LeaveOutFits(simulate, renamed, start))


def fit_with_exchange(
    simulate: Simulate,
    measured: Sequence[MeasuredCurve],
    start: Array,
    pair: tuple[int, int],
    exchange: Exchange,
    before: Array,
) -> RecordCorrection:
    """Fit all sites with the records of two exchanged; ``before`` are the errors without the exchange."""
    renamed = _exchange_records(measured, *pair)
    sites = LeaveOutFits(_simulate_exchanged(simulate, start, pair, exchange), renamed, start)
    return _build_correction("swap", pair, "swapped site names", before, sites)


def _build_correction(
    kind: Literal["swap", "unit"], which: tuple[int, ...], cause: str, before: Array, sites: LeaveOutFits
) -> RecordCorrection:
    after = sites.compute_errors(sites.fit_without())
    gain = float(np.sum(before**2) / max(np.sum(after**2), len(after) * (MIN_ERROR_SHARE / 2) ** 2))
    pairs = [(float(before[i]), float(after[i])) for i in which]
    return RecordCorrection(
        kind,
        which,
        cause,
        gain,
        tuple(b for b, _ in pairs),
        tuple(a for _, a in pairs),
        float(before.max()),
    )


def warn_of_outlier(error: LeaveOneOutError, unit: str = "N") -> RecordWarning:
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
        "error_before_percent": 100 * max(correction.errors_before),
        "error_after_percent": 100 * max(correction.errors_after),
    }
    done = "their records exchanged" if correction.kind == "swap" else "its force converted"
    what = (
        f"with {done}, the squared misfit of all sites falls {correction.gain:.1f} times and the error here "
        f"from {numbers['error_before_percent']:.0f} to {numbers['error_after_percent']:.0f} % of the peak"
    )
    remedies = {
        "swap": "exchange the traces of the two sites, or their names",
        "unit": "convert the force to N",
    }
    return RecordWarning(sites, correction.kind, what, numbers, correction.cause, remedies[correction.kind])


def guess_force_unit(ratio: float) -> str:
    """Return the unit of force that a ratio of measured to predicted force comes near, or an empty text."""
    if ratio <= 0:
        return ""
    name = min(FORCE_UNITS, key=lambda unit: abs(np.log(ratio / FORCE_UNITS[unit])))
    distance = abs(np.log(ratio / FORCE_UNITS[name]))
    return name if distance < min(_UNIT_TOLERANCE * abs(np.log(FORCE_UNITS[name])), 0.5) else ""
