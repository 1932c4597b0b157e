"""One factorisation, used as long as it pays: directly, or as preconditioner of conjugate gradients.

Contact changes are few but stiff, and would spoil an old factor at once.  They are local springs, so the
preconditioner takes them in exactly, by the Sherman-Morrison-Woodbury formula; only the slow change of the
tissue's own stiffness is left to the iteration.
"""

from __future__ import annotations

import time
from collections import Counter, defaultdict

import numpy as np
from numpy.typing import NDArray

from .linear import LinearSolver, NotPositiveDefiniteError, linear_solver, symmetric_product
from .system import System

Array = NDArray[np.float64]
MOST_SPRINGS = 90


class Factor:
    """The linear algebra of one simulation: a factor of some earlier tangent and what to do with it.

    ``counts`` and ``seconds`` tell what was done.
    """

    def __init__(self, system: System, name: str = "auto") -> None:
        self._system = system
        started = time.perf_counter()
        self._solver: LinearSolver = linear_solver(system.indptr, system.indices, name)
        self._diagonal = system.indptr[:-1]
        self._blocks: Array | None = None
        self._columns: dict[int, int] = {}
        self._Z = np.empty((system.unknowns, 0))
        self._shift = 0.0
        self.ready = False
        self.fresh = False
        self.counts: Counter[str] = Counter()
        self.seconds: defaultdict[str, float] = defaultdict(float, factor=time.perf_counter() - started)

    @property
    def name(self) -> str:
        return self._solver.name

    def factorise(self, data: Array, blocks: Array | None = None) -> None:
        """Factorise; a tangent that is not positive definite is shifted until it is.

        ``blocks (c, 3, 3)``: the contact springs that are in ``data``.
        """
        started = time.perf_counter()
        typical = float(np.abs(data[self._diagonal]).mean())
        shift = 0.2 * self._shift if self._shift > 1e-3 * typical else 0.0
        while True:
            self.counts["factorisations"] += 1
            try:
                self._solver.factorise(self._shifted(data, shift))
                break
            except NotPositiveDefiniteError:
                shift = max(5.0 * shift, 1e-3 * typical)
        self._shift = shift
        self.ready = self.fresh = True
        self._blocks = blocks
        self._columns, self._Z = {}, np.empty((self._system.unknowns, 0))
        self.seconds["factor"] += time.perf_counter() - started

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

    def solve(
        self, data: Array, b: Array, blocks: Array | None, tolerance: float, limit: int, x: Array
    ) -> Array:
        """Solve ``A x = b (n, r)`` from the guess ``x``: within ``limit`` products, or by a new factor.

        Where A is not positive definite the result is only a direction of descent; ``fresh`` says that
        the factor was made at the present iterate.

        Parameters
        ----------
        data, blocks : entries of A, and the contact springs (c, 3, 3) that are among them.
        tolerance : of the residual of each column, relative to ``b``.
        """
        if self.ready and limit:
            correction = self._correction(blocks)
            if correction is not None:
                found = self._conjugate_gradients(data, b, correction, tolerance, limit, x)
                if found is not None:
                    return found
        self.factorise(data, blocks)
        return np.ascontiguousarray(self.apply(b))

    def _conjugate_gradients(
        self, data: Array, b: Array, correction: _Correction, tolerance: float, limit: int, x: Array
    ) -> Array | None:
        target = tolerance * np.linalg.norm(b, axis=0)
        r = b - self._product(data, x) if x.any() else b.copy()
        x, p, rz = x.copy(), np.zeros_like(b), np.ones(b.shape[1])
        for _ in range(limit):
            if (np.linalg.norm(r, axis=0) <= target).all():
                return x
            z = correction(np.ascontiguousarray(self.apply(r)))
            fresh = np.einsum("ij,ij->j", r, z)
            p = z + fresh / np.where(rz > 0.0, rz, 1.0) * p
            rz = fresh
            Ap = self._product(data, p)
            curvature = np.einsum("ij,ij->j", p, Ap)
            live = rz > 0.0
            if (curvature[live] <= 0.0).any():  # Steihaug 1983: stop at the edge of the convex region
                return (x if x.any() else z) if self.fresh else None
            step = np.where(live, rz / np.where(live, curvature, 1.0), 0.0)
            x += step * p
            r -= step * Ap
        return x if self.fresh or (np.linalg.norm(r, axis=0) <= target).all() else None

    def _product(self, data: Array, x: Array) -> Array:
        self.counts["products"] += 1
        return symmetric_product(self._system.indptr, self._system.indices, data, x)

    def _correction(self, blocks: Array | None) -> _Correction | None:
        """What the springs that changed since the factorisation do to its solutions; None: too many."""
        if blocks is None or self._blocks is None or self._system.indenter is None:
            return _Correction(
                self._system, np.empty((0, 3)), np.empty(0, dtype=int), np.empty((0, 0)), self._Z
            )
        frame = self._system.indenter.frame  # on a flat face only its last axis is stiff
        change = frame @ (blocks - self._blocks) @ frame.T
        typical = max(float(np.abs(blocks).max()), float(np.abs(self._blocks).max()))
        points, axes = np.nonzero(np.abs(change).max(axis=2) > 1e-3 * typical)
        if len(points) > MOST_SPRINGS:
            return None
        together = points[:, None] == points
        D = np.where(together, change[points[:, None], axes[:, None], axes], 0.0)
        Z = self._influence(points, axes, frame)
        return _Correction(self._system, frame[axes], points, D, Z)

    def _influence(self, points: NDArray[np.int64], axes: NDArray[np.int64], frame: Array) -> Array:
        """Solutions (n, k) for unit forces at contact points along axes of ``frame``, kept."""
        keys = [int(key) for key in 3 * points + axes]
        new = [i for i, key in enumerate(keys) if key not in self._columns]
        if new:
            count = len(self._system.springs_of(self._diagonal))
            unit = np.zeros((count, 3, len(new)))
            unit[points[new], :, np.arange(len(new))] = frame[axes[new]]
            for i in new:
                self._columns[keys[i]] = len(self._columns)
            self._Z = np.hstack([self._Z, self.apply(self._system.at_springs(unit))])
        return self._Z[:, [self._columns[key] for key in keys]]


class _Correction:
    """``(F + N D N^T)^-1 = F^-1 - Z (I + D S)^-1 D N^T F^-1`` with ``Z = F^-1 N`` and ``S = N^T Z``."""

    def __init__(
        self, system: System, directions: Array, points: NDArray[np.int64], D: Array, Z: Array
    ) -> None:
        self._system, self._directions, self._points, self._Z = system, directions, points, Z
        if len(points):
            self._middle = np.linalg.solve(np.eye(len(D)) + D @ self._project(Z), D)

    def _project(self, y: Array) -> Array:
        return np.einsum("ki,kir->kr", self._directions, self._system.springs_of(y)[self._points])

    def __call__(self, y: Array) -> Array:
        """The corrected solutions (n, r) for solutions ``y (n, r)`` of the old factor."""
        return y - self._Z @ (self._middle @ self._project(y)) if len(self._points) else y
