"""What is seen beside a record's force, as it is compared with a simulation.

Ultrasound through the indenter sees tissues become thinner and shear waves run, cameras see the skin around
it move. One simulation tells them all (`SiteModel.layers`, `SiteModel.skin_points`, `SiteModel.waves`).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from ...arrays import Array
from ...identify.fit.objective import find_largest_magnitude
from ...identify.uncertainty.noise import SiteNoise, compute_depth_slope, compute_skin_similarity
from ...indentation import Simulation

_LEAST_DEPTH = 0.1  # of the largest: nearer to touch-down moves are not in proportion to the depth


@dataclass(frozen=True)
class SecondaryValues:
    """What is seen beside a record's force: values (n,), and where a simulation of it shows them.

    Each is a mean over time of one gauge: ``at`` (n, t) of the record's times, of number ``gauge`` (n,) in
    `Simulation.observed`. ``time_s`` (n,) is when; ``covariance`` (n, n) is that of the readings. ``what`` is
    seen, ``facts`` are for the stored row. ``unit`` is that of the values.
    """

    what: str
    value: Array
    time_s: Array
    gauge: NDArray[np.int64]
    at: Array
    covariance: Array
    facts: dict[str, Any]

    kind: ClassVar[str]
    quantity: ClassVar[str]  # in the heads of stored curves
    unit: ClassVar[str] = "mm"

    def of(self, simulation: Simulation) -> tuple[Array, Array]:
        """The same values (n,) of a simulation, and their derivatives (n, p); none: (n, 0)."""
        values = np.einsum("nt,nt->n", self.at, simulation.observed[self.gauge])
        slopes = simulation.observed_jacobian
        if slopes is None:
            return values, np.zeros((len(values), 0))
        return values, np.einsum("nt,ntp->np", self.at, slopes[self.gauge])

    @property
    def ending(self) -> str:
        """The unit, in the heads of stored curves."""
        return self.unit.replace("/", "_")

    @property
    def noise_sd(self) -> float:
        """Standard deviation of the values, root mean square."""
        return float(np.sqrt(np.diag(self.covariance).mean()))

    def weight(self, error_share: float) -> float:
        """How much its residuals count beside those of a force, 1 at most.

        A force counts as one whose error is ``error_share`` of its largest. Where this is off by more than
        that share of the largest value, it counts by as much less.
        """
        return min(1.0, (error_share * find_largest_magnitude(self.value) / self.noise_sd) ** 2)

    def noise(
        self, name: str, simulated: Array, depth_mm: Array | None, touch_down_sd_mm: float
    ) -> SiteNoise:
        """Noise of the values: of the readings, and of the touch-down.

        ``simulated`` (n,) tell what a wrong touch-down does to them; no ``depth_mm`` (t,) of the indenter
        at the record's times under a stated force, where the time of touch-down alone is off.
        """
        covariance = self.covariance
        if depth_mm is not None:
            slope = touch_down_sd_mm * self.by_depth(self.at @ depth_mm, simulated)
            covariance = covariance + np.outer(slope, slope)
        sd = self.facts["sd"]
        return SiteNoise(
            name, self.time_s, covariance, sd, 0.0, touch_down_sd_mm, self.unit, similarity=self.alike
        )

    @property
    def alike(self) -> Array | None:
        """See `SiteNoise.similarity`."""
        return None

    def by_depth(self, depth_mm: Array, simulated: Array) -> Array:
        """How the values (n,) change with the depth (n,), in their unit for each mm."""
        raise NotImplementedError

    def by_strain(self, simulated: Array) -> Array | None:
        """How the values (n,) change with the logarithm of all strain; None where a depth decides it."""
        return None

    @property
    def columns(self) -> dict[str, Array]:
        """What the stored curves say of each value."""
        return {"time_s": self.time_s}


@dataclass(frozen=True)
class LayerMeasurement(SecondaryValues):
    """The compression of a tissue under the indenter."""

    kind: ClassVar = "ultrasound"
    quantity: ClassVar = "compression"

    def by_depth(self, depth_mm: Array, simulated: Array) -> Array:
        return compute_depth_slope(self.time_s, depth_mm, simulated)


@dataclass(frozen=True)
class SurfaceMeasurement(SecondaryValues):
    """The displacement of the skin around the indenter: ``points`` (n, 3) mm along ``components`` (n,)."""

    points: Array
    components: NDArray[np.int64]

    kind: ClassVar = "surface"
    quantity: ClassVar = "displacement"

    @property
    def alike(self) -> Array:
        return compute_skin_similarity(self.points, self.components)

    def by_depth(self, depth_mm: Array, simulated: Array) -> Array:
        """Moves of the skin are nearly in proportion to the depth."""
        return _divide_by_depth(depth_mm, simulated)

    @property
    def columns(self) -> dict[str, Array]:
        places = dict(zip(("x_mm", "y_mm", "z_mm"), self.points.T, strict=True))
        return {"time_s": self.time_s, **places, "component": self.components.astype(np.float64)}


@dataclass(frozen=True)
class WaveMeasurement(SecondaryValues):
    """Speeds of shear waves, m/s, at one place under the indenter: at rest, and while it presses."""

    kind: ClassVar = "shear waves"
    quantity: ClassVar = "speed"
    unit: ClassVar = "m/s"

    def by_depth(self, depth_mm: Array, simulated: Array) -> Array:
        """What strain adds to a speed is nearly in proportion to the depth."""
        return _divide_by_depth(depth_mm, simulated - simulated[np.argmin(depth_mm)])

    def by_strain(self, simulated: Array) -> Array:
        """As much as strain adds to a speed since the first reading."""
        return np.asarray(simulated - simulated[np.argmin(self.time_s)])


def _divide_by_depth(depth_mm: Array, values: Array) -> Array:
    """Values (n,) over depths (n,), mm; none where the indenter is not in."""
    deepest = float(depth_mm.max())
    if deepest <= 0.0:
        return np.zeros_like(values)
    return np.asarray(values / np.maximum(depth_mm, _LEAST_DEPTH * deepest))
