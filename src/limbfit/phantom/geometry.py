"""A synthetic residuum in patient space: the truth that everything else is held to.

Its surfaces as closed triangles come straight from the implicit fields and not from the image.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property, partial

import numpy as np
import pyvista as pv

from ..anatomy.meshing.layers import LayerSpec
from ..anatomy.surfaces.surfaces import Anatomy, Surface
from ..anatomy.surfaces.triangles import find_bodies, find_open_edges, from_pyvista
from ..arrays import Array
from ..errors import InputError
from .limb_shapes import (
    PROXIMAL_CUT_MM,
    Floats,
    LimbShape,
    Shank,
    Thigh,
    compute_skin_field,
    compute_surface_point,
    compute_tendon_field,
    vary,
)

TENDON = "tendon"  # the region's name
LIMBS: dict[str, LimbShape] = {"transtibial": Shank(), "transfemoral": Thigh()}
# Tissue over the muscle, outermost first: as in the paper, or with fat of its own.
SKIN_LAYER = (LayerSpec("skin", 3.0),)
SKIN_AND_FAT = (LayerSpec("skin", 2.0), LayerSpec("fat", 4.0))
Field = Callable[[Floats], Floats]
Corner = tuple[float, float, float]  # of a box of the limb frame, mm

STICK_OUT_MM = 6.0  # of the femur beyond the cut, so that the void it leaves is open there


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

    def move(self, rotation: Floats, translation: Floats) -> Limb:
        """The limb after a rigid motion about its own middle (LPS)."""
        middle = self.to_patient(np.array([0.0, 0.0, PROXIMAL_CUT_MM / 2]))
        origin = rotation @ (self.origin - middle) + middle + translation
        return replace(self, rotation=rotation @ self.rotation, origin=origin)

    @cached_property
    def proximal_normal(self) -> Array:
        """Proximal direction in LPS."""
        return self.rotation @ np.array([0.0, 0.0, 1.0])


def make_limb(
    seed: int,
    layers: tuple[LayerSpec, ...] = SKIN_LAYER,
    tendon: bool = False,
    kind: str = "transtibial",
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
    skin = extract_contour(lambda p: compute_skin_field(shape, p), low, high, spacing)
    low, high = (-62.0, -66.0, 10.0), (62.0, 62.0, PROXIMAL_CUT_MM + STICK_OUT_MM)
    bones = {
        name: extract_contour(partial(shape.bone_field, name), low, high, spacing / 1.5)
        for name in limb.bone_names
    }
    regions = {}
    if limb.has_tendon:
        z = shape.datum - 12.0
        low, high = (-24.0, -66.0, z - 36.0), (24.0, -22.0, z + 36.0)
        tendon = extract_contour(lambda p: limb.tendon(limb.to_patient(p)), low, high, spacing / 2)
        regions[TENDON] = _to_patient_space(limb, tendon)
    return Anatomy(
        skin=_to_patient_space(limb, skin),
        bones={name: _to_patient_space(limb, bone) for name, bone in bones.items()},
        cut_point=limb.to_patient(np.array([0.0, 0.0, PROXIMAL_CUT_MM])),
        cut_normal=limb.proximal_normal,
        regions=regions,
    )


def build_outer_surface(limb: Limb, thickness_mm: float, spacing: float = 2.4) -> Surface:
    """Build the closed surface (LPS mm) about ``thickness_mm`` outside the skin: that of a liner."""
    reach = thickness_mm + 4.0
    low, high = (-80.0 - reach, -85.0 - reach, -reach), (80.0 + reach, 85.0 + reach, PROXIMAL_CUT_MM)

    def field(points: Floats) -> Floats:
        return compute_skin_field(limb.shape, points) - thickness_mm

    return _to_patient_space(limb, extract_contour(field, low, high, spacing))


def _to_patient_space(limb: Limb, surface: Surface) -> Surface:
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
    return surface if surface.volume > 0 else surface.flipped


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
