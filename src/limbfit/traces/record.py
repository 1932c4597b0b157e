"""Records: the type, how it is read from files in s, mm and N, and the checks that every record passes.

A unit is converted where the file states it, beside a name in brackets or in a row under the names; a unit
that is not known is refused.
"""

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Self

import numpy as np
from scipy.ndimage import median_filter

from ..arrays import Array, Indices, Mask
from ..errors import TraceError, add_location
from .formats import TIME, ColumnTable, Row, is_number, read_table
from .numerics import average_in_bins, estimate_noise_level

COLUMNS = ("time_s", "displacement_mm", "force_N")
MIN_SAMPLES = 20
# What is plausible: unit, least and most, and what a value looks like that is so only times a factor.
_PLAUSIBLE: Mapping[str, tuple[str, float, float, Mapping[float, str]]] = {
    "travel": ("mm", 0.2, 60.0, {1e3: "metres", 1e-3: "micrometres"}),
    "speed": ("mm/s", 0.05, 50.0, {1e3: "milliseconds", 1e6: "microseconds", 1 / 60: "minutes"}),
    "peak force": ("N", 0.05, 200.0, {1e3: "kilonewtons", 1e-3: "millinewtons", 9.81e-3: "grams"}),
}
_MAX_BINS = 200  # of samples whose mean force is looked at
_START_SAMPLES, _REST_SHARE = 5, 0.02  # samples at the least that tell the force at the start; of the travel
_PRESSED_SHARE = 0.5  # of the rise of force: the indenter is in the limb
_UNITS: Mapping[str, Mapping[str, float]] = {  # by the end of a column's key; "m_s" before "s"
    "m_s": {"m/s": 1.0, "cm/s": 1e-2, "mm/s": 1e-3},
    "s": {"s": 1.0, "sec": 1.0, "seconds": 1.0, "ms": 1e-3, "us": 1e-6, "µs": 1e-6, "min": 60.0, "h": 3600.0},
    "mm": {"mm": 1.0, "cm": 10.0, "m": 1e3, "um": 1e-3, "µm": 1e-3, "in": 25.4, "inch": 25.4},
    "N": {
        "N": 1.0,
        "newton": 1.0,
        "newtons": 1.0,
        "kN": 1e3,
        "cN": 1e-2,
        "mN": 1e-3,
        "kgf": 9.80665,
        "lbf": 4.4482216152605,
    },
}
# Of a load cell that shows a mass or a pressure, or is not calibrated: in brackets these are units too.
_OTHER_UNITS = ("kg", "g", "t", "lb", "lbs", "oz", "gf", "kp", "V", "mV", "%", "Pa", "kPa", "MPa", "psi")
_ALL_UNITS = {unit.casefold() for units in (*_UNITS.values(), _OTHER_UNITS) for unit in units}
_BRACKETED = re.compile(r".*[\[(]\s*(?P<unit>[^\[\]()]+?)\s*[\])]")
_DAY_S = 86400.0
_CLOCK = re.compile(
    r"(?:\d{1,4}[-./]\d{1,2}[-./]\d{1,4}[T ]\s*)?"  # a date: a record is shorter than a day
    r"(?P<h>\d{1,2}):(?P<m>\d{2}):(?P<s>\d{2}(?:[.,]\d+)?)"
    r"\s*(?P<half>[AaPp][Mm])?(?:Z|[+-]\d{2}:?\d{2})?"
)


