"""What sensors in a socket recorded: their files, and cells that cannot be compared.

``cells`` is a CSV with a row for each cell. ``tekscan`` is the ASCII export of F-Socket, F-Scan and I-Scan:
lines of a name and a value until ``ASCII_DATA``, then frames of rows with commas, ``B`` where the sheet has
no cell. ``pliance`` is that of Novel: lines of text, then ``time[secs]`` with the numbers of the cells, and a
line for each frame. Both are read as the example files of the R package pressuRe have them (Telfer and Li).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import takewhile
from pathlib import Path
from typing import Any, NamedTuple
from warnings import catch_warnings

import numpy as np
from scipy.ndimage import convolve

from ..arrays import Array, Indices
from ..errors import InputError, add_location

COLUMNS = ("x_mm", "y_mm", "z_mm", "area_mm2", "pressure_kPa")
PRESSURE_KPA = {"kpa": 1.0, "pa": 1e-3, "mpa": 1e3, "psi": 6.894757, "mmhg": 0.1333224, "n/cm2": 10.0}
LENGTH_MM = {"mm": 1.0, "millimeters": 1.0, "cm": 10.0, "centimeters": 10.0, "in": 25.4, "inches": 25.4}
AREA_MM2 = {f"{name}2": factor**2 for name, factor in LENGTH_MM.items()}
FULL_SCALE = 255.0  # counts of Tekscan's converter, in which the header states its noise threshold
DEAD_SHARE = 0.7  # of its neighbours, three or more, read something while a dead cell never does
BELOW_SHARE = 0.95  # of the noise threshold, which exports round
COMPARED, BELOW, SATURATED, DEAD = "compared", "below noise", "saturated", "dead"
_AGAIN = "export the file again, as ASCII with its whole header"


class SheetLayout(NamedTuple):
    """Rows and columns of a sheet, and the distances from one to the next, mm."""

    shape: tuple[int, int]
    spacing_mm: tuple[float, float]


@dataclass(frozen=True, eq=False)
class SensorFrames:
    """Pressure (f, n) kPa of n cells at ``time_s`` (f,), nan where there is no reading.

    Cells have a ``position`` (n, 3) mm, or a ``place`` (n, 2): row and column on the sheet of a ``layout``,
    from 0. Frames from start to end count, and nothing is recorded below noise.
    """

    time_s: Array
    pressure_kPa: Array
    area_mm2: Array
    position: Array | None = None
    place: Indices | None = None
    layout: SheetLayout | None = None
    noise_kPa: float = 0.0
    saturation_kPa: float = np.inf
    start_s: float = -np.inf
    end_s: float = np.inf

    @property
    def names(self) -> list[str]:
        """Of each cell row and column on its sheet, or its number, from 1."""
        cells = np.arange(len(self.area_mm2))[:, None] if self.place is None else self.place
        return ["-".join(map(str, cell)) for cell in (cells + 1).tolist()]

    @property
    def frames(self) -> Array:
        """Pressure (k, n) kPa of the frames that count."""
        return self.pressure_kPa[(self.time_s >= self.start_s) & (self.time_s <= self.end_s)]

    @property
    def states(self) -> list[str]:
        """What each cell is: `COMPARED`, or why it cannot be compared."""
        mean = self.frames.mean(axis=0)
        states = np.where(mean < BELOW_SHARE * self.noise_kPa, BELOW, COMPARED).astype(object)
        states[(self.frames >= self.saturation_kPa).any(axis=0)] = SATURATED
        if self.place is not None and self.layout is not None:
            at, maps = tuple(self.place.T), np.zeros((2, *self.layout.shape))
            maps[0][at], maps[1][at] = 1.0, mean > self.noise_kPa
            ring = np.where(np.arange(9).reshape(3, 3) == 4, 0.0, 1.0)
            neighbours, pressed = (convolve(one, ring, mode="constant")[at] for one in maps)
            is_alone = (neighbours > 2.0) & (pressed >= DEAD_SHARE * neighbours)
            states[is_alone & ~(self.pressure_kPa > 0.0).any(axis=0)] = DEAD
        states[np.isnan(mean)] = DEAD
        return [str(state) for state in states]


def read_recording(file: Path, layout: SheetLayout | None, kind: str, **stated: Any) -> SensorFrames:
    """Read a file of a kind: ``cells``, ``tekscan``, or ``pliance``, which does not state its layout.

    Raises `InputError` with the file, the place in it and the remedy. ``stated``: fields in place of its own.
    """
    with add_location(file=file), catch_warnings(action="ignore"):  # NumPy's, of what is empty
        try:
            lines = file.read_text(encoding="utf-8-sig", errors="replace").splitlines()
            if layout is not None:
                found = _read_pliance(lines, layout)
            else:
                found = _read_cells(lines) if kind == "cells" else _read_tekscan(lines)
        except (OSError, ValueError, IndexError) as error:
            raise InputError(f"not readable: {error}", place="numbers", remedy=_AGAIN) from None
        found = replace(found, **stated)
        if not len(found.frames):
            what = f"no frame from {found.start_s:g} to {found.end_s:g} s"
            raise InputError(what, place="frames", remedy="correct from_s and to_s of the study")
    return found


def _parse_quantity(text: str, units: Mapping[str, float], place: str) -> float:
    """A number with its unit, such as ``5.08 mm``, or the factor of a unit alone."""
    number, _, unit = text.strip().rpartition(" ")
    if unit.lower() not in units:
        raise InputError(f"unknown unit {unit!r}", place=place, remedy=f"export it in {', '.join(units)}")
    return float(number or 1.0) * units[unit.lower()]


def _read_cells(lines: Sequence[str]) -> SensorFrames:
    table = np.genfromtxt(lines, delimiter=",", names=True, deletechars="", autostrip=True, ndmin=1)
    for name in COLUMNS:
        if name not in (table.dtype.names or ()):
            remedy = f"name the columns {', '.join(COLUMNS)}"
            raise InputError(f"no column {name}", place="header", remedy=remedy)
    *position, area, pressure = (np.asarray(table[name], dtype=np.float64) for name in COLUMNS)
    if not len(area) or not np.isfinite(position).all() or not (area > 0.0).all():
        raise InputError("cells without position or area", remedy="only pressure_kPa may be empty")
    return SensorFrames(np.zeros(1), pressure[None], area, np.column_stack(position))


def _read_tekscan(lines: Sequence[str]) -> SensorFrames:
    head = list(takewhile(lambda line: not line.startswith("ASCII_DATA"), lines))
    stated = dict(line.split(maxsplit=1) for line in head if len(line.split()) > 1)
    for name in ("ROWS", "COLS", "ROW_SPACING", "COL_SPACING", "SENSEL_AREA", "SECONDS_PER_FRAME", "UNITS"):
        if name not in stated:
            raise InputError(f"no line {name}", place="header", remedy=_AGAIN)
    kPa = _parse_quantity(stated["UNITS"], PRESSURE_KPA, "UNITS")
    full = _parse_quantity(stated.get("SATURATION_PRESSURE", "inf kPa"), PRESSURE_KPA, "SATURATION_PRESSURE")
    rows, columns, counts = (int(stated.get(name, 0)) for name in ("ROWS", "COLS", "NOISE_THRESHOLD"))
    data = [line.rstrip(",") for line in lines[len(head) + 1 :] if line[:1].isdigit() or line[:1] == "B"]
    table = np.genfromtxt(data, delimiter=",", ndmin=2)  # B is nan
    if not table.size or rows < 1 or table.shape[1] != columns or len(table) % rows:
        what = f"frames that are not of {rows} rows of {columns} cells"
        raise InputError(what, place="Frame", remedy=_AGAIN)
    frames = table.reshape(-1, rows, columns)
    place = np.argwhere(np.isfinite(frames).all(axis=0))
    down, across = (_parse_quantity(stated[name], LENGTH_MM, name) for name in ("ROW_SPACING", "COL_SPACING"))
    return SensorFrames(
        float(stated["SECONDS_PER_FRAME"]) * np.arange(len(frames), dtype=np.float64),
        kPa * frames[:, place[:, 0], place[:, 1]],
        np.full(len(place), _parse_quantity(stated["SENSEL_AREA"], AREA_MM2, "SENSEL_AREA")),
        place=place,
        layout=SheetLayout((rows, columns), (down, across)),
        noise_kPa=counts * full / FULL_SCALE if np.isfinite(full) else 0.0,
        saturation_kPa=full,
    )


def _read_pliance(lines: Sequence[str], layout: SheetLayout) -> SensorFrames:
    start = next((i for i, line in enumerate(lines) if line.startswith("time[secs]")), None)
    unit = next((line.rpartition(" in ")[2] for line in lines if line.startswith("pressure values in")), None)
    if start is None or unit is None:
        what = f"no line {'time[secs]' if start is None else 'pressure values in'}"
        raise InputError(what, place="header", remedy=_AGAIN)
    kPa = _parse_quantity(unit, PRESSURE_KPA, "pressure values in")
    cells = np.array(lines[start].split()[1:], dtype=np.int64) - 1
    table = np.loadtxt(takewhile(lambda line: line.strip()[:1].isdigit(), lines[start + 1 :]), ndmin=2)
    rows, columns = layout.shape
    if len(set(cells.tolist())) < len(cells) or cells.max() >= rows * columns:
        what = f"cells up to number {cells.max() + 1} on a sheet of {rows} rows of {columns}"
        remedy = "correct rows and columns, or export one sheet alone"
        raise InputError(what, place="time[secs]", remedy=remedy)
    place, area = np.column_stack(np.divmod(cells, columns)), np.full(len(cells), np.prod(layout.spacing_mm))
    return SensorFrames(table[:, 0], kPa * table[:, 1:], area, place=place, layout=layout)
