"""What is seen beside a record's force, as it is compared with a simulation.

Ultrasound through the indenter sees tissues become thinner, cameras see the skin around it move. Both are
lengths that change in time, and the gauges of one simulation tell them (`SiteModel.layers`,
`SiteModel.skin_points`).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from ...identify.fit.objective import largest
from ...identify.uncertainty.noise import SiteNoise, alike_on_skin, depth_slope
from ...indentation import Simulation

Array = NDArray[np.float64]

_LEAST_DEPTH = 0.1  # of the largest: nearer to touch-down moves are not in proportion to the depth


@dataclass(frozen=True)
class Observed:
    """Lengths (n,) mm that are seen beside a record's force, and where a simulation of it shows them.

    Each is a mean over time of one gauge: ``at`` (n, t) of the record's times, of number ``gauge`` (n,) in
    `Simulation.observed_mm`. ``time_s`` (n,) is when; ``covariance`` (n, n) mm^2 is that of the readings.
    ``what`` is seen, ``facts`` are for the stored row.
    """

    what: str
    value_mm: Array
    time_s: Array
    gauge: NDArray[np.int64]
    at: Array
    covariance: Array
    facts: dict[str, Any]

    kind: ClassVar[str]
    quantity: ClassVar[str]  # in the heads of stored curves

    def of(self, simulation: Simulation) -> tuple[Array, Array]:
        """The same lengths (n,) mm of a simulation, and their derivatives (n, p); none: (n, 0)."""
        values = np.einsum("nt,nt->n", self.at, simulation.observed_mm[self.gauge])
        slopes = simulation.observed_jacobian
        if slopes is None:
            return values, np.zeros((len(values), 0))
        return values, np.einsum("nt,ntp->np", self.at, slopes[self.gauge])

    @property
    def noise_mm(self) -> float:
        """Standard deviation of the lengths, root mean square."""
        return float(np.sqrt(np.diag(self.covariance).mean()))

    def weight(self, error_share: float) -> float:
        """How much its residuals count beside those of a force, 1 at most.

        A force counts as one whose error is ``error_share`` of its largest. Where this is off by more than
        that share of the largest length, it counts by as much less.
        """
        return min(1.0, (error_share * largest(self.value_mm) / self.noise_mm) ** 2)

    def noise(
        self, name: str, simulated_mm: Array, depth_mm: Array | None, touch_down_sd_mm: float
    ) -> SiteNoise:
        """Noise of the lengths: of the readings, and of the touch-down.

        ``simulated_mm`` (n,) tell what a wrong touch-down does to them; no ``depth_mm`` (t,) of the indenter
        at the record's times under a stated force, where the time of touch-down alone is off.
        """
        covariance = self.covariance
        if depth_mm is not None:
            slope = touch_down_sd_mm * self.by_depth(self.at @ depth_mm, simulated_mm)
            covariance = covariance + np.outer(slope, slope)
        sd = self.facts["sd_mm"]
        return SiteNoise(name, self.time_s, covariance, sd, 0.0, touch_down_sd_mm, "mm", alike=self.alike)

    @property
    def alike(self) -> Array | None:
        """See `SiteNoise.alike`."""
        return None

    def by_depth(self, depth_mm: Array, simulated_mm: Array) -> Array:
        """How the lengths (n,) change with the depth (n,), mm/mm."""
        raise NotImplementedError

    @property
    def columns(self) -> dict[str, Array]:
        """What the stored curves say of each length."""
        return {"time_s": self.time_s}


@dataclass(frozen=True)
class SeenLayer(Observed):
    """The compression of a tissue under the indenter."""

    kind: ClassVar = "ultrasound"
    quantity: ClassVar = "compression"

    def by_depth(self, depth_mm: Array, simulated_mm: Array) -> Array:
        return depth_slope(self.time_s, depth_mm, simulated_mm)


@dataclass(frozen=True)
class SeenSurface(Observed):
    """The displacement of the skin around the indenter: ``points`` (n, 3) mm along ``components`` (n,)."""

    points: Array
    components: NDArray[np.int64]

    kind: ClassVar = "surface"
    quantity: ClassVar = "displacement"

    @property
    def alike(self) -> Array:
        return alike_on_skin(self.points, self.components)

    def by_depth(self, depth_mm: Array, simulated_mm: Array) -> Array:
        """Moves of the skin are nearly in proportion to the depth."""
        return simulated_mm / np.maximum(depth_mm, _LEAST_DEPTH * depth_mm.max())

    @property
    def columns(self) -> dict[str, Array]:
        places = dict(zip(("x_mm", "y_mm", "z_mm"), self.points.T, strict=True))
        return {"time_s": self.time_s, **places, "component": self.components.astype(np.float64)}
