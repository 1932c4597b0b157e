"""A closed triangle surface of your own."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Self

import numpy as np
from numba import njit

from ..errors import ProblemError
from .facets import STEEPEST_DEG, Facets
from .rigid_surface import Body, RigidSurface, surface_distance
from .shape import Array, Distance, Shape, Size


@dataclass(frozen=True)
class Stl(Shape):
    """The body that a surface encloses; its width is measured, and its edges are rounded by as much as its
    details allow."""

    surface: RigidSurface
    body: Body

    name: ClassVar = "stl"
    words: ClassVar = "indenter with a surface of its own"
    needs_file: ClassVar = True

    @classmethod
    def of(cls, size: Size) -> Self:
        """See `Shape.of`."""
        if size.surface is None:
            raise ProblemError("an indenter of shape 'stl' needs a surface")
        cls.measured(size.measures or {})
        radius, body = size.surface.rounded(size.radius, size.edge_radius >= size.least_radius)
        return cls(size.width, radius, size.surface, body)

    @classmethod
    def said(cls, settings: Mapping[str, Any]) -> str:
        """See `Shape.said`; the width of the settings is not its own."""
        return f"{cls.words} (edge radius {settings.get('edge_radius_mm')} mm)"

    def distance(self, points: Array) -> Distance:
        """See `Shape.distance`."""
        return _distances(points, self.body, self.radius)

    def facets(self) -> Facets:
        """The surface as it is, its edges sharp."""
        used, faces = np.unique(self.surface.faces, return_inverse=True)
        points, faces = self.surface.points[used], faces.reshape(-1, 3)
        a, b, c = (points[faces[:, i]] for i in range(3))
        normals = np.cross(b - a, c - a)
        steep = np.cos(np.radians(STEEPEST_DEG))
        front = faces[normals[:, 2] > steep * np.linalg.norm(normals, axis=1)]
        if not len(front):
            raise ProblemError("no face of the indenter's surface looks along its axis")
        return Facets(points, front, rounding=0.0, closed=faces)

    @property
    def length(self) -> float:
        """From the foremost to the hindmost point, mm."""
        return -float(self.surface.points[:, 2].min())


@njit(cache=True)
def _distances(points, body, radius):  # type: ignore[no-untyped-def]
    n = len(points)
    values, slopes, bends = np.empty(n), np.empty((n, 3)), np.empty((n, 3, 3))
    for k in range(n):
        values[k] = surface_distance(body, radius, points[k], slopes[k], bends[k])
    return values, slopes, bends
