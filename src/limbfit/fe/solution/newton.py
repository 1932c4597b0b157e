"""Equilibrium of one step: Newton's method on the incremental potential with a line search.

Where the search can use a small part of a direction only, the model that gave it is not to be trusted that
far: the next ones are damped by the stiffness of shear (`convexity`), more after every short step and less
after every full one, as in a trust region (Levenberg 1944, Marquardt 1963).

Bodies that a force drives would follow a direction by millimetres in one step, but which points will touch is
predicted on flat faces and for small moves only.  So their moves are bounded, by a share of their width.

A guess lies deep in the indenter, and a rounded edge that presses on it that hard makes a tangent of large
negative eigenvalues, pressure over radius, which say nothing of the equilibrium.  So far from it the edge is
taken as flat there (`Increment.flat_from`).
"""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ...arrays import Array
from ..kernel.laws import Laws
from ..system import Evaluation, Increment, System
from .direction import find_newton_direction
from .factor import Factor
from .linear import NotPositiveDefiniteError

# A shorter step damps the next directions, at first by this share of each tissue's own shear modulus; it is
# changed by a factor, and less than the smallest is none.
SHORT_STEP, FIRST_DAMPING, DAMPING_CHANGE, LEAST_DAMPING = 0.3, 0.1, 4.0, 0.02
# Times the tolerance: a residual that is accepted, with a warning, where the line search finds no lower
# energy.
LOOSE_FACTOR = 100.0
MAX_BACKTRACKS = 12  # of a line search
NEAR_EQUILIBRIUM = 0.1  # residual over reactions from which the tangent is the exact one
MIN_FORCE_N = 1e-300  # N; before the first touch there are no reactions


@dataclass(frozen=True)
class NewtonControl:
    """Tolerance of the residual relative to the reactions, limits, and the damping to begin with.

    ``reduction``: share of the first residual that will do instead of the tolerance.
    ``max_penetration``: penetration (mm) that near equilibrium ends the search, for the penalty is too small.
    ``tangent``: whether the tangent is wanted at the equilibrium.
    """

    tolerance: float = 3e-5
    max_iterations: int = 30
    damping: float = 0.0
    reduction: float = 0.0
    max_penetration: float = np.inf
    tangent: bool = True


@dataclass(frozen=True)
class Equilibrium:
    """Where Newton stopped.

    ``reason`` is empty at equilibrium, or near one of unbearable penetration; ``damped``: it had to shorten a
    step much; ``residual``: over the reactions, more than the tolerance where nothing lower was found;
    ``first``: that of the guess; ``unsettled``: that which renewing the grip went on causing.
    """

    u: Array
    at: Evaluation
    iterations: int
    reason: str = ""
    damped: bool = False
    residual: float = np.inf
    first: float = np.inf
    unsettled: float = 0.0


def equilibrate(
    system: System, laws: Laws, increment: Increment, guesses: Sequence[Array], factor: Factor,
    control: NewtonControl, floor: float, deep: float, seconds: defaultdict[str, float],
) -> Equilibrium:  # fmt: skip
    """Minimise the potential of ``increment`` from the first of the ``guesses`` (n, 3), or a better one.

    Supported components of the guesses are in place; ``floor`` (N) is the smallest force against which the
    residual is judged, ``deep`` (mm) the penetration from which other guesses are tried.
    """
    evaluate = _Evaluator(system, laws, increment, seconds)
    u, here = _select_lowest(evaluate, guesses, deep)
    if not np.isfinite(here.energy):
        return Equilibrium(u, here, 0, "an element is inverted at the start of the step")
    last, damping, damped, first = np.inf, control.damping, False, np.inf
    for iteration in range(control.max_iterations):
        norm = compute_residual_norm(system, here)
        scale = compute_reaction_scale(system, here, floor)
        share = norm / max(scale, MIN_FORCE_N)
        first = first if iteration else share
        rounding = norm > 0.3 * last and norm <= 1e-9 * scale  # no further digits to be had
        unbearable = norm <= NEAR_EQUILIBRIUM * scale and here.penetration > control.max_penetration
        tolerance = max(control.tolerance, control.reduction * first)
        if norm <= tolerance * scale or rounding or unbearable:
            return Equilibrium(u, here, iteration, damped=damped, residual=share, first=first)
        if not np.isfinite(norm):
            return Equilibrium(u, here, iteration, "the residual is not finite")
        if here.data is None:
            here = evaluate(u)
        sufficient = 0.3 * tolerance * scale / norm
        forcing = min(0.02, max(0.1 * norm / scale, sufficient))
        try:
            direction = find_newton_direction(system, here, factor, forcing, damping)
        except NotPositiveDefiniteError:
            return Equilibrium(u, here, iteration, "the tangent cannot be factorised")
        last = norm
        if norm <= NEAR_EQUILIBRIUM * scale:
            evaluate.use_exact_tangent()
        direction = system.bodies.compute_trusted_share(direction) * direction
        evaluate.predict_friction(u, direction)
        wants_tangent = control.tangent or forcing > sufficient
        found = _search_along_line(evaluate, u, here, direction, wants_tangent)
        if found is None:
            if norm <= LOOSE_FACTOR * control.tolerance * scale:
                return Equilibrium(u, here, iteration, damped=damped, residual=share, first=first)
            return Equilibrium(u, here, iteration, "the line search found no lower energy")
        u, here, step = found
        damping, damped = _update_damping(damping, step), damped or step < SHORT_STEP
    return Equilibrium(u, here, control.max_iterations, "Newton's method did not converge")


