"""The discretised body: what depends on mesh, supports and contact faces only, built once and reused.

Free displacement components are numbered node by node; the matrix is the upper triangle in CSR form, and
every entry of every element's upper triangle knows its place in it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from typing import TypeVar

import numpy as np
import scipy.sparse as sp
from numba import njit
from numpy.typing import NDArray

from .contact.contact import (
    ContactSurface,
    Distances,
    Touch,
    add_springs,
    check_clear,
    contact,
    touching_offset,
)
from .contact.grip import Grip
from .contact.indenter import Indenter
from .kernel.assembly import Elements, assemble
from .kernel.elements import Element, reference_gradients
from .kernel.laws import Laws
from .problem import Problem, ProblemError, check
from .threads import thread_pool

Array = NDArray[np.float64]
T = TypeVar("T")


@dataclass(frozen=True)
class Increment:
    """What is constant while one step is solved.

    ``displacement`` is the indenter's advance, ``across (2,)`` its move across its axis, mm; ``scale (r,)``
    and ``history (m, q, 6)`` are s and K of `assembly`; ``penalty`` in MPa/mm; the ``grip`` holds points
    along the indenter; points deeper than ``flat_from`` (mm) have the tangent of a flat indenter.
    """

    time: float
    displacement: float
    scale: Array
    history: Array
    penalty: float
    grip: Grip | None = None
    flat_from: float = np.inf
    across: tuple[float, float] = (0.0, 0.0)


@dataclass(frozen=True)
class Evaluation:
    """The potential and its derivatives at one displacement field.

    ``data``: entries of the tangent; None where it was not asked for.  ``reaction (3,)``: force of the
    indenter in its frame, N; the last is the ``force`` along the axis.
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
    reaction: Array | None = None

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
        self.points = np.ascontiguousarray(mesh.points, dtype=float)
        self.cells = np.ascontiguousarray(mesh.cells, dtype=np.int32)
        self.regions = np.ascontiguousarray(mesh.regions, dtype=np.int32)
        self.gradients, self.weights = reference_gradients(self.element, self.points, mesh.cells)
        self._number_unknowns(problem)
        self._build_pattern()
        self.surface: ContactSurface | None = None
        self.indenter = problem.indenter
        if problem.indenter is not None:
            faces = np.asarray(problem.contact_faces, dtype=np.int64)
            self.surface = ContactSurface.build(self.element, self.points, faces, problem.contact_rule)
            nothing = np.zeros(self.surface.areas.shape)
            vectors = np.zeros((*nothing.shape, 3))
            self._slipping = nothing > 0.0, vectors, vectors, nothing
            self.spread = self._spread(self.surface)
            touching = self.surface.faces
            self.face_positions = _positions(touching, self.numbers, self.indptr, self.indices)
            indenter = problem.indenter
            if problem.start == "touching":
                indenter = indenter.moved(self._touching(indenter))
            check_clear(self.surface, indenter.moved(float(problem.history.at(0.0))))
            self.indenter = indenter

    def _touching(self, indenter: Indenter) -> float:
        assert self.surface is not None
        offset = touching_offset(self.surface, indenter)
        if abs(self.surface.gaps(indenter.moved(offset)).min()) > 1e-6:
            raise ProblemError(
                "the indenter never meets the contact faces", remedy="check its centre, axis and the faces"
            )
        return offset

    def _number_unknowns(self, problem: Problem) -> None:
        n = len(self.points)
        factors = np.full((n, 3), np.nan)
        for support in problem.supports:
            factors[np.asarray(support.nodes), support.component] = support.factor
        factors[np.asarray(problem.fixed, dtype=int)] = 0.0
        free = np.isnan(factors)
        self.supported = ~free
        self.factors = np.where(free, 0.0, factors)
        self.free = np.flatnonzero(free.ravel())
        self.numbers = np.full((n, 3), -1, dtype=np.int32)
        self.numbers.ravel()[self.free] = np.arange(len(self.free), dtype=np.int32)
        if not len(self.free):
            raise ProblemError("every node is held: nothing is left to solve")

    def _build_pattern(self) -> None:
        graph, numbers = node_graph(self.cells, len(self.points)), self.numbers
        self.indptr, self.indices = upper_pattern(numbers, graph.indptr, graph.indices, len(self.free))
        self.cell_positions = _positions(self.cells, numbers, self.indptr, self.indices)

    @property
    def unknowns(self) -> int:
        return len(self.free)

    def fits(self, problem: Problem) -> bool:
        """Whether this discretisation is also that of ``problem`` (the same mesh, supports and indenter)."""
        mine = self.problem
        return (
            mine.mesh is problem.mesh
            and mine.fixed is problem.fixed
            and mine.contact_faces is problem.contact_faces
            and mine.indenter is problem.indenter
            and mine.supports == problem.supports
            and (mine.element, mine.start, mine.contact_rule)
            == (problem.element, problem.start, problem.contact_rule)
        )

    def impose(self, u: Array, displacement: float) -> Array:
        """``u`` with the supported components at their values."""
        return np.where(self.supported, self.factors * displacement, u)

    def elements(self, cells: slice) -> Elements:
        """Some of the elements, as the kernels take them."""
        return self.cells[cells], self.gradients[cells], self.weights[cells], self.regions[cells]

    def over_cells(self, work: Callable[[slice], T]) -> list[T]:
        """``work`` done on as many parts of the cells as there are threads, side by side."""
        ends = np.linspace(0, len(self.cells), self.threads + 1).astype(int)
        parts = [slice(a, b) for a, b in pairwise(ends)]
        return [work(parts[0])] if len(parts) == 1 else list(thread_pool(self.threads).map(work, parts))

    def evaluate(self, u: Array, laws: Laws, increment: Increment, tangent: bool = True) -> Evaluation:
        """Energy, residual (n, 3) and, if wanted, tangent entries at ``u (n, 3)``."""
        size = len(self.indices) if tangent else 0
        mean = self.element.mean_dilatation

        def part(cells: slice) -> tuple[float, Array, Array]:
            residual, data = np.zeros_like(u), np.zeros(size)
            energy = assemble(
                self.elements(cells), mean, laws.tables, increment.scale, increment.history[cells], u,
                tangent, self.cell_positions[cells], residual, data,
            )  # fmt: skip
            return energy, residual, data

        (energy, residual, data), *others = self.over_cells(part)
        for more in others:
            energy += more[0]
            residual += more[1]
            data += more[2]
        if not np.isfinite(energy) or self.surface is None or self.indenter is None:
            return Evaluation(energy, residual, data if tangent else None)
        (found, deepest, area), reaction, pushed, advance, touch = self._contact(u, increment)
        if tangent:
            blocks = touch.blocks.reshape(*self.surface.areas.shape, 3, 3)
            add_springs(self.surface.N, blocks, self.face_positions, data)
        norm = float(np.linalg.norm(pushed))
        return Evaluation(
            energy + found, residual + pushed, data if tangent else None, float(reaction[2]), deepest, area,
            advance, norm, touch, reaction,
        )  # fmt: skip

    def contact_force(self, u: Array, increment: Increment) -> Array:
        """The contact part of the residual (n, 3), N."""
        return np.zeros_like(u) if self.surface is None else self._contact(u, increment)[2]

    def tool(self, increment: Increment) -> tuple[ContactSurface, Indenter]:
        """The contact surface, and the indenter where it is in a step."""
        if self.surface is None or self.indenter is None:
            raise ProblemError("the problem has no indenter")
        return self.surface, self.indenter.moved(increment.displacement, increment.across)

    def _contact(
        self, u: Array, increment: Increment
    ) -> tuple[tuple[float, float, float], Array, Array, Array, Touch]:
        """What `contact` returns, the reaction, residual and advance that it fills, and its springs."""
        surface, indenter = self.tool(increment)
        grip = increment.grip
        near = Distances.of(surface, indenter, u, None if grip is None else grip.held)
        holding = self._slipping if grip is None else (grip.held, grip.places, grip.normals, grip.bounds)
        shape, reaction = surface.areas.shape, np.zeros(3)
        residual, advance, gaps = np.zeros_like(u), np.zeros_like(u), np.full(shape, np.inf)
        normals, blocks, stick = np.zeros((*shape, 3)), np.zeros((*shape, 3, 3)), np.zeros((*shape, 3, 3))
        found = contact(
            surface.faces, surface.N, surface.areas,
            (near.points, near.places, near.gaps, near.slopes, near.bends), indenter.frame,
            increment.penalty, increment.flat_from, holding, reaction, residual, advance, gaps, normals,
            blocks, stick,
        )  # fmt: skip
        weights = increment.penalty * surface.areas.ravel()
        touch = Touch(
            gaps.ravel(), normals.reshape(-1, 3), weights, blocks.reshape(-1, 3, 3), stick.reshape(-1, 3, 3)
        )
        return found, reaction, residual, advance, touch

    def with_springs(self, data: Array, blocks: Array) -> Array:
        """``data`` plus a stiffness (c, 3, 3) at every contact point."""
        assert self.surface is not None
        data = data.copy()
        surface = self.surface
        shape = *surface.areas.shape, 3, 3
        add_springs(surface.N, np.ascontiguousarray(blocks).reshape(shape), self.face_positions, data)
        return data

    def at_springs(self, forces: Array) -> Array:
        """Forces (c, 3, ...) at the contact points as a vector (or matrix) of the unknowns."""
        return np.asarray(self.spread @ forces.reshape(-1, *forces.shape[2:]))

    def springs_of(self, x: Array) -> Array:
        """Values (c, 3, ...) of a vector (or matrix) of the unknowns at the contact points."""
        return np.asarray(self.spread.T @ x).reshape(-1, 3, *x.shape[1:])

    def _spread(self, surface: ContactSurface) -> sp.csr_matrix:
        """Shares (unknowns, 3 c) of the unknowns in the position of every contact point."""
        f, q = len(surface.faces), len(surface.N)
        columns = np.arange(3 * f * q).reshape(f, q, 1, 3)
        rows = self.numbers[surface.faces][:, None]
        shares = surface.N[None, :, :, None]
        rows, columns, shares = np.broadcast_arrays(rows, columns, shares)
        held = rows < 0
        entries = shares[~held], (rows[~held], columns[~held])
        return sp.csr_matrix(entries, shape=(self.unknowns, 3 * f * q))


