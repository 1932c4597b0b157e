"""A preconditioner for quadratic tetrahedra that costs time in proportion to the unknowns.

One V-cycle between the quadratic and the linear tetrahedra of the same corners (p-multigrid, Ronquist and
Patera 1987): a Gauss-Seidel sweep over the nodes, a correction with a factor of the linear tetrahedra's
matrix, the sweep backwards.  That factor has an eighth of the unknowns and is made anew for every tangent,
contact and all.  Everything is in single precision: it only preconditions.

Matrices are upper triangles of 3 x 3 blocks by node, the diagonal block first in each row.
"""

import numpy as np
import scipy.sparse as sp
from numba import njit
from numpy.typing import NDArray

from ...arrays import Array, Index, Indices, Mask
from ...mesh import TET10_EDGES
from ..pattern import build_node_graph, build_upper_pattern, place_of
from ..system import System
from .linear import LinearSolver, NotPositiveDefiniteError, build_linear_solver

# A block is added to the upper triangle turned where its parents are in reverse, both ways on the diagonal.
_TURNED, _BOTH = 1, 2


class Multigrid(LinearSolver):
    """A peer of the solvers in `linear`, but its solutions are only near: they have to be iterated upon.

    For any of the quadratic tetrahedra in the element table.
    """

    name = "multigrid"
    lasting, slow = False, False
    worth = 4.0  # setting up costs about four cycles and products

    def __init__(self, system: System, threads: int = 1) -> None:
        linear_cells = system.cells[:, :4]
        corners = np.unique(linear_cells)
        fine, self._slots = _number_nodes(system.numbers >= 0)
        moving = np.zeros_like(system.numbers, dtype=bool)
        moving[corners] = system.numbers[corners] >= 0
        linear, coarse_slots = _number_nodes(moving)
        self._coarse_slots = coarse_slots
        active = fine >= 0
        self._fine, self._places = _group_into_blocks(
            system.indptr, system.indices, self._slots, int(active.sum())
        )
        numbers = np.full(moving.shape, -1, dtype=np.int32)
        numbers[moving] = np.arange(len(coarse_slots), dtype=np.int32)
        graph = build_node_graph(linear_cells, len(numbers))
        indptr, indices = build_upper_pattern(numbers, graph)
        self._coarse, self._coarse_places = _group_into_blocks(
            indptr, indices, coarse_slots, int((linear >= 0).sum())
        )
        self._parents = linear[_find_ends(system.cells, len(fine))][active]
        self._free = (system.numbers >= 0)[active]
        rows, ends = np.nonzero(self._parents >= 0)
        halves = np.full(len(rows), 0.5)
        # (nodes, coarse nodes): each node moves by the mean of its parents, and shares its residual so.
        self._mean = sp.csr_matrix(
            (halves, (rows, self._parents[rows, ends])), shape=(len(self._parents), len(self._coarse[0]) - 1)
        )
        self._targets = _coarse_targets(*self._fine, self._parents, *self._coarse)
        self._solver = build_linear_solver(indptr, indices, threads=threads, single=True)

    def factorise(self, data: Array) -> None:
        ptr, cols = self._fine
        self._blocks = np.zeros((len(cols), 3, 3), dtype=np.float32)
        self._blocks.ravel()[self._places] = data
        self._inverse = np.empty((len(ptr) - 1, 3, 3), dtype=np.float32)
        if not _prepare(ptr, self._blocks, self._inverse):
            raise NotPositiveDefiniteError
        coarse = np.zeros((len(self._coarse[1]), 3, 3))
        _galerkin(ptr, cols, self._blocks, self._targets, coarse)
        self._solver.factorise(coarse.ravel()[self._coarse_places])

    def solve(self, b: Array) -> Array:
        columns = b.reshape(len(b), -1)
        x = np.empty_like(columns)
        for c in range(columns.shape[1]):
            x[:, c] = self._cycle(columns[:, c])
        return x.reshape(b.shape)

    def _cycle(self, b: Array) -> Array:
        ptr, cols = self._fine
        r = np.zeros(self._free.shape, dtype=np.float32)
        r.ravel()[self._slots] = b
        x, q = np.empty_like(r), np.empty_like(r)
        _forward(ptr, cols, self._blocks, self._inverse, r, x, q)
        right = self._mean.T @ q
        moved = np.zeros(right.shape)
        moved.ravel()[self._coarse_slots] = self._solver.solve(right.ravel()[self._coarse_slots])
        r = np.where(self._free, self._mean @ moved, 0.0).astype(np.float32)
        _backward(ptr, cols, self._blocks, self._inverse, r, x, q)
        return x.ravel()[self._slots].astype(np.float64)


