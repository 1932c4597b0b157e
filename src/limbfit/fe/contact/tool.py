"""A rigid body where it is in a state, and the surface that it may touch: what the contact laws work on.

The displacements ``u (r, 3)`` of a system are those of its nodes, then two rows for each body that something
is free to move: its translation and its rotation times `Tool.unit`, both in mm.

With the pivot ``p``, the translation ``d`` and the rotation ``R`` of the vector ``w``, a point ``x`` of space
is at ``z = R^T (x - p - d)`` of the body, about its pivot.  What a coordinate does to the body's points is
given as a *lever*: the relative displacement ``dr = dx + L dq`` of a point against the body, in space.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import expm

from ...arrays import Array, Indices, Mask
from .contact import ContactSurface
from .rigid import RigidShape


@dataclass(frozen=True)
class Pose:
    """A body that started as ``start`` and is moved by ``coordinates (6,)``: mm along the axes of its frame,
    and the rotation vector in its frame, rad, about the ``pivot (3,)``."""

    start: RigidShape
    pivot: Array
    coordinates: Array

    @property
    def is_turned(self) -> bool:
        return bool(self.coordinates[3:].any())

    @cached_property
    def rotation(self) -> Array:
        """R (3, 3)."""
        return np.asarray(expm(self._spin(self.coordinates[3:]))) if self.is_turned else np.eye(3)

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
        if not self.is_turned:  # the series of the exponential at nothing, without an exponential
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
        if not self.is_turned:
            return self.start.place(centre + shift, frame[2], frame[0])
        axes = frame @ self.rotation.T
        place = self.pivot + shift + self.rotation @ (centre - self.pivot)
        return self.start.place(place, axes[2], axes[0])

    def levers(self, points: Array, coordinates: NDArray[np.intp]) -> Array:
        """(c, 3, k): relative displacement of points (c, 3) per unit of the ``coordinates (k,)``."""
        out = np.empty((len(points), 3, len(coordinates)))
        for column, i in enumerate(coordinates):
            if i > 2:
                out[:, :, column] = self._from_pivot(points) @ self.slopes[i - 3] @ self.rotation.T
            else:
                out[:, :, column] = -self.start.frame[i]
        return out

    def _from_pivot(self, points: Array) -> Array:
        return np.asarray(points - self.pivot - self.coordinates[:3] @ self.start.frame)

    def compute_turning(self, forces: Array, coordinates: NDArray[np.intp]) -> Array:
        """(c, 3, k): change of the forces (c, 3), which turn with the body, per unit of the coordinates."""
        out = np.zeros((len(forces), 3, len(coordinates)))
        for column, i in enumerate(coordinates):
            if i > 2:
                out[:, :, column] = forces @ self.rotation @ self.slopes[i - 3].T
        return out

    def compute_bending(self, points: Array, forces: Array, coordinates: NDArray[np.intp]) -> Array:
        """(k, k): second derivative of the energy through the rotation's own curvature, for the energy's
        derivatives ``forces (c, 3)`` with respect to the points (c, 3)."""
        moments = self._from_pivot(points).T @ forces
        out = np.zeros((len(coordinates), len(coordinates)))
        for a, i in enumerate(coordinates):
            for b, j in enumerate(coordinates):
                if i > 2 and j > 2:
                    out[a, b] = np.sum(moments * (self.bends[i - 3, j - 3] @ self.rotation.T))
        return out


@dataclass(frozen=True)
class Tool:
    """See the module docstring.

    Parameters
    ----------
    surface : its nodes are the first rows of ``u``.
    pose : where the body is at ``u``.
    u : (r, 3) mm.
    free : (k,) which of the six coordinates are unknowns.
    row : the first of the body's two rows in ``u``; it has them where a coordinate is free.
    unit : mm per radian of a turn.
    """

    surface: ContactSurface
    pose: Pose
    u: Array
    free: NDArray[np.intp]
    row: int
    unit: float

    @property
    def body(self) -> RigidShape:
        return self.pose.body

    @cached_property
    def places(self) -> Array:
        """The contact points (f, q, 3) in space, mm."""
        return self.surface.interpolate_points(self.surface.points + self.u[: len(self.surface.points)])

    @cached_property
    def local_points(self) -> Array:
        """The contact points (f, q, 3) in the body's frame, mm."""
        return (self.places - np.asarray(self.body.centre)) @ self.body.frame.T

    @property
    def gaps(self) -> Array:
        """Signed distances (f, q) at the contact points, mm."""
        return self.body.local_distance(self.local_points)[0]

    @property
    def units(self) -> Array:
        """(k,) of the free coordinates per mm of their entries in ``u``."""
        return np.where(self.free > 2, 1.0 / self.unit, 1.0)

    @cached_property
    def levers(self) -> Array:
        """(f q, 3, k): relative displacement in space of the points per mm of the free coordinates."""
        return self.pose.levers(self.places.reshape(-1, 3), self.free) * self.units

    def relative_motion(self, du: Array) -> Array:
        """What changes ``du (r, 3, p)`` do to the points in the body's frame (f, q, 3, p)."""
        surface = self.surface
        found = np.einsum("qk,fkjp->fqjp", surface.N, du[surface.faces], optimize=True)
        if len(self.free):
            change = du[self.row : self.row + 2].reshape(6, -1)[self.free]
            found += (self.levers @ change).reshape(found.shape)
        return np.einsum("ij,fqjp->fqip", self.body.frame, found, optimize=True)

    def distribute_forces(self, forces: Array) -> Array:
        """Forces (f q, 3, p) at the points, in space, as those of ``u (r, 3, p)``."""
        n, p = len(self.surface.points), forces.shape[-1]
        out = np.zeros((len(self.u), 3, p))
        out[:n] = (self.surface.shares @ forces.reshape(-1, 3 * p)).reshape(n, 3, p)
        if len(self.free):
            on_body = np.zeros((6, p))
            on_body[self.free] = np.einsum("cik,cip->kp", self.levers, forces)
            out[self.row : self.row + 2] = on_body.reshape(2, 3, p)
        return out


