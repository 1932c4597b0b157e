"""What holds contact points along a body: sticking, or Coulomb friction, in one form for the kernel.

A held point has an anchor ``a`` in the body's frame: the place where it was at the end of the step in which
it first touched.  With its move along the tangent plane, ``s = P (x - a)``, ``P = 1 - n n^T``, its energy is
``eps dA_0 H(|s|)`` with ``H(s) = s^2 / 2`` up to the bound ``b`` and ``b s - b^2 / 2`` beyond it: it sticks
by the contact's own penalty up to a slip of ``b`` mm, and beyond pulls with ``eps b`` whatever the slip.  In
a step anchors, planes and bounds are constant, so this is a convex potential with a symmetric tangent.

Its kink is sharp, ``b`` is thousandths of a mm: Newton's method with the second derivative does not predict
that a slip turns round or ends, and then takes as many iterations as there are points that do.  So it is
primal-dual (Chan, Golub and Mulet 1999): the part ``p`` of the slip that pulls, ``|s| p = b s``, is a
variable of its own, with which the tangent of a point that slips is ``eps b / |s| (P - (p s^T + s p^T) / (2 b
|s|))``.  It is the second derivative where ``p`` is what the slip says, and positive where ``|p| <= b``.

*Sticky* points have no bound.  The plane stays that at the anchor, so that the energy is quadratic, and an
anchor neither pulls nor pushes along the normal.  An anchor whose point lets go is dropped, and the step is
solved again.

*Coulomb's* bound is ``mu <-phi> |grad phi|`` over the hardness, mm, where penetration and normal are those of
the last equilibrium (as in incremental potential contact, Li et al. 2020).  The step is solved again with new
ones until they do not change; what is in equilibrium then is Coulomb's law.  Up to the bound a point sticks
by ``hardness`` times the penalty of the contact, so the width in which sticking goes over into slipping is
``mu`` times the penetration over the hardness.  The anchor of a point that slips follows it at the distance
of the bound (return mapping, Wriggers 2006, chapter 5.2), so what sticks does not creep, however many steps
it is held for.  `StepwiseCoulomb` is the other law, that of FEBio's ``sliding-elastic``: slip counts from the
start of the step.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, replace
from typing import ClassVar, Self

import numpy as np

from ...arrays import Array, Mask
from .contact import ContactSurface
from .tool import Distances, Tool


@dataclass(frozen=True)
class StickyContact(ABC):
    """The held points among the contact points (f, q), in the body's frame.

    Parameters
    ----------
    held : (f, q) which points have an anchor.
    places, normals : (f, q, 3) anchor, mm, and unit normal of the tangent plane.
    bounds : (f, q) slip at which a point gives way, mm; infinite where it never does.
    d_places : (f, q, 3, p) derivative of the anchors with respect to the parameters.
    pulls : (f, q, 3) the dual variable, mm: the part of the slip that pulls, as the tangent takes it to be.
    """

    held: Mask
    places: Array
    normals: Array
    bounds: Array
    d_places: Array
    pulls: Array

    hardness = 1.0  # stiffness that holds a point over that of the contact
    lags: ClassVar[bool] = False  # True if a step holds something constant that follows u (`coupling`)

    @property
    def arrays(self) -> tuple[Mask, Array, Array, Array, Array]:
        """What the contact kernel takes of it, point by point."""
        places, normals, pulls = (x.reshape(-1, 3) for x in (self.places, self.normals, self.pulls))
        return self.held.ravel(), places, normals, self.bounds.ravel(), pulls

    def drop_derivatives(self) -> Self:
        """The same points without derivatives, to be kept."""
        return replace(self, d_places=np.zeros((*self.held.shape, 3, 0)))

    def start(self, tool: Tool) -> StickyContact:
        """The points before the first step, with the body where it starts."""
        return self

    def predict(self, tool: Tool, du: Array) -> Self:
        """The points with the pulls that their tangent predicts after a change ``du (r, 3)`` of ``u``."""
        return self

    @abstractmethod
    def renew(self, tool: Tool) -> StickyContact:
        """What an equilibrium with the body where it is asks for; itself where nothing changes."""

    @abstractmethod
    def advance(self, tool: Tool, du: Array | None) -> StickyContact:
        """The points after a step that ended there.

        ``du (r, 3, p)`` is the derivative of the tool's ``u``, where derivatives are wanted.
        """

    @abstractmethod
    def differentiate_anchors(self, tool: Tool) -> Array:
        """Derivative (f, q, 3, p) of the points' forces, over penalty and area, through the anchors alone."""

    @abstractmethod
    def coupling(self, tool: Tool) -> Array | None:
        """Derivative (f, q, 3, 3) of the forces, over penalty and area, through what a step holds constant
        although it follows the displacement; None where nothing does."""