def _number_nodes(moving: Mask) -> tuple[Index, Indices]:
    """Number of each node that can move in any component (else -1); places of the unknowns, 3 to a node."""
    active = moving.any(axis=1)
    number = np.where(active, np.cumsum(active) - 1, -1).astype(np.int32)
    return number, np.flatnonzero(moving[active].ravel())


def _group_into_blocks(
    indptr: Index, indices: Index, slots: Indices, nodes: int
) -> tuple[tuple[Index, Index], Indices]:
    """Rows and columns of the blocks, and the place in them of every entry of the matrix by unknowns."""
    rows, count = np.repeat(slots, np.diff(indptr)), len(indices)
    numbered = sp.csr_matrix((np.arange(1, count + 1), (rows, slots[indices])), shape=(3 * nodes,) * 2)
    blocks = numbered.tobsr((3, 3))
    blocks.sort_indices()
    filled = np.flatnonzero(blocks.data)
    places = np.empty(count, dtype=np.int64)
    places[blocks.data.ravel()[filled] - 1] = filled
    return (blocks.indptr.astype(np.int32), blocks.indices.astype(np.int32)), places


def _find_ends(cells: NDArray, nodes: int) -> Indices:
    """The two corners (n, 2) between which each node lies: a corner between itself and itself."""
    ends = np.stack([np.arange(nodes)] * 2, axis=1)
    ends[cells[:, 4:].ravel()] = cells[:, TET10_EDGES].reshape(-1, 2)
    return ends


@njit(cache=True)
def _coarse_targets(ptr, cols, parents, coarse_ptr, coarse_cols):  # type: ignore[no-untyped-def]
    """Coarse block of each pair of parents of a block's nodes, 3 times its place and how it is added; -1:
    one of them is held.  Shape (nb, 2, 2)."""
    out = np.full((len(cols), 2, 2), -1, dtype=np.int32)
    for i in range(len(ptr) - 1):
        for p in range(ptr[i], ptr[i + 1]):
            for a in range(2):
                for b in range(2):
                    I, J = parents[i, a], parents[cols[p], b]
                    if I >= 0 and J >= 0:
                        low, high = min(I, J), max(I, J)
                        at = place_of(coarse_cols, coarse_ptr[low], coarse_ptr[low + 1], high)
                        out[p, a, b] = 3 * at + (_TURNED if I > J else _BOTH if I == J else 0)
    return out


@njit(cache=True)
def _prepare(ptr, blocks, inverse):  # type: ignore[no-untyped-def]
    """Complete the diagonal blocks and invert them, held components left out; False where indefinite."""
    D = np.empty((3, 3))
    for i in range(len(ptr) - 1):
        B = blocks[ptr[i]]
        for a in range(3):
            for b in range(3):
                B[a, b] = B[min(a, b), max(a, b)]
                D[a, b] = B[a, b]
            if D[a, a] == 0.0:
                D[a, a] = 1.0
        det = 0.0
        for a in range(3):
            a1, a2 = (a + 1) % 3, (a + 2) % 3
            det += D[0, a] * (D[1, a1] * D[2, a2] - D[1, a2] * D[2, a1])
        minor = D[0, 0] * D[1, 1] - D[0, 1] * D[1, 0]
        if not (D[0, 0] > 0.0 and minor > 0.0 and det > 0.0):
            return False
        for a in range(3):
            a1, a2 = (a + 1) % 3, (a + 2) % 3
            for b in range(3):
                b1, b2 = (b + 1) % 3, (b + 2) % 3
                inverse[i, b, a] = (D[a1, b1] * D[a2, b2] - D[a1, b2] * D[a2, b1]) / det
    return True


@njit(cache=True)
def _galerkin(ptr, cols, blocks, targets, coarse):  # type: ignore[no-untyped-def]
    """The matrix of the linear tetrahedra: each node stands for the mean of its two parents."""
    for i in range(len(ptr) - 1):
        for p in range(ptr[i], ptr[i + 1]):
            for a in range(2):
                for b in range(2):
                    if targets[p, a, b] < 0:
                        continue
                    at, how = targets[p, a, b] // 3, targets[p, a, b] % 3
                    if cols[p] == i and how == _TURNED:
                        continue  # its mirror image is added
                    both = how == _BOTH and cols[p] != i
                    C, B = coarse[at], blocks[p]
                    for r in range(3):
                        for s in range(3):
                            C[r, s] += 0.25 * (B[s, r] if how == _TURNED else B[r, s])
                            if both:
                                C[r, s] += 0.25 * B[s, r]


