"""Contact springs that changed since a factorisation, taken into its solutions exactly.

With ``F`` the factored matrix, ``N`` unit forces at the changed springs and ``D`` the change of their
stiffness, ``(F + N D N^T)^-1 = F^-1 - F^-1 N D (I + S D)^-1 N^T F^-1``, ``S = N^T F^-1 N`` (Sherman, Morrison
and Woodbury).  All that contact does to a solution thus happens in a small dense space.

With ``F^-1 = B A``, the halves of a solution, it happens between them: ``W = A N`` and ``P = B^T N`` give
``S = P^T W`` and ``B (I - W D (I + S D)^-1 P^T) A``.  Of a Cholesky factor ``P`` is ``W``, and where the
indenter will touch is eliminated last, so that ``W`` is small and costs nothing.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ...arrays import Array
from ..problem import Problem
from ..system import System
from .linear import NONE, Halves, Index

Single = NDArray[np.float32]
Bools = NDArray[np.bool_]
# Smaller changes, relative to the stiffest spring, are left to the iteration.
NOTABLE_CHANGE = 0.03
# With more columns than this the dense solutions cost too much.
MAX_COLUMNS = 500
# Over the power 2/3 of all unknowns, as a cut across the body has: with more, the factor itself costs too
# much.
MAX_LAST = 1.5


def find_touched_unknowns(system: System, problem: Problem) -> Index:
    """Unknowns where bodies will touch, for the factor to eliminate last; none where they are too many."""
    found = system.bodies.find_swept_unknowns([body.motion for body in problem.rigid_bodies])
    return found if len(found) <= MAX_LAST * system.unknowns ** (2 / 3) else NONE


class SpringColumns:
    """First halves ``W`` of solutions for unit forces at contact points, made when first needed and kept.

    ``inner (c,)``: points whose columns cost nothing, since they stand on unknowns that are eliminated last.
    ``rows``: unknowns beyond which ``W (rows, k)`` is zero.  ``at_points (c, 3, k)``: how the forces move the
    points; 0 where that is not known for nothing.
    """

    def __init__(self, system: System, halves: Halves) -> None:
        self._bodies, self._unknowns, self._halves = system.bodies, system.unknowns, halves
        self.inner = system.bodies.find_points_on(halves.last)
        self._shares = system.bodies.select_shares(halves.last)
        self.clear(None)

    def clear(self, blocks: Array | None) -> None:
        """Forget the columns: there is a new factor, whose springs are ``blocks (c, 3, 3)``."""
        self.blocks = blocks
        self.keys: dict[tuple[int, int], int] = {}
        self.rows: Index | slice = self._halves.last if self.inner.any() else slice(None)
        # In single precision like the factor: they only precondition.
        rows = len(self._halves.last) if self.inner.any() else self._unknowns
        self.W: Single = np.empty((rows, 0), dtype=np.float32)
        self.P = self.W
        self.S = np.empty((0, 0))
        count = 0 if blocks is None else len(blocks)
        self.at_points = np.empty((count, 3, 0))

    def change(self, touched: Bools, normals: Array, blocks: Array, most: int) -> SpringChange | None:
        """The change to ``blocks``; None where it needs more than ``most`` columns.

        ``touched (c,)``: springs to be pushed along ``normals (c, 3)`` although they may not differ.
        """
        if self.blocks is None:
            return None
        frames = self._bodies.frames  # on a flat face only the last axis is stiff
        change = frames @ (blocks - self.blocks) @ frames.transpose(0, 2, 1)
        typical = max(float(np.abs(blocks).max()), float(np.abs(self.blocks).max()), 1e-300)
        wanted = np.abs(change).max(axis=2) > NOTABLE_CHANGE * typical
        wanted |= touched[:, None] & (np.abs(np.einsum("cij,cj->ci", frames, normals)) > 0.2)
        if not self._complete(wanted, most):
            return None
        return SpringChange(self, np.array(list(self.keys), dtype=int).reshape(-1, 2), frames, change,
                            0.1 * NOTABLE_CHANGE * typical)  # fmt: skip

    def displace_points(self, y: Array, closed: Bools) -> Array:
        """Displacements (c, 3) of the contact points by the half solution ``y (n, 1)``.

        Where only inner points are ``closed (c,)``, the others are taken to stay.
        """
        if not self.inner.any() or (closed & ~self.inner).any():
            return self._bodies.move_springs(self._halves.backward(y))[..., 0]
        x = self._halves.backward(y[self._halves.last], True)
        return np.where(self.inner[:, None], self._bodies.move_springs(x, self._shares)[..., 0], 0.0)

    def add_to(self, y: Array, coefficients: Array) -> Array:
        """Half solutions ``y (n, r)`` with the columns added, ``coefficients (k, r)`` times."""
        y = y.copy()
        y[self.rows] += self.W[:, : len(coefficients)] @ coefficients.astype(np.float32)
        return y

    def _complete(self, wanted: Bools, most: int) -> bool:
        """Make the columns that are missing, unless they would be too many in all."""
        new = [key for key in zip(*map(np.ndarray.tolist, np.nonzero(wanted))) if key not in self.keys]
        costly = sum(not self.inner[point] for point, _ in (*self.keys, *new))
        if costly > most or len(self.keys) + len(new) > max(most, MAX_COLUMNS):
            return False
        for inner in (True, False):
            self._add([key for key in new if self.inner[key[0]] == inner], inner)
        return True

    def _add(self, new: list[tuple[int, int]], inner: bool) -> None:
        if not new:
            return
        self.keys.update({key: len(self.keys) + i for i, key in enumerate(new)})
        points, axes = np.array(new).T
        unit = np.zeros((len(self.inner), 3, len(new)))
        unit[points, :, np.arange(len(new))] = self._bodies.frames[points, axes]
        shares = self._shares if inner else None
        N = self._bodies.spread_forces(unit, shares)
        W = self._halves.forward(N, inner)
        at_points = self._bodies.move_springs(self._halves.backward(W, inner), shares)
        if inner:
            at_points[~self.inner] = 0.0
        elif not isinstance(self.rows, slice):
            self.W, self.rows = self._widen(self.W), slice(None)
        narrow = inner and isinstance(self.rows, slice)
        self.W = np.hstack([self.W, self._widen(W) if narrow else W.astype(np.float32)])
        self.P = self.W if self._halves.transposed else np.hstack([self.P, N.astype(np.float32)])
        self.S = (self.P.T @ self.W).astype(float)
        self.at_points = np.concatenate([self.at_points, at_points], axis=2)

    def _widen(self, W: Array | Single) -> Single:
        """Columns (m, k) of the unknowns that are eliminated last, as those of all (n, k)."""
        out = np.zeros((self._unknowns, W.shape[1]), dtype=np.float32)
        out[self._halves.last] = W
        return out


class SpringChange:
    """One set of changed springs: of all columns ``points (k,)`` and ``directions (k, 3)``; of those
    ``stiffer (j,)`` whose stiffness changed, ``D (j, j)``.

    ``keys (k, 2)``: point and axis of the columns; ``change (c, 3, 3)`` of stiffness in the points'
    ``frames``, N/mm, of which less than ``little`` is none.
    """

    def __init__(
        self, columns: SpringColumns, keys: NDArray[np.int64], frames: Array, change: Array, little: float
    ) -> None:
        self._columns, (self._points, axes) = columns, keys.T
        self._directions = frames[self._points, axes]
        self._stiffer = np.flatnonzero((np.abs(change[self._points]) > little).any(axis=(1, 2)))
        points, axes = self._points[self._stiffer], axes[self._stiffer]
        D = np.where(points[:, None] == points, change[points[:, None], axes[:, None], axes], 0.0)
        S = columns.S[np.ix_(self._stiffer, self._stiffer)]
        self._answer = D @ np.linalg.inv(np.eye(len(D)) + S @ D)

    def project(self, values: Array) -> Array:
        """Components (k, ...) along the springs of vectors (c, 3, ...) at the contact points."""
        return np.einsum("ki,ki...->k...", self._directions, values[self._points])

    def correct(self, y: Array) -> Array:
        """First halves of solutions (n, r) of the changed matrix from those ``y (n, r)`` of the factor."""
        if not len(self._stiffer):
            return y
        moved = (self._columns.P.T @ y[self._columns.rows].astype(np.float32))[self._stiffer]
        coefficients = np.zeros((len(self._points), y.shape[1]))
        coefficients[self._stiffer] = -(self._answer @ moved)
        return self._columns.add_to(y, coefficients)

    def coefficients(self, moved: Array, forces: Array) -> Array:
        """What to add (k,) of each column, for displacements of the factor's solution and forces (c, 3)."""
        out = self.project(forces)
        at = self._stiffer
        out[at] -= self._answer @ (self.project(moved) + self._columns.S @ out)[at]
        return out

    def at_points(self, coefficients: Array) -> Array:
        """The combination of columns at the contact points (c, 3)."""
        return self._columns.at_points @ coefficients
