"""A synthetic transtibial residuum as smooth implicit functions: the truth that everything else is held to.

Limb frame (mm): origin at the distal tip, z proximal, -y anterior, +x medial (a right limb). A *field* is
negative inside, zero on the surface, and close to the distance in millimetres near it; divide it by the
length of its gradient where a sharper distance is needed. Angles around the limb count from anterior (0)
through medial (+pi/2) to posterior (pi).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from ..anatomy.meshing.layers import LayerSpec

Array = NDArray[np.floating]
BONES = ("tibia", "fibula", "patella", "femur")
PROXIMAL_CUT_MM = 250.0
TENDON, TENDON_MM = "tendon", (24.0, 6.0)  # the region's name; width and thickness of the patellar tendon
# Tissue over the muscle, outermost first: as in the paper, or with fat of its own.
SKIN_LAYER = (LayerSpec("skin", 3.0),)
SKIN_AND_FAT = (LayerSpec("skin", 2.0), LayerSpec("fat", 4.0))


@dataclass(frozen=True)
class LimbShape:
    """Sizes of the residuum, millimetres and radians; ``limb_shape`` draws them around the defaults."""

    radius_distal: float = 43.0
    radius_proximal: float = 61.0
    dome: float = 38.0
    flattening: float = 6.5
    calf: float = 7.0
    joint: float = 168.0
    joint_gap: float = 6.0
    pad: float = 22.5
    crest_depth: float = 4.0
    crest_angle: float = 0.12
    medial_depth: float = 8.5
    fibula_cut: float = 33.0
    fibula_radius: float = 6.5
    condyle: float = 23.0
    patella: float = 20.0


# How far a seed may move each size from its default.
_VARIATION = {
    "radius_distal": 2.0,
    "radius_proximal": 2.0,
    "dome": 3.0,
    "flattening": 0.8,
    "calf": 1.5,
    "joint": 5.0,
    "joint_gap": 0.4,
    "pad": 2.0,
    "crest_depth": 0.5,
    "crest_angle": 0.05,
    "medial_depth": 0.7,
    "fibula_cut": 2.0,
    "fibula_radius": 0.4,
    "condyle": 1.0,
    "patella": 1.0,
}


def limb_shape(seed: int) -> LimbShape:
    """The shape of a seed; each size is uniform around its default."""
    random = np.random.default_rng([seed, 1])
    base = LimbShape()
    drawn = {name: getattr(base, name) + span * random.uniform(-1, 1) for name, span in _VARIATION.items()}
    return LimbShape(**drawn)


def rotation_about(axis: Array, angle: float) -> NDArray[np.float64]:
    """Rotation matrix (3, 3) about ``axis`` by ``angle`` radians (Rodrigues)."""
    x, y, z = np.asarray(axis, float) / np.linalg.norm(axis)
    K = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + np.sin(angle) * K + (1 - np.cos(angle)) * K @ K


@dataclass(frozen=True)
class Limb:
    """A residuum in patient space (LPS mm): ``x_lps = rotation @ x_limb + origin``."""

    shape: LimbShape
    rotation: NDArray[np.float64]
    origin: NDArray[np.float64]
    layers: tuple[LayerSpec, ...] = SKIN_LAYER
    has_tendon: bool = False

    @property
    def layers_mm(self) -> float:
        """Depth of the muscle under the skin's surface."""
        return sum(layer.thickness_mm or 0.0 for layer in self.layers)

    def to_limb(self, points: Array) -> Array:
        """Points (..., 3) from LPS to the limb frame."""
        return (points - self.origin.astype(points.dtype)) @ self.rotation.astype(points.dtype)

    def to_patient(self, points: Array) -> NDArray[np.float64]:
        """Points (..., 3) from the limb frame to LPS."""
        return np.asarray(points, np.float64) @ self.rotation.T + self.origin

    def skin(self, points: Array) -> Array:
        """Skin field at LPS points (..., 3), unbounded proximally."""
        return skin_field(self.shape, self.to_limb(points))

    def bone(self, name: str, points: Array) -> Array:
        """Field of one of ``BONES`` at LPS points (..., 3); the femur is unbounded proximally."""
        return bone_field(self.shape, name, self.to_limb(points))

    def bones(self, points: Array) -> Array:
        """Field of all bones together at LPS points (..., 3)."""
        local = self.to_limb(points)
        return np.minimum.reduce([bone_field(self.shape, name, local) for name in BONES])

    def tendon(self, points: Array) -> Array:
        """Field of the patellar tendon between the bones at LPS points (..., 3)."""
        return np.maximum(tendon_field(self.shape, self.to_limb(points)), -self.bones(points))

    def skin_point(self, angle: float, height: float) -> NDArray[np.float64]:
        """The LPS point of the skin at an angle around the limb and a height above its tip."""
        return self.to_patient(surface_point(self.shape, np.asarray(angle), np.asarray(height)))

    def inward(self, points: Array) -> NDArray[np.float64]:
        """Unit inward skin normals (n, 3) at LPS points (n, 3)."""
        gradient = gradient_of(self.skin, points)
        return -gradient / np.linalg.norm(gradient, axis=-1, keepdims=True)

    def tissue_thickness(self, point: Array, axis: Array, limit: float = 40.0) -> float:
        """Soft tissue between a skin point and the first bone along ``axis``; ``limit`` where none is met."""
        along = np.arange(0.0, limit, 0.1)
        inside = self.bones(point + along[:, None] * axis) < 0
        return float(along[inside.argmax()]) if inside.any() else limit

    def moved(self, rotation: Array, translation: Array) -> Limb:
        """The limb after a rigid motion about its own middle (LPS)."""
        middle = self.to_patient(np.array([0.0, 0.0, PROXIMAL_CUT_MM / 2]))
        origin = rotation @ (self.origin - middle) + middle + translation
        return replace(self, rotation=rotation @ self.rotation, origin=origin)

    @cached_property
    def proximal_normal(self) -> NDArray[np.float64]:
        """Proximal direction in LPS."""
        return self.rotation @ np.array([0.0, 0.0, 1.0])


