"""The contract of an indenter's shape: its distance, facets, section and words; and the shapes that limbfit
knows: square, cylinder, sphere, and a closed triangle surface from a file.

Facets are the front of an indenter: grids of quadrilaterals, disks, bodies of revolution.

The frame of a shape: origin at the middle of its foremost face, z along the axis into the tissue, x along the
edge; the body lies at ``z <= 0``.
"""

import math
import warnings
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Self

import numpy as np
from numba import njit

from ..arrays import Array, Indices
from ..errors import ProblemError
from .triangles import Body, RigidSurface, compute_triangle_normals, surface_distance

Distance = tuple[Array, Array, Array]

# No mesh resolves the singularity of a sharp edge; this rounding over the width stands for it.
SHARP_EDGE = 0.01
STEEPEST_DEG = 68.0  # of a face: the skin under a punch does not reach what is steeper
FLAT, ARC, RINGS = 8, 4, 6  # divisions of half a face, of its rounding, and around the middle of a disk
SPHERE_STEEPEST_DEG = 75.0  # of a face; what is steeper touches no skin


@dataclass(frozen=True)
class Facets:
    """The front of an indenter in its frame, outward, without the side walls.

    Parameters
    ----------
    points : (n, 3) mm.
    front : (f, 4) faces, which are grown backwards into a solid; (f, 3) with ``closed`` faces.
    rounding : radius of the roundest edge that the facets stand for, mm; 0 where edges are sharp.
    closed : (m, 3) the whole surface, where that is what the shape is.
    """

    points: Array
    front: Indices
    rounding: float
    closed: Indices | None = None


def steps(steepest_deg: float = STEEPEST_DEG) -> Array:
    """Angles (k,) along a rounded edge, from its start to its steepest face, rad."""
    return np.linspace(0.0, np.radians(steepest_deg), ARC + 1)[1:]


def build_quadrilaterals(number: Indices) -> Indices:
    """Indices (f, 4) of a grid (k, l) of node numbers, counter-clockwise where the axes are."""
    corners = number[:-1, :-1], number[1:, :-1], number[1:, 1:], number[:-1, 1:]
    return np.stack(corners, axis=-1).reshape(-1, 4)


def revolved(
    disk: float, beyond: Array, outline: Callable[[Array], tuple[Array, Array]]
) -> tuple[Array, Indices]:
    """Points (n, 3) and faces (f, 4) of the front of a body of revolution.

    Parameters
    ----------
    disk : arc length from the axis, mm, up to which the front is a disk without a kink.
    beyond : (k,) arc lengths of the circles around it.
    outline : radius and z, mm, at arc lengths from the axis.
    """
    plane, faces = _build_disk(disk, beyond)
    length = np.linalg.norm(plane, axis=1)
    rho, z = outline(length)
    direction = plane / np.maximum(length, 1e-300)[:, None]
    return np.column_stack([rho[:, None] * direction, z]), faces


def _build_disk(radius: float, beyond: Array) -> tuple[Array, Indices]:
    """Points (n, 2) and faces (f, 4) of a disk and of circles ``beyond`` it: a grid, rings around it."""
    side = np.linspace(-1.0, 1.0, 2 * FLAT + 1)
    square = np.stack(np.meshgrid(side, side, indexing="ij"), axis=-1)
    size = np.abs(square).max(axis=-1, keepdims=True)
    circle = size * square / np.maximum(np.linalg.norm(square, axis=-1, keepdims=True), 1e-300)
    core = 0.5 * radius * (0.6 * square + 0.4 * circle)
    number = np.arange(len(side) ** 2).reshape(len(side), -1)
    around = np.concatenate([number[:-1, 0], number[-1, :-1], number[:0:-1, -1], number[0, :0:-1]])
    rim = core.reshape(-1, 2)[around]
    angle = -0.75 * np.pi + 2.0 * np.pi * np.arange(len(around)) / len(around)
    unit = np.column_stack([np.cos(angle), np.sin(angle)])
    shares = np.arange(1, RINGS + 1)[:, None, None] / RINGS
    rings = np.concatenate([(1.0 - shares) * rim + shares * radius * unit, beyond[:, None, None] * unit])
    numbers = np.vstack(
        [around, number.size + np.arange(rings.shape[0] * len(around)).reshape(len(rings), -1)]
    )
    outside = build_quadrilaterals(np.hstack([numbers, numbers[:, :1]]))
    points = np.concatenate([core.reshape(-1, 2), rings.reshape(-1, 2)])
    return points, np.vstack([build_quadrilaterals(number), outside])


@dataclass(frozen=True)
class Measure:
    """A number that a shape has beside its width and the rounding of its edges.

    Parameters
    ----------
    key : its name with its unit, such as ``taper_deg``: a field of the shape and a key of a study's
        ``[indenter]``.
    value, lower, upper : its value by default, and its bounds.
    words : what reports call it.
    """

    key: str
    value: float
    lower: float
    upper: float
    words: str = ""


