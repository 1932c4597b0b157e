"""Rays from a limb's middle line to its surface, on which a socket around it is drawn.

The middle line follows the centres of the limb's sections down to the centre of its rounded end. From there
on up rays run across the limb frame's z axis; below, they leave that centre in all distal directions. A point
has three coordinates: its angle around the limb, its station (mm: height over the centre, or the arc below
it, which is negative) and its radius. Rays do not cross, so a face that has one radius for each angle and
station cannot fold. `Offsets` are moves along them, such as the shape that pressures give a socket, and
along them a face is moved clear of the limb.
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy.interpolate import interpn
from scipy.ndimage import gaussian_filter
from scipy.sparse import csr_array

from ..anatomy.grid import Frame, format_place
from ..anatomy.surfaces.triangles import Surface, find_half_edges
from ..arrays import Array, Indices
from ..errors import SurfaceError
from .shape import measure_section

ANGLES = 180
STEP_MM = 1.5  # between stations
BELOW_CUT_MM = 1.0  # the highest station
DEGREE = 3  # of the middle line
LEVELS = 60
SMOOTH_MM = 1.5  # roughness that is shorter is not the limb's shape
FOLD_MM = 1.0  # a ray that meets the surface again so much farther out meets a fold
CLEAR_MM = 0.5  # between face and limb: what is promised
TARGET_MM = 0.8  # what is aimed at where it is measured
MAX_ROUNDS = 12  # of moving a face clear
OFFSET_SMOOTH_MM = 5.0  # half of an edge of the limb's mesh: what is shorter is that of its faces


@dataclass(frozen=True, eq=False)
class Rays:
    """The rays of a limb; points are those of the limb frame, mm.

    Attributes
    ----------
    line : coefficients (degree + 1, 2) of the middle line's x and y in the station.
    centre_z : height of the end's centre.
    end_radius : of the limb at that height, mm.
    top : the station of the proximal cut, beyond which the middle line is straight.
    """

    line: Array
    centre_z: float
    end_radius: float
    top: float

    @property
    def bottom(self) -> float:
        """The station of the distal pole."""
        return -0.5 * np.pi * self.end_radius

    def middle(self, station: Array) -> Array:
        """(..., 3) the middle line at stations (...); below the end's centre it stays there."""
        up = np.maximum(station, 0.0)
        across = np.stack([np.polyval(column, np.minimum(up, self.top)) for column in self.line.T], axis=-1)
        return np.concatenate([across, (self.centre_z + up)[..., None]], axis=-1)

    def direction(self, angle: Array, station: Array) -> Array:
        """(..., 3) unit vectors along the rays."""
        angle, station = np.broadcast_arrays(angle, station)
        fall = np.maximum(-station, 0.0) / self.end_radius
        flat = np.cos(fall)
        return np.stack([flat * np.cos(angle), flat * np.sin(angle), -np.sin(fall)], axis=-1)

    def points(self, angle: Array, station: Array, radius: Array) -> Array:
        """Points (..., 3) of coordinates (...)."""
        return self.middle(station) + radius[..., None] * self.direction(angle, station)

    def coordinates(self, points: Array) -> tuple[Array, Array, Array]:
        """Angle, station and radius (...) of points (..., 3)."""
        station = points[..., 2] - self.centre_z
        spoke = points - self.middle(station)
        across = np.hypot(spoke[..., 0], spoke[..., 1])
        fall = np.arctan2(np.maximum(-spoke[..., 2], 0.0), across)
        below = station < 0.0
        return (
            np.arctan2(spoke[..., 1], spoke[..., 0]),
            np.where(below, -fall * self.end_radius, station),
            np.where(below, np.hypot(across, spoke[..., 2]), across),
        )