@dataclass(frozen=True)
class Anchors(StickyContact):
    """A `StickyContact` whose planes stay those at the anchors; ``d_normals (f, q, 3, p)`` is theirs."""

    d_normals: Array

    @classmethod
    def begin(cls, surface: ContactSurface, parameters: int = 0) -> Anchors:
        shape = surface.areas.shape
        vectors, slopes = np.zeros((*shape, 3)), np.zeros((*shape, 3, parameters))
        held, bounds = np.zeros(shape, dtype=bool), np.full(shape, np.inf)
        return cls(held, vectors, vectors, bounds, slopes, vectors, slopes)

    def drop_derivatives(self) -> Self:
        nothing = np.zeros((*self.held.shape, 3, 0))
        return replace(self, d_places=nothing, d_normals=nothing)

    def renew(self, tool: Tool) -> Anchors:
        """The anchors without those whose points left the indenter."""
        lost = self.held & (tool.gaps >= 0.0)
        return replace(self, held=self.held & ~lost) if lost.any() else self

    def advance(self, tool: Tool, du: Array | None) -> Anchors:
        """The anchors at the end of a step: points that touch for the first time are held where they are."""
        local, near, shape = tool.local_points, Distances.from_tool(tool), self.held.shape
        closed, normals = near.scatter(near.gaps, shape) < 0.0, near.scatter(near.normals, shape)
        new = (closed & ~self.held)[..., None]
        d_places, d_normals = self.d_places, self.d_normals
        if du is not None:
            moved, curvatures = tool.relative_motion(du), near.scatter(near.tilts, shape)
            d_places = np.where(new[..., None], moved, d_places)
            d_normals = np.where(new[..., None], curvatures @ moved, d_normals)
        places, normals = np.where(new, local, self.places), np.where(new, normals, self.normals)
        return Anchors(closed, places, normals, self.bounds, d_places, self.pulls, d_normals)

    def differentiate_anchors(self, tool: Tool) -> Array:
        move = tool.local_points - self.places
        n, d_n, d_a = self.normals[..., None], self.d_normals, self.d_places
        across = np.einsum("fqi,fqi->fq", self.normals, move)[..., None, None]
        turned = np.einsum("fqip,fqi->fqp", d_n, move) + -np.einsum("fqi,fqip->fqp", self.normals, d_a)
        change = -(d_n * across + n * turned[:, :, None]) - d_a
        return np.asarray(self.held[..., None, None] * change)

    def coupling(self, tool: Tool) -> None:
        """None: anchors and planes stay."""


@dataclass(frozen=True)
class Coulomb(StickyContact):
    """A `StickyContact` whose bounds are ``mu`` times the penetration, over the ``hardness``."""

    mu: float
    hardness: float

    lags: ClassVar[bool] = True

    @classmethod
    def begin(cls, mu: float, surface: ContactSurface, parameters: int = 0, hardness: float = 1.0) -> Self:
        shape = surface.areas.shape
        nothing, vectors = np.zeros(shape), np.zeros((*shape, 3))
        slopes = np.zeros((*shape, 3, parameters))
        return cls(nothing > 0.0, vectors, vectors, nothing, slopes, vectors, mu, hardness)

    def renew(self, tool: Tool) -> Self:
        """Planes, bounds and pulls as they are where the tool is."""
        now = self._update_bounds(Distances.from_tool(tool, self.held))
        return replace(now, pulls=_Slip.from_points(now, tool.local_points).elastic)

    def predict(self, tool: Tool, du: Array) -> Self:
        slip = _Slip.from_points(self, tool.local_points)
        moved = tool.relative_motion(du[..., None])[..., 0]
        some = np.where(self.bounds > 0.0, self.bounds, 1.0)[..., None]
        lead = _shorten_to_bounds(self.pulls, self.bounds) / some
        across = moved - np.einsum("fqi,fqi->fq", self.normals, moved)[..., None] * self.normals
        along = np.einsum("fqi,fqi->fq", slip.unit, across)[..., None]
        change = slip.share[..., 0] * (across - np.where(slip.stuck[..., None], 0.0, along * lead))
        return replace(self, pulls=_shorten_to_bounds(slip.elastic + change, self.bounds))

    def _update_bounds(self, near: Distances) -> Self:
        bounds = self.mu / self.hardness * np.maximum(-near.gaps, 0.0) * near.steepness
        normals = near.scatter(near.normals, self.held.shape)
        return replace(self, normals=normals, bounds=near.scatter(bounds, self.held.shape))

    def advance(self, tool: Tool, du: Array | None) -> Coulomb:
        """The anchors at the end of a step: those of new points where they are, those of slipping ones drawn
        along; planes and bounds are those that hold there."""
        near = Distances.from_tool(tool, self.held)
        now = self._update_bounds(near)
        closed, local = now.bounds > 0.0, tool.local_points
        slip = _Slip.from_points(now, local)
        new, drawn = (closed & ~self.held)[..., None], (closed & self.held & ~slip.stuck)[..., None]
        places = np.where(new, local, np.where(drawn, local - slip.elastic, self.places))
        d_places = self.d_places
        if du is not None:
            moved = tool.relative_motion(du)
            tangent = slip.tangent + now._coupling(near, slip)
            d_elastic = tangent @ moved - slip.tangent @ d_places
            d_drawn = np.where(drawn[..., None], moved - d_elastic, d_places)
            d_places = np.where(new[..., None], moved, d_drawn)
        pulls = np.where((closed & self.held)[..., None], slip.elastic, 0.0)
        return replace(now, held=closed, places=places, d_places=d_places, pulls=pulls)

    def differentiate_anchors(self, tool: Tool) -> Array:
        return np.asarray(-self.hardness * _Slip.from_points(self, tool.local_points).tangent @ self.d_places)

    def coupling(self, tool: Tool) -> Array:
        """Derivative (f, q, 3, 3) of the forces, over penalty and area, through planes and bounds, which are
        those that hold where the tool is."""
        near = Distances.from_tool(tool, self.held)
        return self.hardness * self._coupling(near, _Slip.from_points(self, tool.local_points))

    def _coupling(self, near: Distances, slip: _Slip) -> Array:
        """That of the elastic part of the slip."""
        bends, deeper = (near.scatter(values, self.held.shape) for values in (near.tilts, near.force_slopes))
        n, move = self.normals, slip.move
        across = np.einsum("fqi,fqi->fq", n, move)[..., None, None]
        turned = -(across * bends + n[..., None] * np.einsum("fqi,fqij->fqj", move, bends)[:, :, None])
        along = np.einsum("fqi,fqij->fqj", slip.unit, turned)[:, :, None]
        yielding = self.mu / self.hardness * slip.unit[..., None] * deeper[:, :, None]
        yielding += slip.share * (turned - slip.unit[..., None] * along)
        found = np.where(slip.stuck[..., None, None], turned, yielding)
        return np.where((self.held & (self.bounds > 0.0))[..., None, None], found, 0.0)