@dataclass(frozen=True)
class Size:
    """The size of a shape: ``width`` and ``edge_radius`` in mm, its measures by key, its surface, and
    the rounding over the width that stands for a ``sharp`` edge."""

    width: float
    edge_radius: float = 0.0
    measures: Mapping[str, float] | None = None
    surface: RigidSurface | None = None
    sharp: float = SHARP_EDGE

    def __post_init__(self) -> None:
        if not (math.isfinite(self.width) and self.width > 0):
            raise ProblemError(f"indenter width {self.width} mm is not positive")
        if not 0 < self.sharp <= SHARP_EDGE:
            raise ProblemError(
                f"a sharp edge of {self.sharp} of the width is not above 0 and up to {SHARP_EDGE}"
            )
        if not 0 <= self.edge_radius <= self.width / 2:
            raise ProblemError(f"edge radius {self.edge_radius} mm does not fit a width of {self.width} mm")

    @property
    def least_radius(self) -> float:
        """The rounding of an edge that is called sharp, mm."""
        return self.sharp * self.width

    @property
    def radius(self) -> float:
        """The rounding that edges get, mm."""
        return max(self.edge_radius, self.least_radius)


@dataclass(frozen=True)
class Shape(ABC):
    """A body of one size; its class is what `limbfit.register_shape` takes.

    Fields beyond the two below are the shape's measures (`Measure`), by their keys.

    Parameters
    ----------
    width : edge length or diameter, mm, rounding included.
    radius : rounding of its edges, mm.
    """

    width: float
    radius: float

    name: ClassVar[str]  # what a study says in ``indenter.shape``
    words: ClassVar[str]  # what it is called in prose, such as "square indenter"
    measures: ClassVar[tuple[Measure, ...]] = ()
    has_edge: ClassVar[bool] = True  # an edge radius can be given
    is_edge_doubted: ClassVar[bool] = False  # how round the edges are is a source of uncertainty
    is_round: ClassVar[bool] = False  # a turn about the axis changes nothing
    needs_file: ClassVar[bool] = False  # its surface is a file
    variants: ClassVar[Mapping[str, float]] = {}  # edge radius over width of those that studies compare with

    @classmethod
    def of(cls, size: Size) -> Self:
        """The shape of a size. Raises `ProblemError` where it cannot be of that size."""
        if size.surface is not None:
            raise ProblemError(f"an indenter of shape {cls.name!r} has no surface")
        return cls(size.width, size.radius, **cls.complete_measures(size.measures or {}))

    @classmethod
    def complete_measures(cls, given: Mapping[str, float]) -> dict[str, float]:
        """Return its measures by key, with the usual value of each that is not given. Raises `ProblemError`
        for one that it does not have, or beyond its bounds.
        """
        unknown = sorted(given.keys() - {measure.key for measure in cls.measures})
        if unknown:
            known = ", ".join(measure.key for measure in cls.measures) or "none"
            raise ProblemError(
                f"an indenter of shape {cls.name!r} has no {unknown[0]}", remedy=f"its own measures: {known}"
            )
        values = {measure.key: float(given.get(measure.key, measure.value)) for measure in cls.measures}
        for measure in cls.measures:
            if not measure.lower <= values[measure.key] <= measure.upper:
                raise ProblemError(
                    f"{measure.key} = {values[measure.key]:g} of an indenter of shape {cls.name!r} is not "
                    f"between {measure.lower:g} and {measure.upper:g}"
                )
        return values

    @classmethod
    def describe(cls, settings: Mapping[str, Any]) -> str:
        """The ``[indenter]`` of a study in words."""
        edge = f"edge radius {settings.get('edge_radius_mm')} mm"
        own = [f"{measure.words or measure.key} {settings.get(measure.key)}" for measure in cls.measures]
        inside = ", ".join([edge] * cls.has_edge + own)
        return f"{cls.words} of {settings.get('width_mm')} mm" + (f" ({inside})" if inside else "")

    @classmethod
    def said(cls, settings: Mapping[str, Any]) -> str:
        """The former name of `describe`."""
        warnings.warn("Shape.said is now called describe", FutureWarning, stacklevel=2)
        return cls.describe(settings)

    @abstractmethod
    def distance(self, points: Array) -> Distance:
        """Signed distance (n,), mm, gradient (n, 3) and hessian (n, 3, 3) at points (n, 3) of its frame.

        Negative inside.  Deeper than the rounding the way out should be through the foremost face: a point
        that a large step left inside must go back to where it came from, not sideways.
        """

    @abstractmethod
    def facets(self) -> Facets:
        """Its front, or all of it, as a mesh: what other programs are given."""

    @property
    def reach(self) -> float:
        """Largest distance from the axis, along x or y, at which tissue may touch it, mm."""
        return 0.9 * self.width

    @property
    def length(self) -> float:
        """From the foremost point to the far end, mm; the width for shapes without one."""
        return self.width

    @property
    def section(self) -> float:
        """Area of the section that pushes, mm^2."""
        return np.pi / 4.0 * self.width**2 if self.is_round else self.width**2


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
        return values, *_rotate_about_axis(points, rho, slopes, bends)


@njit(cache=True)
def _rotate_about_axis(points, rho, slopes, bends):  # type: ignore[no-untyped-def]
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
