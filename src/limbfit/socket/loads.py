"""Loads of standing and walking as forces on the socket, in multiples of body weight.

Sizes of the forces: peaks and valley of the vertical ground reaction in level walking (Winter, The
Biomechanics and Motor Control of Human Gait, 2nd ed. 1991; a prosthetic side is loaded a little less). Lines
of heel strike and toe-off: after the loading conditions I and II of ISO 10328, rounded to 10 mm at the knee
and to a tenth in their slope. They combine the largest moments of stance: for judging sockets side by side.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from ..arrays import Array
from .landmarks import Directions


@dataclass(frozen=True)
class StandardLoad:
    """A force along a straight line.

    Attributes
    ----------
    proximal, anterior, medial : the force on the socket, in body weights.
    ahead_mm, inside_mm : where the line passes the knee centre, anterior and medial of it; a line through it
        passes the limb's middle where there is no knee.
    """

    proximal: float
    anterior: float = 0.0
    medial: float = 0.0
    ahead_mm: float = 0.0
    inside_mm: float = 0.0

    def force(self, body_weight: float, directions: Directions) -> Array:
        """(3,) N, LPS, on the socket."""
        force = self.proximal * directions.proximal + self.anterior * directions.anterior
        if self.medial:
            force = force + self.medial * directions.medial
        return np.asarray(body_weight * force)

    def moment(self, body_weight: float, directions: Directions) -> Array:
        """(3,) N mm, LPS, on the socket about the knee centre."""
        arm = self.ahead_mm * directions.anterior
        if self.inside_mm:
            arm = arm + self.inside_mm * directions.medial
        return np.cross(arm, self.force(body_weight, directions))


STANDARD_LOADS: Mapping[str, StandardLoad] = {
    "double stance": StandardLoad(0.5),
    "single stance": StandardLoad(1.0),
    "heel strike": StandardLoad(1.1, 0.2, 0.2, 50.0, 50.0),  # ISO 10328, condition I
    "mid-stance": StandardLoad(0.8, 0.0, 0.0, 0.0, 40.0),
    "toe-off": StandardLoad(1.1, -0.1, 0.0, 70.0, 40.0),  # ISO 10328, condition II
}
