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
from typing import Literal

import numpy as np

from ...arrays import Array
from ...phases import find_boundaries, find_phases
from ..fit.objective import MeasuredCurve, Simulate, SiteResponse, check_responses
from .leave_one_out import (
    MAX_ERROR_SHARE,
    MIN_ERROR_SHARE,
    MIN_GAIN,
    MIN_SITES,
    LeaveOneOutError,
    LeaveOutFits,
    LogLinearModel,
    RecordCorrection,
    count_sites,
    find_misfitting_sites,
    find_worst_sites,
    list_pairs,
)
from .plausibility import UNITS, RecordWarning

History = tuple[Array, Array]

_UNIT_TOLERANCE = 0.25  # of the logarithm of a unit's factor: how near the force ratio must come
_MAX_CORRECTIONS = 3  # corrections that are looked for
_MAX_SIMULATED_EXCHANGES = 3  # exchanges that are simulated
FORCE_UNITS = {name: force for name, (force, travel, time) in UNITS.items() if travel == time == 1.0}


Exchange = Callable[[Array, int, int], tuple[SiteResponse, SiteResponse]]


def approximate_response(response: SiteResponse, history: History, other_history: History) -> SiteResponse:
    """Approximate a site's response to another site's record.

    The curve is stretched in time, and by a power law in depth with the exponent of its own loading.

    Parameters
    ----------
    history, other_history : times (n,) s and depths (n,) mm of its record and of the other one.
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
    worst = sorted(find_worst_sites(fits, before))
    forces = [i for i in worst if measured[i].unit == "N"]
    units = [
        fit_with_conversion(simulate, measured, start, i, unit, before)
        for i in forces
        for unit in FORCE_UNITS
    ]
    pairs = list_pairs(measured, worst)
    swaps = [fit_with_exchange(simulate, measured, start, pair, exchange, before) for pair in pairs]
    if exactly is not None:
        likely = sorted((s for s in swaps if s.gain > MIN_GAIN / 2), key=lambda s: -s.gain)
        pairs = [(s.sites[0], s.sites[1]) for s in likely[:_MAX_SIMULATED_EXCHANGES]]
        pairs = [pair for pair in pairs if all(r.completed for r in exactly(start, *pair))]
        swaps = [fit_with_exchange(simulate, measured, start, pair, exactly, before) for pair in pairs]
    convincing = [correction for correction in (*units, *swaps) if correction.is_convincing]
    return max(convincing, key=lambda correction: correction.gain, default=None)


def _exchange_records(measured: Sequence[MeasuredCurve], i: int, j: int) -> list[MeasuredCurve]:
    """Return the records with two of them in each other's place."""
    found = list(measured)
    found[i] = replace(measured[j], site=measured[i].site_name)
    found[j] = replace(measured[i], site=measured[j].site_name)
    return found


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
    if count_sites(measured) < MIN_SITES:
        return OutlierReport((), ())
    model = LogLinearModel(start, simulate(start))
    fits = LeaveOutFits(model, measured, start)
    errors = fits.leave_one_out()
    if neutral is not None and fits.compute_errors(start).max() > MAX_ERROR_SHARE:
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
    corrected_sites = {site for warning in warnings for site in warning.sites}
    others = (i for i in misfitting if measured[i].name not in corrected_sites)
    return (*warnings, *(warn_of_outlier(singles[i], measured[i].unit) for i in others))


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
    kind: Literal["swap", "unit"], indices: tuple[int, ...], cause: str, before: Array, sites: LeaveOutFits
) -> RecordCorrection:
    after = sites.compute_errors(sites.fit_without())
    gain = float(np.sum(before**2) / max(np.sum(after**2), len(after) * (MIN_ERROR_SHARE / 2) ** 2))
    pairs = [(float(before[i]), float(after[i])) for i in indices]
    return RecordCorrection(
        kind,
        indices,
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
