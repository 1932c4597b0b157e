"""A synthetic residuum, transtibial or transfemoral, as smooth implicit functions, and in patient space.

It is the truth that everything else is held to. Its surfaces as closed triangles come straight from the
implicit fields and not from the image.

Limb frame (mm): origin at the distal tip, z proximal, -y anterior, +x medial (a right limb). A *field* is
negative inside, zero on the surface, and close to the distance in millimetres near it; divide it by the
length of its gradient where a sharper distance is needed. Angles around the limb count from anterior (0)
through medial (+pi/2) to posterior (pi).
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields, replace
from functools import cached_property, partial
from typing import ClassVar, Self

import numpy as np
import pyvista as pv
from numpy.typing import NDArray

from ..anatomy.meshing.layers import LayerSpec
from ..anatomy.surfaces.surfaces import Anatomy, Surface
from ..anatomy.surfaces.triangles import find_bodies, find_open_edges, from_pyvista
from ..arrays import Array
from ..errors import InputError

Floats = NDArray[np.floating]  # images are made in single precision
Field = Callable[[Floats], Floats]
Corner = tuple[float, float, float]  # of a box of the limb frame, mm

PROXIMAL_CUT_MM = 250.0
STICK_OUT_MM = 6.0  # of the femur beyond the cut, so that the void it leaves is open there
TENDON = "tendon"  # the region's name
TENDON_MM = 24.0, 6.0  # width and thickness of the patellar tendon
# Tissue over the muscle, outermost first: as in the paper, or with fat of its own.
SKIN_LAYER = (LayerSpec("skin", 3.0),)
SKIN_AND_FAT = (LayerSpec("skin", 2.0), LayerSpec("fat", 4.0))


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

    def blend(shaft: Floats, target: tuple[float, float]) -> Floats:
        return shaft[..., :2] + plateau[..., None] * (np.array(target, shaft.dtype) - shaft[..., :2])

    crest = compute_surface_point(
        shape, np.full_like(z, shape.crest_angle), section_z, shape.crest_depth + depth
    )
    medial = compute_surface_point(shape, np.full_like(z, 0.92), section_z, shape.medial_depth + depth)
    lateral = 0.38 * compute_surface_point(shape, np.full_like(z, -0.25), np.maximum(section_z, shape.dome))
    corners = (blend(crest, (0.0, -20.0)), blend(medial, (23.0, 4.0)), blend(lateral, (-21.0, 2.0)))
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


LIMBS: dict[str, LimbShape] = {"transtibial": Shank(), "transfemoral": Thigh()}


def build_rotation(axis: Floats, angle: float) -> Array:
    """Rotation matrix (3, 3) about ``axis`` by ``angle`` radians (Rodrigues)."""
    x, y, z = np.asarray(axis, float) / np.linalg.norm(axis)
    K = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + np.sin(angle) * K + (1 - np.cos(angle)) * K @ K


@dataclass(frozen=True)
class Limb:
    """A residuum in patient space (LPS mm): ``x_lps = rotation @ x_limb + origin``."""

    shape: LimbShape
    rotation: Array
    origin: Array
    layers: tuple[LayerSpec, ...] = SKIN_LAYER
    has_tendon: bool = False

    @property
    def kind(self) -> str:
        """Its name in ``LIMBS``."""
        return next(name for name, shape in LIMBS.items() if type(shape) is type(self.shape))

    @property
    def bone_names(self) -> tuple[str, ...]:
        return tuple(self.shape.cortex_mm)

    @property
    def layers_mm(self) -> float:
        """Depth of the muscle under the skin's surface."""
        return sum(layer.thickness_mm or 0.0 for layer in self.layers)

    def to_limb(self, points: Floats) -> Floats:
        """Points (..., 3) from LPS to the limb frame."""
        return (points - self.origin.astype(points.dtype)) @ self.rotation.astype(points.dtype)

    def to_patient(self, points: Floats) -> Array:
        """Points (..., 3) from the limb frame to LPS."""
        return np.asarray(points, np.float64) @ self.rotation.T + self.origin

    def skin(self, points: Floats) -> Floats:
        """Skin field at LPS points (..., 3), unbounded proximally."""
        return compute_skin_field(self.shape, self.to_limb(points))

    def bone(self, name: str, points: Floats) -> Floats:
        """Field of one of its bones at LPS points (..., 3); the femur is unbounded proximally."""
        return self.shape.bone_field(name, self.to_limb(points))

    def bones(self, points: Floats) -> Floats:
        """Field of all bones together at LPS points (..., 3)."""
        local = self.to_limb(points)
        return np.minimum.reduce([self.shape.bone_field(name, local) for name in self.bone_names])

    def tendon(self, points: Floats) -> Floats:
        """Field of the patellar tendon between the bones at LPS points (..., 3)."""
        assert isinstance(self.shape, Shank)
        return np.maximum(compute_tendon_field(self.shape, self.to_limb(points)), -self.bones(points))

    def skin_point(self, angle: float, height: float) -> Array:
        """The LPS point of the skin at an angle around the limb and a height above its tip."""
        return self.to_patient(compute_surface_point(self.shape, np.asarray(angle), np.asarray(height)))

    def inward(self, points: Floats) -> Array:
        """Unit inward skin normals (n, 3) at LPS points (n, 3)."""
        gradient = compute_gradient(self.skin, points)
        return -gradient / np.linalg.norm(gradient, axis=-1, keepdims=True)

    def tissue_thickness(self, point: Floats, axis: Floats, limit: float = 40.0) -> float:
        """Soft tissue between a skin point and the first bone along ``axis``; ``limit`` where none is met."""
        along = np.arange(0.0, limit, 0.1)
        inside = self.bones(point + along[:, None] * axis) < 0
        return float(along[inside.argmax()]) if inside.any() else limit

    def move(self, rotation: Floats, translation: Floats) -> Self:
        """The limb after a rigid motion about its own middle (LPS)."""
        middle = self.to_patient(np.array([0.0, 0.0, PROXIMAL_CUT_MM / 2]))
        origin = rotation @ (self.origin - middle) + middle + translation
        return replace(self, rotation=rotation @ self.rotation, origin=origin)

    @cached_property
    def proximal_normal(self) -> Array:
        """Proximal direction in LPS."""
        return self.rotation @ np.array([0.0, 0.0, 1.0])


