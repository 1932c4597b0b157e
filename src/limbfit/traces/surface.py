"""What cameras or scans see around the indenter: points of the skin that move while it is pressed."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..errors import TraceError
from .formats import TIME
from .numerics import Array
from .reading import read_columns

PLACE = ("x_mm", "y_mm", "z_mm")
MOVES = ("ux_mm", "uy_mm", "uz_mm")
MAX_TIMES = 8  # of comparison; more frames are averaged
LEAST_EXTENT_MM, LEAST_MOVE_MM, MOST_MOVE_MM = 1.0, 0.01, 100.0
_SAME_MM = 1e-3


@dataclass(frozen=True)
class SurfaceMotion:
    """How points of the skin move: ``moved_mm`` (f, k, 3) of ``points`` (k, 3) mm at ``time_s`` (f,).

    Components that were not seen are nan.
    """

    points: Array
    time_s: Array
    moved_mm: Array

    @classmethod
    def of_rows(cls, time_s: Array, place_mm: Array, moved_mm: Array) -> SurfaceMotion:
        """From rows (r, ...), one for each point at each time; rows of one place are of one point."""
        frames, frame = np.unique(time_s, return_inverse=True)
        points, point = _find_points(place_mm)
        whole = np.full((len(frames), len(points), 3), np.nan)
        whole[frame, point] = moved_mm
        return cls(points, frames, whole)

    @property
    def rows(self) -> tuple[Array, Array, Array]:
        """What `of_rows` takes: of every point at every time, seen or not."""
        f, k, _ = self.moved_mm.shape
        return np.repeat(self.time_s, k), np.tile(self.points, (f, 1)), self.moved_mm.reshape(-1, 3)

    @property
    def largest_mm(self) -> float:
        """The largest component of all."""
        return float(np.nanmax(np.abs(self.moved_mm)))

    def frames(self, which: NDArray[np.bool_]) -> SurfaceMotion:
        """Some of the frames (f,)."""
        return SurfaceMotion(self.points, self.time_s[which], self.moved_mm[which])

    def means(self, points: NDArray[np.int64]) -> SurfaceMeans:
        """Of some of the points over at most `MAX_TIMES` spans of time, each over the frames that show it."""
        spans = np.array_split(np.arange(len(self.time_s)), min(len(self.time_s), MAX_TIMES))
        seen = np.isfinite(self.moved_mm[:, points])
        found: list[tuple[Array, int, int]] = []
        for span in spans:
            for k, i in zip(*np.nonzero(seen[span].any(axis=0))):
                shown = np.zeros(len(self.time_s))
                shown[span] = seen[span, k, i]
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

    point: NDArray[np.int64]
    component: NDArray[np.int64]
    frames: Array
    time_s: Array
    moved_mm: Array

    @property
    def samples(self) -> Array:
        """How many frames (n,) each is the mean of."""
        return np.asarray((self.frames > 0.0).sum(axis=1), dtype=np.float64)


def read_surface_motion(path: str | Path, time_name: str) -> SurfaceMotion:
    """Read a table with a row for each point at each time: where it is at rest, and its displacement.

    Columns are the time, ``x_mm``, ``y_mm``, ``z_mm`` and one or more of ``ux_mm``, ``uy_mm``, ``uz_mm``,
    whose cells may be empty. Rows with the same position are of one point.

    Raises
    ------
    TraceError
        With the file, the column and the remedy.
    """
    file = Path(path)
    named = {TIME: time_name} | {name: name for name in PLACE}
    columns = read_columns(file, named, wanted=lambda name: name in MOVES, gaps=True)
    given = [name for name in MOVES if name in columns]
    if not given:
        raise TraceError(
            "no displacement of a point", file=file, place="header", remedy="name columns ux_mm, uy_mm, uz_mm"
        )
    for name, values in columns.items():
        bad = np.flatnonzero(np.isinf(values) if name in MOVES else ~np.isfinite(values))
        if bad.size:
            raise TraceError(
                f"{values[bad[0]]} in sample {bad[0] + 1}",
                file=file,
                place=name,
                remedy="give a number" + (", or leave the cell empty" if name in MOVES else ""),
            )
    place = np.column_stack([columns[name] for name in PLACE])
    nothing = np.full(len(place), np.nan)
    moved = np.column_stack([columns.get(name, nothing) for name in MOVES])
    _check_sizes(file, place, moved, ", ".join(given))
    _check_once(file, time_name, columns[time_name], place)
    return SurfaceMotion.of_rows(columns[time_name], place, moved)


def _check_sizes(file: Path, place: Array, moved: Array, given: str) -> None:
    """Whether positions and displacements can be millimetres."""
    if not np.isfinite(moved).any():
        raise TraceError("no displacement is given", file=file, place=given, remedy="fill some of its cells")
    extent, largest = float(np.ptp(place, axis=0).max()), float(np.nanmax(np.abs(moved)))
    if extent < LEAST_EXTENT_MM:
        raise TraceError(
            f"all points lie within {extent:.3g} mm", file=file, place=PLACE[0], remedy="give millimetres"
        )
    if not LEAST_MOVE_MM <= largest <= MOST_MOVE_MM:
        span = f"{LEAST_MOVE_MM:g} to {MOST_MOVE_MM:g} mm"
        raise TraceError(
            f"the largest displacement is {largest:.3g} mm, and not {span}",
            file=file,
            place=given,
            remedy="give millimetres",
        )


def _find_points(place: Array) -> tuple[Array, NDArray[np.int64]]:
    """The places (k, 3) of rows (r, 3), each once, and which (r,) each row has."""
    whole = np.round(place / _SAME_MM).astype(np.int64)
    _, first, point = np.unique(whole, axis=0, return_index=True, return_inverse=True)
    return place[first], point.ravel()


def _check_once(file: Path, time_name: str, time: Array, place: Array) -> None:
    """Whether no point has two rows at one time."""
    rows = np.column_stack([time, _find_points(place)[1]])
    _, once = np.unique(rows, axis=0, return_index=True)
    if len(once) < len(rows):
        again = int(np.setdiff1d(np.arange(len(rows)), once)[0])
        where = ", ".join(f"{value:g}" for value in place[again])
        raise TraceError(
            f"the point ({where}) has two rows at {time[again]:g} s",
            file=file,
            place=time_name,
            remedy="give each point one row for each time",
        )


def select_frames_in_contact(
    motion: SurfaceMotion, record_s: tuple[float, float], touch_down_s: float, end_s: float
) -> SurfaceMotion:
    """The frames between touch-down and ``end_s``, counted from touch-down.

    ``record_s`` are the record's first and last time; all times are of its clock.

    Raises
    ------
    TraceError
        For times outside the record, or none in contact.
    """
    first, last = float(motion.time_s[0]), float(motion.time_s[-1])
    if first < record_s[0] or last > record_s[1]:
        raise TraceError(
            f"times from {first:g} to {last:g} s, and the record goes from {record_s[0]:g} to "
            f"{record_s[1]:g} s",
            remedy="give times of the record's own clock",
        )
    found = motion.frames((motion.time_s > touch_down_s) & (motion.time_s <= end_s))
    if not np.isfinite(found.moved_mm).any():
        raise TraceError(
            f"no displacement while the indenter presses ({touch_down_s:.2f} to {end_s:.2f} s)",
            remedy="give some at times between, on the record's own clock",
        )
    return SurfaceMotion(found.points, found.time_s - touch_down_s, found.moved_mm)
