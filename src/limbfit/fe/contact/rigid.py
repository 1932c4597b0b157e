"""What every rigid shape is: a frame, an extent, and the signed distance with two derivatives."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from functools import cached_property
from typing import Self

import numpy as np
from numpy.typing import NDArray

from ...arrays import Array


class RigidShape(ABC):
    """A rigid shape with a frame of its own, in which it is asked for distances; mm."""

    @property
    @abstractmethod
    def centre(self) -> Sequence[float] | Array:
        """(3,) the origin of the frame."""

    @property
    @abstractmethod
    def axis(self) -> Sequence[float] | Array:
        """(3,) the last axis of the frame, of any length; it points into the tissue."""

    @property
    @abstractmethod
    def edge(self) -> Sequence[float] | Array | None:
        """(3,) a direction in the plane of the frame's first and last axis."""

    @property
    @abstractmethod
    def width(self) -> float:
        """The extent across the axis."""

    @property
    @abstractmethod
    def length(self) -> float:
        """The extent along the axis."""

    @cached_property
    def frame(self) -> Array:
        """(3, 3) orthonormal rows: edge, axis x edge, axis."""
        axis = np.asarray(self.axis, dtype=float) / np.linalg.norm(self.axis)
        edge = self._edge_direction()
        edge = edge - (edge @ axis) * axis
        edge = edge / np.linalg.norm(edge)
        return np.array([edge, np.cross(axis, edge), axis])

    def _edge_direction(self) -> Array:
        return np.asarray(self.edge, dtype=float)

    @abstractmethod
    def placed(self, centre: Array, axis: Array, edge: Array) -> Self:
        """The shape with another frame."""

    def moved(self, distance: float, across: Sequence[float] = (0.0, 0.0)) -> Self:
        """The shape, advanced along its axis by ``distance`` mm and ``across`` it along x and y."""
        move = np.array([*across, distance]) @ self.frame
        return self.placed(np.asarray(self.centre, dtype=float) + move, *self.frame[[2, 0]])

    @abstractmethod
    def near(self, points: Array) -> NDArray[np.bool_]:
        """Which points (n, 3) of its frame it may touch; the distance of others is not computed."""

    @abstractmethod
    def _distances(self, x: Array) -> tuple[Array, Array, Array]:
        """`local_distance` of points (n, 3)."""

    def local_distance(self, points: Array) -> tuple[Array, Array, Array]:
        """Distance (...), mm, gradient (..., 3) and hessian (..., 3, 3) at points (..., 3) of its frame."""
        shape = points.shape[:-1]
        values, slopes, bends = self._distances(np.ascontiguousarray(points, dtype=float).reshape(-1, 3))
        return values.reshape(shape), slopes.reshape(*shape, 3), bends.reshape(*shape, 3, 3)

    def signed_distance(self, points: Array) -> Array:
        """Distance (n,) of points (n, 3) of space, mm; negative inside or behind, infinite beyond reach."""
        local = (np.asarray(points, dtype=float) - np.asarray(self.centre, dtype=float)) @ self.frame.T
        return self.local_distance(local)[0]

    @property
    def grows(self) -> bool:
        """True if it has other forms than its final one."""
        return False

    def grown(self, share: float) -> Self:
        """The shape when it has grown so far; 1 is its final form."""
        return self
