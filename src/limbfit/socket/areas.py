"""Round areas and whole regions that are pressed into a socket's face, or relieved, besides its reduction."""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import ClassVar, Self

import numpy as np
from scipy.spatial import KDTree

from ..anatomy.surfaces.triangles import Surface
from ..arrays import Array
from ..errors import SurfaceError

MAX_SIDE_SLOPE = 1.717  # slope of (1 - r^2/R^2)^3, over depth and radius, at 1/sqrt(5) of the radius
MAX_OFF_FACE_MM = 25.0  # the thickest liner between skin and socket, and some
MAX_BESIDE_MM = 5.0  # a place so far beside the face is not on it


@dataclass(frozen=True, eq=False)
class Area:
    """A round area of the face that presses in (positive depth) or gives relief.

    Attributes
    ----------
    points : its middle (3,), LPS mm, on the limb or near it; kept as (1, 3).
    radius_mm : how far from there its depth has faded to nothing.
    depth_mm : there, along the limb's normal.

    Raises
    ------
    SurfaceError
        Where its sides would be steeper than 45 degrees.
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

    @cached_property
    def _tree(self) -> KDTree:
        return KDTree(self.points)

    def depth(self, points: Array) -> Array:
        """(n,) mm at points (n, 3)."""
        return self.depth_mm * self.share(points)

    def share(self, points: Array) -> Array:
        """(n,) of its depth at points (n, 3), which fades without a kink in slope or curvature."""
        apart = self._tree.query(points)[0] / self.radius_mm
        return np.asarray(np.maximum(1.0 - apart**2, 0.0) ** 3)

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

    def compute_relative_distance(self, point: Array) -> float:
        """Distance of a point (3,) from it over its radius."""
        return float(self._tree.query(point)[0] / self.radius_mm)


class Zone(Area):
    """A whole region of the limb: ``points`` (n, 3) cover it, and its radius is the reach beyond them."""

    kind = "region"
    width = "a reach"
    max_beside_mm = MAX_BESIDE_MM
