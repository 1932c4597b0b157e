"""Frictionless rigid contact by a penalty energy over the reference skin.

``E = eps/2 int <-phi(x)>^2 dA_0`` with the indenter's signed distance ``phi``: one potential, hence a
symmetric tangent, and a reaction that is its derivative with respect to the indenter's advance.  The body
gives distances, gradients and hessians (`Distances`); the energy's kernel knows nothing else of it.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.sparse as sp
from numba import njit

from ...arrays import Array, Indices, Mask
from ...errors import ProblemError
from ..kernel.elements import Element, build_face_quadrature
from .rigid import RigidShape

MAX_START_DEPTH_MM = 0.02  # a body may start that deep: other quadratures touch a little sooner


@dataclass(frozen=True)
class ContactSurface:
    """Faces (f, k) that may touch: shape values (q, k), reference areas (f, q), rest points (n, 3).

    With the nodal rule a "face" is one node (k = q = 1) that stands for its share of the area.
    """

    faces: Indices
    N: Array
    areas: Array
    points: Array

    @classmethod
    def build(cls, element: Element, points: Array, faces: Indices, rule: str) -> ContactSurface:
        N, areas = build_face_quadrature(element, points, faces, rule)
        if rule == "nodes":
            nodes, owner = np.unique(faces[:, N.argmax(axis=1)], return_inverse=True)
            share = np.asarray(np.bincount(owner.ravel(), areas.ravel()), dtype=float)
            return cls(nodes[:, None], np.ones((1, 1)), share[:, None], points)
        return cls(np.ascontiguousarray(faces), np.ascontiguousarray(N), areas, points)

    @property
    def points_at_rest(self) -> Array:
        """The quadrature points (f, q, 3) of the undeformed surface, mm."""
        return self.interpolate_points(self.points)

    def gaps_at_rest(self, indenter: RigidShape) -> Array:
        """Signed distances (f, q) of the undeformed surface, mm."""
        points = self.points_at_rest
        return indenter.signed_distance(points.reshape(-1, 3)).reshape(points.shape[:2])

    def interpolate_points(self, nodes: Array) -> Array:
        """The quadrature points (f, q, 3) of nodes that are at ``nodes (n, 3)``, mm."""
        return np.einsum("qk,fki->fqi", self.N, nodes[self.faces], optimize=True)

    @cached_property
    def shares(self) -> sp.csr_matrix:
        """(n, f q): how the force at every quadrature point is that of the nodes."""
        (f, k), q = self.faces.shape, len(self.N)
        nodes, shares = np.broadcast_arrays(self.faces[:, None], self.N[None])
        columns = np.repeat(np.arange(f * q), k)
        return sp.csr_matrix((shares.ravel(), (nodes.ravel(), columns)), shape=(len(self.points), f * q))


@dataclass(frozen=True)
class Touch:
    """Contact points (c,) as springs: gap (mm, infinite where far), unit normal (c, 3), stiffness
    ``weights (c,)`` along it (N/mm), and the tangent ``blocks (c, 3, 3)``; the part ``stick (c, 3, 3)`` of
    the tangent is that of anchors, there whether the gap is closed or not.  ``forces (c, 3)``: derivative
    of the energy with respect to the points, N."""

    gaps: Array
    normals: Array
    weights: Array
    blocks: Array
    stick: Array
    forces: Array

    @property
    def is_closed(self) -> Mask:
        return self.gaps < 0.0

    def assume_closed(self, closed: Mask) -> tuple[Array, Array]:
        """Blocks (c, 3, 3) and the change of the contact forces (c, 3) were ``closed`` the points in touch.

        A point that closes pulls until it touches; one that opens is let go.
        """
        change = closed.astype(float) - self.is_closed
        stiff = self.weights[:, None, None] * self.normals[:, :, None] * self.normals[:, None, :]
        gaps = np.where(change != 0.0, self.gaps, 0.0)
        pushing = np.where((change > 0)[:, None, None], stiff, self.blocks - self.stick)
        forces = (change * self.weights * gaps)[:, None] * self.normals
        return self.stick + pushing * closed[:, None, None], forces


def find_touching_offset(surface: ContactSurface, indenter: RigidShape) -> float:
    """Advance along the axis, mm, that brings the indenter to just touch the undeformed surface.

    From far outside it advances by the smallest distance, which cannot jump over the first touch, or by a
    thousandth of its width where that is less; the last advance is then halved.
    """
    at = surface.points_at_rest.reshape(-1, 3)
    along = (at - np.asarray(indenter.centre)) @ indenter.frame[2]
    low = high = float(along.min()) - indenter.width
    end, least = float(along.max()) + indenter.length, 1e-3 * indenter.width

    def gap(advance: float) -> float:
        return float(indenter.move(advance).signed_distance(at).min())

    while high < end and (distance := gap(high)) > 0.0:
        low, high = high, high + max(distance, least)
    while high - low > 1e-9:
        middle = 0.5 * (low + high)
        low, high = (middle, high) if gap(middle) > 0.0 else (low, middle)
    return low


def check_clear(surface: ContactSurface, indenter: RigidShape, name: str) -> None:
    """Raise `ProblemError` where the body starts inside the undeformed tissue."""
    gaps = surface.gaps_at_rest(indenter)
    at = np.unravel_index(gaps.argmin(), gaps.shape)
    depth = -float(gaps[at])
    if depth > MAX_START_DEPTH_MM:
        where = ", ".join(f"{v:.2f}" for v in surface.points_at_rest[at])
        what = f"the {name} starts {depth:.3g} mm inside the tissue, deepest at ({where}) mm"
        raise ProblemError(what, remedy="move it out along its axis, or start it touching")


@njit(cache=True)
def contact(  # type: ignore[no-untyped-def]
    near, frame, weights, areas, flat_from, grip, hardness, forces, gaps, normals, blocks, stick
):  # fmt: skip
    """Energy and forces of the contact points of one body; the hessian is that of the springs ``blocks``.

    ``near``: the arrays of `Distances`, whatever the body; ``frame``: the axes (3, 3) of the body.
    ``weights, areas (c,)``: penalty times area (N/mm) and area of every point.  ``flat_from``: penetration
    from which a point's tangent leaves the body's curvature out (mm).  ``grip``: the held points, their
    anchors, normals, bounds and pulls (`StickyContact`), by ``hardness`` times the weights.
    ``forces (c, 3)`` receive
    the derivative of the energy with respect to the points, N; ``gaps (c,)``, ``normals (c, 3)`` and ``blocks
    (c, 3, 3)`` distance, its gradient and the tangent of each point, ``stick (c, 3, 3)`` the part of the
    tangent that holds it along the body.
    Returns energy, largest penetration (mm), reference area in touch (mm^2).
    """
    points, local, phis, slopes, bends = near
    held, places, planes, bounds, pulls = grip
    t, h, hold = np.empty(3), np.empty((3, 3)), np.empty((3, 3))
    energy = deepest = area = 0.0
    for p in range(len(points)):
        c = points[p]
        phi, g, w = phis[p], slopes[p], weights[c]
        gaps[c] = phi
        t[:], h[:] = 0.0, 0.0
        for i in range(3):
            normals[c, i] = frame[0, i] * g[0] + frame[1, i] * g[1] + frame[2, i] * g[2]
        if phi < 0.0:
            energy += 0.5 * w * phi * phi
            deepest = max(deepest, -phi)
            area += areas[c]
            for i in range(3):
                t[i] = w * phi * g[i]
                for j in range(3):
                    h[i, j] = w * (g[i] * g[j] + (phi * bends[p, i, j] if phi > -flat_from else 0.0))
        if held[c]:
            energy += _hold(local[p], places[c], planes[c], bounds[c], pulls[c], hardness * w, t, hold)
            _rotate_tensor(frame, hold, stick[c])
            for i in range(3):
                for j in range(3):
                    h[i, j] += hold[i, j]
        elif phi >= 0.0:
            continue
        for i in range(3):
            forces[c, i] = frame[0, i] * t[0] + frame[1, i] * t[1] + frame[2, i] * t[2]
        _rotate_tensor(frame, h, blocks[c])
    return energy, deepest, area


@njit(cache=True)
def _rotate_tensor(frame, h, out):  # type: ignore[no-untyped-def]
    """Fill ``out`` with the tensor ``h (3, 3)`` of the body's frame in space."""
    for i in range(3):
        for j in range(3):
            out[i, j] = 0.0
            for p in range(3):
                for r in range(3):
                    out[i, j] += frame[p, i] * h[p, r] * frame[r, j]


