"""Linear systems of an equilibrium that friction makes unsymmetric.

The tangent ``K`` of a step holds normal force and plane of friction constant.  At equilibrium they follow
the displacement, by blocks ``C`` at the contact points: the derivative ``x`` solves ``(K + C) x = b``, by
iterating ``K x = b - C x`` with the factor that Newton has, as the equilibrium itself was found.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..system import Evaluation, System
from .factor import Factor
from .sensitivity import TOLERANCE, solve_with_adjoint

Array = NDArray[np.float64]
MOST_SWEEPS = 60


def solve_coupled(
    system: System, at: Evaluation, factor: Factor, b: Array, guess: Array, coupling: Array | None
) -> tuple[Array, Array]:
    """Solutions (n, p) for ``b (n, p)``, and what they change the force along the indenter's axis by (p,), N.

    ``coupling (c, 3, 3)``: C at the contact points, N/mm; None where there is none.
    """
    advance = np.zeros(len(b)) if at.advance is None else at.advance.ravel()[system.free]
    if coupling is None:
        x, advanced = solve_with_adjoint(at, factor, b, guess, advance)
        return x, -advanced
    assert system.indenter is not None
    x, pushed = guess, coupling @ system.springs_of(guess)
    bearable = TOLERANCE * np.linalg.norm(b, axis=0)
    for _ in range(MOST_SWEEPS):
        last = system.at_springs(pushed)
        x, advanced = solve_with_adjoint(at, factor, b - last, x, advance)
        pushed = coupling @ system.springs_of(x)
        if (np.linalg.norm(system.at_springs(pushed) - last, axis=0) <= bearable).all():
            break
    else:
        factor.counts["inexact"] += 1
    return x, -advanced - np.einsum("i,cip->p", system.indenter.frame[2], pushed)
