"""What a step holds constant although it follows the displacement, taken in: friction, rims of pressures.

The tangent ``K`` of a step holds the normal force and plane of friction constant, and the rim's part of a
follower pressure.  At equilibrium they follow the displacement, by an unsymmetric ``C``.  Equilibrium with
all of them as they are there is found by Newton's method with ``K + C``, and so are its derivatives, both by
GMRES with the factor that Newton has as the preconditioner.  Renewing them alone, a fixed point, diverges
where a body wedges itself in: there ``K^-1 C`` is larger than one.
"""

import time
from collections import defaultdict
from dataclasses import replace

import numpy as np
import scipy.sparse.linalg as spla

from ...arrays import Array
from ..kernel.laws import Laws
from ..system import Evaluation, Increment, System
from .direction import update_springs
from .factor import Factor
from .linear import NotPositiveDefiniteError
from .newton import Equilibrium, NewtonControl, compute_reaction_scale, compute_residual_norm
from .sensitivity import solve_with_adjoint

# GMRES: vectors that it keeps, and how often it starts anew; the residual of Newton's directions, and of
# derivatives, which no adjoint corrects.
VECTORS, RESTARTS, FORCING, TOLERANCE = 40, 4, 1e-2, 2e-5
# Newton's iterations, and cuts of its step where an element is inverted.
MAX_ITERATIONS, MAX_CUTS = 25, 6
# The share by which the residual falls where it gets closer, steps in a row that may bring it no closer, and
# residual over reactions from which it does not come back.
MIN_REDUCTION, MAX_VAIN_STEPS, DIVERGED = 0.1, 5, 1.0


class Coupling:
    """The matrix C of a step at one displacement, by its products."""

    def __init__(self, system: System, increment: Increment, u: Array) -> None:
        self._bodies = system.bodies
        self._rims = system.pressures.coupling(u, increment.pressures) if increment.pressures else None
        self._blocks: Array | None = None
        for i, (grip, tool) in enumerate(zip(increment.grips, system.tools(u, increment))):
            found = None if grip is None else grip.coupling(tool)
            if found is None:
                continue
            if self._blocks is None:
                self._blocks = np.zeros((self._bodies.count, 3, 3))
            stiff = (increment.penalty * tool.surface.areas)[..., None, None]
            in_space = tool.body.frame.T @ (stiff * found) @ tool.body.frame
            self._blocks[self._bodies.all[i].points] = in_space.reshape(-1, 3, 3)

    def __bool__(self) -> bool:
        return self._rims is not None or self._blocks is not None

    @property
    def blocks(self) -> Array | float:
        """(c, 3, 3) of the contact points, N/mm; 0 where nothing holds them."""
        return 0.0 if self._blocks is None else self._blocks

    def __call__(self, x: Array) -> Array:
        """``C x (n, p)``."""
        out = np.zeros_like(x) if self._rims is None else self._rims @ x
        if self._blocks is None:
            return np.asarray(out)
        return np.asarray(out + self._bodies.spread_forces(self._blocks @ self._bodies.move_springs(x)))

    def project_on_axis(self, x: Array) -> Array:
        """What ``C x`` changes the force of the first body along its axis by (p,), N."""
        if self._blocks is None:
            return np.zeros(x.shape[1])
        return self._bodies.project_on_axis(self._blocks @ self._bodies.move_springs(x))


def renew_increment(system: System, increment: Increment, u: Array) -> Increment:
    """The step with grips and rims as they are at ``u (r, 3)``; itself where nothing changes."""
    grips = tuple(g and g.renew(tool) for g, tool in zip(increment.grips, system.tools(u, increment)))
    if not increment.pressures and all(new is old for new, old in zip(grips, increment.grips)):
        return increment
    rims = system.pressures.compute_rims(u, increment.pressures) if increment.pressures else 0.0
    return replace(increment, grips=grips, rims=rims)