def make_limb(
    seed: int, layers: tuple[LayerSpec, ...] = SKIN_LAYER, tendon: bool = False, kind: str = "transtibial"
) -> Limb:
    """The limb of a seed: its shape, lying 8 to 14 degrees off the patient axes, under some layers. Raises
    `InputError` for a limb that is none of ``LIMBS``, or a patellar tendon of one that has none.
    """
    if kind not in LIMBS:
        raise InputError(f"unknown limb {kind!r}", remedy=f"use one of {', '.join(LIMBS)}")
    if tendon and kind != "transtibial":
        raise InputError(f"a {kind} limb has no patellar tendon", remedy="leave it out")
    random = np.random.default_rng([seed, 2])
    lean = np.deg2rad(random.uniform(8, 14))
    towards = random.uniform(0, 2 * np.pi)
    lean_axis = np.array([np.cos(towards), np.sin(towards), 0.0])
    turn = build_rotation(np.array([0.0, 0.0, 1.0]), np.deg2rad(random.uniform(-8, 8)))
    origin = np.array([-95.0, 15.0, -420.0]) + random.uniform(-15, 15, 3)
    return Limb(vary(LIMBS[kind], seed), build_rotation(lean_axis, lean) @ turn, origin, layers, tendon)


def compute_gradient(field, points: Floats, step: float = 0.05) -> Array:  # type: ignore[no-untyped-def]
    """Central differences (n, 3) of a field at points (n, 3)."""
    offsets = step * np.eye(3)
    return np.stack([(field(points + d) - field(points - d)) / (2 * step) for d in offsets], axis=-1)


