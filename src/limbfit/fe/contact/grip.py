"""What holds contact points along the indenter: sticking, or Coulomb friction, in one form for the kernel.

A held point has an anchor ``a`` in the indenter's frame.  With its move along the tangent plane,
``s = P (x - a)``, ``P = 1 - n n^T``, its energy is ``eps dA_0 H(|s|)`` with ``H(s) = s^2 / 2`` up to the
bound ``b`` and ``b s - b^2 / 2`` beyond it: it sticks by the contact's own penalty up to a slip of ``b`` mm,
and beyond pulls with ``eps b`` whatever the slip.  In a step anchors, planes and bounds are constant, so this
is a convex potential with a symmetric tangent.

Its kink is sharp, ``b`` is thousandths of a mm: Newton's method with the second derivative does not foresee
that a slip turns round or ends, and then takes as many iterations as there are points that do.  So it is
primal-dual (Chan, Golub and Mulet 1999): the part ``p`` of the slip that pulls, ``|s| p = b s``, is a
variable of its own, with which the tangent of a point that slips is ``eps b / |s| (P - (p s^T + s p^T) / (2 b
|s|))``.  It is the second derivative where ``p`` is what the slip says, and positive where ``|p| <= b``.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, replace
from typing import ClassVar, Self

import numpy as np
from numpy.typing import NDArray

from .tool import Tool

Array = NDArray[np.float64]
Bools = NDArray[np.bool_]


@dataclass(frozen=True)
class StickyContact(ABC):
    """The held points among the contact points (f, q), in the indenter's frame.

    Parameters
    ----------
    held : (f, q) which points have an anchor.
    places, normals : (f, q, 3) anchor, mm, and unit normal of the tangent plane.
    bounds : (f, q) slip at which a point gives way, mm; infinite where it never does.
    d_places : (f, q, 3, p) derivative of the anchors with respect to the parameters.
    pulls : (f, q, 3) the dual variable, mm: the part of the slip that pulls, as the tangent takes it to be.
    """

    held: Bools
    places: Array
    normals: Array
    bounds: Array
    d_places: Array
    pulls: Array

    # Stiffness that holds a point over that of the contact.
    hardness = 1.0
    # Whether a step holds something constant that follows the displacement (`coupling`).
    lags: ClassVar[bool] = False

    @property
    def arrays(self) -> tuple[Bools, Array, Array, Array, Array]:
        """What the contact kernel takes of it, point by point."""
        places, normals, pulls = (x.reshape(-1, 3) for x in (self.places, self.normals, self.pulls))
        return self.held.ravel(), places, normals, self.bounds.ravel(), pulls

    def bare(self) -> Self:
        """The grip without derivatives, to be kept."""
        return replace(self, d_places=np.zeros((*self.held.shape, 3, 0)))

    def begun(self, tool: Tool) -> StickyContact:
        """The grip before the first step, with the tool where it starts."""
        return self

    def foreseen(self, tool: Tool, du: Array) -> Self:
        """The grip with the pulls that its tangent foresees after a change ``du (r, 3)`` of ``u``."""
        return self

    @abstractmethod
    def renewed(self, tool: Tool) -> StickyContact:
        """The grip that an equilibrium with the tool where it is asks for; itself where it holds."""

    @abstractmethod
    def after(self, tool: Tool, du: Array | None) -> StickyContact:
        """The grip after a step that ended there; ``du (r, 3, p)`` the derivative of the tool's ``u``, where
        wanted."""

    @abstractmethod
    def explicit(self, tool: Tool) -> Array:
        """Derivative (f, q, 3, p) of the points' forces, over penalty and area, through the anchors alone."""

    @abstractmethod
    def coupling(self, tool: Tool) -> Array | None:
        """Derivative (f, q, 3, 3) of the forces, over penalty and area, through what a step holds constant
        although it follows the displacement; None where nothing does."""
