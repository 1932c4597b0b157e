"""A rigid surface of triangles that is met from one side: what all of its kinds have in common."""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass
from functools import cached_property
from typing import Self

import numpy as np
from numpy.typing import NDArray

from ...errors import ProblemError
from ...shapes.triangles import check_triangles

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Wall:
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
    def frame(self) -> Array:
        """(3, 3) orthonormal rows: edge, axis x edge, axis."""
        axis = np.asarray(self.axis, dtype=float) / np.linalg.norm(self.axis)
        edge = np.asarray(self.edge, dtype=float)
        edge = edge - (edge @ axis) * axis
        edge = edge / np.linalg.norm(edge)
        return np.array([edge, np.cross(axis, edge), axis])

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
        """The same surface with another frame; what was derived from its triangles is kept."""
        other = copy(self)
        other.__dict__.pop("frame", None)
        other.__dict__.update(centre=centre, axis=axis, edge=edge)
        return other

    def moved(self, distance: float, across: Sequence[float] = (0.0, 0.0)) -> Self:
        """The surface, advanced along its axis by ``distance`` mm and ``across`` it along x and y."""
        move = np.array([*across, distance]) @ self.frame
        return self.placed(np.asarray(self.centre, dtype=float) + move, *self.frame[[2, 0]])

    def signed_distance(self, points: Array) -> Array:
        """Distance (n,) of points (n, 3), mm; negative behind the surface, infinite where it is not felt."""
        local = (np.asarray(points, dtype=float) - np.asarray(self.centre, dtype=float)) @ self.frame.T
        return self.local_distance(local)[0]

    def local_distance(self, points: Array) -> tuple[Array, Array, Array]:
        """Distance (...), mm, gradient (..., 3) and hessian (..., 3, 3) at points (..., 3) of its frame."""
        shape = points.shape[:-1]
        values, slopes, bends = self._distances(np.ascontiguousarray(points, dtype=float).reshape(-1, 3))
        return values.reshape(shape), slopes.reshape(*shape, 3), bends.reshape(*shape, 3, 3)

    def _distances(self, x: Array) -> tuple[Array, Array, Array]:
        """`local_distance` of points (n, 3)."""
        raise NotImplementedError


def check_open_surface(points: Array, faces: NDArray, name: str) -> tuple[Array, NDArray[np.int64]]:
    """The arrays of a surface with one side.

    Raises
    ------
    ProblemError
        Where it is no triangle surface, or its triangles do not agree on a side.
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