@dataclass(frozen=True)
class Distances:
    """Contact points near a rigid body.

    ``points (k,)``: their numbers among all (f, q).  In the body's frame: ``places (k, 3)``, signed distances
    ``gaps (k,)``, mm, their gradients ``slopes (k, 3)`` and hessians ``bends (k, 3, 3)``, 1/mm.
    """

    points: Indices
    places: Array
    gaps: Array
    slopes: Array
    bends: Array

    @classmethod
    def from_tool(cls, tool: Tool, also: Mask | None = None) -> Distances:
        """From the body where it is; ``also (f, q)`` points far away."""
        local = tool.local_points.reshape(-1, 3)
        near = tool.body.find_near(local)
        if also is not None:
            near |= also.ravel()
        points = np.flatnonzero(near)
        return cls(points, local[points], *tool.body.local_distance(local[points]))

    def scatter(self, values: Array, shape: tuple[int, ...]) -> Array:
        """Values (k, ...) at their places among all contact points, of this ``shape`` (f, q); 0 elsewhere."""
        out = np.zeros((*shape, *values.shape[1:]))
        out.reshape(-1, *values.shape[1:])[self.points] = values
        return out

    @cached_property
    def steepness(self) -> Array:
        """(k,) length of the gradients: one where gaps are distances, less where a surface fades."""
        return np.linalg.norm(self.slopes, axis=1)

    @cached_property
    def normals(self) -> Array:
        """(k, 3) unit normals; zero where a body is not felt."""
        return self.slopes / np.where(self.steepness > 0.0, self.steepness, 1.0)[:, None]

    @property
    def tilts(self) -> Array:
        """(k, 3, 3) derivatives of the unit normals, 1/mm."""
        n, steep = self.normals, np.where(self.steepness > 0.0, self.steepness, 1.0)
        along = n[:, :, None] * np.einsum("ki,kij->kj", n, self.bends)[:, None]
        return (self.bends - along) / steep[:, None, None]

    @property
    def force_slopes(self) -> Array:
        """(k, 3) derivatives of the normal force of points in touch, ``-gap |slope|``."""
        gaps = np.where(np.isfinite(self.gaps), self.gaps, 0.0)[:, None]
        bent = np.einsum("kij,kj->ki", self.bends, self.normals)
        return -(self.steepness[:, None] * self.slopes + gaps * bent)