@dataclass(frozen=True, eq=False)
class LimbProfile:
    """Radii of a closed limb surface on its rays.

    Attributes
    ----------
    rays : of the limb.
    stations : (k,) from the distal pole up to the proximal cut, mm.
    angles : (ANGLES,) radians from -pi on.
    radius : (k, ANGLES) mm, without roughness.
    folds : (k, ANGLES) by how much farther out a ray meets the surface again, mm.
    """

    rays: Rays
    stations: Array
    angles: Array
    radius: Array
    folds: Array

    def find_radius(self, angle: Array, station: Array) -> Array:
        """Radii (...) at angles and stations, mm; those beyond the last station are the last one's."""
        return self.interpolate(self.radius, angle, station)

    def interpolate(self, field: Array, angle: Array, station: Array) -> Array:
        """A field (k, ANGLES) at angles and stations (...)."""
        grid = self.stations, np.append(self.angles, np.pi)
        turned = np.mod(angle + np.pi, 2 * np.pi) - np.pi
        at = np.broadcast_arrays(np.clip(station, self.stations[0], self.stations[-1]), turned)
        return np.asarray(interpn(grid, np.column_stack([field, field[:, 0]]), np.stack(at, axis=-1)))


@lru_cache(maxsize=4)
def compute_profile(outer: Surface, frame: Frame) -> LimbProfile:
    """Compute the radii of a limb's closed outer surface (LPS mm) in its frame; those of the last limbs are
    kept. Raises `SurfaceError` where the surface does not surround its own middle line.
    """
    local = Surface(frame.to_limb(outer.points), outer.faces)
    rays = _build_rays(local)
    top = -BELOW_CUT_MM - rays.centre_z
    below = np.linspace(rays.bottom, 0.0, max(8, round(-rays.bottom / STEP_MM)), endpoint=False)
    stations = np.concatenate([below, np.linspace(0.0, top, max(8, round(top / STEP_MM)))])
    angles = -np.pi + 2 * np.pi * np.arange(ANGLES) / ANGLES
    radius, folds = compute_radii(local, rays, stations, angles)
    if np.isnan(radius).any():
        k = int(np.isnan(radius).any(axis=1).argmax())
        place = format_place(frame.to_patient(rays.middle(stations[k])), 0)
        raise SurfaceError(
            f"a ray from the limb's middle line at {place} never meets the limb",
            remedy="close the surface, or move the proximal cut nearer to the knee",
        )
    radius = smooth(radius, stations, float(np.median(radius)), SMOOTH_MM)
    return LimbProfile(rays, stations, angles, radius, folds)


def _build_rays(local: Surface) -> Rays:
    bottom = float(local.points[:, 2].min())
    if bottom > -30.0:
        raise SurfaceError(
            f"the limb reaches {-bottom:.0f} mm below its proximal cut, and a socket needs 30 mm or more",
            remedy="move the proximal cut up",
        )
    levels = np.linspace(bottom, -BELOW_CUT_MM, LEVELS + 2)[1:]
    measured = np.array([measure_section(local, z) for z in levels])
    mean_radius = np.sqrt(measured[:, 2] / np.pi)
    # The end is as high as the limb is wide there; a long one keeps half of the limb for its shank.
    rounded = np.flatnonzero(levels - bottom >= np.minimum(mean_radius, 0.5 * (-bottom)))[0]
    centre_z = float(levels[rounded])
    line = np.polyfit(levels[rounded:] - centre_z, measured[rounded:, :2], DEGREE)
    return Rays(line, centre_z, float(mean_radius[rounded]), -centre_z)


def compute_radii(local: Surface, rays: Rays, stations: Array, angles: Array) -> tuple[Array, Array]:
    """Compute where each ray leaves a surface (limb frame) for good, and how far in it left it before.

    Returns
    -------
    radius : (stations, angles) mm; NaN where a ray does not meet the surface.
    folds : (stations, angles) mm.
    """
    ways = rays.direction(angles[None, :], stations[:, None])
    starts = np.broadcast_to(rays.middle(stations)[:, None], ways.shape)
    hits = local.find_ray_hits(starts.reshape(-1, 3), ways.reshape(-1, 3))
    radius = np.array([met[-1] if len(met) else np.nan for met in hits])
    folds = np.array([met[-1] - met[0] if len(met) else 0.0 for met in hits])
    return radius.reshape(ways.shape[:2]), folds.reshape(ways.shape[:2])


