"""Sparse symmetric matrices: linear systems behind one interface (PARDISO, CHOLMOD, SuperLU), and products.

A matrix is the upper triangle in CSR form (``indptr, indices`` sorted, diagonal first in each row).  A
factorisation is Cholesky where the library offers it, so that a matrix that is not positive definite is
noticed: `NotPositiveDefiniteError`.
"""

import ctypes
import functools
import importlib
import importlib.metadata
import os
import weakref
from abc import ABC, abstractmethod
from itertools import pairwise
from typing import Any, ClassVar

import numpy as np
import scipy.sparse as sp
import scipy.sparse.linalg as spla
from numba import njit
from numpy.typing import NDArray
from threadpoolctl import threadpool_info

from ...arrays import Array, Index, Indices
from ...errors import ProblemError
from ..system import get_thread_pool

# An environment variable: with any value, PARDISO counts as not installed.
WITHOUT_PARDISO = "LIMBFIT_WITHOUT_PARDISO"
# A factorisation costs as many solutions as its entries in a row, to the power 4/3, over this: a quarter as
# many operations for each entry (15 % off for tetrahedra and hexahedra of 1,000 to 50,000 unknowns), 45 times
# as fast as those of a solution, which waits for memory (PARDISO, 10,000 to 200,000 unknowns).
ROW_PER_SOLUTION = 180.0
# Places of PARDISO's parameters: solutions among marked unknowns alone; a factorisation for many threads.
PARTIAL, MANY_THREADS = 30, 23
COLUMNS = 16  # of right-hand sides among the marked unknowns at once


class NotPositiveDefiniteError(ArithmeticError):
    """The matrix has no Cholesky factor."""


NONE: Index = np.zeros(0, dtype=np.int32)


class LinearSolver(ABC):
    """Analyse once, factorise often, solve oftener.

    ``lasting``: whether a factorisation is worth keeping for other matrices; ``slow``: whether multigrid wins
    at any size; ``worth``: its cost over that of one solution and one product with the matrix, estimated from
    the factor's entries (not timed: a run must be repeatable).

    A solution is made in two halves.  ``transposed``: whether `backward` is the transpose of `forward`;
    ``last``: unknowns that are eliminated last, so that halves among them alone cost next to nothing.  A
    solver that knows no halves does all of it in the first.
    """

    name: ClassVar[str]
    lasting: ClassVar[bool]
    slow: ClassVar[bool]
    worth: float
    transposed: ClassVar[bool] = False
    last: Index = NONE

    @abstractmethod
    def factorise(self, data: Array) -> None:
        """Factorise the matrix with these entries; raises `NotPositiveDefiniteError`."""

    @abstractmethod
    def solve(self, b: Array) -> Array:
        """Solution (n,) or (n, r) for right-hand sides of that shape."""

    def forward(self, b: Array, last: bool = False) -> Array:
        """The first half of a solution (n, r).

        ``last``: of the unknowns ``last`` only, beyond which ``b`` is zero.
        """
        return self.solve(b)

    def backward(self, y: Array, last: bool = False) -> Array:
        """The second half; ``last``: of the unknowns ``last`` only."""
        return y


