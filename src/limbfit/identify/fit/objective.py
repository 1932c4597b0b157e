"""The objective: simulated minus measured forces as a vector of residuals, with its derivatives.

There are two objectives. ``pointwise`` takes every difference of force, divided by the site's largest
measured force and by the root of the number of points, so that all sites count alike whatever their stiffness
or sampling. A deviation that an uncertain touch-down explains counts less (generalised least squares on that
one shape). ``paper`` is equation 8 as printed: one mean squared difference per site, which least squares then
squares again.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from ...arrays import Array
from ...errors import CalibrationError, TraceError

Objective = Literal["pointwise", "paper"]

# Of the largest force: where all residuals vanish, equation 8 squared has no curvature
_MIN_ERROR_SHARE = 1e-4


def find_largest_magnitude(values: Array) -> float:
    """Return the largest absolute value of values (n,)."""
    return float(np.abs(values).max())


@dataclass(frozen=True)
class MeasuredCurve:
    """A measured curve at the times of its simulation: ``force_N`` (n,); ``weight`` scales its cost.

    All curves of one place have the same ``site``; by default a curve is a site of its own. Where a force
    drives the indenter, or where lengths are seen beside the force, ``force_N`` holds lengths and ``unit`` is
    mm. ``touch_down_sd_N`` (n,) is the effect of one standard deviation of the touch-down. Beside it the
    model may be off everywhere by ``error_share`` of the largest force.
    """

    name: str
    force_N: Array
    weight: float = 1.0
    site: str = ""
    unit: str = "N"
    touch_down_sd_N: Array | None = None
    error_share: float = 0.01

    def __post_init__(self) -> None:
        if self.force_N.size < 2 or not np.all(np.isfinite(self.force_N)) or not self.peak_N > 0.0:
            raise TraceError("no measured force to compare with", place=self.name)

    @property
    def peak_N(self) -> float:
        """The largest force; the largest magnitude where lengths are compared."""
        return find_largest_magnitude(self.force_N) if self.unit == "mm" else float(self.force_N.max())

    @property
    def site_name(self) -> str:
        """The name that all curves of one site share."""
        return self.site or self.name

    @property
    def scale(self) -> float:
        """One over (largest force x sqrt(n)), times the root of the weight."""
        return float(np.sqrt(self.weight / self.force_N.size) / self.peak_N)

    def discount_touch_down(self, rows: Array, power: float = 0.5) -> Array:
        """Multiply rows (n, ...) by a power of the inverse covariance of the touch-down alone."""
        if self.touch_down_sd_N is None or not (size := float(np.linalg.norm(self.touch_down_sd_N))):
            return rows
        shape = self.touch_down_sd_N / size
        variance = 1.0 + (size / self.peak_N / self.error_share) ** 2 / self.force_N.size
        return np.asarray(rows - np.multiply.outer(shape, (1.0 - variance**-power) * (shape @ rows)))

    def compute_cost_curvature(self, objective: Objective, difference_N: Array) -> Array:
        """Return the second derivative (n, n) of the cost with respect to the simulated force (n,).

        ``difference_N`` (n,) is that force less the measured one. The cost is half the square of the
        residuals. With W this matrix and J the derivatives of the force, the gradient of the cost changes by
        ``-J' W`` times a change of the record and, apart from the second derivatives of the force, by ``J' W
        J`` times a step.
        """
        n = difference_N.size
        if objective == "pointwise":
            return self.scale**2 * self.discount_touch_down(np.eye(n), power=1.0)
        square = max(float(difference_N @ difference_N), n * (_MIN_ERROR_SHARE * self.peak_N) ** 2)
        both = square * np.eye(n) + 2 * np.outer(difference_N, difference_N)
        return np.asarray(2 * (self.weight / n) ** 2 * both)


@dataclass(frozen=True)
class SiteResponse:
    """The result of a simulation: force (n,) in N and its derivatives (n, p); ``reason`` says why it failed.

    ``site`` is the name of the record where it is known. ``warnings`` are those of a completed simulation.
    ``slipped`` or ``folded`` repeats the one among them that says why, or is empty: a simulation that slipped
    lost its equilibrium, and its force belongs to another one; folded elements lose stiffness gradually.
    """

    force_N: Array
    jacobian: Array
    completed: bool = True
    reason: str = ""
    site: str = ""
    warnings: tuple[str, ...] = ()
    slipped: str = ""
    folded: str = ""

    @property
    def fault(self) -> str:
        """Why it cannot be used, or an empty text."""
        if not self.completed:
            return self.reason or "simulation failed"
        is_finite = np.isfinite(self.force_N).all() and np.isfinite(self.jacobian).all()
        return "" if is_finite else "the simulated force is not finite"


Simulate = Callable[[Array], Sequence[SiteResponse]]


def check_responses(
    responses: Sequence[SiteResponse], measured: Sequence[MeasuredCurve], parameters: int
) -> str:
    """Return why an evaluation cannot be used, or an empty text.

    Raises `CalibrationError` if a completed simulation has the wrong shape: an error of the caller, not
    of the physics.
    """
    if len(responses) != len(measured):
        raise CalibrationError(f"{len(responses)} responses for {len(measured)} sites")
    for response, site in zip(responses, measured):
        shapes, n = (response.force_N.shape, response.jacobian.shape), site.force_N.size
        if response.completed and shapes != ((n,), (n, parameters)):
            raise CalibrationError(f"{site.name}: the simulated force has the wrong shape")
        if response.fault:
            return f"{site.name}: {response.fault}"
    return ""


def find_new_warnings(
    responses: Sequence[SiteResponse], before: Sequence[SiteResponse], measured: Sequence[MeasuredCurve]
) -> tuple[str, str]:
    """Return the first slip and the first fold that are not in the responses ``before``, or empty texts.

    If ``before`` is empty, every slip and fold is new.
    """

    def find_first(kind: str) -> str:
        known = [getattr(one, kind) for one in before] or [""] * len(measured)
        rows = zip(measured, responses, known, strict=True)
        new = (f"{m.name}: {getattr(r, kind)}" for m, r, old in rows if getattr(r, kind) and not old)
        return next(new, "")

    return find_first("slipped"), find_first("folded")


def compute_residuals(
    objective: Objective, responses: Sequence[SiteResponse], measured: Sequence[MeasuredCurve]
) -> tuple[Array, Array]:
    """Return the residuals (N,) and their derivatives (N, p) with respect to the full parameters."""
    rows = _compute_pointwise_residuals if objective == "pointwise" else _compute_mean_square_residuals
    pairs = [rows(response, site) for response, site in zip(responses, measured, strict=True)]
    return np.concatenate([r for r, _ in pairs]), np.concatenate([j for _, j in pairs])


def _compute_pointwise_residuals(response: SiteResponse, site: MeasuredCurve) -> tuple[Array, Array]:
    difference = response.force_N - site.force_N
    residual, jacobian = (site.discount_touch_down(rows) for rows in (difference, response.jacobian))
    return residual * site.scale, jacobian * site.scale


def _compute_mean_square_residuals(response: SiteResponse, site: MeasuredCurve) -> tuple[Array, Array]:
    """Equation 8's entry R of a site, with rows that complete the second derivative of the objective.

    Least squares would take the slope g of R alone, as g g'. There is only one entry per site, fewer than
    there are parameters, so the rest of the Hessian, R times the second derivative of R, decides where the
    minimum is. Its part ``2 w R J'J / n`` is added as rows whose residual is zero.
    """
    difference = response.force_N - site.force_N
    value = site.weight * float(np.mean(difference**2))
    share = 2 * site.weight / difference.size
    slope = share * difference @ response.jacobian
    bend = np.sqrt(share * value) * response.jacobian
    return np.r_[value, np.zeros(difference.size)], np.vstack([slope, bend])
