"""Rigid shapes: what they all are, a frame, an extent, and the signed distance with two derivatives.

An open surface is met from one side: a socket, whose inside the limb touches.  Its triangles run
counter-clockwise seen from the tissue.  The distance is that to the closest point, positive on the tissue's
side.  Points beyond the brim, or farther away than the surface's reach, are free.

The indenter's frame: origin at the middle of its foremost face (``centre``), coordinates ``(x, y, z)`` along
``edge``, ``axis x edge`` and ``axis``; the body lies at ``z <= 0``.
"""

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from copy import copy
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Self

import numpy as np
from numba import njit
from numpy.typing import NDArray

from ...arrays import Array, Indices, Mask
from ...errors import ProblemError
from ...shapes import SHAPES, SHARP_EDGE, RigidSurface, Shape, Size
from ...shapes.triangles import (
    INSIDE,
    Tree,
    build_tree,
    check_triangles,
    closest_point,
    compute_normal_spread,
    compute_triangle_normals,
    curvature,
    feature_normal,
    find_neighbours,
)

# What lies beyond the brim by less than this share of the triangle beside it is still met.
BEYOND = 0.02
Facets = tuple[Array, Array, Array, Array, Mask, Tree]


class RigidShape(ABC):
    """A rigid shape with a frame of its own, in which it is asked for distances; mm.

    ``centre``: (3,) the origin of the frame. ``axis``: (3,) its last axis, of any length; it points into the
    tissue. ``edge``: (3,) a direction in the plane of its first and last axis.
    """

    centre: Sequence[float] | Array
    axis: Sequence[float] | Array
    edge: Sequence[float] | Array | None

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
    def place(self, centre: Array, axis: Array, edge: Array) -> Self:
        """The shape with another frame."""

    def move(self, distance: float, across: Sequence[float] = (0.0, 0.0)) -> Self:
        """The shape, advanced along its axis by ``distance`` mm and ``across`` it along x and y."""
        move = np.array([*across, distance]) @ self.frame
        return self.place(np.asarray(self.centre, dtype=float) + move, *self.frame[[2, 0]])

    @abstractmethod
    def find_near(self, points: Array) -> Mask:
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


@dataclass(frozen=True)
class Indenter(RigidShape):
    """A rigid indenter that moves along ``axis``.

    Raises `ProblemError` for a size, a place or a direction that is impossible, and `InputError` for a shape
    that nobody registered.

    Parameters
    ----------
    shape : ``square`` (prism), ``sphere``, ``cylinder`` (flat end), ``stl`` (the ``surface``) or the name of
        one that was registered by `limbfit.register_shape`.
    width : edge length or diameter, mm, rounding included; with a surface it is measured.
    edge_radius : rounding of the edges, mm.  Less than 1 % of the width (also 0, a sharp edge) is taken as
        1 % of the width, with a surface as much of it as its details allow; a sphere has none.
    centre : (3,) the middle of the foremost face, mm.
    axis : (3,) into the tissue; any length.
    edge : (3,) direction of one edge of the square; by default the cross product of ``axis`` and z.
    surface : triangles in the indenter's frame, for ``stl`` only.
    sharp : the rounding over the width that stands for a sharp edge, where 1 % is too coarse for the tissue.
    measures : further numbers of a shape that has them, by their keys.
    """

    shape: str = "square"
    width: float = 20.0
    edge_radius: float = 0.0
    centre: Sequence[float] | Array = (0.0, 0.0, 0.0)
    axis: Sequence[float] | Array = (0.0, 0.0, -1.0)
    edge: Sequence[float] | Array | None = None
    surface: RigidSurface | None = None
    sharp: float = SHARP_EDGE
    measures: Mapping[str, float] = field(default_factory=dict)
    body: Shape = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        if self.surface is not None:
            object.__setattr__(self, "width", self.surface.width)
        size = Size(self.width, self.edge_radius, self.measures, self.surface, self.sharp)
        object.__setattr__(self, "body", SHAPES[self.shape].of(size))
        for name in ("centre", "axis", *(["edge"] if self.edge is not None else [])):
            value = np.asarray(getattr(self, name), dtype=float)
            if value.shape != (3,) or not np.isfinite(value).all():
                raise ProblemError(f"indenter {name} is not three finite numbers")
            object.__setattr__(self, name, tuple(value.tolist()))  # a copy, which the caller cannot change
        if np.linalg.norm(self.axis) < 1e-12:
            raise ProblemError("indenter axis has no length")
        if np.linalg.norm(np.cross(self.axis, self._edge_direction())) < 1e-9:
            raise ProblemError("indenter edge is parallel to its axis")

    def _edge_direction(self) -> Array:
        if self.edge is not None:
            return np.asarray(self.edge, dtype=float)
        axis = np.asarray(self.axis, dtype=float)
        guess = np.cross(axis, [0.0, 0.0, 1.0])
        small = np.linalg.norm(guess) < 1e-6 * np.linalg.norm(axis)
        return np.array([1.0, 0.0, 0.0]) if small else guess

    @property
    def length(self) -> float:
        """From the foremost point to the far end of a surface; the width for shapes without one, mm."""
        return self.body.length

    def place(self, centre: Array, axis: Array, edge: Array) -> Self:
        return replace(self, centre=centre, axis=axis, edge=edge)

    def find_near(self, points: Array) -> Mask:
        x, y, z = points.T
        reach = self.body.reach
        return np.asarray((z <= self.width / 2) & (np.abs(x) <= reach) & (np.abs(y) <= reach))

    def _distances(self, x: Array) -> tuple[Array, Array, Array]:
        return self.body.distance(x)