class Pardiso(LinearSolver):
    """Cholesky by Intel MKL's PARDISO, in double or single precision.

    A factor in single precision takes half the time and half the memory; it is meant as a preconditioner.
    """

    name = "pardiso"
    lasting, slow, transposed = True, False, True

    def __init__(
        self, indptr: Index, indices: Index, threads: int = 1, single: bool = False, last: Index = NONE
    ) -> None:
        self._indptr = np.ascontiguousarray(indptr, dtype=np.int32)
        self._indices = np.ascontiguousarray(indices, dtype=np.int32)
        self._n = ctypes.c_int32(len(indptr) - 1)
        self._type: Any = np.float32 if single else np.float64
        self._threads = threads
        self._data = np.ones(len(indices), dtype=self._type)
        self._room: Array | None = None
        self._handle = np.zeros(64, dtype=np.int64)
        self._parameters = np.zeros(64, dtype=np.int32)
        # no defaults, METIS, count entries, single precision, zero-based rows
        for position, value in {0: 1, 1: 2, 9: 13, 17: -1, 20: 1, 27: int(single), 34: 1}.items():
            self._parameters[position] = value
        self.last, self._marks = last, np.zeros(len(indptr) - 1, dtype=np.int32)
        self._marks[last] = 1
        # Of the analysis: what is marked goes to the end.  Solutions would be serial then, unless the
        # factorisation is the one for many threads.
        self._parameters[PARTIAL] = int(len(last) > 0)
        self._parameters[MANY_THREADS] = int(len(last) > 0 and threads > 1)
        if os.environ.get(WITHOUT_PARDISO):
            raise ImportError(f"PARDISO is left out: {WITHOUT_PARDISO} is set")
        self._mkl = _load_mkl()
        # The factor lives outside Python's memory.
        self._release = weakref.finalize(self, _release, self._mkl, self._handle, self._parameters, self._n)
        self._call(11, np.zeros(1), np.zeros(1), 1)
        _silence_openmp()  # loaded by the first call
        self._parameters[PARTIAL] = 0
        self.worth = max((float(self._parameters[17]) / self._n.value) ** (4 / 3) / ROW_PER_SOLUTION, 2.0)

    def factorise(self, data: Array) -> None:
        self._data = np.array(data, dtype=self._type)
        self._call(22, np.zeros(1), np.zeros(1), 1)

    def solve(self, b: Array) -> Array:
        return self._run_phase(33, b, False).astype(np.float64)

    def forward(self, b: Array, last: bool = False) -> Array:
        return self._run_phase(331, b, last)

    def backward(self, y: Array, last: bool = False) -> Array:
        return self._run_phase(333, y, last).astype(np.float64)

    def _run_phase(self, phase: int, b: Array, last: bool) -> Array:
        if last:
            return self._run_among_last(phase, b)
        right = np.asfortranarray(b, dtype=self._type)
        x = np.zeros_like(right, order="F")
        self._call(phase, right, x, 1 if b.ndim == 1 else b.shape[1])
        return x

    def _run_among_last(self, phase: int, b: Array) -> Array:
        """A half of solutions (m, r) among the unknowns ``last``."""
        if self._room is None:
            self._room = np.zeros((2, self._n.value * COLUMNS), dtype=self._type)
        right, x = (room.reshape(-1, COLUMNS, order="F") for room in self._room)
        out = np.empty(b.shape, dtype=self._type)
        self._parameters[PARTIAL] = 1
        for at in range(0, b.shape[1], COLUMNS):
            part = b[:, at : at + COLUMNS]
            right[self.last, : part.shape[1]] = part
            self._call(phase, right, x, part.shape[1])
            out[:, at : at + COLUMNS] = x[self.last, : part.shape[1]]
        self._parameters[PARTIAL] = 0
        return out

    def _call(self, phase: int, b: Array, x: Array, count: int) -> None:
        self._mkl.MKL_Set_Num_Threads(self._threads)
        code = _call_pardiso(
            self._mkl, self._handle, self._parameters, self._n, phase, count,
            self._data, self._indptr, self._indices, self._marks, b, x,
        )  # fmt: skip
        if code == -4:
            raise NotPositiveDefiniteError
        if code:
            raise MemoryError(f"PARDISO failed with code {code}")


def _silence_openmp() -> None:
    """Let Intel's OpenMP threads sleep at once between factorisations instead of spinning for 0.2 s."""
    for library in threadpool_info():
        if library["prefix"] == "libiomp":
            ctypes.CDLL(library["filepath"]).kmp_set_blocktime(0)


@functools.cache
def _load_mkl() -> Any:
    """MKL's library: from the installed package, or as pypardiso finds it by searching the disk."""
    try:
        files = importlib.metadata.files("mkl") or []
    except importlib.metadata.PackageNotFoundError:
        files = []
    for file in files:
        if file.name.startswith("libmkl_rt."):
            return ctypes.CDLL(str(file.locate()))
    return importlib.import_module("pypardiso").PyPardisoSolver().libmkl


def _call_pardiso(
    mkl: Any, handle: NDArray, parameters: Index, n: ctypes.c_int32, phase: int, count: int, *arrays: NDArray
) -> int:
    """The error code of a call; ``arrays``: data, indptr, indices, marks, right-hand sides and solutions."""

    def number(value: int) -> Any:
        return ctypes.byref(ctypes.c_int32(value))

    def address(array: NDArray) -> ctypes.c_void_p:
        return ctypes.c_void_p(array.ctypes.data)

    error = ctypes.c_int32(0)
    positive_definite = 2
    data, indptr, indices, marks, b, x = map(address, arrays)
    mkl["pardiso"](
        address(handle), number(1), number(1), number(positive_definite), number(phase), ctypes.byref(n),
        data, indptr, indices, marks, number(count), address(parameters), number(0), b, x,
        ctypes.byref(error),
    )  # fmt: skip
    return error.value


def _release(mkl: Any, handle: Indices, parameters: Index, n: ctypes.c_int32) -> None:
    empty, none = np.zeros(1), np.zeros(1, dtype=np.int32)
    _call_pardiso(mkl, handle, parameters, n, -1, 1, empty, none, none, none, empty, empty)


class _ByPattern(LinearSolver):
    """A solver that is given the matrix's pattern, and makes no use of the rest."""

    lasting = True

    def __init__(self, indptr: Index, indices: Index, *unused: Any) -> None:
        self._pattern = (np.asarray(indices), np.asarray(indptr))
        self._n = len(indptr) - 1


class Cholmod(_ByPattern):
    """Supernodal Cholesky by CHOLMOD, through scikit-sparse."""

    name = "cholmod"
    slow = False
    worth = 20.0

    def __init__(self, indptr: Index, indices: Index, *unused: Any) -> None:
        super().__init__(indptr, indices)
        self._cholmod = importlib.import_module("sksparse.cholmod")
        self._factor = self._cholmod.analyze(self._build_lower(np.ones(len(indices))), mode="supernodal")

    def _build_lower(self, data: Array) -> sp.csc_matrix:
        # The upper triangle's rows are the lower triangle's columns.
        return sp.csc_matrix((data, *self._pattern), shape=(self._n, self._n))

    def factorise(self, data: Array) -> None:
        try:
            self._factor.cholesky_inplace(self._build_lower(data))
        except self._cholmod.CholmodNotPositiveDefiniteError:
            raise NotPositiveDefiniteError from None

    def solve(self, b: Array) -> Array:
        return self._factor(b)


