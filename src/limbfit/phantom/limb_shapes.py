"""Synthetic limbs as smooth implicit functions: a transtibial and a transfemoral residuum.

Limb frame (mm): origin at the distal tip, z proximal, -y anterior, +x medial (a right limb). A *field* is
negative inside, zero on the surface, and close to the distance in millimetres near it; divide it by the
length of its gradient where a sharper distance is needed. Angles around the limb count from anterior (0)
through medial (+pi/2) to posterior (pi).
"""

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.floating]  # images are made in single precision
PROXIMAL_CUT_MM = 250.0
TENDON_MM = 24.0, 6.0  # width and thickness of the patellar tendon


@dataclass(frozen=True)
class LimbShape(ABC):
    """The sizes of a kind of limb, mm and radians.

    ``dome`` is the height of the rounding of the distal end, ``cortex_mm`` the thickness of each bone's
    cortex.
    """

    cortex_mm: ClassVar[Mapping[str, float]]

    radius_distal: float
    radius_proximal: float
    dome: float

    @property
    @abstractmethod
    def datum(self) -> float:
        """Height from which places on the limb are counted downwards."""

    @abstractmethod
    def section_radius(self, angle: Floats, z: Floats) -> Floats:
        """Radius of the limb's section without the rounding of its distal end."""

    @abstractmethod
    def bone_field(self, name: str, points: Floats) -> Floats:
        """Field of a bone at points (..., 3) of the limb frame; a bone at the cut is unbounded proximally."""


def make_size(default: float, variation: float) -> float:
    """Make a size of a shape, which a seed may move by ``variation`` from its default."""
    return field(default=default, metadata={"variation": variation})


def vary(base: LimbShape, seed: int) -> LimbShape:
    """Draw the shape of a seed; each size is uniform around its default."""
    random = np.random.default_rng([seed, 1])
    drawn = {
        size.name: getattr(base, size.name) + size.metadata["variation"] * random.uniform(-1, 1)
        for size in fields(base)
    }
    return replace(base, **drawn)


def compute_smoothstep(t: Floats) -> Floats:
    """0 below 0, 1 above 1, with level ends."""
    t = np.clip(t, 0, 1)
    return t * t * (3 - 2 * t)


def bump(t: Floats) -> Floats:
    """A bell of height 1 and standard deviation 1."""
    return np.exp(-0.5 * t * t)


def _compute_dome(shape: LimbShape, z: Floats) -> Floats:
    return np.clip((shape.dome - z) / shape.dome, 0, None)


def compute_skin_field(shape: LimbShape, points: Floats) -> Floats:
    """Compute the skin field at limb points (..., 3): star-shaped sections on an ellipsoidal end."""
    x, y, z = points[..., 0], points[..., 1], points[..., 2]
    radius = shape.section_radius(np.arctan2(x, -y), z)
    level = np.sqrt((x * x + y * y) / radius**2 + _compute_dome(shape, z) ** 2)
    return (level - 1) * radius


def compute_surface_point(shape: LimbShape, angle: Floats, z: Floats, inset: Floats | float = 0.0) -> Floats:
    """Point (..., 3) at an angle and height, ``inset`` millimetres radially under the skin."""
    reach = np.sqrt(np.clip(1 - _compute_dome(shape, z) ** 2, 0, None))
    radius = shape.section_radius(angle, z) * reach - inset
    return np.stack([radius * np.sin(angle), -radius * np.cos(angle), z + 0 * radius], axis=-1)


def extrude_section(section: Floats, z: Floats, low: float, high: float, rounding: float) -> Floats:
    """A prism from ``low`` to ``high`` over a section's field, its edges rounded."""
    return intersect_fields(section, np.maximum(z - high, low - z), rounding)


def compute_triangle_distance(x: Floats, y: Floats, corners: tuple[Floats, Floats, Floats]) -> Floats:
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
    points: Floats, centre: tuple[float, float, float], axes: tuple[float, float, float]
) -> Floats:
    """First-order distance to an ellipsoid."""
    scaled = (points - np.array(centre, points.dtype)) / np.array(axes, points.dtype)
    k0 = np.linalg.norm(scaled, axis=-1)
    k1 = np.linalg.norm(scaled / np.array(axes, points.dtype), axis=-1)
    return k0 * (k0 - 1) / np.maximum(k1, 1e-6)


def intersect_fields(a: Floats, b: Floats, rounding: float) -> Floats:
    """Field of what two bodies share, with rounded edges."""
    a, b = a + rounding, b + rounding
    outside = np.hypot(np.maximum(a, 0), np.maximum(b, 0))
    return np.minimum(np.maximum(a, b), 0) + outside - rounding


