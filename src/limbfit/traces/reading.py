"""Records from files: columns by name, in s, mm and N.

A unit is converted where the file states it, beside a name in brackets or in a row under the names; a unit
that is not known is refused.
"""

import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import TraceError, add_location
from .formats import TIME, ColumnTable, Row, is_number, read_table
from .numerics import Array
from .record import COLUMNS, Trace, check_trace

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


def read_trace(path: str | Path, columns: tuple[str, str, str] = COLUMNS) -> Trace:
    """Read and check a record; its ``notes`` say what was done to read it.

    Parameters
    ----------
    path : a text table (comma, semicolon or tab; UTF-8 or UTF-16), ``.lvm``, ``.tdms``, ``.xlsx`` or ``.mat``
        (version 5).
    columns : the names of time (s), displacement (mm) and force (N) in it.

    Raises
    ------
    TraceError
        With the file, the row or column, and the remedy.
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

    Parameters
    ----------
    columns : the name of each column that must be there, by its key; a key ends in its unit, as ``time_s``.
    select : True for the names of others that are read; these are their own keys.
    gaps : an empty cell of a table is nan.

    Raises
    ------
    TraceError
        With the file, the row or column, and the remedy.
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
        raise TraceError(
            f"{len(places)} columns are named {name!r}",
            place="header",
            remedy=f'rename the one that is meant, and name it in the study: [traces] {key} = "..."',
        )
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
        raise TraceError(
            f"the unit {' and '.join(units)!r} of column {name!r} is none of {', '.join(known)}",
            place="units",
            remedy=f'convert the column, or name another in the study: [traces] {key} = "..."',
        )
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
