"""Equilibrium of one step: Newton's method on the incremental potential with a line search."""

from __future__ import annotations

import time
from collections import defaultdict
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .direction import newton_direction
from .factor import Factor
from .laws import Laws
from .system import Evaluation, Increment, System

Array = NDArray[np.float64]


@dataclass(frozen=True)
class NewtonControl:
    """Tolerance of the residual relative to the reactions, and limits."""

    tolerance: float = 3e-5
    max_iterations: int = 30
    max_backtracks: int = 12


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
        forcing = min(0.02, max(0.1 * norm / scale, 0.3 * control.tolerance * scale / norm))
        direction = newton_direction(system, here, factor, forcing)
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