@dataclass(frozen=True, eq=False)
class Wall(RigidShape):
    """Triangles in a frame of their own.

    ``points``: (n, 3) mm, in the body's frame. ``faces``: (m, 3) corners, counter-clockwise seen from the
    tissue. ``centre``: (3,) the origin of the body's frame, mm. ``axis``, ``edge``: (3,) third and first axis
    of the frame; an advance moves along ``axis``.
    """

    points: Array
    faces: Indices
    centre: Sequence[float] | Array = (0.0, 0.0, 0.0)
    axis: Sequence[float] | Array = (0.0, 0.0, 1.0)
    edge: Sequence[float] | Array = (1.0, 0.0, 0.0)

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

    def place(self, centre: Array, axis: Array, edge: Array) -> Self:
        """The surface with another frame; what was derived from its triangles is kept."""
        other = copy(self)
        other.__dict__.pop("frame", None)
        other.__dict__.update(centre=centre, axis=axis, edge=edge)
        return other


def check_open_surface(points: Array, faces: NDArray, name: str) -> tuple[Array, Indices]:
    """The arrays of a surface with one side. Raises `ProblemError` where it is no triangle surface, or its
    triangles do not agree on a side.
    """
    points, faces = np.asarray(points, dtype=float), np.asarray(faces)
    check_triangles(points, faces, name)
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    if len(np.unique(edges, axis=0)) < len(edges):
        what = f"the triangles of {name} do not agree on a side, or more than two meet at an edge"
        raise ProblemError(what, remedy="orient them alike, counter-clockwise seen from the tissue")
    return points, faces.astype(np.int64)


