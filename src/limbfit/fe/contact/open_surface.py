"""An open rigid surface that is met from one side: a socket, whose inside the limb touches.

Its triangles run counter-clockwise seen from the tissue.  The distance is that to the closest point, positive
on the tissue's side.  Points beyond the brim, or farther away than the surface's reach, are free.
"""

from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass
from functools import cached_property
from typing import Self

import numpy as np
from numba import njit
from numpy.typing import NDArray

from ...arrays import Array
from ...errors import ProblemError
from ...shapes.triangles import (
    INSIDE,
    Tree,
    build_tree,
    check_triangles,
    closest_point,
    compute_normal_spread,
    compute_triangle_normals,
    curvature,
    feature_normal,
    find_neighbours,
)
from .rigid import RigidShape


@dataclass(frozen=True, eq=False)
class Wall(RigidShape):
    """Triangles in a frame of their own.

    Parameters
    ----------
    points : (n, 3) mm, in the body's frame.
    faces : (m, 3) corners, counter-clockwise seen from the tissue.
    centre : (3,) the origin of the body's frame, mm.
    axis, edge : (3,) third and first axis of the frame; an advance moves along ``axis``.
    """

    points: Array
    faces: NDArray[np.int64]
    centre: Sequence[float] | Array = (0.0, 0.0, 0.0)
    axis: Sequence[float] | Array = (0.0, 0.0, 1.0)
    edge: Sequence[float] | Array = (1.0, 0.0, 0.0)

    @cached_property
    def _extent(self) -> Array:
        return np.asarray(np.ptp(self.points[np.unique(self.faces)], axis=0))

    @property
    def width(self) -> float:
        """Its largest extent across the axis, mm."""
        return float(self._extent[:2].max())

    @property
    def length(self) -> float:
        """Its extent along the axis, mm."""
        return float(self._extent[2])

    def placed(self, centre: Array, axis: Array, edge: Array) -> Self:
        """The surface with another frame; what was derived from its triangles is kept."""
        other = copy(self)
        other.__dict__.pop("frame", None)
        other.__dict__.update(centre=centre, axis=axis, edge=edge)
        return other


def check_open_surface(points: Array, faces: NDArray, name: str) -> tuple[Array, NDArray[np.int64]]:
    """The arrays of a surface with one side. Raises `ProblemError` where it is no triangle surface, or its
    triangles do not agree on a side.
    """
    points, faces = np.asarray(points, dtype=float), np.asarray(faces)
    check_triangles(points, faces, name)
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    if len(np.unique(edges, axis=0)) < len(edges):
        raise ProblemError(
            f"the triangles of {name} do not agree on a side, or more than two meet at an edge",
            remedy="orient them alike, counter-clockwise seen from the tissue",
        )
    return points, faces.astype(np.int64)


# What lies beyond the brim by less than this share of the triangle beside it is still met.
BEYOND = 0.02
Facets = tuple[Array, Array, Array, Array, NDArray[np.bool_], Tree]


@dataclass(frozen=True, eq=False)
class OpenSurface(Wall):
    """An open surface as a rigid body; see the module docstring, and `Wall`.

    Parameters
    ----------
    points, faces, centre, axis, edge : as in `Wall`.
    reach : distance from which the surface is not felt, mm.

    Raises
    ------
    ProblemError
        Where it is no triangle surface, or its triangles do not agree on a side.
    """

    reach: float = 20.0

    def __post_init__(self) -> None:
        points, faces = check_open_surface(self.points, self.faces, "the open surface")
        if not self.reach > 0.0:
            raise ProblemError(f"a reach of {self.reach} mm is not positive")
        object.__setattr__(self, "points", points)
        object.__setattr__(self, "faces", faces)
        _ = self._box, self._facets  # derived once, and kept where the surface is placed anew

    @cached_property
    def _box(self) -> tuple[Array, Array]:
        used = self.points[np.unique(self.faces)]
        return used.min(axis=0) - self.reach, used.max(axis=0) + self.reach

    @cached_property
    def _facets(self) -> Facets:
        corners = np.ascontiguousarray(self.points[self.faces])
        normals = compute_triangle_normals(corners)[0]
        sums = compute_normal_spread(self.points, self.faces, normals)[1]
        beyond = find_neighbours(self.faces)
        edges = normals[:, None] + np.where(beyond[..., None] >= 0, normals[beyond], 0.0)
        tree = build_tree(corners, np.arange(len(corners)))
        return corners, normals, edges, sums[self.faces], _find_brim(self.faces, beyond < 0), tree

    def near(self, points: Array) -> NDArray[np.bool_]:
        low, high = self._box
        return np.asarray(((points >= low) & (points <= high)).all(axis=1))

    def _distances(self, x: Array) -> tuple[Array, Array, Array]:
        return compute_wall_distances(x, self._facets, self.reach)


def _find_brim(faces: NDArray[np.int64], open_edges: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """(m, 6) which edges and corners of each triangle are part of the brim."""
    ends = np.concatenate([faces[open_edges], np.roll(faces, -1, axis=1)[open_edges]])
    return np.concatenate([open_edges, np.isin(faces, ends)], axis=1)


@njit(cache=True)
def _wall_distance(wall, reach, x, gradient, hessian):  # type: ignore[no-untyped-def]
    """Distance of ``x (3,)`` from the surface; fills its gradient (3,) and hessian (3, 3)."""
    corners, normals, edge_normals, sums, brim, tree = wall
    point, outward, axis = np.empty(3), np.empty(3), np.zeros(3)
    gradient[:], hessian[:, :] = 0.0, 0.0
    face, feature, squared = closest_point(corners, tree, x, point)
    if squared > reach * reach:
        return np.inf
    side = size = 0.0
    for i in range(3):
        side += (x[i] - point[i]) * normals[face, i]
        size += (corners[face, 1, i] - corners[face, 0, i]) ** 2
    gradient[:] = normals[face]
    if feature == INSIDE:
        return side
    if brim[face, feature - 1]:
        # Beside a plane of symmetry the brim is met; beyond it, nothing is.
        return side if squared - side * side <= BEYOND * BEYOND * size else np.inf
    feature_normal(normals, edge_normals, sums, face, feature, outward)
    along = length = 0.0
    for i in range(3):
        along += (x[i] - point[i]) * outward[i]
        length += outward[i] * outward[i]
    d = np.sqrt(squared)
    if d <= 1e-9 * np.sqrt(size):
        for i in range(3):
            gradient[i] = outward[i] / np.sqrt(length)
        return 0.0
    sign = 1.0 if along >= 0.0 else -1.0
    for i in range(3):
        gradient[i] = sign * (x[i] - point[i]) / d
    curvature(corners, face, feature, axis, gradient, sign / d, hessian)
    return sign * d


@njit(cache=True)
def compute_wall_distances(points, wall, reach):  # type: ignore[no-untyped-def]
    """`_wall_distance` of many points (n, 3) with its derivatives."""
    n = len(points)
    values, slopes, bends = np.empty(n), np.empty((n, 3)), np.empty((n, 3, 3))
    for i in range(n):
        values[i] = _wall_distance(wall, reach, points[i], slopes[i], bends[i])
    return values, slopes, bends