def make_limb(seed: int, layers: tuple[LayerSpec, ...] = SKIN_LAYER, tendon: bool = False) -> Limb:
    """The limb of a seed: its shape, lying 8 to 14 degrees off the patient axes, under some layers."""
    random = np.random.default_rng([seed, 2])
    lean = np.deg2rad(random.uniform(8, 14))
    towards = random.uniform(0, 2 * np.pi)
    lean_axis = np.array([np.cos(towards), np.sin(towards), 0.0])
    turn = rotation_about(np.array([0.0, 0.0, 1.0]), np.deg2rad(random.uniform(-8, 8)))
    origin = np.array([-95.0, 15.0, -420.0]) + random.uniform(-15, 15, 3)
    return Limb(limb_shape(seed), rotation_about(lean_axis, lean) @ turn, origin, layers, tendon)


def gradient_of(field, points: Array, step: float = 0.05) -> NDArray[np.float64]:  # type: ignore[no-untyped-def]
    """Central differences (n, 3) of a field at points (n, 3)."""
    offsets = step * np.eye(3)
    return np.stack([(field(points + d) - field(points - d)) / (2 * step) for d in offsets], axis=-1)


# --- skin -----------------------------------------------------------------------------------------------


def _smoothstep(t: Array) -> Array:
    t = np.clip(t, 0, 1)
    return t * t * (3 - 2 * t)


def _bump(t: Array) -> Array:
    return np.exp(-0.5 * t * t)


def section_radius(shape: LimbShape, angle: Array, z: Array) -> Array:
    """Radius of the limb's section without the rounding of its distal end."""
    mean = shape.radius_distal + (shape.radius_proximal - shape.radius_distal) * _smoothstep(z / 185)
    posterior = ((1 - np.cos(angle)) / 2) ** 2
    calf = shape.calf * _bump((z - shape.joint + 60) / 42) * posterior
    anteromedial = ((1 + np.cos(angle - 0.45)) / 2) ** 3
    flat = -shape.flattening * _smoothstep((shape.joint - z + 10) / 50) * anteromedial
    knee = 2.5 * _bump((z - shape.joint - 30) / 22) * ((1 + np.cos(angle)) / 2) ** 4
    popliteal = -3.0 * _bump((z - shape.joint - 5) / 18) * posterior
    return mean + calf + flat + knee + popliteal


def _dome(shape: LimbShape, z: Array) -> Array:
    return np.clip((shape.dome - z) / shape.dome, 0, None)


def skin_field(shape: LimbShape, points: Array) -> Array:
    """Skin field at points (..., 3) of the limb frame: star-shaped sections on an ellipsoidal end."""
    x, y, z = points[..., 0], points[..., 1], points[..., 2]
    radius = section_radius(shape, np.arctan2(x, -y), z)
    level = np.sqrt((x * x + y * y) / radius**2 + _dome(shape, z) ** 2)
    return (level - 1) * radius


def surface_point(shape: LimbShape, angle: Array, z: Array, inset: Array | float = 0.0) -> Array:
    """Point (..., 3) at an angle and height, ``inset`` millimetres radially under the skin."""
    reach = np.sqrt(np.clip(1 - _dome(shape, z) ** 2, 0, None))
    radius = section_radius(shape, angle, z) * reach - inset
    return np.stack([radius * np.sin(angle), -radius * np.cos(angle), z + 0 * radius], axis=-1)


# --- bones ----------------------------------------------------------------------------------------------


def bone_field(shape: LimbShape, name: str, points: Array) -> Array:
    """Field of a bone at points (..., 3) of the limb frame."""
    return _BONE_FIELDS[name](shape, points)


def _between(section: Array, z: Array, low: float, high: float, rounding: float) -> Array:
    """A prism from ``low`` to ``high`` over a section's field, its edges rounded."""
    a = section + rounding
    b = np.maximum(z - high, low - z) + rounding
    outside = np.hypot(np.maximum(a, 0), np.maximum(b, 0))
    return np.minimum(np.maximum(a, b), 0) + outside - rounding


