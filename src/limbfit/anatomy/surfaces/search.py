"""Nearest points and signed distances of a triangle surface, whose trees are built once for all queries."""

from __future__ import annotations

from functools import cached_property

import igl
import numpy as np
from numpy.typing import ArrayLike, NDArray

from ...arrays import Array

Ints = NDArray[np.int64]


class SurfaceSearch:
    """The trees of a surface: ``points`` (n, 3) mm and ``faces`` (m, 3), which must not change any more."""

    def __init__(self, points: Array, faces: Ints) -> None:
        self._surface = np.ascontiguousarray(points), np.ascontiguousarray(faces)

    def nearest(self, points: ArrayLike) -> tuple[Array, Ints, Array]:
        """Squared distance (k,) of points (k, 3), mm^2, the nearest face (k,), and where on it (k, 3)."""
        query = _to_query(points)
        if not len(query):
            return np.zeros(0), np.zeros(0, dtype=np.int64), np.zeros((0, 3))
        squared, face, foot = self._boxes.squared_distance(*self._surface, query)
        return squared, face, foot

    def signed(self, points: ArrayLike) -> tuple[Array, Ints, Array]:
        """As `nearest`, with the distance (k,) to a closed outward surface, mm, negative inside.

        Inside is where the fast winding number says so (Barill et al. 2018, ACM Trans Graph 37, 43), which
        small holes and crossing faces do not mislead.
        """
        squared, face, foot = self.nearest(points)
        if not len(face):
            return squared, face, foot
        inside = self._windings.winding_number(_to_query(points)) > 0.5
        return np.where(inside, -1.0, 1.0) * np.sqrt(squared), face, foot

    @cached_property
    def _boxes(self) -> igl.AABB:
        tree = igl.AABB()
        tree.init(*self._surface)
        return tree

    @cached_property
    def _windings(self) -> igl.FastWindingNumberBVH:
        tree = igl.FastWindingNumberBVH()
        tree.init(*self._surface)
        return tree


def _to_query(points: ArrayLike) -> Array:
    return np.ascontiguousarray(points, dtype=np.float64).reshape(-1, 3)
