"""A synthetic transfemoral residuum: its skin, and the shaft of its femur."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from .fields import PROXIMAL_CUT_MM, Array, LimbShape, bump, compute_smoothstep, extrude_section


@dataclass(frozen=True)
class Thigh(LimbShape):
    """Sizes of a transfemoral residuum, mm and radians."""

    cortex_mm: ClassVar[Mapping[str, float]] = {"femur": 5.0}
    variation: ClassVar[Mapping[str, float]] = {
        "radius_distal": 2.0,
        "radius_proximal": 2.0,
        "dome": 3.0,
        "quadriceps": 1.0,
        "adductors": 1.0,
        "flattening": 0.8,
        "femur_cut": 3.0,
        "femur_radius": 0.6,
        "lateral": 1.5,
        "anterior": 1.5,
        "bow": 1.0,
    }

    radius_distal: float = 50.0
    radius_proximal: float = 65.0
    dome: float = 42.0
    quadriceps: float = 4.0
    adductors: float = 5.0
    flattening: float = 4.0
    femur_cut: float = 40.0
    femur_radius: float = 13.5
    lateral: float = 10.0
    anterior: float = 5.0
    bow: float = 4.0

    @property
    def datum(self) -> float:
        """The proximal cut, below the hip."""
        return PROXIMAL_CUT_MM

    def section_radius(self, angle: Array, z: Array) -> Array:
        mean = self.radius_distal + (self.radius_proximal - self.radius_distal) * compute_smoothstep(z / 220)
        front = self.quadriceps * bump((z - 150) / 60) * ((1 + np.cos(angle)) / 2) ** 2
        inner = self.adductors * compute_smoothstep((z - 100) / 130) * ((1 + np.sin(angle)) / 2) ** 2
        outer = -self.flattening * compute_smoothstep((z - 60) / 80) * ((1 - np.sin(angle)) / 2) ** 3
        return mean + front + inner + outer

    def bone_field(self, name: str, points: Array) -> Array:
        """Field of the femur's bowed shaft at points (..., 3) of the limb frame, unbounded proximally."""
        x, y, z = points[..., 0], points[..., 1], points[..., 2]
        aside = self.lateral * compute_smoothstep((z + 60) / 250)
        ahead = self.anterior + self.bow * bump((z - 130) / 70)
        radius = self.femur_radius + 2.0 * compute_smoothstep((z - 190) / 60)
        return extrude_section(np.hypot(x + aside, y + ahead) - radius, z, self.femur_cut, 1e3, 4.0)
