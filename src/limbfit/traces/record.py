"""Records: the type, and the checks that every record passes."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import median_filter

from ..errors import TraceError
from .numerics import Array, average_in_bins, estimate_noise_level

COLUMNS = ("time_s", "displacement_mm", "force_N")
MIN_SAMPLES = 20
MAX_SAMPLES = 20_000_000
SPEED_RANGE = (0.05, 50.0)
TRAVEL_RANGE = (0.2, 60.0)
PEAK_RANGE = (0.05, 200.0)
_MAX_BINS = 200  # of samples whose mean force is looked at
_START_SAMPLES, _REST_SHARE = 5, 0.02  # samples at the least that tell the force at the start; of the travel
_PRESSED_SHARE = 0.5  # of the rise of force: the indenter is in the limb


@dataclass(frozen=True)
class Trace:
    """One record: ``time_s``, ``displacement_mm``, ``force_N``, each (n,); ``notes``: how it was read."""

    time_s: Array
    displacement_mm: Array
    force_N: Array
    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class TraceWarning:
    """Something to know about a record: its kind, what, its likely cause, the remedy, and the numbers.

    ``adds_sd_mm`` among the numbers is the standard deviation of the touch-down that it alone makes.
    """

    kind: str
    what: str
    cause: str
    remedy: str
    evidence: Mapping[str, float]


def check_finite(values: Array, name: str, remedy: str | None = None) -> None:
    """Raise `TraceError` at the first of the values (n,) of a column that is not finite."""
    bad = np.flatnonzero(~np.isfinite(values))
    if bad.size:
        what = f"{values[bad[0]]} in sample {bad[0] + 1}"
        raise TraceError(what, place=name, remedy=remedy)


def check_trace(trace: Trace, *, columns: tuple[str, str, str] = COLUMNS) -> None:
    """Refuse a record that cannot be an indentation in s, mm and N.

    Raises
    ------
    TraceError
        Too short, not finite, time going back, never in contact, or units that cannot be right: travel
        outside 0.2-60 mm, speed outside 0.05-50 mm/s, peak force outside 0.05-200 N.
    """
    series = (trace.time_s, trace.displacement_mm, trace.force_N)
    for values, name in zip(series, columns, strict=True):
        if values.shape != trace.time_s.shape or values.ndim != 1:
            raise TraceError(f"{values.size} values for {trace.time_s.size} times", place=name)
        check_finite(values, name)
    if len(trace.time_s) < MIN_SAMPLES:
        what = f"only {len(trace.time_s)} samples"
        raise TraceError(what, remedy=f"a record needs at least {MIN_SAMPLES}")
    steps = np.diff(trace.time_s)
    back = np.flatnonzero(steps < 0)
    if back.size:
        what = f"time goes back at sample {back[0] + 2}"
        raise TraceError(what, place=columns[0], remedy="remove or sort the samples")
    if (times := int((steps > 0).sum()) + 1) < MIN_SAMPLES:
        what = f"only {times} different times for {len(trace.time_s)} samples"
        raise TraceError(what, place=columns[0], remedy="export times with more digits")
    _check_contact(trace, columns)
    _check_units(trace, columns)


def measure_start_force(trace: Trace) -> float:
    """Measure the force before the indenter moves, N: a sensor may have an offset."""
    travel = np.abs(trace.displacement_mm - np.median(trace.displacement_mm[:_START_SAMPLES]))
    moving = np.flatnonzero(travel > _REST_SHARE * travel.max())  # before a fast ramp there are few samples
    at_rest = max(int(moving[0]) if moving.size else 0, _START_SAMPLES)
    return float(np.median(trace.force_N[:at_rest]))


def _check_contact(trace: Trace, columns: tuple[str, str, str]) -> None:
    noise = estimate_noise_level(trace.force_N)
    _, force, _ = average_in_bins(trace.time_s, trace.force_N, _MAX_BINS)
    start = measure_start_force(trace)
    rise, fall = float(force.max()) - start, start - float(force.min())
    if rise <= 5 * noise and fall > 5 * noise and fall > 2 * rise:
        remedy = "pushing must be positive: change the sign"
        raise TraceError("the force falls when the indenter pushes", place=columns[2], remedy=remedy)
    if rise <= 5 * noise:
        what = f"no contact: the force rises by {rise:.3g} against a noise of {noise:.3g}"
        raise TraceError(what, place=columns[2], remedy="check the sensor, or leave the site out")


def _check_units(trace: Trace, columns: tuple[str, str, str]) -> None:
    # Single samples that stick out are replaced later, and say nothing of units.
    u, force = (median_filter(one, 5, mode="mirror") for one in (trace.displacement_mm, trace.force_N))
    start = float(np.median(u[:_START_SAMPLES]))
    force = force - measure_start_force(trace)
    pressed = float(np.median(u[force >= _PRESSED_SHARE * force.max()]))
    if pressed < start - _REST_SHARE * float(np.ptp(u)):
        remedy = "displacement into the limb must be positive: change the sign"
        raise TraceError("the displacement falls", place=columns[1], remedy=remedy)
    _check_range(
        float(u.max()) - start, TRAVEL_RANGE, "travel", "mm", {1e3: "metres", 1e-3: "micrometres"}, columns[1]
    )
    speed = _compute_typical_speed(trace.time_s, u)
    guesses = {1e3: "milliseconds", 1e6: "microseconds", 1 / 60: "minutes"}
    _check_range(speed, SPEED_RANGE, "speed", "mm/s", guesses, columns[0])
    peak = float(force.max())
    guesses = {1e3: "kilonewtons", 1e-3: "millinewtons", 9.81e-3: "grams"}
    _check_range(peak, PEAK_RANGE, "peak force", "N", guesses, columns[2])


def _compute_typical_speed(time: Array, u: Array) -> float:
    """Speed on the way in between 20 and 80 % of the travel, mm/s, from displacements (n,) mm."""
    low, high = np.median(u[:5]), u.max()
    top = int(np.argmax(u >= low + 0.8 * (high - low)))
    below = np.flatnonzero(u[: top + 1] <= low + 0.2 * (high - low))
    if not len(below):
        what = f"the displacement starts at {u[0]:.3g} mm and falls to {low:.3g} mm at once"
        raise TraceError(what, remedy="cut off the samples before the indenter moves in")
    return float((u[top] - u[below[-1]]) / (time[top] - time[below[-1]]))


def _check_range(
    value: float,
    limits: tuple[float, float],
    quantity: str,
    unit: str,
    guesses: dict[float, str],
    column: str,
) -> None:
    low, high = limits
    if low <= value <= high:
        return
    likely = [name for factor, name in guesses.items() if low <= value * factor <= high]
    remedy = f"it looks like {likely[0]}: convert it" if likely else "check the units"
    what = f"a {quantity} of {value:.3g} {unit} is not plausible ({low:g} to {high:g})"
    raise TraceError(what, place=column, remedy=remedy)