def _triangle(x: Array, y: Array, corners: tuple[Array, Array, Array]) -> Array:
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


def _tibia(shape: LimbShape, points: Array) -> Array:
    """A rounded triangle: crest under the skin, medial face along it, widening to the plateau."""
    x, y, z = points[..., 0], points[..., 1], points[..., 2]
    plateau = _smoothstep((z - shape.joint + 48) / 38)
    rounding = 3.5 + 9.5 * plateau
    bevel = 9.0 * _smoothstep((65 - z) / 45)
    tuberosity = 3.0 * _smoothstep((z - shape.joint + 65) / 30)
    section_z = np.minimum(z, shape.joint)
    depth = 3.5 + bevel + tuberosity

    def blended(shaft: Array, target: tuple[float, float]) -> Array:
        return shaft[..., :2] + plateau[..., None] * (np.array(target, shaft.dtype) - shaft[..., :2])

    crest = surface_point(shape, np.full_like(z, shape.crest_angle), section_z, shape.crest_depth + depth)
    medial = surface_point(shape, np.full_like(z, 0.92), section_z, shape.medial_depth + depth)
    lateral = 0.38 * surface_point(shape, np.full_like(z, -0.25), np.maximum(section_z, shape.dome))
    corners = (
        blended(crest, (0.0, -20.0)),
        blended(medial, (23.0, 4.0)),
        blended(lateral, (-21.0, 2.0)),
    )
    section = _triangle(x, y, corners) - rounding
    return _between(section, z, shape.pad, shape.joint - shape.joint_gap / 2, 4.0)


def _fibula(shape: LimbShape, points: Array) -> Array:
    """A thin rod on the lateral side, posterior of the tibia, with a head below the knee."""
    x, y, z = points[..., 0], points[..., 1], points[..., 2]
    top = shape.joint - 13
    head = _smoothstep((z - top + 32) / 24)
    radius = shape.fibula_radius + 2.5 * head
    inset = radius + 12.0 - 5.5 * head
    section_z = np.clip(z, shape.dome, shape.joint)
    centre = surface_point(shape, -1.85 - 0.2 * head, section_z, inset)
    section = np.hypot(x - centre[..., 0], y - centre[..., 1]) - radius
    return _between(section, z, shape.fibula_cut, top, 5.0)


def _ellipsoid(points: Array, centre: tuple[float, float, float], axes: tuple[float, float, float]) -> Array:
    """First-order distance to an ellipsoid."""
    scaled = (points - np.array(centre, points.dtype)) / np.array(axes, points.dtype)
    k0 = np.linalg.norm(scaled, axis=-1)
    k1 = np.linalg.norm(scaled / np.array(axes, points.dtype), axis=-1)
    return k0 * (k0 - 1) / np.maximum(k1, 1e-6)


def _joined(a: Array, b: Array, blend: float) -> Array:
    """Smooth union of two fields."""
    h = np.clip(blend - np.abs(a - b), 0, None) / blend
    return np.minimum(a, b) - h * h * blend / 4


def _femur(shape: LimbShape, points: Array) -> Array:
    """Two condyles on a shaft that leaves the image."""
    x, y, z = points[..., 0], points[..., 1], points[..., 2]
    low = shape.joint + shape.joint_gap / 2
    axes = (19.0, 28.0, shape.condyle)
    medial = _ellipsoid(points, (21.0, 5.0, low + shape.condyle), axes)
    lateral = _ellipsoid(points, (-21.0, 5.0, low + shape.condyle), axes)
    flare = 15.0 + 10.0 * _bump((z - low - 25) / 22)
    shaft = _between(np.hypot(x, y - 1.0) - flare, z, low + 9, 1e3, 8.0)
    return _joined(_joined(medial, lateral, 8.0), shaft, 12.0)


def _patella(shape: LimbShape, points: Array) -> Array:
    height = shape.joint + 33
    anterior = float(section_radius(shape, np.asarray(0.0), np.asarray(height)))
    axes = (shape.patella, 9.5, shape.patella + 1)
    return _ellipsoid(points, (0.0, -(anterior - 7.0 - axes[1]), height), axes)


def tendon_field(shape: LimbShape, points: Array) -> Array:
    """A flat band from within the patella's lower half to within the tibial tuberosity, under the skin."""
    x, y, z = points[..., 0], points[..., 1], points[..., 2]
    above = z - shape.joint
    depth = 9.5 + 5.5 * _smoothstep((above - 2) / 16) + 4.5 * _smoothstep((-14 - above) / 24)
    across = y + section_radius(shape, 0 * z, z) - depth
    a, b = np.abs(x) - TENDON_MM[0] / 2 + 2.5, np.abs(across) - TENDON_MM[1] / 2 + 2.5
    section = np.minimum(np.maximum(a, b), 0) + np.hypot(np.maximum(a, 0), np.maximum(b, 0)) - 2.5
    return _between(section, z, shape.joint - 40, shape.joint + 17, 2.0)


_BONE_FIELDS = {"tibia": _tibia, "fibula": _fibula, "patella": _patella, "femur": _femur}