def smooth(field: Array, stations: Array, radius: float, size_mm: float) -> Array:
    """Smooth a field (stations, angles) around a limb of a ``radius``, over ``size_mm``.

    Across the pole a ray goes on at the other side.
    """
    pad = max(6, round(4.0 * size_mm / STEP_MM))
    beyond = np.roll(field[1 : pad + 1][::-1], ANGLES // 2, axis=1)
    across = size_mm / (2 * np.pi / ANGLES * radius)
    padded = gaussian_filter(
        np.vstack([beyond, field]), (size_mm / STEP_MM, across), mode=("nearest", "wrap")
    )
    return np.asarray(padded[pad:], dtype=float)


@dataclass(frozen=True, eq=False)
class Offsets:
    """Moves along the rays of a limb.

    Attributes
    ----------
    limb : whose rays they are.
    radial : (k, angles) mm, positive outwards, at the limb's stations and angles.
    """

    limb: LimbProfile
    radial: Array

    def moves(self, points: Array) -> Array:
        """Moves (n, 3) of points (n, 3) of the limb frame, along their rays."""
        angle, station, _ = self.limb.rays.coordinates(points)
        size = self.limb.interpolate(self.radial, angle, station)
        return np.asarray(size[:, None] * self.limb.rays.direction(angle, station))


def compute_offsets(limb: LimbProfile, before: Surface, after: Surface, frame: Frame) -> Offsets:
    """Compute by how much a limb's outer surface (LPS mm) moves along each ray of the limb.

    Both surfaces have the same triangles, open at the proximal cut, so that their facets cancel. Raises
    `SurfaceError` where a surface does not surround the limb's middle line.
    """
    first, second = (
        compute_radii(Surface(frame.to_limb(one.points), one.faces), limb.rays, limb.stations, limb.angles)[0]
        for one in (before, after)
    )
    radial = second - first
    # Rays beside the proximal cut may pass it: no face reaches there.
    known = np.flatnonzero(~np.isnan(radial).any(axis=1))
    if len(known) < 0.9 * len(radial) or known[0] != 0 or np.any(np.diff(known) > 1):
        raise SurfaceError(
            "the moved surface does not surround the limb's middle line", remedy="lower the pressure"
        )
    radial[known[-1] + 1 :] = radial[known[-1]]
    return Offsets(limb, smooth(radial, limb.stations, float(np.median(first[known])), OFFSET_SMOOTH_MM))


def apply_clearance(points: Array, faces: Indices, limb: LimbProfile, outer: Surface, frame: Frame) -> Array:
    """Move the points of a face (limb frame) until it is clear of the limb by ``CLEAR_MM`` or more.

    Each stays on its ray and moves outwards only. What is measured are the face's points, middles of edges
    and faces, and the limb's points. Raises `SurfaceError` where that takes more than ``MAX_ROUNDS`` rounds.
    """
    local = Surface(frame.to_limb(outer.points), outer.faces)
    angle, station, radius = limb.rays.coordinates(points)
    edges = find_half_edges(faces)
    both = np.vstack([edges, edges[:, ::-1]])
    neighbours = csr_array((np.ones(len(both)), (both[:, 0], both[:, 1])), shape=(len(points), len(points)))
    radius = np.maximum(radius, limb.find_radius(angle, station) + TARGET_MM)
    for _ in range(MAX_ROUNDS):
        moved = limb.rays.points(angle, station, radius)
        need = _compute_moves(moved, faces, local)
        if need.max() <= TARGET_MM - CLEAR_MM:
            return moved
        # A point's neighbours go with it, so that the face stays smooth.
        beside = neighbours.multiply(need[None, :]).max(axis=1).toarray().ravel()
        radius = radius + 1.3 * np.maximum(need, 0.5 * beside)
    raise SurfaceError(
        "the socket cannot be moved clear of the limb",
        remedy="smooth the limb's surface, or trim below where it is folded",
    )


def _compute_moves(points: Array, faces: Indices, limb: Surface) -> Array:
    """Compute by how much each point (n,) should move out so that all measured near it is clear, mm."""
    need = np.maximum(TARGET_MM - limb.signed_distance(points), 0.0)
    for corners in ((0, 1), (1, 2), (2, 0), (0, 1, 2)):
        ends = faces[:, list(corners)]
        short = np.maximum(TARGET_MM - limb.signed_distance(points[ends].mean(axis=1)), 0.0)
        np.maximum.at(need, ends, short[:, None])
    squared, nearest, _ = Surface(points, faces).find_nearest(limb.points)
    np.maximum.at(need, faces[nearest], np.maximum(TARGET_MM - np.sqrt(squared), 0.0)[:, None])
    return need