def join_fields(a: Floats, b: Floats, blend: float) -> Floats:
    """Join two fields smoothly."""
    h = np.clip(blend - np.abs(a - b), 0, None) / blend
    return np.minimum(a, b) - h * h * blend / 4


@dataclass(frozen=True)
class Shank(LimbShape):
    """Sizes of a transtibial residuum, mm and radians."""

    cortex_mm: ClassVar[Mapping[str, float]] = {"tibia": 3.2, "fibula": 2.4, "patella": 2.4, "femur": 2.8}

    radius_distal: float = make_size(43.0, 2.0)
    radius_proximal: float = make_size(61.0, 2.0)
    dome: float = make_size(38.0, 3.0)
    flattening: float = make_size(6.5, 0.8)
    calf: float = make_size(7.0, 1.5)
    joint: float = make_size(168.0, 5.0)
    joint_gap: float = make_size(6.0, 0.4)
    pad: float = make_size(22.5, 2.0)
    crest_depth: float = make_size(4.0, 0.5)
    crest_angle: float = make_size(0.12, 0.05)
    medial_depth: float = make_size(8.5, 0.7)
    fibula_cut: float = make_size(33.0, 2.0)
    fibula_radius: float = make_size(6.5, 0.4)
    condyle: float = make_size(23.0, 1.0)
    patella: float = make_size(20.0, 1.0)

    @property
    def datum(self) -> float:
        """The knee joint."""
        return self.joint

    def section_radius(self, angle: Floats, z: Floats) -> Floats:
        mean = self.radius_distal + (self.radius_proximal - self.radius_distal) * compute_smoothstep(z / 185)
        posterior = ((1 - np.cos(angle)) / 2) ** 2
        calf = self.calf * bump((z - self.joint + 60) / 42) * posterior
        anteromedial = ((1 + np.cos(angle - 0.45)) / 2) ** 3
        flat = -self.flattening * compute_smoothstep((self.joint - z + 10) / 50) * anteromedial
        knee = 2.5 * bump((z - self.joint - 30) / 22) * ((1 + np.cos(angle)) / 2) ** 4
        popliteal = -3.0 * bump((z - self.joint - 5) / 18) * posterior
        return mean + calf + flat + knee + popliteal

    def bone_field(self, name: str, points: Floats) -> Floats:
        return _BONE_FIELDS[name](self, points)


def _compute_tibia(shape: Shank, points: Floats) -> Floats:
    """A rounded triangle: crest under the skin, medial face along it, widening to the plateau."""
    x, y, z = points[..., 0], points[..., 1], points[..., 2]
    plateau = compute_smoothstep((z - shape.joint + 48) / 38)
    rounding = 3.5 + 9.5 * plateau
    bevel = 9.0 * compute_smoothstep((65 - z) / 45)
    tuberosity = 3.0 * compute_smoothstep((z - shape.joint + 65) / 30)
    section_z = np.minimum(z, shape.joint)
    depth = 3.5 + bevel + tuberosity

    def blended(shaft: Floats, target: tuple[float, float]) -> Floats:
        return shaft[..., :2] + plateau[..., None] * (np.array(target, shaft.dtype) - shaft[..., :2])

    crest = compute_surface_point(
        shape, np.full_like(z, shape.crest_angle), section_z, shape.crest_depth + depth
    )
    medial = compute_surface_point(shape, np.full_like(z, 0.92), section_z, shape.medial_depth + depth)
    lateral = 0.38 * compute_surface_point(shape, np.full_like(z, -0.25), np.maximum(section_z, shape.dome))
    corners = (
        blended(crest, (0.0, -20.0)),
        blended(medial, (23.0, 4.0)),
        blended(lateral, (-21.0, 2.0)),
    )
    section = compute_triangle_distance(x, y, corners) - rounding
    return extrude_section(section, z, shape.pad, shape.joint - shape.joint_gap / 2, 4.0)


def _compute_fibula(shape: Shank, points: Floats) -> Floats:
    """A thin rod on the lateral side, posterior of the tibia, with a head below the knee."""
    x, y, z = points[..., 0], points[..., 1], points[..., 2]
    top = shape.joint - 13
    head = compute_smoothstep((z - top + 32) / 24)
    radius = shape.fibula_radius + 2.5 * head
    inset = radius + 12.0 - 5.5 * head
    section_z = np.clip(z, shape.dome, shape.joint)
    centre = compute_surface_point(shape, -1.85 - 0.2 * head, section_z, inset)
    section = np.hypot(x - centre[..., 0], y - centre[..., 1]) - radius
    return extrude_section(section, z, shape.fibula_cut, top, 5.0)


