"""What is measured of an indentation beside its force.

Ultrasound through the indenter sees tissues that become thinner from touch-down on, elastography reads the
speeds of shear waves in them, and cameras or scans see points of the skin around the indenter move.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..arrays import Array, Indices
from ..errors import TraceError, add_location
from .formats import TIME
from .record import check_finite, read_columns

_LAYER_SUFFIX = "_mm"
MIN_LAYER_READINGS = 5
MAX_LAYER_POINTS = 81  # of comparison; more samples are averaged
THICKNESS_MM = (0.2, 200.0)
MAX_WAVE_POINTS = 20  # of comparison at a place; more readings are averaged
WAVE_SPEED_M_S = (0.2, 30.0)
_WAVE_COLUMN = re.compile(r"(?P<tissue>.+?)(?:_(?P<depth>\d+(?:\.\d+)?)mm)?_m_s")
_POSITION_COLUMNS = ("x_mm", "y_mm", "z_mm")
_MOTION_COLUMNS = ("ux_mm", "uy_mm", "uz_mm")
MAX_SURFACE_TIMES = 8  # of comparison; more frames are averaged
MIN_EXTENT_MM, MIN_MOTION_MM, MAX_MOTION_MM = 1.0, 0.01, 100.0
_POSITION_TOLERANCE_MM = 1e-3


@dataclass(frozen=True)
class Layers:
    """Thickness (n,) mm of tissues under the indenter, by name, at times (n,) s of the record."""

    time_s: Array
    thickness_mm: Mapping[str, Array]


@dataclass(frozen=True)
class LayerThinning:
    """How much thinner a tissue is than at rest, from touch-down on.

    ``time_s``, ``compression_mm`` (n,) are means of ``samples`` (n,) readings each, whose standard deviation
    is ``sd_mm``; the thickness at rest is the mean of ``before`` readings, an error that all share.
    """

    tissue: str
    thickness_mm: float
    time_s: Array
    compression_mm: Array
    samples: Array
    before: int
    sd_mm: float

    @property
    def covariance(self) -> Array:
        """Covariance of the compressions (n, n) by the readings' noise, mm^2."""
        variance = self.sd_mm**2
        return np.diag(variance / self.samples) + variance / self.before

    @property
    def is_detectable(self) -> bool:
        """True if the tissue gives way by more than three deviations of what is compared."""
        return bool(self.compression_mm.max() > 3.0 * np.sqrt(np.diag(self.covariance).mean()))


def read_layers(path: str | Path, time_name: str) -> Layers:
    """Read a table with a column of times and, for each tissue, a column such as ``muscle_mm``. Raises
    `TraceError` with the file, the column and the remedy.
    """
    with add_location(file=path):
        time, columns = _read_timed_columns(path, time_name, _LAYER_SUFFIX, "thickness of a tissue")
        for name, values in columns.items():
            check_finite(values, name)
            _check_range(values, name, THICKNESS_MM, "mm is no tissue's thickness", "give millimetres")
    return Layers(time, {name.removesuffix(_LAYER_SUFFIX): values for name, values in columns.items()})


def _read_timed_columns(
    path: str | Path, time_name: str, suffix: str, quantity: str, gaps: bool = False
) -> tuple[Array, dict[str, Array]]:
    """Read the times, which must grow, and the columns of a ``quantity``, whose names end in ``suffix``."""
    columns = read_columns(
        Path(path), {TIME: time_name}, select=lambda name: name.endswith(suffix), gaps=gaps
    )
    time = columns.pop(time_name)
    if not columns:
        remedy = f"name columns such as muscle{suffix}"
        raise TraceError(f"no {quantity}", place="header", remedy=remedy)
    if not np.isfinite(time).all() or np.any(np.diff(time) <= 0.0):
        raise TraceError("time does not increase", place=time_name, remedy="sort the readings")
    return time, columns


def _check_range(values: Array, name: str, limits: tuple[float, float], wrong: str, remedy: str) -> None:
    """Refuse the values (n,) of a column that lie outside the limits of its quantity."""
    low, high = limits
    if values.min() < low or values.max() > high:
        what = f"{values.min():.3g} to {values.max():.3g} {wrong} ({low:g} to {high:g})"
        raise TraceError(what, place=name, remedy=remedy)