@dataclass(frozen=True, eq=False)
class OpenSurface(Wall):
    """An open surface as a rigid body; see the module docstring, and `Wall`.

    Raises `ProblemError` where it is no triangle surface, or its triangles do not agree on a side.

    Parameters
    ----------
    points, faces, centre, axis, edge : as in `Wall`.
    reach : distance from which the surface is not felt, mm.
    """

    reach: float = 20.0

    def __post_init__(self) -> None:
        points, faces = check_open_surface(self.points, self.faces, "the open surface")
        if not self.reach > 0.0:
            raise ProblemError(f"a reach of {self.reach} mm is not positive")
        object.__setattr__(self, "points", points)
        object.__setattr__(self, "faces", faces)
        _ = self._box, self._facets  # derived once, and kept where the surface is placed anew

    @cached_property
    def _box(self) -> tuple[Array, Array]:
        used = self.points[np.unique(self.faces)]
        return used.min(axis=0) - self.reach, used.max(axis=0) + self.reach

    @cached_property
    def _facets(self) -> Facets:
        corners, normals, edges, sums = compute_features(self.points, self.faces)
        open_edges = find_neighbours(self.faces) < 0
        ends = np.concatenate([self.faces[open_edges], np.roll(self.faces, -1, axis=1)[open_edges]])
        brim = np.concatenate([open_edges, np.isin(self.faces, ends)], axis=1)  # (m, 6): edges and corners
        return corners, normals, edges, sums, brim, build_tree(corners, np.arange(len(corners)))

    def find_near(self, points: Array) -> Mask:
        low, high = self._box
        return np.asarray(((points >= low) & (points <= high)).all(axis=1))

    def _distances(self, x: Array) -> tuple[Array, Array, Array]:
        return compute_wall_distances(x, self._facets, self.reach)


def compute_features(points: Array, faces: Indices) -> tuple[Array, Array, Array, Array]:
    """Corners (m, 3, 3) of triangles, normals (m, 3), and directions (m, 3, 3) of edges and of corners."""
    corners = np.ascontiguousarray(points[faces])
    normals = compute_triangle_normals(corners)[0]
    sums = compute_normal_spread(points, faces, normals)[1]
    beyond = find_neighbours(faces)
    edges = normals[:, None] + np.where(beyond[..., None] >= 0, normals[beyond], 0.0)
    return corners, normals, edges, sums[faces]


@njit(cache=True)
def _wall_distance(wall, reach, x, gradient, hessian):  # type: ignore[no-untyped-def]
    """Distance of ``x (3,)`` from the surface; fills its gradient (3,) and hessian (3, 3)."""
    corners, normals, edge_normals, sums, brim, tree = wall
    point, outward, axis = np.empty(3), np.empty(3), np.zeros(3)
    gradient[:], hessian[:, :] = 0.0, 0.0
    face, feature, squared = closest_point(corners, tree, x, point)
    if squared > reach * reach:
        return np.inf
    side = size = 0.0
    for i in range(3):
        side += (x[i] - point[i]) * normals[face, i]
        size += (corners[face, 1, i] - corners[face, 0, i]) ** 2
    gradient[:] = normals[face]
    if feature == INSIDE:
        return side
    if brim[face, feature - 1]:
        # Beside a plane of symmetry the brim is met; beyond it, nothing is.
        return side if squared - side * side <= BEYOND * BEYOND * size else np.inf
    feature_normal(normals, edge_normals, sums, face, feature, outward)
    along = length = 0.0
    for i in range(3):
        along += (x[i] - point[i]) * outward[i]
        length += outward[i] * outward[i]
    d = np.sqrt(squared)
    if d <= 1e-9 * np.sqrt(size):
        for i in range(3):
            gradient[i] = outward[i] / np.sqrt(length)
        return 0.0
    sign = 1.0 if along >= 0.0 else -1.0
    for i in range(3):
        gradient[i] = sign * (x[i] - point[i]) / d
    curvature(corners, face, feature, axis, gradient, sign / d, hessian)
    return sign * d


@njit(cache=True)
def compute_wall_distances(points, wall, reach):  # type: ignore[no-untyped-def]
    """`_wall_distance` of many points (n, 3) with its derivatives."""
    n = len(points)
    values, slopes, bends = np.empty(n), np.empty((n, 3)), np.empty((n, 3, 3))
    for i in range(n):
        values[i] = _wall_distance(wall, reach, points[i], slopes[i], bends[i])
    return values, slopes, bends