@njit(cache=True, fastmath={"contract"})
def _forward(ptr, cols, blocks, inverse, r, x, q):  # type: ignore[no-untyped-def]
    """Gauss-Seidel from zero, ``(D + L) x = r``, and what is left of ``r`` in ``q``; ``r`` is used up."""
    n = len(ptr) - 1
    for i in range(n):
        D = inverse[i]
        x0 = D[0, 0] * r[i, 0] + D[0, 1] * r[i, 1] + D[0, 2] * r[i, 2]
        x1 = D[1, 0] * r[i, 0] + D[1, 1] * r[i, 1] + D[1, 2] * r[i, 2]
        x2 = D[2, 0] * r[i, 0] + D[2, 1] * r[i, 1] + D[2, 2] * r[i, 2]
        x[i, 0], x[i, 1], x[i, 2] = x0, x1, x2
        for p in range(ptr[i] + 1, ptr[i + 1]):
            j, B = cols[p], blocks[p]
            r[j, 0] -= B[0, 0] * x0 + B[1, 0] * x1 + B[2, 0] * x2
            r[j, 1] -= B[0, 1] * x0 + B[1, 1] * x1 + B[2, 1] * x2
            r[j, 2] -= B[0, 2] * x0 + B[1, 2] * x1 + B[2, 2] * x2
    for i in range(n):
        q0 = q1 = q2 = np.float32(0.0)
        for p in range(ptr[i] + 1, ptr[i + 1]):
            j, B = cols[p], blocks[p]
            q0 -= B[0, 0] * x[j, 0] + B[0, 1] * x[j, 1] + B[0, 2] * x[j, 2]
            q1 -= B[1, 0] * x[j, 0] + B[1, 1] * x[j, 1] + B[1, 2] * x[j, 2]
            q2 -= B[2, 0] * x[j, 0] + B[2, 1] * x[j, 1] + B[2, 2] * x[j, 2]
        q[i, 0], q[i, 1], q[i, 2] = q0, q1, q2


@njit(cache=True, fastmath={"contract"})
def _backward(ptr, cols, blocks, inverse, e, x, q):  # type: ignore[no-untyped-def]
    """Add ``e`` and a Gauss-Seidel sweep backwards to ``x``; ``q`` is the residual at ``x`` before."""
    n = len(ptr) - 1
    for i in range(n):  # q -= A e
        e0, e1, e2 = e[i, 0], e[i, 1], e[i, 2]
        B = blocks[ptr[i]]
        q0 = q[i, 0] - (B[0, 0] * e0 + B[0, 1] * e1 + B[0, 2] * e2)
        q1 = q[i, 1] - (B[1, 0] * e0 + B[1, 1] * e1 + B[1, 2] * e2)
        q2 = q[i, 2] - (B[2, 0] * e0 + B[2, 1] * e1 + B[2, 2] * e2)
        for p in range(ptr[i] + 1, ptr[i + 1]):
            j, B = cols[p], blocks[p]
            q0 -= B[0, 0] * e[j, 0] + B[0, 1] * e[j, 1] + B[0, 2] * e[j, 2]
            q1 -= B[1, 0] * e[j, 0] + B[1, 1] * e[j, 1] + B[1, 2] * e[j, 2]
            q2 -= B[2, 0] * e[j, 0] + B[2, 1] * e[j, 1] + B[2, 2] * e[j, 2]
            q[j, 0] -= B[0, 0] * e0 + B[1, 0] * e1 + B[2, 0] * e2
            q[j, 1] -= B[0, 1] * e0 + B[1, 1] * e1 + B[2, 1] * e2
            q[j, 2] -= B[0, 2] * e0 + B[1, 2] * e1 + B[2, 2] * e2
        q[i, 0], q[i, 1], q[i, 2] = q0, q1, q2
        x[i, 0] += e0
        x[i, 1] += e1
        x[i, 2] += e2
    for i in range(n - 1, -1, -1):  # (D + U) e = q
        q0, q1, q2 = q[i, 0], q[i, 1], q[i, 2]
        for p in range(ptr[i] + 1, ptr[i + 1]):
            j, B = cols[p], blocks[p]
            q0 -= B[0, 0] * e[j, 0] + B[0, 1] * e[j, 1] + B[0, 2] * e[j, 2]
            q1 -= B[1, 0] * e[j, 0] + B[1, 1] * e[j, 1] + B[1, 2] * e[j, 2]
            q2 -= B[2, 0] * e[j, 0] + B[2, 1] * e[j, 1] + B[2, 2] * e[j, 2]
        D = inverse[i]
        for a in range(3):
            e[i, a] = D[a, 0] * q0 + D[a, 1] * q1 + D[a, 2] * q2
            x[i, a] += e[i, a]
