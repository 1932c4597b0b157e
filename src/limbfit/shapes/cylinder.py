"""A round rod with a flat end and a rounded edge."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numba import njit

from .facets import Facets, revolved, steps
from .revolution import Revolution
from .shape import Array, Distance


@dataclass(frozen=True)
class Cylinder(Revolution):
    """A rod without a far end."""

    name: ClassVar[str] = "cylinder"
    words: ClassVar[str] = "cylindrical indenter"
    variants: ClassVar = {"cylinder": 0.0}

    @property
    def flat(self) -> float:
        """Radius of the flat part of its front, mm."""
        return self.width / 2 - self.radius

    def meridian(self, rho: Array, z: Array) -> Distance:
        """See `Revolution.meridian`."""
        return _rounded(rho, z, self.flat, self.radius)

    def facets(self) -> Facets:
        """A disk and its rounding."""
        points, faces = revolved(self.flat, self.flat + self.radius * steps(), self.outline)
        return Facets(points, faces, rounding=self.radius)

    def outline(self, length: Array) -> tuple[Array, Array]:
        """Radius and z (n,) at arc lengths (n,) from the axis, mm."""
        turned = np.maximum(length - self.flat, 0.0) / self.radius
        rho = np.minimum(length, self.flat) + self.radius * np.sin(turned)
        return rho, self.radius * (np.cos(turned) - 1.0)


@njit(cache=True)
def _rounded(rho, z, flat, radius):  # type: ignore[no-untyped-def]
    """A rod shrunk by its rounding, grown again."""
    n = len(rho)
    values, slopes, bends = np.empty(n), np.zeros((n, 2)), np.zeros((n, 3))
    for k in range(n):
        p, up = max(rho[k] - flat, 0.0), max(z[k] + radius, 0.0)
        r = np.sqrt(p * p + up * up)
        if r <= 1e-12 * (flat + radius):
            values[k], slopes[k, 1] = z[k], 1.0
            continue
        across, ahead = p / r, up / r
        values[k] = r - radius
        slopes[k] = across, ahead
        if rho[k] >= flat:
            bends[k, 0] = 1.0 / r
        if up > 0.0:
            bends[k, 2] = 1.0 / r
        bends[k, 0] -= across * across / r
        bends[k, 1] = -across * ahead / r
        bends[k, 2] -= ahead * ahead / r
    return values, slopes, bends
