"""The sparse pattern of a discretisation: which unknowns meet, and where their entries are."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from numba import njit

from ..arrays import Index, Indices


@dataclass(frozen=True)
class Pattern:
    """The upper triangle in CSR form, and the number of each unknown (r, 3); -1: none."""

    indptr: Index
    indices: Index
    numbers: Index


def build_node_graph(cells: Index, nodes: int) -> sp.csr_matrix:
    """Which nodes share a cell, themselves included; rows sorted."""
    m, k = cells.shape
    incidence = sp.csr_matrix(
        (np.ones(m * k, dtype=np.int32), cells.ravel(), np.arange(0, m * k + 1, k)), shape=(m, nodes)
    )
    graph = (incidence.T @ incidence).tocsr()
    graph.sort_indices()
    return graph


def append_rows(graph: sp.csr_matrix, borders: Sequence[Indices]) -> sp.csr_matrix:
    """A graph with two further rows for each of the ``borders``: they meet its nodes and each other."""
    n = graph.shape[0]
    size = n + 2 * len(borders)
    meetings = [
        (extra, other)
        for i, nodes in enumerate(borders)
        for extra in (n + 2 * i, n + 2 * i + 1)
        for other in (*nodes.tolist(), n + 2 * i, n + 2 * i + 1)
    ]
    if not meetings:
        return graph
    rows, columns = np.array(meetings).T
    new = sp.csr_matrix((np.ones(len(rows), dtype=np.int32), (rows, columns)), shape=(size, size))
    old = graph.copy()
    old.resize(size, size)
    whole = (old + new + new.T).tocsr()
    whole.sort_indices()
    return whole


def build_upper_pattern(numbers: Index, graph: sp.csr_matrix) -> tuple[Index, Index]:
    """Upper triangle (indptr, indices) of the unknowns' graph, rows sorted, from that of the nodes."""
    kept = np.flatnonzero(numbers.ravel() >= 0)
    whole = sp.kron(graph.astype(np.int8), np.ones((3, 3), dtype=np.int8), format="bsr").tocsr()
    upper = sp.triu(whole[kept][:, kept], format="csr")
    upper.sort_indices()
    return upper.indptr.astype(np.int32), upper.indices.astype(np.int32)


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
def find_positions(cells, numbers, indptr, indices):  # type: ignore[no-untyped-def]
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