@dataclass(frozen=True)
class StepwiseCoulomb(Coulomb):
    """`Coulomb` with every point anchored where it was at the end of the last step, in touch or not.

    Friction is that of the slip in one step: what sticks slips on by a little in every step, as the force
    that held it is not carried along, and a point rubs in the step in which it first touches.  So forces
    depend on the steps.  This is the law of FEBio's ``sliding-elastic`` with ``laugon`` PENALTY (FEBio 4,
    ``FESlidingElasticInterface``).
    """

    def start(self, tool: Tool) -> StepwiseCoulomb:
        """Every point where it is at rest."""
        return self.advance(tool, None)

    def advance(self, tool: Tool, du: Array | None) -> StepwiseCoulomb:
        """Every point where it is at the end of a step."""
        places, d_places = tool.local_points, self.d_places if du is None else tool.relative_motion(du)
        now, held = self.renew(tool), np.ones_like(self.held)
        now = replace(now, held=held, places=places, d_places=d_places)
        return now._update_bounds(Distances.from_tool(tool, held))


# How long a point that sticks keeps its anchor: until it slips, or for one step.
LAWS_OF_STICKING: dict[str, type[Coulomb]] = {"anchored": Coulomb, "stepwise": StepwiseCoulomb}


@dataclass(frozen=True)
class _Slip:
    """The slip of the held points (f, q) at one place.

    Parameters
    ----------
    move : (f, q, 3) from the anchor, mm.
    unit : (f, q, 3) direction of the slip in the tangent plane; zero where there is none.
    stuck : (f, q) which points are within their bounds.
    elastic : (f, q, 3) the part of the slip that pulls, mm: the force over penalty and area.
    share : (f, q, 1, 1) of that part.
    tangent : (f, q, 3, 3) derivative of ``elastic``, planes and bounds held.
    """

    move: Array
    unit: Array
    stuck: Mask
    elastic: Array
    share: Array
    tangent: Array

    @classmethod
    def from_points(cls, grip: Coulomb, local: Array) -> _Slip:
        n, move = grip.normals, local - grip.places
        slip = move - np.einsum("fqi,fqi->fq", n, move)[..., None] * n
        length = np.linalg.norm(slip, axis=-1)
        stuck = length < grip.bounds
        some = np.where(length > 0.0, length, 1.0)
        unit = slip / some[..., None]
        share = np.where(stuck, 1.0, grip.bounds / some)[..., None, None]
        planes = np.eye(3) - n[..., :, None] * n[..., None, :]
        outer = np.where(stuck[..., None, None], 0.0, unit[..., :, None] * unit[..., None, :])
        tangent = np.where(grip.held[..., None, None], share * (planes - outer), 0.0)
        return cls(move, unit, stuck, share[..., 0] * slip, share, tangent)


def _shorten_to_bounds(vectors: Array, bounds: Array) -> Array:
    """Vectors (f, q, 3) shortened to the bounds (f, q)."""
    length = np.linalg.norm(vectors, axis=-1)
    return vectors * np.minimum(1.0, bounds / np.where(length > 0.0, length, 1.0))[..., None]