def node_graph(cells: NDArray[np.int32], nodes: int) -> sp.csr_matrix:
    """Which nodes share a cell, themselves included; rows sorted."""
    m, k = cells.shape
    incidence = sp.csr_matrix(
        (np.ones(m * k, dtype=np.int32), cells.ravel(), np.arange(0, m * k + 1, k)), shape=(m, nodes)
    )
    graph = (incidence.T @ incidence).tocsr()
    graph.sort_indices()
    return graph


@njit(cache=True)
def upper_pattern(numbers, start, neighbours, n):  # type: ignore[no-untyped-def]
    """Upper triangle of the unknowns' graph, rows sorted, from the sorted graph of the nodes."""
    indptr = np.zeros(n + 1, dtype=np.int32)
    for sweep in range(2):
        if sweep == 1:
            for i in range(n):
                indptr[i + 1] += indptr[i]
            indices = np.empty(indptr[n], dtype=np.int32)
        for a in range(numbers.shape[0]):
            for i in range(3):
                row = numbers[a, i]
                if row < 0:
                    continue
                count = 0
                for p in range(start[a], start[a + 1]):
                    for j in range(3):
                        column = numbers[neighbours[p], j]
                        if column >= row:
                            if sweep == 1:
                                indices[indptr[row] + count] = column
                            count += 1
                if sweep == 0:
                    indptr[row + 1] = count
    return indptr, indices


@njit(cache=True)
def place_of(columns, left, right, column):  # type: ignore[no-untyped-def]
    """Place of a column among the sorted ``columns[left:right]`` of a row."""
    while left < right:
        middle = (left + right) // 2
        if columns[middle] < column:
            left = middle + 1
        else:
            right = middle
    return left


@njit(cache=True)
def _positions(cells, numbers, indptr, indices):  # type: ignore[no-untyped-def]
    """Place of each upper-triangle entry (component-major rows) of each cell in the sparse data."""
    m, k = cells.shape
    n = 3 * k
    out = np.empty((m, n * (n + 1) // 2), dtype=np.int32)
    for e in range(m):
        at = 0
        for r in range(n):
            row = numbers[cells[e, r % k], r // k]
            for c in range(r, n):
                column = numbers[cells[e, c % k], c // k]
                low, high = min(row, column), max(row, column)
                out[e, at] = -1
                if low >= 0:
                    out[e, at] = place_of(indices, indptr[low], indptr[low + 1], high)
                at += 1
    return out
