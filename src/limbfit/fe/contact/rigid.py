"""What contact asks of a rigid shape."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


class RigidShape(Protocol):
    """A rigid shape with a frame of its own, in which it is asked for distances; mm."""

    @property
    def centre(self) -> Sequence[float] | Array:
        """(3,) the origin of its frame."""

    @property
    def frame(self) -> Array:
        """(3, 3) orthonormal rows: the axes of its frame, the last into the tissue."""

    @property
    def width(self) -> float:
        """Its extent across the axis."""

    @property
    def length(self) -> float:
        """Its extent along the axis."""

    def near(self, points: Array) -> NDArray[np.bool_]:
        """Which points (n, 3) of its frame it may touch; the distance of others is not looked for."""

    def local_distance(self, points: Array) -> tuple[Array, Array, Array]:
        """Distance (...), gradient (..., 3) and hessian (..., 3, 3) at points (..., 3) of its frame."""

    def signed_distance(self, points: Array) -> Array:
        """Distance (n,) of points (n, 3) of space; negative inside."""

    def moved(self, distance: float, across: Sequence[float] = (0.0, 0.0)) -> RigidShape:
        """The shape, advanced along its axis by ``distance`` and ``across`` it."""

    @property
    def grows(self) -> bool:
        """Whether it has other forms than its final one."""

    def grown(self, share: float) -> RigidShape:
        """The shape as it is when it has grown so far, 1: its final one."""

    def placed(self, centre: Array, axis: Array, edge: Array) -> RigidShape:
        """The shape with another frame."""
