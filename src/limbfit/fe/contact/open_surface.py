"""An open rigid surface that is met from one side: a socket, whose inside the limb touches.

Its triangles run counter-clockwise seen from the tissue.  The distance is that to the closest point, positive
on the tissue's side.  Points beyond the brim, or farther away than the surface's reach, are free.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numba import njit
from numpy.typing import NDArray

from ...errors import ProblemError
from ...shapes.triangles import (
    INSIDE,
    Tree,
    build_tree,
    closest_point,
    compute_normal_spread,
    compute_triangle_normals,
    curvature,
    feature_normal,
    find_neighbours,
)
from .wall import Wall, check_open_surface

Array = NDArray[np.float64]
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

    @property
    def grows(self) -> bool:
        return False

    def grown(self, share: float) -> OpenSurface:
        return self

    def near(self, points: Array) -> NDArray[np.bool_]:
        """Which points (n, 3) of its frame it may touch."""
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
