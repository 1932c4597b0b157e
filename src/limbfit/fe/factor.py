"""One factorisation, used as long as it pays: directly, or as preconditioner of conjugate gradients."""

from __future__ import annotations

import time
from collections import Counter, defaultdict

import numpy as np
from numpy.typing import NDArray

from .linear import LinearSolver, NotPositiveDefiniteError, linear_solver, symmetric_product
from .system import System

Array = NDArray[np.float64]


class Factor:
    """The linear algebra of one simulation: a factor of some earlier tangent and what to do with it.

    ``counts`` and ``seconds`` tell what was done.
    """

    def __init__(self, system: System, name: str = "auto") -> None:
        self._system = system
        started = time.perf_counter()
        self._solver: LinearSolver = linear_solver(system.indptr, system.indices, name)
        self._diagonal = system.indptr[:-1]
        self.ready = False
        self.counts: Counter[str] = Counter()
        self.seconds: defaultdict[str, float] = defaultdict(float, factor=time.perf_counter() - started)

    @property
    def name(self) -> str:
        return self._solver.name

    def factorise(self, data: Array) -> bool:
        """Factorise; a tangent that is not positive definite is shifted until it is (then False)."""
        started = time.perf_counter()
        shift, exact = 0.0, True
        typical = float(np.abs(data[self._diagonal]).mean())
        while True:
            self.counts["factorisations"] += 1
            try:
                self._solver.factorise(self._shifted(data, shift))
                break
            except NotPositiveDefiniteError:
                exact = False
                shift = max(10.0 * shift, 1e-3 * typical)
        self.ready = True
        self.seconds["factor"] += time.perf_counter() - started
        return exact

    def _shifted(self, data: Array, shift: float) -> Array:
        if shift == 0.0:
            return data
        data = data.copy()
        data[self._diagonal] += shift
        return data

    def apply(self, b: Array) -> Array:
        """The factor's solution for ``b (n,)`` or ``(n, r)``."""
        started = time.perf_counter()
        x = self._solver.solve(b)
        self.counts["solves"] += 1
        self.seconds["solve"] += time.perf_counter() - started
        return x

    def conjugate_gradients(self, data: Array, b: Array, tolerance: float, limit: int) -> Array | None:
        """Solve ``A x = b (n, r)`` to ``|r| <= tolerance |b|`` per column, or None after ``limit`` products."""
        x = np.zeros_like(b)
        r = b.copy()
        target = tolerance * np.linalg.norm(b, axis=0)
        z = self._columns(r)
        p, rz = z.copy(), np.einsum("ij,ij->j", r, z)
        for _ in range(limit):
            Ap = symmetric_product(self._system.indptr, self._system.indices, data, p)
            self.counts["products"] += 1
            curvature = np.einsum("ij,ij->j", p, Ap)
            live = rz > 0.0
            if (curvature[live] <= 0.0).any():
                return None
            step = np.where(live, rz / np.where(live, curvature, 1.0), 0.0)
            x += step * p
            r -= step * Ap
            if (np.linalg.norm(r, axis=0) <= target).all():
                return x
            z = self._columns(r)
            fresh = np.einsum("ij,ij->j", r, z)
            p = z + np.where(live, fresh / np.where(live, rz, 1.0), 0.0) * p
            rz = fresh
        return None

    def _columns(self, r: Array) -> Array:
        return np.ascontiguousarray(self.apply(r))
