"""What a rigid body does to the tissue at one accepted step: pressure and shear, and their resultants."""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from ..arrays import Array, Indices
from ..renamed import find_renamed
from .contact.contact import ContactSurface
from .kernel.laws import Laws
from .result import State
from .system import System

KPA = 1e3  # per MPa


@dataclass(frozen=True)
class Tractions:
    """At the contact points (f, q) of a body's faces, where the tissue is deformed.

    Parameters
    ----------
    faces : (f, k) nodes of each face; single nodes with the nodal contact rule.
    shares : (q, k) of the nodes in each contact point.
    points : (f, q, 3) mm.
    areas : (f, q) mm^2.
    normals : (f, q, 3) of the body's wall, into the tissue.
    forces : (f, q, 3) on the tissue, N.
    """

    faces: Indices
    shares: Array
    points: Array
    areas: Array
    normals: Array
    forces: Array

    @property
    def pressure_kPa(self) -> Array:
        """(f, q) contact pressure, kPa."""
        return KPA * np.einsum("fqi,fqi->fq", self.forces, self.normals) / self.areas

    @property
    def shear_kPa(self) -> Array:
        """(f, q, 3) traction along the wall, kPa."""
        along = np.einsum("fqi,fqi->fq", self.forces, self.normals)[..., None] * self.normals
        return KPA * (self.forces - along) / self.areas[..., None]

    @cached_property
    def face_pressure_kPa(self) -> Array:
        """(f,) mean over each face, kPa."""
        return self._average_over_faces(self.pressure_kPa[..., None])[:, 0]

    @cached_property
    def face_shear_kPa(self) -> Array:
        """(f, 3) mean over each face, kPa."""
        return self._average_over_faces(self.shear_kPa)

    @property
    def contact_area(self) -> float:
        """Where there is pressure, mm^2."""
        return float(self.areas[self.pressure_kPa > 0.0].sum())

    @property
    def force(self) -> Array:
        """(3,) on the tissue, N."""
        return np.asarray(self.forces.sum(axis=(0, 1)))

    def moment(self, about: Array) -> Array:
        """(3,) on the tissue about a point (3,), N mm."""
        return np.asarray(np.cross(self.points - np.asarray(about), self.forces).sum(axis=(0, 1)))

    def average_at_nodes(self, n: int) -> tuple[Array, Array]:
        """Pressure (n,) and shear (n, 3), kPa, at the nodes of a mesh: the means of the faces around them, by
        their areas; 0 at nodes of none."""
        weights = np.repeat(self.areas.sum(axis=1), self.faces.shape[1])
        nodes = self.faces.ravel()
        size = np.bincount(nodes, weights, minlength=n)
        values = np.column_stack([self.face_pressure_kPa, self.face_shear_kPa])
        spread = np.repeat(values, self.faces.shape[1], axis=0) * weights[:, None]
        sums = np.column_stack([np.bincount(nodes, part, minlength=n) for part in spread.T])
        means = sums / np.where(size > 0.0, size, 1.0)[:, None]
        return means[:, 0], means[:, 1:]

    def _average_over_faces(self, values: Array) -> Array:
        return np.asarray(np.einsum("fq,fqi->fi", self.areas, values) / self.areas.sum(axis=1)[:, None])


def compute_tractions(system: System, laws: Laws, state: State, body: int = 0) -> Tractions:
    """Those of the ``body``-th of a problem's rigid bodies in a state."""
    one, penalty = system.bodies.all[body], state.penalty * laws.modulus
    found = system.bodies.evaluate(state.rows, state.drives, penalty, np.inf, state.grips, tangent=False)
    normals, forces = found.touch.normals[one.points], -found.touch.forces[one.points]
    length = np.linalg.norm(normals, axis=1)[:, None]
    normals = normals / np.where(length > 0.0, length, 1.0)
    now = ContactSurface.build(
        system.element, system.points + state.u, np.asarray(one.stated.faces), system.problem.contact_rule
    )
    shape = (*now.areas.shape, 3)
    return Tractions(
        one.surface.faces, one.surface.N, found.tools[body].places, now.areas, normals.reshape(shape),
        forces.reshape(shape),
    )  # fmt: skip


def __getattr__(name: str) -> Any:
    return find_renamed(__name__, name, {"tractions": "compute_tractions"})
