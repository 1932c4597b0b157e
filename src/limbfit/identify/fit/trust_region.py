"""Bounded nonlinear least squares for expensive functions whose evaluations may fail.

Each step solves the linearised problem exactly inside a box, the intersection of the bounds with a trust
region, so the iterates never leave the bounds. A trial that fails, or does not lower the cost, shrinks the
region and costs one evaluation; nothing else remembers it. The whole state is (point, radius). Textbook:
Nocedal and Wright, Numerical Optimization, chapters 4 and 10; Moré 1978 for the gain ratio.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from scipy.optimize import lsq_linear

from ...arrays import Array

FIRST_RADIUS = 0.5  # in logarithms: first steps twice as long were refused on phantom and OpenLimb
FORCES_UNCHANGED = "the forces would hardly change"
AT_NOISE_FLOOR = "the error falls by no more than the noise of the simulations"
_MAX_RADIUS = 2.0
_MAX_REJECTED = 8
# Directions that the data hardly see are not followed: relative to the residual, in units of z.
_DAMPING = 1e-2
# Less than this share of the squared error cannot be relied on: simulations are not smooth to the last digit.
_NOISE_FLOOR_SHARE = 1e-2
# The same of three ever shorter steps in a row, however much each promised: what is smooth is not refused so.
_ROUGH_SHARE, _MAX_REFUSED = 0.1, 3
_CREEP_FACTOR = 4.0  # times the change at which an iteration ends, where it creeps along a valley
_EXACT_FIT = 1e-9  # a residual this small (relative force) is a perfect fit


@dataclass(frozen=True)
class SearchPoint:
    """An evaluated point: z (k,), residual (N,), jacobian (N, k)."""

    z: Array
    residual: Array
    jacobian: Array

    @property
    def cost(self) -> float:
        """Half the sum of squares."""
        return 0.5 * float(self.residual @ self.residual)


@dataclass(frozen=True)
class SearchStep:
    """An accepted point and the radius for the next step; the last one has a ``reason`` and ``converged``."""

    point: SearchPoint
    radius: float
    reason: str = ""
    converged: bool = False


Evaluate = Callable[[Array], "SearchPoint | None"]
Stop = Callable[[SearchPoint, SearchPoint], str]


def minimise(
    evaluate: Evaluate,
    point: SearchPoint,
    lower: Array,
    upper: Array,
    *,
    tolerance: float = 1e-3,
    change: float = 0.0,
    radius: float = FIRST_RADIUS,
    max_iterations: int = 25,
    stop: Stop | None = None,
) -> Iterator[SearchStep]:
    """Yield the accepted points after ``point``; the last one carries the reason for the end.

    Parameters
    ----------
    evaluate : returns the point at z, or None where it cannot be evaluated.
    tolerance : the search ends where a full Gauss-Newton step would change no entry of z by more than this,
        or would lower the cost by less than this fraction. It also ends at the noise floor: where a step that
        promises less than a hundredth of the cost is refused, or lowers it by less than this fraction, and
        where three ever shorter steps in a row are refused that promise less than a tenth.
    change : the search also ends where a full step would change the norm of the residual vector by less than
        this, or where the last step did and a full step would change it by less than four times this.
    radius : half the width of the trust region, in z.
    stop : a further rule: takes the last two points and returns a reason to end, or an empty text.
    """
    rejected = refused = accepted = 0
    while True:
        reason = _find_convergence(point, lower, upper, tolerance, change)
        if reason:
            yield SearchStep(point, radius, reason, converged=True)
            return
        step = _solve_bounded_step(
            point, np.maximum(lower - point.z, -radius), np.minimum(upper - point.z, radius)
        )
        promised = _predict_decrease(point, step)
        hopeless = promised < _NOISE_FLOOR_SHARE * point.cost and not np.any(np.abs(step) > 0.99 * radius)
        trial = evaluate(np.clip(point.z + step, lower, upper))
        gain = -np.inf if trial is None else (point.cost - trial.cost) / max(promised, 1e-300)
        length = float(np.abs(step).max())
        radius = _update_radius(radius, length, gain)
        if trial is None or gain <= 1e-4:
            refused = refused + 1 if trial is not None else 0
            rough = refused >= _MAX_REFUSED and promised < _ROUGH_SHARE * point.cost
            if trial is not None and (hopeless or rough):
                yield SearchStep(point, radius, AT_NOISE_FLOOR, converged=True)
                return
            rejected += 1
            if rejected >= _MAX_REJECTED or radius < 1e-3 * tolerance:
                why = "the simulations fail" if trial is None else "no smaller step lowers the error"
                yield SearchStep(point, radius, f"stuck: {why} around this point")
                return
            continue
        previous, point, rejected, refused, accepted = point, trial, 0, 0, accepted + 1
        reason = stop(previous, point) if stop else ""
        if _is_creeping(previous, point, lower, upper, change):
            reason = reason or FORCES_UNCHANGED
        if hopeless and previous.cost - point.cost < tolerance * previous.cost:
            reason = reason or AT_NOISE_FLOOR
        if reason or accepted >= max_iterations:
            yield SearchStep(point, radius, reason or "the limit of iterations is reached", bool(reason))
            return
        yield SearchStep(point, radius)


def _solve_bounded_step(point: SearchPoint, lower: Array, upper: Array) -> Array:
    """The least-squares step inside a box, damped in directions that the data do not determine."""
    size = len(point.z)
    damping = _DAMPING * np.linalg.norm(point.residual) + 1e-14
    rows = np.vstack([point.jacobian, damping * np.eye(size)])
    target = np.r_[-point.residual, np.zeros(size)]
    return lsq_linear(rows, target, bounds=(lower, upper), method="bvls").x


def _predict_decrease(point: SearchPoint, step: Array) -> float:
    """The decrease of the cost that the linearisation promises."""
    after = point.residual + point.jacobian @ step
    return point.cost - 0.5 * float(after @ after)


def _update_radius(radius: float, length: float, gain: float) -> float:
    if gain < 0.25:
        return 0.35 * length
    if gain > 0.75 and length > 0.95 * radius:
        return min(2 * radius, _MAX_RADIUS)
    return radius


def _is_creeping(before: SearchPoint, after: SearchPoint, lower: Array, upper: Array, change: float) -> bool:
    """True if the step changed hardly anything, and the next full step promises little more."""
    if float(np.linalg.norm(after.residual - before.residual)) >= change:
        return False
    step = _solve_bounded_step(after, lower - after.z, upper - after.z)
    return float(np.linalg.norm(after.jacobian @ step)) < _CREEP_FACTOR * change


def _find_convergence(point: SearchPoint, lower: Array, upper: Array, tolerance: float, change: float) -> str:
    if float(np.linalg.norm(point.residual)) < _EXACT_FIT:
        return "the fit is exact"
    step = _solve_bounded_step(point, lower - point.z, upper - point.z)
    if np.abs(step).max() < tolerance:
        return f"no parameter would change by more than {tolerance:g} of itself"
    if float(np.linalg.norm(point.jacobian @ step)) < change:
        return FORCES_UNCHANGED
    if _predict_decrease(point, step) < tolerance * point.cost:
        return f"the squared error would fall by less than {tolerance:g} of itself"
    return ""
