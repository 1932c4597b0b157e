"""The shapes that limbfit knows: square, cylinder, sphere, and a closed triangle surface from a file."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Self

import numpy as np
from numba import njit

from ..errors import ProblemError
from .shape import (
    ARC,
    FLAT,
    STEEPEST_DEG,
    Array,
    Distance,
    Facets,
    Revolution,
    Shape,
    Size,
    build_quadrilaterals,
    revolved,
    steps,
)
from .triangles import Body, RigidSurface, compute_triangle_normals, surface_distance

SPHERE_STEEPEST_DEG = 75.0  # of a face; what is steeper touches no skin


@dataclass(frozen=True)
class Square(Shape):
    """A prism without a far end; ``width`` is its edge length."""

    name: ClassVar = "square"
    words: ClassVar = "square indenter"
    is_edge_doubted: ClassVar = True
    variants: ClassVar = {"square": 0.0, "square, rounded edge": 0.1}

    def distance(self, points: Array) -> Distance:
        return _compute_box_distances(points, self.width / 2, self.radius)

    def facets(self) -> Facets:
        """A flat square, rounded at edges and corners."""
        inner, radius = self.width / 2 - self.radius, self.radius
        angles = steps()
        flat = np.linspace(-inner, inner, 2 * FLAT + 1)
        base = np.concatenate([np.full(ARC, -inner), flat, np.full(ARC, inner)])
        slope = np.concatenate([-np.tan(angles[::-1]), np.zeros(len(flat)), np.tan(angles)])
        x, y = np.meshgrid(base, base, indexing="ij")
        a, b = np.meshgrid(slope, slope, indexing="ij")
        length = np.sqrt(a**2 + b**2 + 1.0)
        grid = np.stack([x + radius * a / length, y + radius * b / length, radius / length - radius], axis=-1)
        return Facets(
            grid.reshape(-1, 3), build_quadrilaterals(np.arange(x.size).reshape(x.shape)), rounding=radius
        )


@njit(cache=True)
def _compute_box_distances(points, half, radius):  # type: ignore[no-untyped-def]
    """A box shrunk by its rounding, grown again (Quilez' rounded box)."""
    n = len(points)
    values, slopes, bends = np.empty(n), np.zeros((n, 3)), np.zeros((n, 3, 3))
    inner = half - radius
    for k in range(n):
        x, gradient, hessian = points[k], slopes[k], bends[k]
        z = x[2] + radius
        p, q, up = max(abs(x[0]) - inner, 0.0), max(abs(x[1]) - inner, 0.0), max(z, 0.0)
        r = np.sqrt(p * p + q * q + up * up)
        if r <= 1e-12 * half:
            gradient[2] = 1.0
            values[k] = z - radius
            continue
        gradient[0], gradient[1], gradient[2] = np.sign(x[0]) * p / r, np.sign(x[1]) * q / r, up / r
        for i in range(3):
            active = (p if i == 0 else (q if i == 1 else up)) > 0.0
            for j in range(3):
                hessian[i, j] = ((1.0 if i == j and active else 0.0) - gradient[i] * gradient[j]) / r
        values[k] = r - radius
    return values, slopes, bends


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
        return _compute_rod_distances(rho, z, self.flat, self.radius)

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
def _compute_rod_distances(rho, z, flat, radius):  # type: ignore[no-untyped-def]
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


@dataclass(frozen=True)
class Sphere(Cylinder):
    """A sphere in front, a rod behind it."""

    name: ClassVar[str] = "sphere"
    words: ClassVar[str] = "spherical indenter"
    has_edge: ClassVar = False
    variants: ClassVar = {"sphere": 0.0}

    @classmethod
    def of(cls, size: Size) -> Self:
        """See `Shape.of`; it has no edge to round."""
        return replace(super().of(size), radius=size.width / 2)

    def facets(self) -> Facets:
        """A disk, bent."""
        points, faces = revolved(self.radius * np.radians(SPHERE_STEEPEST_DEG), np.zeros(0), self.outline)
        return Facets(points, faces, rounding=self.radius)


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
        if size.surface is None:
            raise ProblemError("an indenter of shape 'stl' needs a surface")
        cls.complete_measures(size.measures or {})
        radius, body = size.surface.round_edges(size.radius, size.edge_radius >= size.least_radius)
        return cls(size.width, radius, size.surface, body)

    @classmethod
    def describe(cls, settings: Mapping[str, Any]) -> str:
        """See `Shape.describe`; the width of the settings is not its own."""
        return f"{cls.words} (edge radius {settings.get('edge_radius_mm')} mm)"

    def distance(self, points: Array) -> Distance:
        return _compute_surface_distances(points, self.body, self.radius)

    def facets(self) -> Facets:
        """The surface as it is, its edges sharp."""
        used, faces = np.unique(self.surface.faces, return_inverse=True)
        points, faces = self.surface.points[used], faces.reshape(-1, 3)
        normals, _ = compute_triangle_normals(points[faces])
        front = faces[normals[:, 2] > np.cos(np.radians(STEEPEST_DEG))]
        if not len(front):
            raise ProblemError("no face of the indenter's surface looks along its axis")
        return Facets(points, front, rounding=0.0, closed=faces)

    @property
    def length(self) -> float:
        """From the foremost to the hindmost point, mm."""
        return -float(self.surface.points[:, 2].min())


@njit(cache=True)
def _compute_surface_distances(points, body, radius):  # type: ignore[no-untyped-def]
    n = len(points)
    values, slopes, bends = np.empty(n), np.empty((n, 3)), np.empty((n, 3, 3))
    for k in range(n):
        values[k] = surface_distance(body, radius, points[k], slopes[k], bends[k])
    return values, slopes, bends
