"""Equilibrium of one step: Newton's method on the incremental potential with a line search."""

from __future__ import annotations

import time
from collections import defaultdict
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .factor import Factor
from .laws import Laws
from .system import Evaluation, Increment, System

Array = NDArray[np.float64]
ACTIVE_SET_SWEEPS = 6


@dataclass(frozen=True)
class NewtonControl:
    """Tolerance of the residual relative to the reactions, and limits."""

    tolerance: float = 1e-5
    max_iterations: int = 30
    max_backtracks: int = 12
    stale_products: int = 12


@dataclass(frozen=True)
class Equilibrium:
    """Where Newton stopped: ``reason`` is empty at equilibrium."""

    u: Array
    at: Evaluation
    iterations: int
    reason: str = ""


def equilibrate(
    system: System, laws: Laws, increment: Increment, u: Array, factor: Factor, control: NewtonControl,
    floor: float, seconds: defaultdict[str, float],
) -> Equilibrium:  # fmt: skip
    """Minimise the potential of ``increment`` from ``u (n, 3)``, whose supported components are in place.

    ``floor`` (N) is the smallest force against which the residual is judged.
    """
    here = _evaluate(system, laws, increment, u, seconds)
    if not np.isfinite(here.energy):
        return Equilibrium(u, here, 0, "an element is inverted at the start of the step")
    last = np.inf
    for iteration in range(control.max_iterations):
        norm = residual_norm(system, here)
        scale = reaction_scale(system, here, floor)
        rounding = norm > 0.3 * last and norm <= 1e-9 * scale  # no further digits to be had
        if norm <= control.tolerance * scale or rounding:
            return Equilibrium(u, here, iteration)
        forcing = min(0.1, max(0.1 * norm / scale, 0.3 * control.tolerance * scale / norm))
        stale = control.stale_products if norm < 0.5 * last or iteration == 0 else 0
        direction = _direction(system, here, factor, forcing, stale)
        last = norm
        found = _line_search(system, laws, increment, u, here, direction, control, seconds)
        if found is None:
            if norm <= 100 * control.tolerance * scale:
                return Equilibrium(u, here, iteration)
            return Equilibrium(u, here, iteration, "the line search found no lower energy")
        u, here = found
    return Equilibrium(u, here, control.max_iterations, "Newton's method did not converge")


def residual_norm(system: System, at: Evaluation) -> float:
    """Norm of the out-of-balance force, N."""
    return float(np.linalg.norm(at.residual.ravel()[system.free]))


def reaction_scale(system: System, at: Evaluation, floor: float) -> float:
    """The force against which a residual is judged: contact or support reactions, at least ``floor``, N."""
    supports = float(np.linalg.norm(np.where(system.supported, at.residual, 0.0)))
    return max(at.contact_norm, supports, floor)


def _evaluate(
    system: System, laws: Laws, increment: Increment, u: Array, seconds: defaultdict[str, float]
) -> Evaluation:
    started = time.perf_counter()
    at = system.evaluate(u, laws, increment)
    seconds["assembly"] += time.perf_counter() - started
    return at


def _direction(system: System, at: Evaluation, factor: Factor, forcing: float, stale: int) -> Array:
    """Newton direction (n, 3) with the contact points that it closes and opens foreseen.

    The set of closed points is iterated on the linear model (a primal-dual active set, Hintermueller, Ito and
    Kunisch 2003), which costs a few products; each missed point would cost an assembly of all elements.
    """
    factor.fresh = False
    b = -at.residual.ravel()[system.free][:, None]
    x, touch = np.zeros_like(b), at.touch
    if touch is None:
        x = factor.solve(at.data, b, None, forcing, stale, x)
    else:
        closed = touch.closed
        for _ in range(ACTIVE_SET_SWEEPS):
            blocks, change = touch.under(closed)
            data = system.with_springs(at.data, blocks - touch.blocks)
            right = b - system.at_springs(change)[:, None]
            x = factor.solve(data, right, blocks, forcing, stale, x)
            moved = np.einsum("ci,ci->c", touch.normals, system.springs_of(x[:, 0]))
            foreseen = touch.gaps + moved < 0.0
            if (foreseen == closed).all():
                break
            closed = foreseen
    direction = np.zeros(at.residual.size)
    direction[system.free] = x[:, 0]
    return direction.reshape(at.residual.shape)


def _line_search(
    system: System, laws: Laws, increment: Increment, u: Array, here: Evaluation, direction: Array,
    control: NewtonControl, seconds: defaultdict[str, float],
) -> tuple[Array, Evaluation] | None:  # fmt: skip
    """Backtrack until the energy falls (Armijo), or nearly so where the slope does (Hager and Zhang 2005)."""
    slope = float((here.residual * direction).sum())
    if not slope < 0.0:
        return None
    noise = 1e-11 * abs(here.energy)
    step = 1.0
    for _ in range(control.max_backtracks):
        there = _evaluate(system, laws, increment, u + step * direction, seconds)
        if not np.isfinite(there.energy):
            step *= 0.4
            continue
        rise = there.energy - here.energy
        end = float((there.residual * direction).sum())
        if rise <= 1e-4 * step * slope or (rise <= noise and abs(end) <= 0.9 * abs(slope)):
            return u + step * direction, there
        step *= min(0.6, max(0.1, -slope / max(end - slope, 1e-300))) if end > 0 else 0.5
    return None