def build_true_anatomy(limb: Limb, spacing: float = 2.4) -> Anatomy:
    """Build skin, bones and tendon of a limb (LPS mm); the flat proximal cut closes the skin.

    The skin is contoured on a grid of a ``spacing``, mm (bones: two thirds of it, the tendon: half).
    """
    shape = limb.shape
    low, high = (-80.0, -85.0, -4.0), (80.0, 85.0, PROXIMAL_CUT_MM)
    skin = _extract_surface(limb, lambda p: compute_skin_field(shape, p), low, high, spacing)
    low, high = (-62.0, -66.0, 10.0), (62.0, 62.0, PROXIMAL_CUT_MM + STICK_OUT_MM)
    bones = {
        name: _extract_surface(limb, partial(shape.bone_field, name), low, high, spacing / 1.5)
        for name in limb.bone_names
    }
    regions = {}
    if limb.has_tendon:
        z = shape.datum - 12.0
        low, high = (-24.0, -66.0, z - 36.0), (24.0, -22.0, z + 36.0)
        tendon = _extract_surface(limb, lambda p: limb.tendon(limb.to_patient(p)), low, high, spacing / 2)
        regions[TENDON] = tendon
    cut = limb.to_patient(np.array([0.0, 0.0, PROXIMAL_CUT_MM]))
    return Anatomy(skin, bones, cut, limb.proximal_normal, regions)


def build_outer_surface(limb: Limb, thickness_mm: float, spacing: float = 2.4) -> Surface:
    """Build the closed surface (LPS mm) about ``thickness_mm`` outside the skin: that of a liner."""
    reach = thickness_mm + 4.0
    low, high = (-80.0 - reach, -85.0 - reach, -reach), (80.0 + reach, 85.0 + reach, PROXIMAL_CUT_MM)
    return _extract_surface(
        limb, lambda p: compute_skin_field(limb.shape, p) - thickness_mm, low, high, spacing
    )


def _extract_surface(limb: Limb, field: Field, low: Corner, high: Corner, spacing: float) -> Surface:
    """As `extract_contour`, in patient space (LPS mm)."""
    surface = extract_contour(field, low, high, spacing)
    return Surface(limb.to_patient(surface.points), surface.faces)


def extract_contour(field: Field, low: Corner, high: Corner, spacing: float) -> Surface:
    """Extract the closed zero surface of a field (limb frame), capped flat where it leaves a box's top.

    The field is sampled in the box every ``spacing`` mm.
    """
    size = [round((h - l) / spacing) + 1 for l, h in zip(low, high, strict=True)]
    axes = [np.linspace(l, h, n) for l, h, n in zip(low, high, size, strict=True)]
    z, y, x = np.meshgrid(*axes[::-1], indexing="ij")
    values = field(np.stack([x, y, z], axis=-1))
    image = pv.ImageData(dimensions=size, spacing=[a[1] - a[0] for a in axes], origin=low)
    image.point_data["field"] = values.ravel()
    poly = image.contour([0.0], scalars="field", method="flying_edges", compute_normals=False).clean()
    surface = find_bodies(from_pyvista(poly))[0]
    surface = _cap_rim(_project_to_surface(field, surface, high[2]), high[2])
    return surface if surface.volume > 0 else surface.flipped_surface


def _project_to_surface(field: Field, surface: Surface, top: float) -> Surface:
    """Move points onto the zero of the field by Newton steps; those of the rim stay in the top plane."""
    points = surface.points.copy()
    rim = np.abs(points[:, 2] - top) < 1e-3
    points[rim, 2] = top
    for _ in range(3):
        gradient = compute_gradient(field, points, step=0.02)
        gradient[rim, 2] = 0.0
        points -= (field(points) / (gradient * gradient).sum(axis=1))[:, None] * gradient
    return Surface(points, surface.faces)


def _cap_rim(surface: Surface, top: float) -> Surface:
    """Close a surface with a fan around the middle of its open rim, in the plane z = ``top``."""
    n, rim = len(surface.points), find_open_edges(surface.faces)
    if not len(rim):
        return surface
    middle = np.append(surface.points[np.unique(rim), :2].mean(axis=0), top)
    fan = np.column_stack([rim[:, 1], rim[:, 0], np.full(len(rim), n)])
    return Surface(np.vstack([surface.points, middle]), np.vstack([surface.faces, fan]))
