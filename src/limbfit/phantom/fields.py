"""Smooth implicit functions of which synthetic limbs are made.

Limb frame (mm): origin at the distal tip, z proximal, -y anterior, +x medial (a right limb). A *field* is
negative inside, zero on the surface, and close to the distance in millimetres near it; divide it by the
length of its gradient where a sharper distance is needed. Angles around the limb count from anterior (0)
through medial (+pi/2) to posterior (pi).
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.floating]
PROXIMAL_CUT_MM = 250.0


@dataclass(frozen=True)
class LimbShape(ABC):
    """The sizes of a kind of limb, mm and radians.

    Attributes
    ----------
    dome : height of the rounding of the distal end.
    cortex_mm : thickness of the cortex of each bone.
    variation : how far a seed may move each size from its default.
    """

    cortex_mm: ClassVar[Mapping[str, float]]
    variation: ClassVar[Mapping[str, float]]

    radius_distal: float
    radius_proximal: float
    dome: float

    @property
    @abstractmethod
    def datum(self) -> float:
        """Height from which places on the limb are counted downwards."""

    @abstractmethod
    def section_radius(self, angle: Array, z: Array) -> Array:
        """Radius of the limb's section without the rounding of its distal end."""

    @abstractmethod
    def bone_field(self, name: str, points: Array) -> Array:
        """Field of a bone at points (..., 3) of the limb frame; a bone at the cut is unbounded proximally."""


def vary(base: LimbShape, seed: int) -> LimbShape:
    """The shape of a seed; each size is uniform around its default."""
    random = np.random.default_rng([seed, 1])
    drawn = {
        name: getattr(base, name) + span * random.uniform(-1, 1) for name, span in base.variation.items()
    }
    return replace(base, **drawn)


def compute_smoothstep(t: Array) -> Array:
    """0 below 0, 1 above 1, with level ends."""
    t = np.clip(t, 0, 1)
    return t * t * (3 - 2 * t)


def bump(t: Array) -> Array:
    """A bell of height 1 and standard deviation 1."""
    return np.exp(-0.5 * t * t)


def _compute_dome(shape: LimbShape, z: Array) -> Array:
    return np.clip((shape.dome - z) / shape.dome, 0, None)


def compute_skin_field(shape: LimbShape, points: Array) -> Array:
    """Skin field at points (..., 3) of the limb frame: star-shaped sections on an ellipsoidal end."""
    x, y, z = points[..., 0], points[..., 1], points[..., 2]
    radius = shape.section_radius(np.arctan2(x, -y), z)
    level = np.sqrt((x * x + y * y) / radius**2 + _compute_dome(shape, z) ** 2)
    return (level - 1) * radius


def compute_surface_point(shape: LimbShape, angle: Array, z: Array, inset: Array | float = 0.0) -> Array:
    """Point (..., 3) at an angle and height, ``inset`` millimetres radially under the skin."""
    reach = np.sqrt(np.clip(1 - _compute_dome(shape, z) ** 2, 0, None))
    radius = shape.section_radius(angle, z) * reach - inset
    return np.stack([radius * np.sin(angle), -radius * np.cos(angle), z + 0 * radius], axis=-1)


def extrude_section(section: Array, z: Array, low: float, high: float, rounding: float) -> Array:
    """A prism from ``low`` to ``high`` over a section's field, its edges rounded."""
    a = section + rounding
    b = np.maximum(z - high, low - z) + rounding
    outside = np.hypot(np.maximum(a, 0), np.maximum(b, 0))
    return np.minimum(np.maximum(a, b), 0) + outside - rounding


def compute_triangle_distance(x: Array, y: Array, corners: tuple[Array, Array, Array]) -> Array:
    """Exact signed distance to a triangle whose corners (..., 2) may vary from point to point."""
    squared, sides = [], []
    for start, end in zip(corners, (*corners[1:], corners[0]), strict=True):
        ex, ey = end[..., 0] - start[..., 0], end[..., 1] - start[..., 1]
        px, py = x - start[..., 0], y - start[..., 1]
        along = np.clip((px * ex + py * ey) / (ex * ex + ey * ey), 0, 1)
        squared.append((px - along * ex) ** 2 + (py - along * ey) ** 2)
        sides.append(ex * py - ey * px)
    inside = (np.minimum.reduce(sides) > 0) | (np.maximum.reduce(sides) < 0)
    distance = np.sqrt(np.minimum.reduce(squared))
    return np.where(inside, -distance, distance)


def compute_ellipsoid_distance(
    points: Array, centre: tuple[float, float, float], axes: tuple[float, float, float]
) -> Array:
    """First-order distance to an ellipsoid."""
    scaled = (points - np.array(centre, points.dtype)) / np.array(axes, points.dtype)
    k0 = np.linalg.norm(scaled, axis=-1)
    k1 = np.linalg.norm(scaled / np.array(axes, points.dtype), axis=-1)
    return k0 * (k0 - 1) / np.maximum(k1, 1e-6)


def join_fields(a: Array, b: Array, blend: float) -> Array:
    """Smooth union of two fields."""
    h = np.clip(blend - np.abs(a - b), 0, None) / blend
    return np.minimum(a, b) - h * h * blend / 4
