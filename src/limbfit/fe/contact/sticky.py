"""Sticky contact: a point that has touched does not slip along the indenter until it lets go.

A contact point is anchored where it is at the end of the step in which it first touched, in the indenter's
frame.  From then on ``eps/2 |P (x - a)|^2 dA_0`` holds it, with its move ``x - a`` along the indenter and
``P = 1 - n n^T`` the tangent plane at the anchor: quadratic, so its tangent is constant, and without a part
along the normal, so an anchor neither pulls nor pushes.  The anchors of a step that let go in it are dropped
and the step is solved again.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from .contact import ContactSurface
from .indenter import Indenter

Array = NDArray[np.float64]
Bools = NDArray[np.bool_]


@dataclass(frozen=True)
class Anchors:
    """Anchors of the contact points (f, q), in the indenter's frame.

    Parameters
    ----------
    held : (f, q) which points stick.
    places, normals : (f, q, 3) anchor, mm, and unit normal of the indenter there.
    d_places, d_normals : (f, q, 3, p) their derivatives with respect to the parameters.
    """

    held: Bools
    places: Array
    normals: Array
    d_places: Array
    d_normals: Array

    @classmethod
    def none(cls, surface: ContactSurface, parameters: int = 0) -> Anchors:
        shape = surface.areas.shape
        vectors, slopes = np.zeros((*shape, 3)), np.zeros((*shape, 3, parameters))
        return cls(np.zeros(shape, dtype=bool), vectors, vectors, slopes, slopes)

    def let_go(self, surface: ContactSurface, indenter: Indenter, u: Array) -> Anchors:
        """The anchors without those whose points left the indenter (where it is now) at ``u (n, 3)``."""
        lost = self.held & (surface.gaps(indenter, u) >= 0.0)
        return replace(self, held=self.held & ~lost) if lost.any() else self

    def after(self, surface: ContactSurface, indenter: Indenter, u: Array, du: Array | None) -> Anchors:
        """The anchors at the end of a step: points that touch for the first time are held where they are.

        ``du (n, 3, p)`` is the derivative of ``u (n, 3)``, where that is wanted.
        """
        local = surface.local(indenter, u)
        gaps, normals, curvatures = indenter.local_distance(local)
        closed = gaps < 0.0
        new = (closed & ~self.held)[..., None]
        d_places, d_normals = self.d_places, self.d_normals
        if du is not None:
            moved = np.einsum("ij,qk,fkjp->fqip", indenter.frame, surface.N, du[surface.faces], optimize=True)
            d_places = np.where(new[..., None], moved, d_places)
            d_normals = np.where(new[..., None], curvatures @ moved, d_normals)
        places, normals = np.where(new, local, self.places), np.where(new, normals, self.normals)
        return Anchors(closed, places, normals, d_places, d_normals)

    def explicit(
        self, surface: ContactSurface, indenter: Indenter, u: Array, penalty: float
    ) -> tuple[Array, Array]:
        """Derivatives of the contact forces (n, 3, p) and of the reaction (p,) through the anchors alone."""
        move = surface.local(indenter, u) - self.places
        n, d_n, d_a = self.normals[..., None], self.d_normals, self.d_places
        across = np.einsum("fqi,fqi->fq", self.normals, move)[..., None, None]
        turned = np.einsum("fqip,fqi->fqp", d_n, move) + -np.einsum("fqi,fqip->fqp", self.normals, d_a)
        change = -(d_n * across + n * turned[:, :, None]) - d_a
        change *= (penalty * surface.areas * self.held)[..., None, None]
        forces = np.zeros((*u.shape, change.shape[-1]))
        spread = np.einsum("ij,qk,fqip->fkjp", indenter.frame, surface.N, change, optimize=True)
        np.add.at(forces, surface.faces, spread)
        return forces, -change[:, :, 2].sum(axis=(0, 1))
