"""What every rigid shape is, a frame, an extent, and the signed distance with two derivatives; the indenter.

The indenter's frame: origin at the middle of its foremost face (``centre``), coordinates ``(x, y, z)`` along
``edge``, ``axis x edge`` and ``axis``; the body lies at ``z <= 0``.
"""

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Self

import numpy as np
from numpy.typing import NDArray

from ...arrays import Array
from ...errors import ProblemError
from ...shapes import SHAPES, SHARP_EDGE, RigidSurface, Shape, Size


class RigidShape(ABC):
    """A rigid shape with a frame of its own, in which it is asked for distances; mm.

    Parameters
    ----------
    centre : (3,) the origin of the frame.
    axis : (3,) its last axis, of any length; it points into the tissue.
    edge : (3,) a direction in the plane of its first and last axis.
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


@dataclass(frozen=True)
class Indenter(RigidShape):
    """A rigid indenter that moves along ``axis``.

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

    Raises
    ------
    ProblemError
        For a size, a place or a direction that is impossible.
    InputError
        For a shape that nobody registered.
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

    def placed(self, centre: Array, axis: Array, edge: Array) -> Self:
        return replace(self, centre=centre, axis=axis, edge=edge)

    def near(self, points: Array) -> NDArray[np.bool_]:
        x, y, z = points.T
        reach = self.body.reach
        return np.asarray((z <= self.width / 2) & (np.abs(x) <= reach) & (np.abs(y) <= reach))

    def _distances(self, x: Array) -> tuple[Array, Array, Array]:
        return self.body.distance(x)
