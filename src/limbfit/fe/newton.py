"""Equilibrium of one step: Newton's method on the incremental potential with a line search."""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .direction import newton_direction
from .factor import Factor
from .laws import Laws
from .linear import NotPositiveDefiniteError
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
    system: System, laws: Laws, increment: Increment, guesses: Sequence[Array], factor: Factor,
    control: NewtonControl, floor: float, deep: float, seconds: defaultdict[str, float],
) -> Equilibrium:  # fmt: skip
    """Minimise the potential of ``increment`` from the first of the ``guesses`` (n, 3), or a better one.

    Supported components of the guesses are in place; ``floor`` (N) is the smallest force against which the
    residual is judged, ``deep`` (mm) the penetration from which a guess is doubted.
    """
    evaluate = _Evaluator(system, laws, increment, seconds)
    u, here = _lowest(evaluate, guesses, deep)
    if not np.isfinite(here.energy):
        return Equilibrium(u, here, 0, "an element is inverted at the start of the step")
    last = np.inf
    for iteration in range(control.max_iterations):
        norm = residual_norm(system, here)
        scale = reaction_scale(system, here, floor)
        rounding = norm > 0.3 * last and norm <= 1e-9 * scale  # no further digits to be had
        if norm <= control.tolerance * scale or rounding:
            return Equilibrium(u, here, iteration)
        if not np.isfinite(norm):
            return Equilibrium(u, here, iteration, "the residual is not finite")
        if here.data is None:
            here = evaluate(u)
        forcing = min(0.02, max(0.1 * norm / scale, 0.3 * control.tolerance * scale / norm))
        try:
            direction = newton_direction(system, here, factor, forcing)
        except NotPositiveDefiniteError:
            return Equilibrium(u, here, iteration, "the tangent cannot be factorised")
        last = norm
        found = _line_search(evaluate, u, here, direction, control)
        if found is None:
            if norm <= 100 * control.tolerance * scale:
                return Equilibrium(u, here, iteration)
            return Equilibrium(u, here, iteration, "the line search found no lower energy")
        u, here = found
    return Equilibrium(u, here, control.max_iterations, "Newton's method did not converge")


def _lowest(evaluate: _Evaluator, guesses: Sequence[Array], deep: float) -> tuple[Array, Evaluation]:
    """The first guess; the one of lowest energy where the first runs deep into the indenter."""
    u, at = guesses[0], evaluate(guesses[0])
    if at.penetration > deep or not np.isfinite(at.energy):
        for other in guesses[1:]:
            there = evaluate(other)
            if there.energy < at.energy:
                u, at = other, there
    return u, at


def residual_norm(system: System, at: Evaluation) -> float:
    """Norm of the out-of-balance force, N."""
    return float(np.linalg.norm(at.residual.ravel()[system.free]))


def reaction_scale(system: System, at: Evaluation, floor: float) -> float:
    """The force against which a residual is judged: contact or support reactions, at least ``floor``, N."""
    supports = float(np.linalg.norm(np.where(system.supported, at.residual, 0.0)))
    return max(at.contact_norm, supports, floor)


class _Evaluator:
    """The potential of one step as a function of the displacement."""

    def __init__(
        self, system: System, laws: Laws, increment: Increment, seconds: defaultdict[str, float]
    ) -> None:
        self._system, self._laws, self._increment, self._seconds = system, laws, increment, seconds

    def __call__(self, u: Array, tangent: bool = True) -> Evaluation:
        started = time.perf_counter()
        at = self._system.evaluate(u, self._laws, self._increment, tangent)
        self._seconds["assembly"] += time.perf_counter() - started
        return at


def _line_search(
    evaluate: _Evaluator, u: Array, here: Evaluation, direction: Array, control: NewtonControl
) -> tuple[Array, Evaluation] | None:
    """Backtrack until the energy falls (Armijo), or nearly so where the slope does (Hager and Zhang 2005)."""
    slope = float((here.residual * direction).sum())
    if not slope < 0.0:
        return None
    noise = 1e-11 * abs(here.energy)
    step = 1.0
    for _ in range(control.max_backtracks):
        there = evaluate(u + step * direction, tangent=step == 1.0)
        if not np.isfinite(there.energy):
            step *= 0.4
            continue
        rise = there.energy - here.energy
        end = float((there.residual * direction).sum())
        if rise <= 1e-4 * step * slope or (rise <= noise and abs(end) <= 0.9 * abs(slope)):
            return _expanded(evaluate, u, there, direction, step, slope, end)
        step *= min(0.6, max(0.1, -slope / max(end - slope, 1e-300))) if end > 0 else 0.5
    return None


def _expanded(
    evaluate: _Evaluator, u: Array, there: Evaluation, direction: Array, step: float, slope: float, end: float
) -> tuple[Array, Evaluation]:
    """A step of a shifted tangent is too short: it is doubled while the energy goes on falling as fast."""
    while end < 0.5 * slope:
        further = evaluate(u + 2.0 * step * direction, tangent=False)
        if not further.energy < there.energy:
            break
        step, there = 2.0 * step, further
        end = float((there.residual * direction).sum())
    return u + step * direction, there
