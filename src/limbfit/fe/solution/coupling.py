"""Linear systems of an equilibrium that friction makes unsymmetric.

The tangent ``K`` of a step holds normal force and plane of friction constant.  At equilibrium they follow
the displacement, by blocks ``C`` at the contact points: the derivative ``x`` solves ``(K + C) x = b``, by
iterating ``K x = b - C x`` with the factor that Newton has, as the equilibrium itself was found.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from ..system import Evaluation, System
from .direction import touching
from .factor import Factor
from .sensitivity import TOLERANCE, solve_with_adjoint

Array = NDArray[np.float64]
MOST_SWEEPS = 60


def solve_coupled(
    system: System, at: Evaluation, factor: Factor, b: Array, guess: Array,
    couplings: Sequence[tuple[int, Array]], rims: sp.csr_matrix | None = None,
) -> tuple[Array, Array]:  # fmt: skip
    """Solutions (n, p) for ``b (n, p)``, and what they change the force along the indenter's axis by (p,), N.

    ``couplings``: numbers of rigid bodies with C (c, 3, 3) at their contact points, N/mm; ``rims (n, n)``:
    C of follower pressures.
    """
    advance = np.zeros(len(b)) if at.advance is None else at.advance.ravel()[system.free]
    if not couplings and rims is None:
        x, advanced = solve_with_adjoint(at, factor, b, guess, advance)
        return x, -advanced
    coupling = _Coupling(system, couplings, rims)
    x, last = guess, coupling(guess)
    bearable = TOLERANCE * np.linalg.norm(b, axis=0)
    for _ in range(MOST_SWEEPS):
        x, advanced = solve_with_adjoint(at, factor, b - last, x, advance)
        before, last = last, coupling(x)
        if (np.linalg.norm(last - before, axis=0) <= bearable).all():
            break
    else:
        factor.counts["inexact"] += 1
    return x, coupling.along(x) - advanced


class _Coupling:
    """The products ``C x`` of all that a step holds constant."""

    def __init__(
        self, system: System, couplings: Sequence[tuple[int, Array]], rims: sp.csr_matrix | None
    ) -> None:
        self._bodies, self._rims = system.bodies, rims
        self._blocks = np.zeros((0 if system.bodies is None else system.bodies.count, 3, 3))
        for i, found in couplings:
            self._blocks[touching(system).all[i].points] = found

    def __call__(self, x: Array) -> Array:
        out = np.zeros_like(x) if self._rims is None else self._rims @ x
        return out if self._bodies is None else out + self._bodies.at_springs(self._pushed(x))

    def _pushed(self, x: Array) -> Array:
        assert self._bodies is not None
        return np.asarray(self._blocks @ self._bodies.springs_of(x))

    def along(self, x: Array) -> Array:
        """What it changes the force of the first body along its axis by (p,), N."""
        return np.zeros(x.shape[1]) if self._bodies is None else self._bodies.along(self._pushed(x))
