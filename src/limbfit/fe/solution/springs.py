"""Contact springs that changed since a factorisation, taken into its solutions exactly.

With ``F`` the factored matrix, ``N`` unit forces at the changed springs and ``D`` the change of their
stiffness, ``(F + N D N^T)^-1 = F^-1 - Z D (I + S D)^-1 N^T F^-1``, ``Z = F^-1 N``, ``S = N^T Z``
(Sherman, Morrison and Woodbury).  All that contact does to a solution thus happens in a small dense space.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from ..system import System

Array = NDArray[np.float64]
Bools = NDArray[np.bool_]
# Smaller changes, relative to the stiffest spring, are left to the iteration.
NOTABLE = 0.03


class SpringColumns:
    """Solutions of a factor for unit forces at contact points, made when first needed and kept.

    ``apply (n, r) -> (n, r)`` is the factor's solution.
    """

    def __init__(self, system: System, apply: Callable[[Array], Array]) -> None:
        self._bodies, self._unknowns, self._apply = system.bodies, system.unknowns, apply
        self.clear(None)

    def clear(self, blocks: Array | None) -> None:
        """Forget the columns: there is a new factor, whose springs are ``blocks (c, 3, 3)``."""
        self.blocks = blocks
        self.keys: dict[tuple[int, int], int] = {}
        # In single precision like the factor: they only precondition.
        self.Z = np.empty((self._unknowns, 0), dtype=np.float32, order="F")
        count = 0 if blocks is None else len(blocks)
        self.at_points = np.empty((count, 3, 0))

    def change(self, touched: Bools, normals: Array, blocks: Array, most: int) -> SpringChange | None:
        """The change to ``blocks``; None where it needs more than ``most`` columns.

        ``touched (c,)``: springs to be pushed along ``normals (c, 3)`` although they may not differ.
        """
        if self.blocks is None or self._bodies is None:
            return None
        frames = self._bodies.frames  # on a flat face only the last axis is stiff
        change = frames @ (blocks - self.blocks) @ frames.transpose(0, 2, 1)
        typical = max(float(np.abs(blocks).max()), float(np.abs(self.blocks).max()), 1e-300)
        wanted = np.abs(change).max(axis=2) > NOTABLE * typical
        wanted |= touched[:, None] & (np.abs(np.einsum("cij,cj->ci", frames, normals)) > 0.2)
        if not self._complete(wanted, most):
            return None
        points, axes = np.array(list(self.keys), dtype=int).reshape(-1, 2).T
        together = points[:, None] == points
        D = np.where(together, change[points[:, None], axes[:, None], axes], 0.0)
        return SpringChange(self, points, frames[points, axes], D)

    def moved(self, x: Array) -> Array:
        """Values (c, 3, ...) at the contact points of the unknowns ``x (n, ...)``."""
        assert self._bodies is not None
        return self._bodies.springs_of(x)

    def _complete(self, wanted: Bools, most: int) -> bool:
        """Make the columns that are missing, unless they would be too many in all."""
        new = [key for key in zip(*map(np.ndarray.tolist, np.nonzero(wanted))) if key not in self.keys]
        if len(self.keys) + len(new) > most:
            return False
        if new:
            assert self._bodies is not None
            self.keys.update({key: len(self.keys) + i for i, key in enumerate(new)})
            points, axes = np.array(new).T
            unit = np.zeros((len(wanted), 3, len(new)))
            unit[points, :, np.arange(len(new))] = self._bodies.frames[points, axes]
            Z = self._apply(self._bodies.at_springs(unit))
            self.Z = np.concatenate([self.Z.T, Z.T.astype(np.float32)]).T
            self.at_points = np.concatenate([self.at_points, self._bodies.springs_of(Z)], axis=2)
        return True


class SpringChange:
    """One set of changed springs: ``points (k,)``, ``directions (k, 3)`` and ``D (k, k)``."""

    def __init__(
        self, columns: SpringColumns, points: NDArray[np.int64], directions: Array, D: Array
    ) -> None:
        self._columns, self._points, self._directions, self._D = columns, points, directions, D
        self._S = np.einsum("ki,kil->kl", directions, columns.at_points[points])
        self._inverse = np.linalg.inv(np.eye(len(D)) + self._S @ D)

    def project(self, values: Array) -> Array:
        """Components (k, ...) along the springs of vectors (c, 3, ...) at the contact points."""
        return np.einsum("ki,ki...->k...", self._directions, values[self._points])

    def correct(self, y: Array) -> Array:
        """Solutions (n, r) of the changed matrix from solutions ``y (n, r)`` of the factor."""
        if not len(self._points):
            return y
        moved = self._inverse @ self.project(self._columns.moved(y))
        return y - self._columns.Z @ (self._D @ moved).astype(np.float32)

    def coefficients(self, moved: Array, forces: Array) -> Array:
        """What to add (k,) of each column, for displacements of the factor's solution and forces (c, 3)."""
        f = self.project(forces)
        return f - self._D @ (self._inverse @ (self.project(moved) + self._S @ f))

    def at_points(self, coefficients: Array) -> Array:
        """The combination of columns at the contact points (c, 3)."""
        return self._columns.at_points @ coefficients