@njit(cache=True)
def _hold(local, place, normal, bound, pull, w, t, h):  # type: ignore[no-untyped-def]
    """Add the force of an anchor at the point ``local (3,)`` and fill its tangent; returns its energy.

    Of a point that slips the tangent is stiff across the dual ``pull (3,)``, mm, and along it only as far as
    the pull is short of the bound.
    """
    slip, lead = np.empty(3), np.empty(3)
    across = length = 0.0
    for i in range(3):
        across += normal[i] * (local[i] - place[i])
    for i in range(3):
        slip[i] = local[i] - place[i] - across * normal[i]
        length += slip[i] * slip[i]
    length = np.sqrt(length)
    stuck = length < bound
    share = 1.0 if stuck else (bound / length if length > 0.0 else 0.0)
    if share > 0.0 and not stuck:
        along = pull[0] * normal[0] + pull[1] * normal[1] + pull[2] * normal[2]
        for i in range(3):
            lead[i] = pull[i] - along * normal[i]
        longest = max(bound, np.sqrt(lead[0] * lead[0] + lead[1] * lead[1] + lead[2] * lead[2]))
        for i in range(3):
            lead[i] /= longest
    for i in range(3):
        t[i] += w * share * slip[i]
        for j in range(3):
            h[i, j] = w * share * ((1.0 if i == j else 0.0) - normal[i] * normal[j])
            if share > 0.0 and not stuck:
                h[i, j] -= 0.5 * w * share * (lead[i] * slip[j] + slip[i] * lead[j]) / length
    return w * (0.5 * length * length if stuck else bound * (length - 0.5 * bound))


@njit(cache=True)
def add_springs(N, blocks, positions, data):  # type: ignore[no-untyped-def]
    """Add stiffnesses ``blocks (f, q, 3, 3)`` at the contact points to the sparse ``data``.

    ``positions (f, .)``: where each entry of a face's upper triangle goes; -1: nowhere.
    """
    k = N.shape[1]
    Ke = np.empty((3 * k, 3 * k))
    for f in range(len(blocks)):
        if not blocks[f].any():
            continue
        Ke[:] = 0.0
        for q in range(N.shape[0]):
            for i in range(3):
                for j in range(3):
                    for a in range(k):
                        for b in range(k):
                            Ke[i * k + a, j * k + b] += blocks[f, q, i, j] * N[q, a] * N[q, b]
        at = 0
        for r in range(3 * k):
            for c in range(r, 3 * k):
                if positions[f, at] >= 0:
                    data[positions[f, at]] += Ke[r, c]
                at += 1
