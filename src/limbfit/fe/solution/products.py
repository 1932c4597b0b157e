"""Products of a symmetric matrix with vectors.

It is given by its upper triangle in CSR form, the diagonal first in each row.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from numba import njit
from numpy.typing import NDArray

from ..threads import get_thread_pool

Array = NDArray[np.float64]
Index = NDArray[np.int32]


def multiply_symmetric(indptr: Index, indices: Index, data: Array, x: Array, threads: int = 1) -> Array:
    """``A x`` (n, r) of a symmetric matrix given by its upper triangle."""
    n, columns = x.shape
    if columns > 1 and columns % 8 == 1:  # the last one alone: cheaper than seven or more of padding
        parts = (multiply_symmetric(indptr, indices, data, part, threads) for part in (x[:, :-1], x[:, -1:]))
        return np.hstack(list(parts))
    width = _choose_width(columns)
    padded = np.ascontiguousarray(x) if width == columns else np.zeros((n, width))
    if width > columns:
        padded[:, :columns] = x
    kernel = {1: _one_column, 8: _eight_columns}.get(width, _many_columns)

    def product(rows: tuple[int, int]) -> Array:
        y = np.zeros_like(padded)
        kernel(indptr, indices, data, padded, y, *rows)
        return y

    if threads == 1:
        y = product((0, n))
    else:
        ends = np.searchsorted(indptr, np.linspace(0, len(data), threads + 1)).astype(int)
        y = np.asarray(sum(get_thread_pool(threads).map(product, list(pairwise(ends)))))
    return np.ascontiguousarray(y[:, :columns])


def _choose_width(columns: int) -> int:
    """Columns with padding, where that pays: eight are written out, LLVM vectorises loops over 16."""
    if columns <= 3:
        return columns
    return 8 if columns <= 8 else 16 * ((columns + 15) // 16)


@njit(cache=True, nogil=True)
def _one_column(indptr, indices, data, x, y, start, stop):  # type: ignore[no-untyped-def]
    """Add what rows ``start`` to ``stop`` of the triangle make of ``x (n, 1)`` to ``y``."""
    flat, out = x[:, 0], y[:, 0]
    for i in range(start, stop):
        xi, total = flat[i], data[indptr[i]] * flat[i]
        for p in range(indptr[i] + 1, indptr[i + 1]):
            total += data[p] * flat[indices[p]]
            out[indices[p]] += data[p] * xi
        out[i] += total


@njit(cache=True, nogil=True, fastmath={"contract"})
def _eight_columns(indptr, indices, data, x, y, start, stop):  # type: ignore[no-untyped-def]
    """`_one_column` for ``x (n, 8)``, the row's numbers kept in registers."""
    for i in range(start, stop):
        a = data[indptr[i]]
        x0, x1, x2, x3, x4, x5, x6, x7 = (
            x[i, 0],
            x[i, 1],
            x[i, 2],
            x[i, 3],
            x[i, 4],
            x[i, 5],
            x[i, 6],
            x[i, 7],
        )
        y0, y1, y2, y3, y4, y5, y6, y7 = a * x0, a * x1, a * x2, a * x3, a * x4, a * x5, a * x6, a * x7
        for p in range(indptr[i] + 1, indptr[i + 1]):
            a, xj, yj = data[p], x[indices[p]], y[indices[p]]
            y0, y1, y2, y3 = y0 + a * xj[0], y1 + a * xj[1], y2 + a * xj[2], y3 + a * xj[3]
            y4, y5, y6, y7 = y4 + a * xj[4], y5 + a * xj[5], y6 + a * xj[6], y7 + a * xj[7]
            yj[0] += a * x0
            yj[1] += a * x1
            yj[2] += a * x2
            yj[3] += a * x3
            yj[4] += a * x4
            yj[5] += a * x5
            yj[6] += a * x6
            yj[7] += a * x7
        for r, total in enumerate((y0, y1, y2, y3, y4, y5, y6, y7)):
            y[i, r] += total


@njit(cache=True, nogil=True)
def _many_columns(indptr, indices, data, x, y, start, stop):  # type: ignore[no-untyped-def]
    """`_one_column` for ``x (n, r)``."""
    for i in range(start, stop):
        for r in range(x.shape[1]):
            y[i, r] += data[indptr[i]] * x[i, r]
        for p in range(indptr[i] + 1, indptr[i + 1]):
            j, a = indices[p], data[p]
            for r in range(x.shape[1]):
                y[i, r] += a * x[j, r]
                y[j, r] += a * x[i, r]