def _update_damping(damping: float, step: float) -> float:
    """The damping after a step of this length."""
    if step < SHORT_STEP:
        return max(DAMPING_CHANGE * damping, FIRST_DAMPING)
    if step >= 1.0:
        damping /= DAMPING_CHANGE
    return damping if damping >= LEAST_DAMPING else 0.0


def _select_lowest(evaluate: _Evaluator, guesses: Sequence[Array], deep: float) -> tuple[Array, Evaluation]:
    """The first guess; the one of lowest energy where the first runs deep into the indenter."""
    u, at = guesses[0], evaluate(guesses[0])
    if at.penetration > deep or not np.isfinite(at.energy):
        for other in guesses[1:]:
            there = evaluate(other)
            if there.energy < at.energy:
                u, at = other, there
    return u, at


def compute_residual_norm(system: System, at: Evaluation) -> float:
    """Norm of the out-of-balance force, N."""
    return float(np.linalg.norm(at.residual.ravel()[system.free]))


def compute_reaction_scale(system: System, at: Evaluation, floor: float) -> float:
    """The force against which a residual is judged: contact or support reactions, at least ``floor``, N."""
    held = system.supported[: system.nodes]
    supports = float(np.linalg.norm(np.where(held, at.residual[: system.nodes], 0.0)))
    return max(at.contact_norm, at.load_norm, supports, floor)


class _Evaluator:
    """The potential of one step as a function of the displacement."""

    def __init__(
        self, system: System, laws: Laws, increment: Increment, seconds: defaultdict[str, float]
    ) -> None:
        self._system, self._laws, self._increment, self._seconds = system, laws, increment, seconds

    def use_exact_tangent(self) -> None:
        """From here on with the indenter's curvature everywhere."""
        self._increment = replace(self._increment, flat_from=np.inf)

    def predict_friction(self, u: Array, direction: Array) -> None:
        """From here on with the pulls of friction that the tangent at ``u`` predicts for a full step."""
        now = self._increment
        self._increment = now.predict(self._system.tools(u, now) if any(now.grips) else [], direction)

    def __call__(self, u: Array, tangent: bool = True) -> Evaluation:
        started = time.perf_counter()
        at = self._system.evaluate(u, self._laws, self._increment, tangent)
        self._seconds["assembly"] += time.perf_counter() - started
        return at


def _search_along_line(
    evaluate: _Evaluator, u: Array, here: Evaluation, direction: Array, wants_tangent: bool
) -> tuple[Array, Evaluation, float] | None:
    """Backtrack until the energy falls (Armijo), or nearly so where the slope does (Hager and Zhang 2005).

    The displacement, its evaluation (with the tangent after a full step, if the search is ``wants_tangent``)
    and the step along ``direction``.
    """
    slope = float((here.residual * direction).sum())
    if not slope < 0.0:
        return None
    noise = 1e-11 * abs(here.energy)
    step = 1.0
    for _ in range(MAX_BACKTRACKS):
        there = evaluate(u + step * direction, tangent=wants_tangent and step == 1.0)
        if not np.isfinite(there.energy):
            step *= 0.4
            continue
        rise = there.energy - here.energy
        end = float((there.residual * direction).sum())
        if rise <= 1e-4 * step * slope or (rise <= noise and abs(end) <= 0.9 * abs(slope)):
            return _expand_step(evaluate, u, there, direction, step, slope, end)
        step *= min(0.6, max(0.1, -slope / max(end - slope, 1e-300))) if end > 0 else 0.5
    return None


def _expand_step(
    evaluate: _Evaluator, u: Array, there: Evaluation, direction: Array, step: float, slope: float, end: float
) -> tuple[Array, Evaluation, float]:
    """A step of a shifted tangent is too short: it is doubled while the energy goes on falling as fast."""
    while end < 0.5 * slope:
        further = evaluate(u + 2.0 * step * direction, tangent=False)
        if not further.energy < there.energy:
            break
        step, there = 2.0 * step, further
        end = float((there.residual * direction).sum())
    return u + step * direction, there, step
