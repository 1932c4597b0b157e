"""Where a rigid body is: moved and turned by six coordinates, with derivatives.

With the pivot ``p``, the translation ``d`` and the rotation ``R`` of the vector ``w``, a point ``x`` of space
is at ``z = R^T (x - p - d)`` of the body, about its pivot.  What a coordinate does to the body's points is
told as a *lever*: the relative displacement ``dr = dx + L dq`` of a point against the body, in space.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import expm

from .rigid import RigidShape

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Pose:
    """A body that started as ``start`` and is moved by ``coordinates (6,)``: mm along the axes of its frame,
    and the rotation vector in its frame, rad, about the ``pivot (3,)``."""

    start: RigidShape
    pivot: Array
    coordinates: Array

    @property
    def turned(self) -> bool:
        return bool(self.coordinates[3:].any())

    @cached_property
    def rotation(self) -> Array:
        """R (3, 3)."""
        return np.asarray(expm(self._spin(self.coordinates[3:]))) if self.turned else np.eye(3)

    @cached_property
    def slopes(self) -> Array:
        """Derivatives (3, 3, 3) of R with respect to the three components of the rotation vector."""
        return np.array([self._derivative(unit) for unit in np.eye(3)])

    @cached_property
    def bends(self) -> Array:
        """Second derivatives (3, 3, 3, 3) of R."""
        return np.array([[self._derivative(a, b) for b in np.eye(3)] for a in np.eye(3)])

    def _spin(self, vector: Array) -> Array:
        """The skew matrix of a rotation vector in the body's frame."""
        x, y, z = vector @ self.start.frame
        return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])

    def _derivative(self, *directions: Array) -> Array:
        """Derivative of the exponential along one or two directions, from that of one block matrix.

        The upper right block of ``exp [[W, E], [0, W]]`` is the derivative along E; once more for the second
        (Najfeld and Havel 1995).
        """
        if not self.turned:  # the series of the exponential at nothing, without an exponential
            first, *others = (self._spin(direction) for direction in directions)
            return first if not others else 0.5 * (first @ others[0] + others[0] @ first)
        matrix = self._spin(self.coordinates[3:])
        for direction in directions:
            n = len(matrix)
            along = np.kron(np.eye(n // 3), self._spin(direction))
            matrix = np.block([[matrix, along], [np.zeros((n, n)), matrix]])
        return np.asarray(expm(matrix)[:3, -3:])

    @cached_property
    def body(self) -> RigidShape:
        """The body where it is."""
        frame, centre = self.start.frame, np.asarray(self.start.centre, dtype=float)
        shift = self.coordinates[:3] @ frame
        if not self.turned:
            return self.start.placed(centre + shift, frame[2], frame[0])
        axes = frame @ self.rotation.T
        place = self.pivot + shift + self.rotation @ (centre - self.pivot)
        return self.start.placed(place, axes[2], axes[0])

    def levers(self, points: Array, wanted: NDArray[np.intp]) -> Array:
        """(c, 3, k): relative displacement of points (c, 3) per unit of the ``wanted (k,)`` coordinates."""
        out = np.empty((len(points), 3, len(wanted)))
        for column, i in enumerate(wanted):
            out[:, :, column] = self._turn_lever(points, i - 3) if i > 2 else -self.start.frame[i]
        return out

    def _turn_lever(self, points: Array, k: int) -> Array:
        return np.asarray(self._from_pivot(points) @ self.slopes[k] @ self.rotation.T)

    def _from_pivot(self, points: Array) -> Array:
        return np.asarray(points - self.pivot - self.coordinates[:3] @ self.start.frame)

    def turning(self, forces: Array, wanted: NDArray[np.intp]) -> Array:
        """(c, 3, k): change of the forces (c, 3), which turn with the body, per unit of the coordinates."""
        out = np.zeros((len(forces), 3, len(wanted)))
        for column, i in enumerate(wanted):
            if i > 2:
                out[:, :, column] = forces @ self.rotation @ self.slopes[i - 3].T
        return out

    def bending(self, points: Array, forces: Array, wanted: NDArray[np.intp]) -> Array:
        """(k, k): second derivative of the energy through the rotation's own curvature, for the energy's
        derivatives ``forces (c, 3)`` with respect to the points (c, 3)."""
        moments = self._from_pivot(points).T @ forces
        out = np.zeros((len(wanted), len(wanted)))
        for a, i in enumerate(wanted):
            for b, j in enumerate(wanted):
                if i > 2 and j > 2:
                    out[a, b] = np.sum(moments * (self.bends[i - 3, j - 3] @ self.rotation.T))
        return out
