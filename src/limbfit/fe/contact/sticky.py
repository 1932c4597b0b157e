"""Sticky contact: a point that has touched does not slip along the indenter until it lets go.

A contact point is anchored where it is at the end of the step in which it first touched, in the indenter's
frame.  From then on ``eps/2 |P (x - a)|^2 dA_0`` holds it (`StickyContact` without bounds),
with ``P = 1 - n n^T`` the tangent plane at the anchor: quadratic, so its
tangent is constant, and without a part along the normal, so an anchor
neither pulls nor pushes.  The anchors of a step that let go in it are dropped and the step is solved again.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from numpy.typing import NDArray

from .contact import ContactSurface
from .grip import StickyContact
from .tool import Distances, Tool

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Anchors(StickyContact):
    """A `StickyContact` whose planes stay those at the anchors; ``d_normals (f, q, 3, p)`` is theirs."""

    d_normals: Array

    @classmethod
    def none(cls, surface: ContactSurface, parameters: int = 0) -> Anchors:
        shape = surface.areas.shape
        vectors, slopes = np.zeros((*shape, 3)), np.zeros((*shape, 3, parameters))
        held, bounds = np.zeros(shape, dtype=bool), np.full(shape, np.inf)
        return cls(held, vectors, vectors, bounds, slopes, vectors, slopes)

    def bare(self) -> Self:
        """The anchors without derivatives, to be kept."""
        nothing = np.zeros((*self.held.shape, 3, 0))
        return replace(self, d_places=nothing, d_normals=nothing)

    def renewed(self, tool: Tool) -> Anchors:
        """The anchors without those whose points left the indenter."""
        lost = self.held & (tool.gaps >= 0.0)
        return replace(self, held=self.held & ~lost) if lost.any() else self

    def after(self, tool: Tool, du: Array | None) -> Anchors:
        """The anchors at the end of a step: points that touch for the first time are held where they are.

        ``du (r, 3, p)`` is the derivative of the tool's ``u``, where that is wanted.
        """
        local = tool.local
        near = Distances.of(tool)
        closed, normals = np.zeros_like(self.held), np.zeros_like(self.normals)
        closed.ravel()[near.points] = near.gaps < 0.0
        normals.reshape(-1, 3)[near.points] = near.normals
        new = (closed & ~self.held)[..., None]
        d_places, d_normals = self.d_places, self.d_normals
        if du is not None:
            moved = tool.moved(du)
            curvatures = np.zeros((*normals.shape, 3))
            curvatures.reshape(-1, 3, 3)[near.points] = near.tilts
            d_places = np.where(new[..., None], moved, d_places)
            d_normals = np.where(new[..., None], curvatures @ moved, d_normals)
        places, normals = np.where(new, local, self.places), np.where(new, normals, self.normals)
        return Anchors(closed, places, normals, self.bounds, d_places, self.pulls, d_normals)

    def explicit(self, tool: Tool) -> Array:
        """Derivative (f, q, 3, p) of the points' forces, over penalty and area, through the anchors alone."""
        move = tool.local - self.places
        n, d_n, d_a = self.normals[..., None], self.d_normals, self.d_places
        across = np.einsum("fqi,fqi->fq", self.normals, move)[..., None, None]
        turned = np.einsum("fqip,fqi->fqp", d_n, move) + -np.einsum("fqi,fqip->fqp", self.normals, d_a)
        change = -(d_n * across + n * turned[:, :, None]) - d_a
        return np.asarray(self.held[..., None, None] * change)

    def coupling(self, tool: Tool) -> None:
        """Nothing: anchors and planes stay."""
