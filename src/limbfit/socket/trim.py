"""Where the brim of a socket runs: planes and a closed line across the limb's meridians."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.interpolate import PchipInterpolator

from ..anatomy.grid import Frame
from ..arrays import Array
from ..errors import SurfaceError
from .rays import LimbProfile

MIN_FACE_MM = 30.0  # of face between the distal end and the brim, along the limb
MAX_OFF_LIMB_MM = 30.0  # how far a point of a trimline may lie off the limb


@dataclass(frozen=True)
class Trim:
    """The brim: below every plane, and below the line where there is one.

    Attributes
    ----------
    planes : points and normals (3,), LPS; normals point proximally.
    line : (k, 3) points of a closed line around the limb, LPS mm, on the limb or near it, in order.
    """

    planes: Sequence[tuple[Array, Array]] = ()
    line: Array | None = None

    def __post_init__(self) -> None:
        if not self.planes and self.line is None:
            raise SurfaceError("a socket without a trimline", remedy="state a plane or a line")


@dataclass(frozen=True, eq=False)
class TrimmedLimb:
    """The limb's meridians (limb frame) from the distal pole to the brim.

    Attributes
    ----------
    meridians : (angles, k, 3) points, from the pole on.
    ways : (angles, k) their lengths from the pole, mm.
    length : (angles,) of each up to the brim, mm.
    brim_station : (angles,) the station of the brim.
    """

    meridians: Array
    ways: Array
    length: Array
    brim_station: Array

    def along(self, way: Array) -> Array:
        """(angles, 3) the point of each meridian this far (angles,) from the pole."""
        rows = np.arange(len(way))
        after = np.clip((self.ways < way[:, None]).sum(axis=1), 1, self.ways.shape[1] - 1)
        low, high = self.ways[rows, after - 1], self.ways[rows, after]
        share = ((way - low) / (high - low))[:, None]
        return np.asarray((1 - share) * self.meridians[rows, after - 1] + share * self.meridians[rows, after])

    def tangent(self, way: Array, reach: float = 3.0) -> Array:
        """(angles, 3) unit vectors along the meridians, towards the brim, over some mm."""
        step = self.along(way + reach) - self.along(way - reach)
        return np.asarray(step / np.linalg.norm(step, axis=1, keepdims=True))


def trim_limb(limb: LimbProfile, frame: Frame, trim: Trim) -> TrimmedLimb:
    """Cut the meridians of a limb at its trimline. Raises `SurfaceError` where the brim would lie beyond the
    limb's proximal cut, at its distal end, or a line does not go once around the limb.
    """
    stations, angles = limb.stations, limb.angles
    points = limb.rays.points(angles[:, None], stations[None, :], limb.radius.T)
    points[:, 0] = points[:, 0].mean(axis=0)  # one pole
    lengths = np.linalg.norm(np.diff(points, axis=1), axis=2)
    ways = np.append(np.zeros((len(angles), 1)), np.cumsum(lengths, axis=1), axis=1)
    over = np.max(_measure_above_trimline(points, angles, limb, frame, trim), axis=0)
    after = np.argmax(over > 0.0, axis=1)
    rows = np.arange(len(angles))
    missed = ~(over > 0.0).any(axis=1)
    if missed.any():
        raise SurfaceError(
            f"the brim would lie beyond the limb's proximal cut on {100 * missed.mean():.0f} % of its way",
            remedy="move the trimline down, or the proximal cut up",
        )
    low, high = over[rows, after - 1], over[rows, after]
    share = np.where(after > 0, -low / (high - low), 0.0)
    length = ways[rows, after - 1] + share * (ways[rows, after] - ways[rows, after - 1])
    short = (after == 0) | (length < MIN_FACE_MM)
    if short.any():
        raise SurfaceError(
            f"the brim comes within {max(float(length[short].min()), 0.0):.0f} mm of the distal end, "
            f"and a socket needs {MIN_FACE_MM:g} mm of face",
            remedy="move the trimline up"
            + ("; the normals of its planes point proximally" * bool(trim.planes)),
        )
    station = stations[after - 1] + share * (stations[after] - stations[after - 1])
    return TrimmedLimb(points, ways, length, station)


def find_brim(limb: LimbProfile, frame: Frame, trim: Trim, count: int) -> Array:
    """Find points (count, 3) of the limb where the brim runs, evenly around it, LPS mm.

    Errors are those of `trim_limb`.
    """
    trimmed = trim_limb(limb, frame, trim)
    return frame.to_patient(trimmed.along(trimmed.length)[np.arange(count) * len(limb.angles) // count])


def wrap_trimline(limb: LimbProfile, frame: Frame, points: Array) -> Array:
    """Put points (k, 3), such as those of a trimline, on the limb along their rays, LPS mm."""
    angle, station, _ = limb.rays.coordinates(frame.to_limb(points))
    return frame.to_patient(limb.rays.points(angle, station, limb.at(angle, station)))


def _measure_above_trimline(
    points: Array, angles: Array, limb: LimbProfile, frame: Frame, trim: Trim
) -> list[Array]:
    """Measure how far points (angles, k, 3) lie over each part of the trimline, mm."""
    heights = []
    for point, normal in trim.planes:
        direction = frame.rotation @ np.asarray(normal, dtype=float)
        if direction[2] <= 0.0:
            raise SurfaceError(
                "the normal of a trim plane points distally", remedy="turn it so that it points proximally"
            )
        heights.append((points - frame.to_limb(point)) @ (direction / np.linalg.norm(direction)))
    if trim.line is not None:
        height = _interpolate_line(frame.to_limb(trim.line), limb)
        heights.append(points[..., 2] - height(angles)[:, None])
    return heights


def _interpolate_line(points: Array, limb: LimbProfile) -> PchipInterpolator:
    """Interpolate the height of a closed line (k, 3) over the angle around the limb."""
    if np.array_equal(points[0], points[-1]):  # some state the end of a closed line, too
        points = points[:-1]
    angle, station, radius = limb.rays.coordinates(points)
    off = np.abs(radius - limb.at(angle, station))
    if off.max() > MAX_OFF_LIMB_MM:
        raise SurfaceError(
            f"point {int(off.argmax()) + 1} of the trimline lies {off.max():.0f} mm off the limb",
            remedy="give points on the limb (LPS, mm)",
        )
    steps = np.mod(np.diff(angle, append=angle[0]) + np.pi, 2 * np.pi) - np.pi
    sign = np.sign(steps.sum())
    if len(points) < 3 or sign == 0 or np.any(sign * steps <= 0) or abs(abs(steps.sum()) - 2 * np.pi) > 0.1:
        raise SurfaceError(
            "the trimline does not go once around the limb", remedy="give its points in order around the limb"
        )
    order = np.argsort(angle)
    turns = np.concatenate([angle[order] + turn for turn in (-2 * np.pi, 0.0, 2 * np.pi)])
    return PchipInterpolator(turns, np.tile(points[order, 2], 3))
