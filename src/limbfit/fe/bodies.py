"""The rigid bodies of a discretised problem: their contact as energy, forces, springs and matrix entries.

What is free to move a body joins the unknowns: its coordinates come after those of the nodes, in mm (turns
times `Tool.unit`).  All contact points of all bodies are numbered in one row.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp

from ..arrays import Array, Index, Mask
from .contact.contact import ContactSurface, Touch, add_springs, check_clear, contact, find_touching_offset
from .contact.friction import StickyContact
from .contact.rigid import RigidShape
from .contact.tool import Distances, Pose, Tool
from .kernel.elements import Element
from .motion import Drives, Motion, RigidBody
from .pattern import Pattern, find_positions
from .problem import Problem, ProblemError

# Stiffness that holds a coordinate while a displacement drives it which a force drives at other times, over
# that of all its contact faces: it stays unknown, so that nothing is numbered anew.
HOLDING_STIFFNESS = 100.0
# Stiffness of a coordinate whose body touches nothing, over that of the tissue against a body of its width.
GROUNDING_STIFFNESS = 0.1
# Move of a body that a force drives over its width, up to which a linear model predicts its contact.
TRUSTED_MOVE = 0.05
# Gap over a body's width up to which it may touch what is beside its way.
NEAR_GAP = 0.05


@dataclass(frozen=True)
class Contacts:
    """The contact of all bodies in one state.

    ``area`` and ``penetration`` are mm^2 and mm over all bodies; ``reactions (b, 6)`` the forces, N, and
    moments, N mm, that move each body's coordinates; ``residual (r, 3)`` N; ``turning (c, 3, k)`` and
    ``bending (k, k)`` the parts of the tangent that turns of bodies have beyond the springs; ``tools`` where
    the bodies are.
    """

    energy: float
    penetration: float
    area: float
    reactions: Array
    residual: Array
    touch: Touch
    turning: Array
    bending: Array
    tools: list[Tool]


class _Body:
    """One body: its surface, where it starts, and which of all contact points and unknowns are its own."""

    def __init__(self, stated: RigidBody, surface: ContactSurface, start: RigidShape, row: int) -> None:
        self.stated, self.surface, self.start = stated, surface, start
        self.free = np.flatnonzero(stated.motion.free)
        self.row = row
        self.unit = start.width / 2
        self.frame = start.frame
        self.points = slice(0, 0)
        self.columns = slice(0, 0)
        nothing = np.zeros(surface.areas.size)
        vectors = np.zeros((nothing.size, 3))
        self.loose = (nothing > 0.0, vectors, vectors, nothing, vectors), 1.0

    @property
    def pivot(self) -> Array:
        """The stated one, moved as the body was to where it starts."""
        return self.stated.origin + np.asarray(self.start.centre) - np.asarray(self.stated.shape.centre)

    @property
    def scale(self) -> Array:
        """(6,) mm in ``u`` per mm or radian of the coordinates."""
        return np.repeat([1.0, self.unit], 3)

    def tool(self, u: Array, drive: Array, growth: float) -> Tool:
        """Where it is at ``u (r, 3)``, grown so far; the coordinates that no force ever drives are at
        ``drive (6,)``."""
        coordinates = drive.copy()
        if len(self.free):
            found = u[self.row : self.row + 2].ravel() / self.scale
            coordinates[self.free] = found[self.free]
        pose = Pose(self.start.grown(growth), self.pivot, coordinates)
        return Tool(self.surface, pose, u, self.free, self.row, self.unit)


def count_body_rows(bodies: Sequence[RigidBody]) -> int:
    """Rows of ``u`` beyond those of the nodes: two for each body that something is free to move."""
    return 2 * sum(bool(body.motion.free.any()) for body in bodies)


class Bodies:
    """See the module docstring; there may be none.

    ``levers (c, 3, k)`` are those of the last tangent that was evaluated.
    """

    def __init__(self, problem: Problem, element: Element, points: Array, pattern: Pattern) -> None:
        self.pattern, self.nodes = pattern, len(points)
        self.unknowns = len(pattern.indptr) - 1
        row, first, column = len(points), 0, 0
        self.all: list[_Body] = []
        for stated in problem.rigid_bodies:
            surface = ContactSurface.build(
                element, points, np.asarray(stated.faces, dtype=np.int64), problem.contact_rule
            )
            body = _Body(stated, surface, _place_start(problem, stated, surface), row)
            body.points = slice(first, first + surface.areas.size)
            body.columns = slice(column, column + len(body.free))
            first, column = body.points.stop, body.columns.stop
            row += 2 if len(body.free) else 0
            self.all.append(body)
            drive, forced, growth = stated.motion.at(0.0)
            start = impose_coordinates(body, np.zeros((row, 3)), drive, forced)
            check_clear(surface, body.tool(start, drive, growth).body, stated.name)
        self.rows, self.count, self.free = row, first, column
        self.levers = np.zeros((first, 3, column))
        frames = [np.broadcast_to(b.frame, (b.surface.areas.size, 3, 3)) for b in self.all]
        self.frames = np.concatenate(frames or [np.zeros((0, 3, 3))])
        shares = []
        for body in self.all:
            whole = sp.kron(body.surface.shares, sp.eye(3), format="csr")
            own = whole[np.flatnonzero(pattern.numbers[: self.nodes].ravel() >= 0)]
            own.resize(self.unknowns, whole.shape[1])  # the coordinates of bodies are the last unknowns
            shares.append(own)
        # (unknowns, 3 c) of the unknowns in the position of every contact point.
        self.shares = sp.hstack(shares or [sp.csr_matrix((self.unknowns, 0))], format="csr")
        self._positions = [find_positions(b.surface.faces, pattern.numbers, pattern.indptr, pattern.indices)
                           for b in self.all]  # fmt: skip
        # Where the entries of the bodies' coordinates are in the matrix.
        border = self.unknowns - self.free
        places = np.flatnonzero(pattern.indices >= border)
        rows = np.searchsorted(pattern.indptr, places, side="right") - 1
        columns, above = pattern.indices[places] - border, rows < border
        self._beside = rows[above], columns[above], places[above]
        self._corner = rows[~above] - border, columns[~above], places[~above]

    @property
    def first_body(self) -> _Body:
        """The indenter, or the first body where there is none."""
        return self.all[0]

    def tools(self, u: Array, drives: Drives) -> list[Tool]:
        """Where every body is at ``u (r, 3)``."""
        return [body.tool(u, *drive) for body, *drive in zip(self.all, drives.values, drives.growth)]

    def impose(self, u: Array, drives: Drives) -> Array:
        """``u`` with the free coordinates that displacements drive now at their values."""
        for body, value, forced in zip(self.all, drives.values, drives.forced):
            if len(body.free):
                u = impose_coordinates(body, u, value, forced)
        return u

    def compute_trusted_share(self, direction: Array) -> float:
        """The share, up to 1, of a change ``direction (r, 3)`` of ``u`` for which the linear model of contact
        is trusted; all of it where no force drives a body."""
        widths = [body.start.width for body in self.all if len(body.free)]
        if not widths:
            return 1.0
        return 1.0 / max(1.0, float(np.abs(direction).max()) / (TRUSTED_MOVE * min(widths)))

    def evaluate(
        self,
        u: Array,
        drives: Drives,
        penalty: float,
        flat_from: float,
        grips: Sequence[StickyContact | None],
        tangent: bool,
    ) -> Contacts:
        """Energy and forces of all contact at ``u (r, 3)``; what a tangent needs where it is wanted."""
        gaps, weights, size = np.full(self.count, np.inf), np.zeros(self.count), (self.count, 3)
        forces, normals = np.zeros(size), np.zeros(size)
        blocks, stick = np.zeros((*size, 3)), np.zeros((*size, 3))
        residual, reactions = np.zeros_like(u), np.zeros((len(self.all), 6))
        turning, bending = np.zeros((*size, self.free)), np.zeros((self.free, self.free))
        energy = deepest = area = 0.0
        tools = self.tools(u, drives)
        for i, (body, tool) in enumerate(zip(self.all, tools)):
            at, grip = body.points, grips[i] if i < len(grips) else None
            near = Distances.from_tool(tool, None if grip is None else grip.held)
            areas = body.surface.areas.ravel()
            weights[at] = penalty * areas
            found = contact(
                (near.points, near.places, near.gaps, near.slopes, near.bends), tool.body.frame, weights[at],
                areas, flat_from, *(body.loose if grip is None else (grip.arrays, grip.hardness)), forces[at],
                gaps[at], normals[at], blocks[at], stick[at],
            )  # fmt: skip
            energy, deepest, area = energy + found[0], max(deepest, found[1]), area + found[2]
            pushed = np.flatnonzero(forces[at].any(axis=1))
            places = tool.places.reshape(-1, 3)[pushed]
            levers = tool.pose.levers(places, np.arange(6))
            reactions[i] = np.einsum("cik,ci->k", levers, forces[at][pushed])
            residual += tool.distribute_forces(forces[at][..., None])[..., 0]
            if tangent and len(body.free):
                units, columns = tool.units, body.columns
                self.levers[at, :, columns] = tool.levers
                turning[at, :, columns] = tool.pose.compute_turning(forces[at], body.free) * units
                bent = tool.pose.compute_bending(places, forces[at][pushed], body.free)
                moved = np.einsum("cij,cik->jk", self.levers[at, :, columns], turning[at, :, columns])
                # Between moves and turns: lever of row times turning of column.
                moved = np.where((body.free[:, None] < 3) & (body.free > 2), moved, 0.0)
                bending[columns, columns] = bent * units * units[:, None] + moved + moved.T
        touch = Touch(gaps, normals, weights, blocks, stick, forces)
        return Contacts(energy, deepest, area, reactions, residual, touch, turning, bending, tools)

    def add_tangent(
        self, found: Contacts, drives: Drives, penalty: float, modulus: float, data: Array
    ) -> None:
        """Add the hessian of the contact energy, and of what holds bodies, to the entries ``data``.

        A body that a force drives and that touches nothing is given some: there must be a way to go.
        """
        self._add_springs(found.touch.blocks, data)
        if self.free:
            held = self.compute_grounding(modulus)
            for body, forced in zip(self.all, drives.forced):
                touching = (found.touch.gaps[body.points] < 0.0).any()
                loose = np.where(touching, 0.0, held[body.columns])
                held[body.columns] = np.where(
                    forced[body.free], loose, self._holding_stiffness(body, penalty)
                )
            self._add_border(found.turning, found.bending + np.diag(held), data)

    def compute_grounding(self, modulus: float) -> Array:
        """Stiffness (k,) of the free coordinates of bodies that touch nothing, N/mm, in tissue of a shear
        ``modulus``."""
        sizes = [np.full(len(body.free), body.start.width) for body in self.all]
        return GROUNDING_STIFFNESS * modulus * np.concatenate([np.zeros(0), *sizes])

    def _holding_stiffness(self, body: _Body, penalty: float) -> float:
        """What holds a free coordinate where a displacement drives it, N/mm."""
        return HOLDING_STIFFNESS * penalty * float(body.surface.areas.sum())

    def with_springs(self, data: Array, blocks: Array) -> Array:
        """``data`` plus a stiffness (c, 3, 3) at every contact point."""
        data = data.copy()
        self._add_springs(np.ascontiguousarray(blocks), data)
        return data

    def _add_springs(self, blocks: Array, data: Array) -> None:
        for body, places in zip(self.all, self._positions):
            shape = (*body.surface.areas.shape, 3, 3)
            add_springs(body.surface.N, blocks[body.points].reshape(shape), places, data)
        if self.free:
            columns = blocks @ self.levers
            self._add_border(columns, np.einsum("cij,cik->jk", self.levers, columns), data)

    def _add_border(self, columns: Array, corner: Array, data: Array) -> None:
        """Add what points feel of the coordinates (c, 3, k), and coordinates of each other (k, k)."""
        beside = self.shares @ columns.reshape(-1, self.free)
        for values, (rows, own, places) in ((beside, self._beside), (corner, self._corner)):
            data[places] += values[rows, own]

    def differentiate_advance(self, found: Contacts) -> Array:
        """Mixed derivative (r, 3) with respect to displacement and advance of the first body, times -1."""
        body, axis = self.first_body, self.first_body.frame[2]
        out = found.tools[0].distribute_forces((found.touch.blocks[body.points] @ axis)[..., None])[..., 0]
        if len(body.free):
            turned = np.zeros(6)
            turned[body.free] = axis @ found.turning[body.points, :, body.columns].sum(axis=0)
            out[body.row : body.row + 2] += turned.reshape(2, 3)
        return out

    def project_on_axis(self, forces: Array) -> Array:
        """What forces (c, 3, p) on the points ask of the first body along its axis (p,), N."""
        return -np.einsum("i,cip->p", self.first_body.frame[2], forces[self.first_body.points])

    def spread_forces(self, forces: Array, shares: sp.csr_matrix | None = None) -> Array:
        """Forces (c, 3, ...) at the contact points as a vector (or matrix) of the unknowns, or of some."""
        shares = self.shares if shares is None else shares
        out = np.asarray(shares @ forces.reshape(-1, *forces.shape[2:]))
        if self.free:
            out[-self.free :] += np.einsum("cik,ci...->k...", self.levers, forces)
        return out

    def move_springs(self, x: Array, shares: sp.csr_matrix | None = None) -> Array:
        """Values (c, 3, ...) of a vector (or matrix) of the unknowns, or of some, at the contact points,
        relative to the bodies."""
        shares = self.shares if shares is None else shares
        out = np.asarray(shares.T @ x).reshape(-1, 3, *x.shape[1:])
        if self.free:
            out += np.einsum("cik,k...->ci...", self.levers, x[-self.free :])
        return out

    def find_swept_unknowns(self, motions: Sequence[Motion]) -> Index:
        """Unknowns at contact points that bodies driven by displacements come near to where they rest."""
        rest, under = np.zeros((self.rows, 3)), np.zeros(self.count, dtype=bool)
        for body, motion in zip(self.all, motions):
            for t in motion.times:
                value, forced, growth = motion.at(t)
                tool = body.tool(rest, np.where(forced, 0.0, value), growth)
                under[body.points] |= tool.gaps.ravel() < NEAR_GAP * body.start.width
        touched = np.diff(self.shares[:, np.repeat(under, 3)].indptr) > 0
        touched[self.unknowns - self.free :] = touched.any()
        return np.flatnonzero(touched).astype(np.int32)

    def find_points_on(self, unknowns: Index) -> Mask:
        """Contact points (c,) that move with these unknowns alone; none where there are none."""
        others = np.ones(self.unknowns)
        others[unknowns] = 0.0
        alone = (self.shares.T @ others).reshape(-1, 3) == 0.0
        return alone.all(axis=1) & (len(unknowns) > 0)

    def evaluate_drives(self, u: Array, drives: Drives, penalty: float) -> tuple[float, Array, float]:
        """Energy of what drives the free coordinates at ``u (r, 3)``, its derivative (r, 3), and the norm of
        the forces among it, N."""
        energy, norm, residual = 0.0, 0.0, np.zeros_like(u)
        for body, value, forced in zip(self.all, drives.values, drives.forced):
            if not len(body.free):
                continue
            now, scale = u[body.row : body.row + 2].ravel()[body.free], body.scale[body.free]
            pulls, off = value[body.free] / scale, now - value[body.free] * scale
            under = forced[body.free]
            stiff = self._holding_stiffness(body, penalty)
            energy += float(np.where(under, -pulls * now, 0.5 * stiff * off**2).sum())
            out = np.zeros(6)
            out[body.free] = np.where(under, -pulls, stiff * off)
            residual[body.row : body.row + 2] = out.reshape(2, 3)
            norm += float((pulls[under] ** 2).sum())
        return energy, residual, norm**0.5

    @property
    def own_rows(self) -> tuple[slice, ...]:
        """Of every body, its rows beyond those of the nodes."""
        first = [body.row - self.nodes for body in self.all]
        return tuple(slice(row, row + 2 * bool(len(body.free))) for row, body in zip(first, self.all))

    def differentiate_holding_forces(self, drives: Drives, penalty: float, du: Array) -> Array:
        """Derivatives (r - n, 3, p) of what holds the free coordinates that displacements drive.

        As forces of `driven`, zero for the others; ``du (r - n, 3, p)`` are those of the coordinates, for
        which the stiffness that holds them is a constant.
        """
        out = np.zeros_like(du)
        for body, rows, forced in zip(self.all, self.own_rows, drives.forced):
            held = np.zeros(6, dtype=bool)
            held[body.free] = ~forced[body.free]
            if held.any():
                out[rows] = -self._holding_stiffness(body, penalty) * held.reshape(2, 3, 1) * du[rows]
        return out


def impose_coordinates(body: _Body, u: Array, value: Array, forced: Mask) -> Array:
    """``u (r, 3)`` with the coordinates of a body at ``value (6,)`` that are free and not ``forced`` now."""
    held = np.zeros(6, dtype=bool)
    held[body.free] = ~forced[body.free]
    if held.any():
        u = u.copy()
        rows = u[body.row : body.row + 2].ravel()
        rows[held] = (value * body.scale)[held]
        u[body.row : body.row + 2] = rows.reshape(2, 3)
    return u


def _place_start(problem: Problem, stated: RigidBody, surface: ContactSurface) -> RigidShape:
    """Where a body starts: the indenter just in touch, if the problem says so."""
    if stated.shape is not problem.indenter or problem.start != "touching":
        return stated.shape
    offset = find_touching_offset(surface, stated.shape)
    start = stated.shape.move(offset)
    if abs(surface.gaps_at_rest(start).min()) > 1e-6:
        what = "the indenter never meets the contact faces"
        raise ProblemError(what, remedy="check its centre, axis and the faces")
    return start