def compute_thinnings(
    layers: Layers, touch_down_s: float, end_s: float, sd_mm: float
) -> tuple[LayerThinning, ...]:
    """Compute how each tissue gives way between touch-down and ``end_s``, times of the record.

    The thickness at rest is the mean of all readings before touch-down. Raises `TraceError` where there is
    none, or hardly any reading in contact.
    """
    before = layers.time_s < touch_down_s
    inside = np.flatnonzero((layers.time_s >= touch_down_s) & (layers.time_s <= end_s))
    if not before.any():
        what = "no reading before touch-down, so the thickness at rest is not known"
        raise TraceError(what, remedy="start the ultrasound before the indenter, on the same clock")
    if len(inside) < MIN_LAYER_READINGS:
        remedy = f"give at least {MIN_LAYER_READINGS}, at times of the record's own clock"
        raise TraceError(f"only {len(inside)} readings in contact", remedy=remedy)
    parts = np.array_split(inside, min(len(inside), MAX_LAYER_POINTS))
    samples = np.array([float(len(part)) for part in parts])
    time = np.array([layers.time_s[part].mean() for part in parts]) - touch_down_s
    found = []
    for tissue, values in layers.thickness_mm.items():
        rest = float(values[before].mean())
        lost = rest - np.array([values[part].mean() for part in parts])
        found.append(LayerThinning(tissue, rest, time, lost, samples, int(before.sum()), sd_mm))
    return tuple(found)


@dataclass(frozen=True)
class WaveSpeeds:
    """Speeds (n,) m/s of shear waves at one place, at times (n,) s of the record; as many as were read.

    ``column`` names the place in its file: the ``tissue``, and its ``depth_mm`` below the skin at rest (None:
    the tissue's middle).
    """

    column: str
    tissue: str
    depth_mm: float | None
    time_s: Array
    speed_m_s: Array

    @property
    def name(self) -> str:
        """Name of the place in files and tables."""
        return self.column.removesuffix("_m_s")

    def average(self, touch_down_s: float, end_s: float) -> WaveMeans:
        """Means over at most `MAX_WAVE_POINTS` spans of time until ``end_s``, and over two before touch-down.

        Raises `TraceError` if there are not two readings until then.
        """
        before = np.flatnonzero(self.time_s < touch_down_s)
        inside = np.flatnonzero((self.time_s >= touch_down_s) & (self.time_s <= end_s))
        if len(before) + len(inside) < 2:
            what = f"{len(before) + len(inside)} readings until the indenter lets go ({end_s:.2f} s)"
            remedy = "give two or more, at times of the record's own clock"
            raise TraceError(what, place=self.column, remedy=remedy)
        both = (before, 2), (inside, MAX_WAVE_POINTS)
        parts = [part for of, most in both if len(of) for part in np.array_split(of, min(len(of), most))]
        time = np.maximum([self.time_s[part].mean() - touch_down_s for part in parts], 0.0)
        speed = np.array([self.speed_m_s[part].mean() for part in parts])
        return WaveMeans(time, speed, np.array([float(len(part)) for part in parts]))


@dataclass(frozen=True)
class WaveMeans:
    """Means (n,) m/s of ``samples`` (n,) readings each, at times (n,) s from touch-down; before it 0."""

    time_s: Array
    speed_m_s: Array
    samples: Array

    def covariance(self, sd_m_s: float, bias_m_s: float) -> Array:
        """Covariance of the means (n, n), m^2/s^2: each reading errs, and all of the place together."""
        return np.diag(sd_m_s**2 / self.samples) + bias_m_s**2


def read_wave_speeds(path: str | Path, time_name: str) -> tuple[WaveSpeeds, ...]:
    """Read a table with a column of times and one for each place, such as ``skin_m_s``, ``muscle_12mm_m_s``.

    A cell may be empty. Raises `TraceError` with the file, the column and the remedy.
    """
    with add_location(file=path):
        time, columns = _read_timed_columns(path, time_name, "_m_s", "speed of a wave", gaps=True)
        return tuple(_read_place(name, time, values) for name, values in columns.items())