@dataclass(frozen=True)
class Trace:
    """One record: ``time_s``, ``displacement_mm``, ``force_N``, each (n,); ``notes``: how it was read."""

    time_s: Array
    displacement_mm: Array
    force_N: Array
    notes: tuple[str, ...] = ()

    def select(self, rows: Mask | Indices | slice) -> Self:
        """The samples of some rows alone."""
        values = {name: getattr(self, name)[rows] for name in COLUMNS}
        return replace(self, **values)


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
    """Refuse a record that cannot be an indentation in s, mm and N. Raises `TraceError` for one that
    is too short, not finite, whose time goes back, never in contact, or of units that cannot be right: travel
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
    _check_plausible(float(u.max()) - start, "travel", columns[1])
    _check_plausible(_compute_typical_speed(trace.time_s, u), "speed", columns[0])
    _check_plausible(float(force.max()), "peak force", columns[2])


def _compute_typical_speed(time: Array, u: Array) -> float:
    """Speed on the way in between 20 and 80 % of the travel, mm/s, from displacements (n,) mm."""
    low, high = np.median(u[:5]), u.max()
    top = int(np.argmax(u >= low + 0.8 * (high - low)))
    below = np.flatnonzero(u[: top + 1] <= low + 0.2 * (high - low))
    if not len(below):
        what = f"the displacement starts at {u[0]:.3g} mm and falls to {low:.3g} mm at once"
        raise TraceError(what, remedy="cut off the samples before the indenter moves in")
    if not (duration := time[top] - time[below[-1]]):
        what = f"the indenter moves in by {u[top] - u[below[-1]]:.3g} mm within one time, {time[top]:g} s"
        raise TraceError(what, place=COLUMNS[0], remedy="export times with more digits")
    return float((u[top] - u[below[-1]]) / duration)


def _check_plausible(value: float, quantity: str, column: str) -> None:
    unit, low, high, guesses = _PLAUSIBLE[quantity]
    if low <= value <= high:
        return
    likely = [name for factor, name in guesses.items() if low <= value * factor <= high]
    remedy = f"it looks like {likely[0]}: convert it" if likely else "check the units"
    what = f"a {quantity} of {value:.3g} {unit} is not plausible ({low:g} to {high:g})"
    raise TraceError(what, place=column, remedy=remedy)


def read_trace(path: str | Path, columns: tuple[str, str, str] = COLUMNS) -> Trace:
    """Read and check a record; its ``notes`` say what was done to read it.

    The file is a text table (comma, semicolon or tab; UTF-8 or UTF-16), ``.lvm``, ``.tdms``, ``.xlsx`` or
    ``.mat`` (version 5); ``columns`` are the names of time (s), displacement (mm) and force (N) in it. Raises
    `TraceError` with the file, the row or column, and the remedy.
    """
    with add_location(file=path):
        table = read_table(Path(path), dict(zip(COLUMNS, columns)))
        notes = list(table.notes)
        time = _read_clock(table, columns[0], notes)
        if time is None:
            time = _read_column(table, TIME, columns[0], "", notes)
        displacement, force = (
            _read_column(table, key, name, "", notes) for key, name in zip(COLUMNS[1:], columns[1:])
        )
        trace = Trace(time, displacement, force, tuple(notes))
        check_trace(trace, columns=columns)
    return trace


def read_columns(
    file: Path,
    columns: Mapping[str, str],
    select: Callable[[str], bool] = lambda name: False,
    gaps: bool = False,
) -> dict[str, Array]:
    """Columns of a file that `read_trace` could read, by their keys, and all others that are ``select``.

    Raises `TraceError` with the file, the row or column, and the remedy.

    ``columns``: the name of each column that must be there, by its key; a key ends in its unit, as
    ``time_s``. ``select``: True for the names of others that are read; these are their own keys. ``gaps``: an
    empty cell of a table is nan.
    """
    table = read_table(file, columns)
    named = {name: key for key, name in columns.items()}
    named |= {name: name for name in table.names if select(name) and name not in named}
    empty = "nan" if gaps else ""
    return {name: _read_column(table, key, name, empty, []) for name, key in named.items()}


def _read_column(table: ColumnTable, key: str, name: str, empty: str, notes: list[str]) -> Array:
    """The values of a column in the unit of its key.

    Raises `TraceError` for a cell that is no number, or a name that several columns have, which differ.
    """
    places = [i for i, known in enumerate(table.names) if known == name]
    if table.vectors:
        found = [_to_vector(table.vectors[i], name) for i in places]
    else:
        found = [_read_numbers(table.rows, i, name, empty) for i in places]
    found = [values * find_factor(key, name, table.units[i], notes) for i, values in zip(places, found)]
    if any(not np.array_equal(values, found[0], equal_nan=True) for values in found):
        remedy = f'rename the one that is meant, and name it in the study: [traces] {key} = "..."'
        raise TraceError(f"{len(places)} columns are named {name!r}", place="header", remedy=remedy)
    return found[0]


def find_factor(key: str, name: str, unit: str, notes: list[str]) -> float:
    """Find the factor that converts the values of a column to the unit of its key; 1 if none is stated.

    Raises `TraceError` for a unit that is not one of the key's quantity, or not that in the column's
    name.
    """
    known = next(units for end, units in _UNITS.items() if key.endswith(f"_{end}"))
    beside = _BRACKETED.fullmatch(name)
    below = _BRACKETED.fullmatch(unit)
    units = [below["unit"] if below else unit] if unit else []
    # Other brackets hold other things than units.
    if beside and beside["unit"].casefold() in _ALL_UNITS:
        units.append(beside["unit"])
    folded = {one.casefold(): factor for one, factor in known.items()}  # rigs write KN, Sec and MM, too
    factors = {folded.get(one.casefold(), 0.0) * (one != "MN") for one in units} or {1.0}
    factor = factors.pop()
    if not factor or factors:
        what = f"the unit {' and '.join(units)!r} of column {name!r} is none of {', '.join(known)}"
        remedy = f'convert the column, or name another in the study: [traces] {key} = "..."'
        raise TraceError(what, place="units", remedy=remedy)
    if factor != 1.0:
        notes.append(f"column {name!r} is converted from {units[0]} to {next(iter(known))}")
    return factor


def _get_cell(row: Row, place: int, name: str) -> str:
    line, cells = row
    if place >= len(cells):
        raise TraceError("the row is too short", place=f"line {line}, column {name}")
    return cells[place]


def _read_numbers(rows: Sequence[Row], place: int, name: str, empty: str) -> Array:
    try:
        return np.array([float(cells[place] or empty) for _, cells in rows])
    except (ValueError, IndexError):
        for row in rows:
            cell = _get_cell(row, place, name) or empty
            if not is_number(cell) or "," in cell:
                where = f"line {row[0]}, column {name}"
                raise TraceError(f"{cell[:40]!r} is not a number", place=where) from None
        raise


def _read_clock(table: ColumnTable, name: str, notes: list[str]) -> Array | None:
    """Seconds from the first of times of day (midnight may pass) or time stamps; None for numbers.

    Only of a record: files that go with it share its zero, which they would not know.
    """
    place = table.names.index(name)
    if table.vectors:
        stamps = np.asarray(table.vectors[place])
        if stamps.dtype.kind != "M" or not stamps.size:
            return None
        notes.append(f"the time stamps in column {name!r} are counted from the first")
        return np.asarray((stamps - stamps[0]) / np.timedelta64(1, "s"))
    if not table.rows or not _CLOCK.fullmatch(_get_cell(table.rows[0], place, name)):
        return None
    notes.append(f"the times of day in column {name!r} are counted from the first")
    times = np.array([_parse_time_of_day(_get_cell(row, place, name), row[0], name) for row in table.rows])
    midnights = np.cumsum(np.diff(times, prepend=times[0]) < -_DAY_S / 2)
    return np.asarray(times - times[0] + _DAY_S * midnights)


def _parse_time_of_day(cell: str, line: int, name: str) -> float:
    """Return the seconds from midnight to a time of day."""
    clock = _CLOCK.fullmatch(cell)
    if clock is None:
        where = f"line {line}, column {name}"
        raise TraceError(f"{cell[:40]!r} is not a time of day", place=where)
    hours = int(clock["h"])
    if clock["half"]:
        hours = hours % 12 + 12 * (clock["half"].lower() == "pm")
    return 3600 * hours + 60 * int(clock["m"]) + float(clock["s"].replace(",", "."))


def _to_vector(value: Any, name: str) -> Array:
    array = np.asarray(value).squeeze()
    if array.dtype.kind not in "fiu" or array.ndim != 1:
        raise TraceError("not a vector of real numbers", place=name)
    return np.asarray(array, dtype=np.float64)
