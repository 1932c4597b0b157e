"""Round areas and whole regions that are pressed into a socket's face, or relieved, besides its reduction."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import igl
import numpy as np
from scipy.spatial import KDTree

from ..anatomy.surfaces.triangles import Surface
from ..arrays import Array
from ..errors import SurfaceError

MAX_SIDE_SLOPE = 1.717  # slope of (1 - r^2/R^2)^3, over depth and radius, at 1/sqrt(5) of the radius
MAX_OFF_FACE_MM = 25.0  # the thickest liner between skin and socket, and some
MAX_BESIDE_MM = 5.0  # a place so far beside the face is not on it


def compute_area_weight(apart: Array, reach: float) -> Array:
    """``(1 - r^2/R^2)^3`` of distances r (n,) within a reach R, 0 beyond: no kink in slope or curvature."""
    return np.asarray(np.maximum(1.0 - (apart / reach) ** 2, 0.0) ** 3)


@dataclass(frozen=True)
class Area:
    """A round area of the face that presses in (positive depth) or gives relief.

    Attributes
    ----------
    position : (3,) its middle, LPS mm, on the limb or near it.
    radius_mm : where its depth has faded to nothing.
    depth_mm : at its middle, along the limb's normal.

    Raises
    ------
    SurfaceError
        Where its sides would be steeper than 45 degrees.
    """

    name: str
    position: Array
    radius_mm: float
    depth_mm: float

    def __post_init__(self) -> None:
        _check_sides(f"area {self.name!r}", "a radius", self.depth_mm, self.radius_mm)

    def depth(self, points: Array) -> Array:
        """(n,) mm at points (n, 3)."""
        apart = np.linalg.norm(points - np.asarray(self.position, dtype=float), axis=1)
        return self.depth_mm * compute_area_weight(apart, self.radius_mm)

    def project_to(self, face: Surface) -> Area:
        """Put its middle on the drawn face (LPS), which a liner keeps off the skin.

        Raises
        ------
        SurfaceError
            Where the area lies off the face.
        """
        position = np.asarray(self.position, dtype=float)
        foot, beside, off = _project_to_face(position[None], face)
        if beside[0] > max(MAX_BESIDE_MM, 0.25 * self.radius_mm) or off[0] > MAX_OFF_FACE_MM:
            raise SurfaceError(
                f"area {self.name!r} lies {np.linalg.norm(position - foot[0]):.0f} mm off the socket's face",
                remedy="give a position on the limb below the brim (LPS, mm), or move the trimline up",
            )
        return replace(self, position=foot[0])

    def compute_relative_distance(self, point: Array) -> float:
        """Distance of a point (3,) from its middle over its radius."""
        return float(np.linalg.norm(point - np.asarray(self.position)) / self.radius_mm)


@dataclass(frozen=True, eq=False)
class Zone:
    """A whole region of the limb that presses in (positive depth) or gives relief.

    Attributes
    ----------
    points : (n, 3) that cover the region, LPS mm, on the limb or near it.
    reach_mm : how far beyond them its depth has faded to nothing.
    depth_mm : on them, along the limb's normal.

    Raises
    ------
    SurfaceError
        Where its sides would be steeper than 45 degrees.
    """

    name: str
    points: Array
    reach_mm: float
    depth_mm: float

    def __post_init__(self) -> None:
        _check_sides(f"region {self.name!r}", "a reach", self.depth_mm, self.reach_mm)

    @cached_property
    def _tree(self) -> KDTree:
        return KDTree(self.points)

    def depth(self, points: Array) -> Array:
        """(n,) mm at points (n, 3)."""
        return self.depth_mm * self.share(points)

    def share(self, points: Array) -> Array:
        """(n,) of its depth at points (n, 3): 1 on the region, 0 beyond its reach."""
        return compute_area_weight(self._tree.query(points)[0], self.reach_mm)

    def project_to(self, face: Surface) -> Zone:
        """Put its points on the drawn face (LPS); leave out those beyond the brim.

        Raises
        ------
        SurfaceError
            Where the whole region lies off the face.
        """
        feet, beside, off = _project_to_face(self.points, face)
        under = (beside <= MAX_BESIDE_MM) & (off <= MAX_OFF_FACE_MM)
        if not under.any():
            raise SurfaceError(
                f"region {self.name!r} lies off the socket's face",
                remedy="name a region below the brim, or move the trimline up",
            )
        return replace(self, points=feet[under])

    def compute_relative_distance(self, point: Array) -> float:
        """Distance of a point (3,) from the region over its reach."""
        return float(self._tree.query(point)[0] / self.reach_mm)


def _check_sides(name: str, width: str, depth_mm: float, reach_mm: float) -> None:
    least = MAX_SIDE_SLOPE * abs(depth_mm)
    if least > reach_mm:
        raise SurfaceError(
            f"the sides of {name} would be steeper than 45 degrees",
            remedy=f"give {width} of {least:.1f} mm or more, or less depth",
        )


def _project_to_face(points: Array, face: Surface) -> tuple[Array, Array, Array]:
    """Nearest points (n, 3) of a face, and how far (n,) points lie beside it and off it, mm."""
    _, near, feet = igl.point_mesh_squared_distance(points, face.points, face.faces)
    normals, apart = face.face_normals[near], points - feet
    off = np.einsum("ij,ij->i", apart, normals)
    return feet, np.linalg.norm(apart - off[:, None] * normals, axis=1), np.abs(off)