def _read_place(name: str, time: Array, values: Array) -> WaveSpeeds:
    match = _WAVE_COLUMN.fullmatch(name)
    is_known = ~np.isnan(values)
    if match is None or not is_known.any():
        raise TraceError("no speed is given", place=name, remedy="fill some of its cells, or take it out")
    time, speed = time[is_known], values[is_known]
    _check_range(speed, name, WAVE_SPEED_M_S, "m/s is no soft tissue's speed", "give metres per second")
    depth = match["depth"]
    return WaveSpeeds(name, match["tissue"], float(depth) if depth else None, time, speed)


@dataclass(frozen=True)
class SurfaceMotion:
    """How points of the skin move: ``moved_mm`` (f, k, 3) of ``points`` (k, 3) mm at ``time_s`` (f,).

    Components that were not seen are nan.
    """

    points: Array
    time_s: Array
    moved_mm: Array

    @classmethod
    def from_rows(cls, time_s: Array, place_mm: Array, moved_mm: Array) -> SurfaceMotion:
        """From rows (r, ...), one for each point at each time; rows of one place are of one point."""
        frames, frame = np.unique(time_s, return_inverse=True)
        points, point = _find_points(place_mm)
        whole = np.full((len(frames), len(points), 3), np.nan)
        whole[frame, point] = moved_mm
        return cls(points, frames, whole)

    @property
    def rows(self) -> tuple[Array, Array, Array]:
        """What `from_rows` takes: of every point at every time, seen or not."""
        f, k, _ = self.moved_mm.shape
        return np.repeat(self.time_s, k), np.tile(self.points, (f, 1)), self.moved_mm.reshape(-1, 3)

    @property
    def max_motion_mm(self) -> float:
        """The largest component of all."""
        return float(np.nanmax(np.abs(self.moved_mm)))

    def average(self, points: Indices) -> SurfaceMeans:
        """Means over at most `MAX_SURFACE_TIMES` spans of time, each of the frames that show the point."""
        spans = np.array_split(np.arange(len(self.time_s)), min(len(self.time_s), MAX_SURFACE_TIMES))
        is_known = np.isfinite(self.moved_mm[:, points])
        found: list[tuple[Array, int, int]] = []
        for span in spans:
            for k, i in zip(*np.nonzero(is_known[span].any(axis=0))):
                shown = np.zeros(len(self.time_s))
                shown[span] = is_known[span, k, i]
                found.append((shown / shown.sum(), int(k), int(i)))
        frames = np.array([share for share, _, _ in found])
        point, component = (np.array([one[j] for one in found], dtype=np.int64) for j in (1, 2))
        values = np.nan_to_num(self.moved_mm[:, points[point], component])
        return SurfaceMeans(point, component, frames, frames @ self.time_s, np.sum(frames.T * values, axis=0))


@dataclass(frozen=True)
class SurfaceMeans:
    """Mean moves (n,) mm of points along components, each over some frames.

    ``point`` and ``component`` (n,) number them, ``frames`` (n, f) are their shares in the mean, and
    ``time_s`` (n,) is its time.
    """

    point: Indices
    component: Indices
    frames: Array
    time_s: Array
    moved_mm: Array

    @property
    def samples(self) -> Array:
        """The number of frames (n,) that each is the mean of."""
        return np.asarray((self.frames > 0.0).sum(axis=1), dtype=np.float64)


