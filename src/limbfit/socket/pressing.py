"""Where a socket presses: areas pressed into its face or relieved, and the pressure that is meant there."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import ClassVar, Self

import numpy as np
from scipy.spatial import KDTree

from ..anatomy.surfaces.surfaces import Anatomy
from ..anatomy.surfaces.triangles import Surface
from ..arrays import Array
from ..errors import SurfaceError
from .landmarks import SkinRegion
from .shape import Socket

MAX_SIDE_SLOPE = 1.717  # slope of (1 - r^2/R^2)^3, over depth and radius, at 1/sqrt(5) of the radius
MAX_OFF_FACE_MM = 25.0  # the thickest liner between skin and socket, and some
MAX_BESIDE_MM = 5.0  # a place so far beside the face is not on it
PROMINENCES = ("tibial crest", "fibular head", "distal tibia", "distal fibula")
REACH_MM = 18.0  # beyond a region: over what its pressure, or depth, goes over into what is beside it
BRIM_MM = 20.0  # below the brim: over what the pressure comes on
FULL_DEPTH_MM = 20.0  # of tissue over bone: deeper tissue bears as much

TISSUE_DEPTH = "tissue depth"


@dataclass(frozen=True, eq=False)
class Area:
    """A round area of the face that presses in (positive depth) or gives relief.

    Raises `SurfaceError` where its sides would be steeper than 45 degrees.

    Attributes
    ----------
    points : its middle (3,), LPS mm, on the limb or near it; kept as (1, 3).
    radius_mm : how far from there its depth has faded to nothing.
    depth_mm : there, along the limb's normal.
    """

    kind: ClassVar[str] = "area"
    width: ClassVar[str] = "a radius"

    name: str
    points: Array
    radius_mm: float
    depth_mm: float

    def __post_init__(self) -> None:
        object.__setattr__(self, "points", np.atleast_2d(np.asarray(self.points, dtype=float)))
        least = MAX_SIDE_SLOPE * abs(self.depth_mm)
        if least > self.radius_mm:
            raise SurfaceError(
                f"the sides of {self.kind} {self.name!r} would be steeper than 45 degrees",
                remedy=f"give {self.width} of {least:.1f} mm or more, or less depth",
            )

    @property
    def position(self) -> Array:
        """(3,) the middle, LPS mm."""
        return self.points.mean(axis=0)

    def depth(self, points: Array) -> Array:
        """(n,) mm at points (n, 3)."""
        return self.depth_mm * self.share(points)

    def share(self, points: Array) -> Array:
        """(n,) of its depth at points (n, 3), which fades without a kink in slope or curvature."""
        return np.asarray(np.maximum(1.0 - self.relative_distance(points) ** 2, 0.0) ** 3)

    def relative_distance(self, points: Array) -> Array:
        """Distances (...) of points (..., 3) from it over its radius."""
        return np.asarray(KDTree(self.points).query(points)[0] / self.radius_mm)

    def project_to(self, face: Surface) -> Self:
        """Put its points on the drawn face (LPS), which a liner keeps off the skin; leave out those off it.
        Raises `SurfaceError` where all of it lies off the face.
        """
        _, near, feet = face.find_nearest(self.points)
        apart, normals = self.points - feet, face.face_normals[near]
        off = np.einsum("ij,ij->i", apart, normals)
        beside = np.linalg.norm(apart - off[:, None] * normals, axis=1)
        under = (beside <= self.max_beside_mm) & (np.abs(off) <= MAX_OFF_FACE_MM)
        if not under.any():
            least = np.linalg.norm(apart, axis=1).min()
            raise SurfaceError(
                f"{self.kind} {self.name!r} lies {least:.0f} mm off the socket's face",
                remedy="choose a place on the limb below the brim (LPS, mm), or move the trimline up",
            )
        return replace(self, points=feet[under])

    @property
    def max_beside_mm(self) -> float:
        """How far beside the face a point may lie."""
        return max(MAX_BESIDE_MM, 0.25 * self.radius_mm)


class Zone(Area):
    """A whole region of the limb: ``points`` (n, 3) cover it, and its radius is the reach beyond them."""

    kind = "region"
    width = "a reach"
    max_beside_mm = MAX_BESIDE_MM


# Shares of the stated pressure: of the limb, and of regions that have another one. Round figures for what
# concepts of sockets intend, to begin with; none is measured.
PRESETS: Mapping[str, tuple[float, Mapping[str, float]]] = {
    "hydrostatic": (1.0, {}),
    "total surface bearing": (1.0, dict.fromkeys(PROMINENCES, 0.5)),
    "patellar tendon bearing": (
        0.6,
        {"patellar tendon": 2.0, "medial proximal": 1.5, "posterior proximal": 1.5}
        | dict.fromkeys(PROMINENCES, 0.25),
    ),
}


@dataclass(frozen=True)
class Target:
    """A pressure field over the limb.

    Attributes
    ----------
    kind : ``tissue depth`` or a name of `PRESETS`.
    pressure_kPa : what shares are meant of.
    regions : pressures of regions, kPa, over those of the kind.
    """

    kind: str
    pressure_kPa: float
    regions: Mapping[str, float] = field(default_factory=dict)

    def at(self, points: Array, anatomy: Anatomy, regions: Mapping[str, SkinRegion], socket: Socket) -> Array:
        """Pressure (n,) kPa at points (n, 3) of the limb's outer surface, LPS mm; 0 beyond the brim.

        Raises `SurfaceError` for a region that the limb does not have, and tissue depth of a limb without
        bones.

        Parameters
        ----------
        regions : of the limb; those of a preset that it does not have count as the rest.
        socket : any face around the limb, for where the brim runs.
        """
        skin = anatomy.skin
        below = skin.find_nearest(points)[2]  # a liner
        if self.kind == TISSUE_DEPTH:
            found = self.pressure_kPa * _compute_depth_share(below, anatomy)
            values: dict[str, float] = {}
        else:
            limb, others = PRESETS[self.kind]
            found = np.full(len(points), self.pressure_kPa * limb)
            values = {name: share * self.pressure_kPa for name, share in others.items()}
        rest = {name: values[name] for name in values if name in regions and name not in self.regions}
        for name, value in (*rest.items(), *self.regions.items()):  # where they overlap, what is stated wins
            share = build_zone(name, anatomy, regions, 0.0).share(below)
            found = (1.0 - share) * found + share * value
        # Nothing beyond the brim; below it the pressure grows smoothly.
        t = np.clip(KDTree(socket.points[socket.brim]).query(points)[0] / BRIM_MM, 0.0, 1.0)
        return np.where(socket.find_covered(points), found * t**2 * (3.0 - 2.0 * t), 0.0)


def build_zone(name: str, anatomy: Anatomy, regions: Mapping[str, SkinRegion], depth_mm: float) -> Zone:
    """Build the zone of a region of the limb that is pressed into a face by a depth, or relieved. Raises
    `SurfaceError` where the limb has no such region.
    """
    if name not in regions:
        raise SurfaceError(f"no region is named {name!r}", remedy="the limb has " + ", ".join(regions))
    points = anatomy.skin.triangles[regions[name].faces].mean(axis=1)
    return Zone(name, points, REACH_MM, depth_mm)


def _compute_depth_share(points: Array, anatomy: Anatomy) -> Array:
    """Compute the depth (n,) of points of the skin over the nearest bone, as a share of ``FULL_DEPTH_MM``."""
    if not anatomy.bones:
        raise SurfaceError(
            "the depth of tissue is not known: the limb has no bones",
            remedy=f"choose another socket.design.pressure: {', '.join(PRESETS)}",
        )
    squared = [bone.find_nearest(points)[0] for bone in anatomy.bones.values()]
    return np.asarray(np.clip(np.sqrt(np.min(squared, axis=0)) / FULL_DEPTH_MM, 0.0, 1.0))
