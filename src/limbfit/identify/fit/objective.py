"""What is compared: forces simulated and measured, as a vector of residuals and its derivatives.

Two objectives. ``pointwise`` takes every force difference, over the site's largest measured force and the
root of its number of points, so that each site counts alike whatever its stiffness or sampling; what a
doubtful touch-down does to a record counts for less (generalised least squares on that one shape). ``paper``
takes equation 8 as printed, one mean squared difference per site, which least squares then squares again.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from ...errors import CalibrationError, TraceError

Array = NDArray[np.float64]
Objective = Literal["pointwise", "paper"]

_EXACT = 1e-4  # of the largest force: where all residuals vanish, equation 8 squared has no curvature


def largest(values: Array) -> float:
    """The largest of values (n,) without its sign."""
    return float(np.abs(values).max())


@dataclass(frozen=True)
class Measured:
    """A record at the times of its simulation: ``force_N`` (n,); ``weight`` scales its cost.

    ``site`` is where it is from, the same for all records of a site; by default its own. Under a stated
    force the depth is compared: ``force_N`` is that, and ``unit`` mm; so are lengths that are seen beside the
    force, of either sign. ``doubt_N`` (n,) is one standard
    deviation of what its touch-down may have done to it, beside which it may be off by ``error_share`` of its
    largest force throughout.
    """

    name: str
    force_N: Array
    weight: float = 1.0
    site: str = ""
    unit: str = "N"
    doubt_N: Array | None = None
    error_share: float = 0.01

    def __post_init__(self) -> None:
        if self.force_N.size < 2 or not np.all(np.isfinite(self.force_N)) or not self.peak_N > 0.0:
            raise TraceError("no measured force to compare with", place=self.name)

    @property
    def peak_N(self) -> float:
        """The largest force, or whatever is compared, without its sign."""
        return largest(self.force_N) if self.unit == "mm" else float(self.force_N.max())

    @property
    def where(self) -> str:
        """What records of one site have in common."""
        return self.site or self.name

    @property
    def scale(self) -> float:
        """1 / (largest force x sqrt(n)), times the root of the weight."""
        return float(np.sqrt(self.weight / self.force_N.size) / self.peak_N)

    def discounted(self, rows: Array, power: float = 0.5) -> Array:
        """Rows (n, ...) times a power of the inverse covariance that the touch-down's doubt alone gives."""
        if self.doubt_N is None or not (size := float(np.linalg.norm(self.doubt_N))):
            return rows
        shape = self.doubt_N / size
        variance = 1.0 + (size / self.peak_N / self.error_share) ** 2 / self.force_N.size
        return np.asarray(rows - np.multiply.outer(shape, (1.0 - variance**-power) * (shape @ rows)))

    def curvature(self, objective: Objective, difference_N: Array) -> Array:
        """Second derivative (n, n) of its cost with respect to the simulated force (n,).

        ``difference_N`` (n,) is that force less the measured one. Half the square of the residuals is the
        cost. With derivatives J of the force, its gradient changes by ``-J' W`` times a change of the record
        and, but for the force's own second derivatives, by ``J' W J`` times a step; W is this matrix.
        """
        n = difference_N.size
        if objective == "pointwise":
            return self.scale**2 * self.discounted(np.eye(n), power=1.0)
        square = max(float(difference_N @ difference_N), n * (_EXACT * self.peak_N) ** 2)
        both = square * np.eye(n) + 2 * np.outer(difference_N, difference_N)
        return np.asarray(2 * (self.weight / n) ** 2 * both)


@dataclass(frozen=True)
class SiteResponse:
    """What a simulation gives: force (n,) N and its derivatives (n, p); ``reason`` where it failed.

    ``site``: its name, where it is known; ``doubts``: what is doubtful about a completed one, among it why it
    ``slipped`` or ``folded``, or empty.  One that slipped has lost its equilibrium, and its force is that of
    another one; one with folded elements has lost stiffness by and by.
    """

    force_N: Array
    jacobian: Array
    completed: bool = True
    reason: str = ""
    site: str = ""
    doubts: tuple[str, ...] = ()
    slipped: str = ""
    folded: str = ""


Simulate = Callable[[Array], Sequence[SiteResponse]]


def check_responses(responses: Sequence[SiteResponse], measured: Sequence[Measured], parameters: int) -> str:
    """Why an evaluation cannot be used, or an empty text.

    Raises
    ------
    CalibrationError
        Where a completed simulation has the wrong shape: a fault of the caller, not of the physics.
    """
    if len(responses) != len(measured):
        raise CalibrationError(f"{len(responses)} responses for {len(measured)} sites")
    for response, site in zip(responses, measured):
        if not response.completed:
            return f"{site.name}: {response.reason or 'simulation failed'}"
        n = site.force_N.size
        if response.force_N.shape != (n,) or response.jacobian.shape != (n, parameters):
            raise CalibrationError(f"{site.name}: the simulated force has the wrong shape")
        if not (np.all(np.isfinite(response.force_N)) and np.all(np.isfinite(response.jacobian))):
            return f"{site.name}: the simulated force is not finite"
    return ""


def new_doubts(
    responses: Sequence[SiteResponse], before: Sequence[SiteResponse], measured: Sequence[Measured]
) -> tuple[str, str]:
    """What slipped, and what folded, that did not at the responses ``before`` (none: nowhere); or empty."""

    def first(kind: str) -> str:
        known = [getattr(one, kind) for one in before] or [""] * len(measured)
        rows = zip(measured, responses, known, strict=True)
        new = (f"{m.name}: {getattr(r, kind)}" for m, r, old in rows if getattr(r, kind) and not old)
        return next(new, "")

    return first("slipped"), first("folded")


def residuals(
    objective: Objective, responses: Sequence[SiteResponse], measured: Sequence[Measured]
) -> tuple[Array, Array]:
    """Residual vector (N,) and its derivatives with respect to the full parameters (N, p)."""
    rows = _pointwise if objective == "pointwise" else _mean_squares
    pairs = [rows(response, site) for response, site in zip(responses, measured, strict=True)]
    return np.concatenate([r for r, _ in pairs]), np.concatenate([j for _, j in pairs])


def _pointwise(response: SiteResponse, site: Measured) -> tuple[Array, Array]:
    difference = response.force_N - site.force_N
    return site.discounted(difference) * site.scale, site.discounted(response.jacobian) * site.scale


def _mean_squares(response: SiteResponse, site: Measured) -> tuple[Array, Array]:
    """Equation 8's entry R of a site, and its whole second derivative in first derivatives of the force.

    Least squares takes R's slope g alone, as g g'. There is one entry per site, fewer than parameters, so the
    rest of the Hessian, R times the second derivative of R, decides where the minimum is; its part
    ``2 w R J'J / n`` comes as rows whose residual is zero.
    """
    difference = response.force_N - site.force_N
    value = site.weight * float(np.mean(difference**2))
    share = 2 * site.weight / difference.size
    slope = share * difference @ response.jacobian
    bend = np.sqrt(share * value) * response.jacobian
    return np.r_[value, np.zeros(difference.size)], np.vstack([slope, bend])