def _compute_femur(shape: Shank, points: Floats) -> Floats:
    """Two condyles on a shaft that leaves the image."""
    x, y, z = points[..., 0], points[..., 1], points[..., 2]
    low = shape.joint + shape.joint_gap / 2
    axes = (19.0, 28.0, shape.condyle)
    medial = compute_ellipsoid_distance(points, (21.0, 5.0, low + shape.condyle), axes)
    lateral = compute_ellipsoid_distance(points, (-21.0, 5.0, low + shape.condyle), axes)
    flare = 15.0 + 10.0 * bump((z - low - 25) / 22)
    shaft = extrude_section(np.hypot(x, y - 1.0) - flare, z, low + 9, 1e3, 8.0)
    return join_fields(join_fields(medial, lateral, 8.0), shaft, 12.0)


def _compute_patella(shape: Shank, points: Floats) -> Floats:
    height = shape.joint + 33
    anterior = float(shape.section_radius(np.asarray(0.0), np.asarray(height)))
    axes = (shape.patella, 9.5, shape.patella + 1)
    return compute_ellipsoid_distance(points, (0.0, -(anterior - 7.0 - axes[1]), height), axes)


def compute_tendon_field(shape: Shank, points: Floats) -> Floats:
    """A flat band from within the patella's lower half to within the tibial tuberosity, under the skin."""
    x, y, z = points[..., 0], points[..., 1], points[..., 2]
    above = z - shape.joint
    depth = 9.5 + 5.5 * compute_smoothstep((above - 2) / 16) + 4.5 * compute_smoothstep((-14 - above) / 24)
    across = y + shape.section_radius(0 * z, z) - depth
    section = intersect_fields(np.abs(x) - TENDON_MM[0] / 2, np.abs(across) - TENDON_MM[1] / 2, 2.5)
    return extrude_section(section, z, shape.joint - 40, shape.joint + 17, 2.0)


_BONE_FIELDS = {
    "tibia": _compute_tibia,
    "fibula": _compute_fibula,
    "patella": _compute_patella,
    "femur": _compute_femur,
}


@dataclass(frozen=True)
class Thigh(LimbShape):
    """Sizes of a transfemoral residuum, mm and radians."""

    cortex_mm: ClassVar[Mapping[str, float]] = {"femur": 5.0}

    radius_distal: float = make_size(50.0, 2.0)
    radius_proximal: float = make_size(65.0, 2.0)
    dome: float = make_size(42.0, 3.0)
    quadriceps: float = make_size(4.0, 1.0)
    adductors: float = make_size(5.0, 1.0)
    flattening: float = make_size(4.0, 0.8)
    femur_cut: float = make_size(40.0, 3.0)
    femur_radius: float = make_size(13.5, 0.6)
    lateral: float = make_size(10.0, 1.5)
    anterior: float = make_size(5.0, 1.5)
    bow: float = make_size(4.0, 1.0)

    @property
    def datum(self) -> float:
        """The proximal cut, below the hip."""
        return PROXIMAL_CUT_MM

    def section_radius(self, angle: Floats, z: Floats) -> Floats:
        mean = self.radius_distal + (self.radius_proximal - self.radius_distal) * compute_smoothstep(z / 220)
        front = self.quadriceps * bump((z - 150) / 60) * ((1 + np.cos(angle)) / 2) ** 2
        inner = self.adductors * compute_smoothstep((z - 100) / 130) * ((1 + np.sin(angle)) / 2) ** 2
        outer = -self.flattening * compute_smoothstep((z - 60) / 80) * ((1 - np.sin(angle)) / 2) ** 3
        return mean + front + inner + outer

    def bone_field(self, name: str, points: Floats) -> Floats:
        """Field of the femur's bowed shaft at points (..., 3) of the limb frame, unbounded proximally."""
        x, y, z = points[..., 0], points[..., 1], points[..., 2]
        aside = self.lateral * compute_smoothstep((z + 60) / 250)
        ahead = self.anterior + self.bow * bump((z - 130) / 70)
        radius = self.femur_radius + 2.0 * compute_smoothstep((z - 190) / 60)
        return extrude_section(np.hypot(x + aside, y + ahead) - radius, z, self.femur_cut, 1e3, 4.0)
