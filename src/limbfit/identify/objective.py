"""What is compared: forces simulated and measured, as a vector of residuals and its derivatives.

Two objectives. ``pointwise`` takes every force difference, over the site's largest measured force and the
root of its number of points, so that each site counts alike whatever its stiffness or sampling. ``paper``
takes equation 8 as printed, one mean squared difference per site, which least squares then squares again.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from ..errors import CalibrationError, TraceError

Array = NDArray[np.float64]
Objective = Literal["pointwise", "paper"]


@dataclass(frozen=True)
class Measured:
    """The record of a site at the times of its simulation: ``force_N`` (n,); ``weight`` scales its cost."""

    name: str
    force_N: Array
    weight: float = 1.0

    def __post_init__(self) -> None:
        if self.force_N.size < 2 or not np.all(np.isfinite(self.force_N)) or self.force_N.max() <= 0:
            raise TraceError("no measured force to compare with", place=self.name)

    @property
    def scale(self) -> float:
        """1 / (largest force x sqrt(n)), times the root of the weight."""
        return float(np.sqrt(self.weight / self.force_N.size) / self.force_N.max())


@dataclass(frozen=True)
class SiteResponse:
    """What a simulation gives: force (n,) N and its derivatives (n, p); ``reason`` where it failed."""

    force_N: Array
    jacobian: Array
    completed: bool = True
    reason: str = ""


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


def residuals(
    objective: Objective, responses: Sequence[SiteResponse], measured: Sequence[Measured]
) -> tuple[Array, Array]:
    """Residual vector (N,) and its derivatives with respect to the full parameters (N, p)."""
    rows = _pointwise if objective == "pointwise" else _mean_squares
    pairs = [rows(response, site) for response, site in zip(responses, measured, strict=True)]
    return np.concatenate([r for r, _ in pairs]), np.concatenate([j for _, j in pairs])


def _pointwise(response: SiteResponse, site: Measured) -> tuple[Array, Array]:
    return (response.force_N - site.force_N) * site.scale, response.jacobian * site.scale


def _mean_squares(response: SiteResponse, site: Measured) -> tuple[Array, Array]:
    difference = response.force_N - site.force_N
    jacobian = 2 * difference @ response.jacobian / difference.size
    return np.array([site.weight * np.mean(difference**2)]), site.weight * jacobian[None]
