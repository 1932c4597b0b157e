"""A rigid body where it is in a state, and the surface that it may touch: what the contact laws work on.

The displacements ``u (r, 3)`` of a system are those of its nodes, then two rows for each body that something
is free to move: its translation and its rotation times `Tool.unit`, both in mm.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from .contact import ContactSurface
from .pose import Pose
from .rigid import RigidShape

Array = NDArray[np.float64]
Bools = NDArray[np.bool_]


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
        return self.surface.at(self.surface.points + self.u[: len(self.surface.points)])

    @cached_property
    def local(self) -> Array:
        """The contact points (f, q, 3) in the body's frame, mm."""
        return (self.places - np.asarray(self.body.centre)) @ self.body.frame.T

    @property
    def gaps(self) -> Array:
        """Signed distances (f, q) at the contact points, mm."""
        return self.body.local_distance(self.local)[0]

    @property
    def units(self) -> Array:
        """(k,) of the free coordinates per mm of their entries in ``u``."""
        return np.where(self.free > 2, 1.0 / self.unit, 1.0)

    @cached_property
    def levers(self) -> Array:
        """(f q, 3, k): relative displacement in space of the points per mm of the free coordinates."""
        return self.pose.levers(self.places.reshape(-1, 3), self.free) * self.units

    def moved(self, du: Array) -> Array:
        """What changes ``du (r, 3, p)`` do to the points in the body's frame (f, q, 3, p)."""
        surface = self.surface
        found = np.einsum("qk,fkjp->fqjp", surface.N, du[surface.faces], optimize=True)
        if len(self.free):
            change = du[self.row : self.row + 2].reshape(6, -1)[self.free]
            found += (self.levers @ change).reshape(found.shape)
        return np.einsum("ij,fqjp->fqip", self.body.frame, found, optimize=True)

    def distributed(self, forces: Array) -> Array:
        """Forces (f, q, 3, p) at the points, in the body's frame, as those of ``u (r, 3, p)``."""
        in_space = np.einsum("ij,fqip->fqjp", self.body.frame, forces).reshape(-1, 3, forces.shape[-1])
        return self.gathered(in_space)

    def gathered(self, forces: Array) -> Array:
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

    points: NDArray[np.int64]
    places: Array
    gaps: Array
    slopes: Array
    bends: Array

    @classmethod
    def of(cls, tool: Tool, also: Bools | None = None) -> Distances:
        """From the body where it is; ``also (f, q)`` points far away."""
        local = tool.local.reshape(-1, 3)
        wanted = tool.body.near(local)
        if also is not None:
            wanted |= also.ravel()
        points = np.flatnonzero(wanted)
        return cls(points, local[points], *tool.body.local_distance(local[points]))

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
    def pressing(self) -> Array:
        """(k, 3) derivatives of the normal force of points in touch, ``-gap |slope|``."""
        gaps = np.where(np.isfinite(self.gaps), self.gaps, 0.0)[:, None]
        bent = np.einsum("kij,kj->ki", self.bends, self.normals)
        return -(self.steepness[:, None] * self.slopes + gaps * bent)