def read_surface_motion(path: str | Path, time_name: str) -> SurfaceMotion:
    """Read a table with a row for each point at each time: where it is at rest, and its displacement.

    Columns are the time, ``x_mm``, ``y_mm``, ``z_mm`` and one or more of ``ux_mm``, ``uy_mm``, ``uz_mm``,
    whose cells may be empty. Rows with the same position are of one point. Raises `TraceError` with the file,
    the column and the remedy.
    """
    with add_location(file=path):
        named = {TIME: time_name} | {name: name for name in _POSITION_COLUMNS}
        columns = read_columns(Path(path), named, select=lambda name: name in _MOTION_COLUMNS, gaps=True)
        given = [name for name in _MOTION_COLUMNS if name in columns]
        if not given:
            remedy = "name columns ux_mm, uy_mm, uz_mm"
            raise TraceError("no displacement of a point", place="header", remedy=remedy)
        for name in named.values():
            check_finite(columns[name], name, "give a number")
        for name in given:  # whose empty cells are nan
            values = np.nan_to_num(columns[name], posinf=np.inf, neginf=-np.inf)
            check_finite(values, name, "give a number, or leave the cell empty")
        place = np.column_stack([columns[name] for name in _POSITION_COLUMNS])
        nothing = np.full(len(place), np.nan)
        moved = np.column_stack([columns.get(name, nothing) for name in _MOTION_COLUMNS])
        _check_sizes(place, moved, ", ".join(given))
        _check_unique_rows(time_name, columns[time_name], place)
    return SurfaceMotion.from_rows(columns[time_name], place, moved)


def _check_sizes(place: Array, moved: Array, given: str) -> None:
    """Refuse positions and displacements that cannot be millimetres."""
    if not np.isfinite(moved).any():
        raise TraceError("no displacement is given", place=given, remedy="fill some of its cells")
    extent, largest = float(np.ptp(place, axis=0).max()), float(np.nanmax(np.abs(moved)))
    if extent < MIN_EXTENT_MM:
        what = f"all points lie within {extent:.3g} mm"
        raise TraceError(what, place=_POSITION_COLUMNS[0], remedy="give millimetres")
    if not MIN_MOTION_MM <= largest <= MAX_MOTION_MM:
        limits = f"{MIN_MOTION_MM:g} to {MAX_MOTION_MM:g} mm"
        what = f"the largest displacement is {largest:.3g} mm, and not {limits}"
        raise TraceError(what, place=given, remedy="give millimetres")


def _find_points(place: Array) -> tuple[Array, Indices]:
    """The places (k, 3) of rows (r, 3), each once, and which (r,) each row has."""
    whole = np.round(place / _POSITION_TOLERANCE_MM).astype(np.int64)
    _, first, point = np.unique(whole, axis=0, return_index=True, return_inverse=True)
    return place[first], point.ravel()


def _check_unique_rows(time_name: str, time: Array, place: Array) -> None:
    """Refuse a point that has two rows at one time."""
    rows = np.column_stack([time, _find_points(place)[1]])
    _, once = np.unique(rows, axis=0, return_index=True)
    if len(once) < len(rows):
        again = int(np.setdiff1d(np.arange(len(rows)), once)[0])
        where = ", ".join(f"{value:g}" for value in place[again])
        what = f"the point ({where}) has two rows at {time[again]:g} s"
        raise TraceError(what, place=time_name, remedy="give each point one row for each time")


def select_frames_in_contact(
    motion: SurfaceMotion, record_s: tuple[float, float], touch_down_s: float, end_s: float
) -> SurfaceMotion:
    """The frames between touch-down and ``end_s``, counted from touch-down.

    ``record_s`` are the record's first and last time; all times are of its clock. Raises `TraceError` for
    times outside the record, or none in contact.
    """
    first, last = float(motion.time_s[0]), float(motion.time_s[-1])
    if first < record_s[0] or last > record_s[1]:
        raise TraceError(
            f"times from {first:g} to {last:g} s, and the record goes from {record_s[0]:g} to "
            f"{record_s[1]:g} s",
            remedy="give times of the record's own clock",
        )
    inside = (motion.time_s > touch_down_s) & (motion.time_s <= end_s)
    moved = motion.moved_mm[inside]
    if not np.isfinite(moved).any():
        what = f"no displacement while the indenter presses ({touch_down_s:.2f} to {end_s:.2f} s)"
        raise TraceError(what, remedy="give some at times between, on the record's own clock")
    return SurfaceMotion(motion.points, motion.time_s[inside] - touch_down_s, moved)
