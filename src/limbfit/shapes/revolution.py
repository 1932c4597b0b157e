"""Bodies of revolution about the indenter's axis, given by their distance in the half plane."""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numba import njit

from .shape import Array, Distance, Shape


@dataclass(frozen=True)
class Revolution(Shape):
    """A round shape, which says no more of its distance than `meridian`; ``width`` is its diameter."""

    is_round: ClassVar = True

    @abstractmethod
    def meridian(self, rho: Array, z: Array) -> Distance:
        """Distance (n,) at radius and z, mm, its slopes (n, 2) along them, and its second derivatives (n, 3):
        along radius twice, along radius and z, along z twice."""

    def distance(self, points: Array) -> Distance:
        """See `Shape.distance`."""
        rho = np.hypot(points[:, 0], points[:, 1])
        values, slopes, bends = self.meridian(rho, points[:, 2])
        return values, *_turned(points, rho, slopes, bends)


@njit(cache=True)
def _turned(points, rho, slopes, bends):  # type: ignore[no-untyped-def]
    """Gradients and hessians in space; on the axis, where nothing depends on the direction, by symmetry."""
    n = len(points)
    gradients, hessians = np.empty((n, 3)), np.empty((n, 3, 3))
    for k in range(n):
        c, s, around = 0.0, 0.0, bends[k, 0]
        if rho[k] > 1e-12:
            c, s, around = points[k, 0] / rho[k], points[k, 1] / rho[k], slopes[k, 0] / rho[k]
        along = bends[k, 0] - around
        gradients[k] = c * slopes[k, 0], s * slopes[k, 0], slopes[k, 1]
        hessians[k, 0] = around + c * c * along, c * s * along, c * bends[k, 1]
        hessians[k, 1] = c * s * along, around + s * s * along, s * bends[k, 1]
        hessians[k, 2] = c * bends[k, 1], s * bends[k, 1], bends[k, 2]
    return gradients, hessians