class SuperLU(_ByPattern):
    """LU by SciPy's SuperLU: everywhere there is SciPy; slow, and blind to negative eigenvalues."""

    name = "superlu"
    slow = True
    worth = 40.0
    _factor: Any

    def factorise(self, data: Array) -> None:
        upper = sp.csr_matrix((data, *self._pattern), shape=(self._n, self._n))
        full = (upper + sp.triu(upper, 1).T).tocsc()
        options = {"SymmetricMode": True, "DiagPivotThresh": 0.001}
        try:
            self._factor = spla.splu(full, permc_spec="MMD_AT_PLUS_A", options=options)
        except RuntimeError:
            raise NotPositiveDefiniteError from None

    def solve(self, b: Array) -> Array:
        return self._factor.solve(np.asarray(b))


SOLVERS: dict[str, type] = {solver.name: solver for solver in (Pardiso, Cholmod, SuperLU)}


def build_linear_solver(
    indptr: Index, indices: Index, name: str = "auto", threads: int = 1, single: bool = False,
    last: Index = NONE,
) -> LinearSolver:  # fmt: skip
    """The named solver of `SOLVERS`, or the first that works on this machine.

    ``single``: a factor in single precision will do; ``last``: unknowns to be eliminated last.  Only PARDISO
    makes use of them, and of ``threads``.
    """
    if name not in ("auto", *SOLVERS):
        raise ProblemError(f"unknown linear solver {name!r}", remedy=f"use one of auto, {', '.join(SOLVERS)}")
    for candidate in SOLVERS if name == "auto" else (name,):
        try:
            return SOLVERS[candidate](indptr, indices, threads, single, last)
        except (ImportError, OSError, AttributeError):
            if candidate == name:
                raise
    raise ImportError("no sparse solver works here")


def prefers_multigrid() -> bool:
    """True if the only factorisations of this machine are much slower than multigrid."""
    return build_linear_solver(np.arange(2, dtype=np.int32), np.zeros(1, dtype=np.int32)).slow


def multiply_symmetric(indptr: Index, indices: Index, data: Array, x: Array, threads: int = 1) -> Array:
    """``A x`` (n, r) of a symmetric matrix given by its upper triangle."""
    n, columns = x.shape
    if columns > 1 and columns % 8 == 1:  # the last one alone: cheaper than seven or more of padding
        parts = (multiply_symmetric(indptr, indices, data, part, threads) for part in (x[:, :-1], x[:, -1:]))
        return np.hstack(list(parts))
    width = columns  # with padding, where that pays: LLVM vectorises loops over 16, eight are written out
    if columns > 3:
        width = 8 if columns <= 8 else 16 * ((columns + 15) // 16)
    padded = np.ascontiguousarray(x) if width == columns else np.zeros((n, width))
    if width > columns:
        padded[:, :columns] = x
    kernel = {1: _multiply_one_column, 8: _multiply_eight_columns}.get(width, _multiply_columns)

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


@njit(cache=True, nogil=True)
def _multiply_one_column(indptr, indices, data, x, y, start, stop):  # type: ignore[no-untyped-def]
    """Add what rows ``start`` to ``stop`` of the triangle make of ``x (n, 1)`` to ``y``."""
    flat, out = x[:, 0], y[:, 0]
    for i in range(start, stop):
        xi, total = flat[i], data[indptr[i]] * flat[i]
        for p in range(indptr[i] + 1, indptr[i + 1]):
            total += data[p] * flat[indices[p]]
            out[indices[p]] += data[p] * xi
        out[i] += total


@njit(cache=True, nogil=True, fastmath={"contract"})
def _multiply_eight_columns(indptr, indices, data, x, y, start, stop):  # type: ignore[no-untyped-def]
    """`_multiply_one_column` for ``x (n, 8)``, the row's numbers kept in registers."""
    for i in range(start, stop):
        a = data[indptr[i]]
        x0, x1, x2, x3 = x[i, 0], x[i, 1], x[i, 2], x[i, 3]
        x4, x5, x6, x7 = x[i, 4], x[i, 5], x[i, 6], x[i, 7]
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
def _multiply_columns(indptr, indices, data, x, y, start, stop):  # type: ignore[no-untyped-def]
    """`_multiply_one_column` for ``x (n, r)``."""
    for i in range(start, stop):
        for r in range(x.shape[1]):
            y[i, r] += data[indptr[i]] * x[i, r]
        for p in range(indptr[i] + 1, indptr[i + 1]):
            j, a = indices[p], data[p]
            for r in range(x.shape[1]):
                y[i, r] += a * x[j, r]
                y[j, r] += a * x[i, r]
