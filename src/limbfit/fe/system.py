"""The discretised body: what depends on mesh, supports and contact faces only, built once and reused.

Free displacement components are numbered node by node; the matrix is the upper triangle in CSR form, and
every entry of every element's upper triangle knows its place in it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from functools import cache
from itertools import pairwise
from typing import TypeVar

import numpy as np

from ..arrays import Array
from .bodies import Bodies, Contacts, count_body_rows
from .checking import check
from .contact.contact import Touch
from .contact.friction import StickyContact
from .contact.rigid import Indenter
from .contact.tool import Tool
from .kernel.assembly import Elements, assemble
from .kernel.elements import Element, compute_reference_gradients
from .kernel.laws import Laws
from .motion import Drives
from .pattern import Pattern, append_rows, build_node_graph, build_upper_pattern, find_positions
from .pressure import Pressures
from .problem import Problem, ProblemError

T = TypeVar("T")


@cache
def get_thread_pool(threads: int) -> ThreadPoolExecutor:
    """Workers for compiled kernels that let go of the interpreter; kept for the life of the process."""
    return ThreadPoolExecutor(threads)


@dataclass(frozen=True)
class Increment:
    """What is constant while one step is solved.

    ``displacement`` is that of the history, mm, which drives the supports; ``scale (r,)`` and ``history (m,
    q, 6)`` are s and K of `assembly`; ``penalty`` in MPa/mm; the ``grips`` hold points along the bodies;
    points deeper than ``flat_from`` (mm) have the tangent of a flat body; the ``drives`` move the rigid
    bodies.  The ``pressures (k,)`` in MPa act, with ``rims (n, 3)`` as `Pressures.compute_rims` gave them.
    ``activation``: share of the active stress.
    """

    time: float
    displacement: float
    scale: Array
    history: Array
    penalty: float
    drives: Drives = field(default_factory=Drives.make_empty)
    grips: tuple[StickyContact | None, ...] = ()
    flat_from: float = np.inf
    pressures: tuple[float, ...] = ()
    rims: Array | float = 0.0
    activation: float = 0.0

    @property
    def lags(self) -> bool:
        """True if the step holds something constant that follows the displacement."""
        return bool(self.pressures) or any(grip is not None and grip.lags for grip in self.grips)

    def predict(self, tools: Sequence[Tool], du: Array) -> Increment:
        """With the grips that their tangents predict after a change ``du (r, 3)``; the ``tools`` as now."""
        if not any(self.grips):
            return self
        return replace(self, grips=tuple(g and g.predict(tool, du) for g, tool in zip(self.grips, tools)))


@dataclass(frozen=True)
class Evaluation:
    """The potential and its derivatives at one displacement field.

    ``data``: entries of the tangent; None where it was not asked for.  ``reactions (b, 6)``: what moves the
    coordinates of each body, N and N mm; ``force`` is the first body's along its axis.  ``contact_norm,
    load_norm``: norms of the nodal contact forces, and of the forces that drive bodies, N.
    """

    energy: float
    residual: Array
    data: Array | None
    force: float = 0.0
    penetration: float = 0.0
    contact_area: float = 0.0
    advance: Array | None = None
    contact_norm: float = 0.0
    touch: Touch | None = None
    reactions: Array | None = None
    load_norm: float = 0.0

    @property
    def tangent(self) -> Array:
        """Entries of the tangent."""
        if self.data is None:
            raise ValueError("the tangent was not evaluated")
        return self.data


class System:
    """A problem's discretisation; see the module docstring.  Valid for any materials and history.

    ``threads`` share the cells in every compiled pass.
    """

    def __init__(self, problem: Problem, threads: int = 1) -> None:
        check(problem)
        self.threads = threads
        mesh = problem.mesh
        self.problem = problem
        self.element: Element = problem.formulation
        self.nodes = len(mesh.points)
        self.rows = self.nodes + count_body_rows(problem.rigid_bodies)
        self.points = np.ascontiguousarray(mesh.points, dtype=float)
        self.cells = np.ascontiguousarray(mesh.cells, dtype=np.int32)
        self.regions = np.ascontiguousarray(mesh.regions, dtype=np.int32)
        self.fibres = np.zeros((0, 3))
        if problem.fibres is not None:
            given = np.broadcast_to(np.asarray(problem.fibres, dtype=float), (len(self.cells), 3))
            self.fibres = np.ascontiguousarray(given / np.linalg.norm(given, axis=1, keepdims=True))
        self.gradients, self.weights = compute_reference_gradients(self.element, self.points, mesh.cells)
        self.prestretch = np.zeros((0, 3, 3))
        if problem.prestretch is not None:
            self._apply_prestretch(np.asarray(problem.prestretch, dtype=float))
        self._number_unknowns(problem)
        moved = [np.unique(body.faces) for body in problem.rigid_bodies if body.motion.free.any()]
        graph = append_rows(build_node_graph(self.cells, self.nodes), moved)
        self.indptr, self.indices = build_upper_pattern(self.numbers, graph)
        self.cell_positions = find_positions(self.cells, self.numbers, self.indptr, self.indices)
        pattern = Pattern(self.indptr, self.indices, self.numbers)
        self.pressures = Pressures(self.element, self.points, problem.pressures, pattern)
        self.bodies = Bodies(problem, self.element, self.points, pattern)

    @property
    def indenter(self) -> Indenter | None:
        """The problem's indenter where it starts."""
        if self.problem.indenter is None:
            return None
        start = self.bodies.first_body.start
        assert isinstance(start, Indenter)
        return start

    def _apply_prestretch(self, stretches: Array) -> None:
        """Make gradients (m, q, 3, k) 1/mm and weights (m, q) mm^3 those of the unstrained tissue.

        The elastic deformation of the tissue is ``F G``: ``F`` is that of the mesh, ``G (m, 3, 3)`` the
        deformation from tissue on its own, without stress, to the mesh before equilibrium (multiplicative
        pre-strain; Weiss, Gardiner and Bonifasi-Lista 2002, J. Biomech. 35, 943).  With ``G^T grad N`` and
        ``w/det G`` every kernel sees the tissue on its own; only ``F G = G + sum_a u_a x G^T grad N_a``
        knows ``G`` itself.
        """
        G = np.array(np.broadcast_to(stretches, (len(self.weights), 3, 3)), order="C")
        gradients = np.einsum("mji,mqjk->mqik", G, self.gradients)
        self.prestretch, self.gradients = G, np.ascontiguousarray(gradients)
        self.weights = self.weights / np.linalg.det(G)[:, None]

    def _number_unknowns(self, problem: Problem) -> None:
        factors = np.full((self.rows, 3), np.nan)
        for support in problem.supports:
            factors[np.asarray(support.nodes, dtype=int), support.component] = support.factor
        factors[np.asarray(problem.fixed, dtype=int)] = 0.0
        free = np.isnan(factors)
        forced = [body.motion.free for body in problem.rigid_bodies if body.motion.free.any()]
        free[self.nodes :] = np.array(forced, dtype=bool).reshape(-1, 3)
        self.supported = ~free
        self.factors = np.where(free | np.isnan(factors), 0.0, factors)
        self.free = np.flatnonzero(free.ravel())
        self.numbers = np.full((self.rows, 3), -1, dtype=np.int32)
        self.numbers.ravel()[self.free] = np.arange(len(self.free), dtype=np.int32)
        if not len(self.free):
            raise ProblemError("every node is held: nothing is left to solve")

    @property
    def unknowns(self) -> int:
        return len(self.free)

    def fits(self, problem: Problem) -> bool:
        """True if this discretisation is also that of ``problem`` (the same mesh, supports and indenter)."""
        mine = self.problem
        shared = "mesh", "fixed", "contact_faces", "indenter", "bodies", "pressures", "fibres", "prestretch"
        equal = "supports", "element", "start", "contact_rule"
        return (
            all(getattr(mine, name) is getattr(problem, name) for name in shared)
            and all(getattr(mine, name) == getattr(problem, name) for name in equal)
            and mine.history.forced == problem.history.forced
        )

    def impose(self, u: Array, increment: Increment) -> Array:
        """``u`` with supported components, and coordinates of bodies that are held, at their values."""
        held = np.where(self.supported, self.factors * increment.displacement, u)
        return self.bodies.impose(held, increment.drives)

    def elements(self, cells: slice) -> Elements:
        """Some of the elements, as the kernels take them."""
        own = self.gradients[cells], self.weights[cells], self.regions[cells]
        return self.cells[cells], *own, self.fibres[cells], self.prestretch[cells]

    def map_cells(self, work: Callable[[slice], T]) -> list[T]:
        """The results of ``work`` on as many parts of the cells as there are threads, in parallel."""
        ends = np.linspace(0, len(self.cells), self.threads + 1).astype(int)
        parts = [slice(a, b) for a, b in pairwise(ends)]
        return [work(parts[0])] if len(parts) == 1 else list(get_thread_pool(self.threads).map(work, parts))

    def evaluate(self, u: Array, laws: Laws, increment: Increment, tangent: bool = True) -> Evaluation:
        """Energy, residual (r, 3) and, if wanted, tangent entries at ``u (r, 3)``."""
        if laws.has_fibres and not len(self.fibres):
            raise ProblemError("the fibres of a material have no direction", remedy="state Problem.fibres")
        size = len(self.indices) if tangent else 0
        mean, tables = self.element.mean_dilatation, laws.activate(increment.activation, increment.scale)

        def part(cells: slice) -> tuple[float, Array, Array]:
            residual, data = np.zeros_like(u), np.zeros(size)
            energy = assemble(
                self.elements(cells), mean, tables, increment.scale, increment.history[cells], u,
                tangent, self.cell_positions[cells], residual, data,
            )  # fmt: skip
            return energy, residual, data

        (energy, residual, data), *others = self.map_cells(part)
        for more in others:
            energy += more[0]
            residual += more[1]
            data += more[2]
        load_norm = self._compute_active_force(laws, increment.activation)
        if increment.pressures:
            pressing, pressed, pressure_norm = self.pressures.evaluate(u, increment.pressures, increment.rims)
            energy, residual = energy + pressing, residual + pressed
            load_norm = max(load_norm, pressure_norm)
            if tangent:
                self.pressures.add_tangent(u, increment.pressures, data)
        if not np.isfinite(energy) or not self.bodies.all:
            return Evaluation(energy, residual, data if tangent else None, load_norm=load_norm)
        found = self._evaluate_contact(u, increment, tangent)
        driving, loads, loads_norm = self.bodies.evaluate_drives(u, increment.drives, increment.penalty)
        if tangent:
            self.bodies.add_tangent(found, increment.drives, increment.penalty, laws.modulus, data)
        return Evaluation(
            energy + found.energy + driving, residual + found.residual + loads,
            data if tangent else None, float(found.reactions[0, 2]), found.penetration, found.area,
            self.bodies.differentiate_advance(found) if tangent else None,
            float(np.linalg.norm(found.residual[: self.nodes])), found.touch, found.reactions,
            max(loads_norm, load_norm),
        )  # fmt: skip

    def _compute_active_force(self, laws: Laws, share: float) -> float:
        """The size of active forces, N: their stress on a section of the tissue that contracts."""
        if share == 0.0 or not laws.fibre[:, 2].any():
            return 0.0
        volumes = np.bincount(self.regions, self.weights.sum(axis=1), len(laws.kappa))
        return share * float((laws.fibre[:, 2] * volumes ** (2.0 / 3.0)).max())

    def _evaluate_contact(self, u: Array, increment: Increment, tangent: bool = False) -> Contacts:
        return self.bodies.evaluate(
            u, increment.drives, increment.penalty, increment.flat_from, increment.grips, tangent
        )

    def contact_force(self, u: Array, increment: Increment) -> Array:
        """The contact part of the residual (r, 3), N."""
        return self._evaluate_contact(u, increment).residual

    def tools(self, u: Array, increment: Increment) -> list[Tool]:
        """The rigid bodies where they are at ``u (r, 3)``."""
        return self.bodies.tools(u, increment.drives)