def solve_coupled(
    system: System, at: Evaluation, factor: Factor, b: Array, guess: Array, coupling: Coupling
) -> tuple[Array, Array]:
    """Solutions (n, p) for ``b (n, p)``, and what they change the force of the first body by (p,), N."""
    advance = np.zeros(len(b)) if at.advance is None else at.advance.ravel()[system.free]
    if not coupling:
        x, advanced = solve_with_adjoint(at, factor, b, guess, advance)
        return x, -advanced
    x = _solve_gmres(at, factor, coupling, b, guess, TOLERANCE)
    return x, coupling.project_on_axis(x) - advance @ x


def _solve_gmres(
    at: Evaluation, factor: Factor, coupling: Coupling, b: Array, guess: Array, tolerance: float
) -> Array:
    """Solutions (n, p) of ``(K + C) x = b``; where not all are within the tolerance, they count as inexact.
    As one vector, of columns brought to one length, they share the reading of the factor.
    """
    springs, size = update_springs(at, factor), np.linalg.norm(b, axis=0)
    scale = np.where(size > 0.0, size / max(size.max(), 1e-300), 1.0)

    def product(x: Array) -> Array:
        x = x.reshape(b.shape)
        return (factor.multiply(at.tangent, x) + coupling(x)).ravel()

    def precondition(r: Array) -> Array:
        return factor.precondition(r.reshape(b.shape), springs).ravel()

    A, M = (spla.LinearOperator((b.size, b.size), matvec=f, dtype=float) for f in (product, precondition))
    start, share = (guess / scale).ravel(), tolerance / np.sqrt(b.shape[1])
    x, failed = spla.gmres(A, (b / scale).ravel(), start, rtol=share, restart=VECTORS, maxiter=RESTARTS, M=M)
    factor.counts["inexact"] += int(failed > 0)
    return np.asarray(scale * x.reshape(b.shape))


def couple(
    system: System, laws: Laws, increment: Increment, u: Array, factor: Factor, control: NewtonControl,
    floor: float, seconds: defaultdict[str, float],
) -> tuple[tuple[Equilibrium, Increment] | None, int]:  # fmt: skip
    """Equilibrium near ``u (r, 3)`` with grips and rims as they are there, or None, and the iterations spent.

    Newton's method on the residual, for there is no energy.  It is not smooth: where points stick, slip,
    touch or let go anew, a full step raises it, and the next ones lower it.  So full steps are taken (as in
    semi-smooth Newton methods, Hueber, Stadler and Wohlmuth 2008), and given up where they lead nowhere.
    """

    def evaluate_at(x: Array, by: Increment | None = None) -> tuple[Increment, Evaluation]:
        started = time.perf_counter()
        there = renew_increment(system, increment, x)
        if by is not None:
            pairs = zip(there.grips, by.grips)
            there = replace(there, grips=tuple(g and led and replace(g, pulls=led.pulls) for g, led in pairs))
        at = system.evaluate(x, laws, there)
        seconds["assembly"] += time.perf_counter() - started
        return there, at

    lowest, vain = np.inf, 0
    now, here = evaluate_at(u)
    for iteration in range(MAX_ITERATIONS):
        norm, scale = compute_residual_norm(system, here), compute_reaction_scale(system, here, floor)
        if norm <= control.tolerance * scale:
            if control.tangent:  # derivatives take the slip as it is
                now, here = evaluate_at(u)
            return (Equilibrium(u, here, iteration, residual=norm / max(scale, 1e-300)), now), iteration
        vain = 0 if norm <= (1.0 - MIN_REDUCTION) * lowest else vain + 1
        lowest = min(norm, lowest)
        if vain > MAX_VAIN_STEPS or norm > DIVERGED * scale:
            return None, iteration
        b = -here.residual.ravel()[system.free][:, None]
        try:
            d = _solve_gmres(here, factor, Coupling(system, now, u), b, np.zeros_like(b), FORCING)
        except NotPositiveDefiniteError:
            return None, iteration + 1
        direction = np.zeros(here.residual.size)
        direction[system.free] = d[:, 0]
        way, step = direction.reshape(u.shape), 1.0
        predicted = now.predict(system.tools(u, now), way)
        for _ in range(MAX_CUTS):
            there, at = evaluate_at(u + step * way, predicted)
            if np.isfinite(at.energy):
                break
            step *= 0.5
        else:
            return None, iteration + 1
        u, now, here = u + step * way, there, at
    return None, MAX_ITERATIONS
