"""Which points of a record's surface are compared: near its site, on the skin, beside the indenter."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...arrays import Array
from ...errors import TraceError
from ...indentation import OFF_SKIN_MM, find_nearest_points, is_under, read_indenter, to_vector3
from ...study import Record, Study, Vector
from ...traces import SurfaceMotion
from ..engine.storage import read_curves, write_curves

Ints = NDArray[np.int64]

CURVES = "{}-surface"  # of a record
NEAR_MM = 40.0
MAX_POINTS = 30
_COLUMNS = ("x_mm", "y_mm", "z_mm", "ux_mm", "uy_mm", "uz_mm")


@dataclass(frozen=True)
class ChosenPoints:
    """Points of a surface that are compared.

    ``points`` are their places on the skin, LPS mm, ``axes`` the directions of the components, ``which`` (k,)
    their numbers in the file's motion. ``left_out`` says how many others are not compared, by the reason.
    """

    points: tuple[Vector, ...]
    axes: tuple[Vector, Vector, Vector]
    which: Ints
    left_out: Mapping[str, int]

    @property
    def words(self) -> str:
        """How many are compared and left out."""
        others = "".join(f", {number} {why}" for why, number in self.left_out.items())
        return f"{len(self.points)} points compared{others}"


def write_motion(folder: Path, record: Record, motion: SurfaceMotion) -> None:
    """Store how a record's surface moves from touch-down on."""
    time, place, moved = motion.rows
    columns = dict(zip(_COLUMNS, (*place.T, *moved.T), strict=True))
    write_curves(folder / f"{CURVES.format(record.name)}.csv", time_s=time, **columns)


def read_motion(folder: Path, record: Record) -> SurfaceMotion:
    """What `write_motion` stored."""
    columns = read_curves(folder / f"{CURVES.format(record.name)}.csv")
    rows = np.column_stack([columns[name] for name in _COLUMNS])
    return SurfaceMotion.of_rows(columns["time_s"], rows[:, :3], rows[:, 3:])


def choose_points(
    study: Study,
    record: Record,
    place: tuple[Vector, Vector],
    skin: tuple[Array, Ints],
    motion: SurfaceMotion,
) -> ChosenPoints:
    """The points of a record's surface that can be compared, at most `MAX_POINTS`, evenly spread.

    Parameters
    ----------
    place : position and axis of the indenter.
    skin : points (n, 3) mm and faces (f, 3 or more).
    motion : in the frame that the study states.

    Raises
    ------
    TraceError
        Where there is none, with the study's file.
    """
    assert record.surface is not None
    indenter = read_indenter(study.indenter_of(record), *place, record.site.edge)
    axes, points = np.eye(3), motion.points
    if record.surface_frame == "site":
        axes = indenter.frame
        points = np.array(place[0]) + points @ axes
    away = np.linalg.norm(points - place[0], axis=1)
    if away.min() > NEAR_MM:
        raise TraceError(
            f"no point lies within {NEAR_MM:g} mm of site {record.site.name}: the nearest is "
            f"{away.min():.0f} mm away",
            file=study.path(record.surface),
            place="x_mm, y_mm, z_mm",
            remedy=_describe_remedy(record),
        )
    found = find_nearest_points(*skin, points)
    reasons = {
        f"farther than {NEAR_MM:g} mm from the site": away > NEAR_MM,
        f"more than {OFF_SKIN_MM:g} mm off the skin": found.off_mm > OFF_SKIN_MM,
        "under the indenter": is_under(indenter, found.points),
        "never seen in contact": ~np.isfinite(motion.moved_mm).any(axis=(0, 2)),
    }
    left, left_out = np.ones(len(points), dtype=bool), {}
    for why, bad in reasons.items():
        if (number := int((bad & left).sum())) > 0:
            left_out[why] = number
        left &= ~bad
    if not left.any():
        told = ", ".join(f"{number} {why}" for why, number in left_out.items())
        raise TraceError(
            f"no point can be compared: {told}",
            file=study.path(record.surface),
            place="x_mm, y_mm, z_mm",
            remedy=_describe_remedy(record),
        )
    usable = np.flatnonzero(left)
    which = usable[_spread(found.points[usable], int(np.argmin(away[usable])))]
    if len(which) < len(usable):
        left_out[f"thinned out, to {MAX_POINTS}"] = len(usable) - len(which)
    chosen = tuple(to_vector3(point) for point in found.points[which])
    x, y, z = (to_vector3(axis) for axis in axes)
    return ChosenPoints(chosen, (x, y, z), which, left_out)


def _describe_remedy(record: Record) -> str:
    if record.surface_frame == "site":
        return 'give millimetres from the site, or surface_frame = "limb"'
    return 'give LPS millimetres of the skin at rest, or surface_frame = "site"'


def _spread(points: Array, first: int) -> Ints:
    """At most `MAX_POINTS` of points (k, 3), each as far as can be from those before it; sorted."""
    chosen = [first]
    away = np.linalg.norm(points - points[first], axis=1)
    while len(chosen) < min(len(points), MAX_POINTS):
        chosen.append(int(np.argmax(away)))
        away = np.minimum(away, np.linalg.norm(points - points[chosen[-1]], axis=1))
    return np.array(sorted(chosen))
