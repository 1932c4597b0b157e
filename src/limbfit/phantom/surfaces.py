"""The phantom's surfaces as closed triangles, straight from the implicit fields and not from the image."""

from collections.abc import Callable
from functools import partial

import numpy as np
import pyvista as pv

from ..anatomy.surfaces.surfaces import Anatomy, Surface
from ..anatomy.surfaces.triangles import find_bodies, find_open_edges, from_pyvista
from .geometry import TENDON, Limb, compute_gradient
from .limb_shapes import PROXIMAL_CUT_MM, Floats, compute_skin_field

Field = Callable[[Floats], Floats]
Corner = tuple[float, float, float]  # of a box of the limb frame, mm

STICK_OUT_MM = 6.0  # of the femur beyond the cut, so that the void it leaves is open there


def build_true_anatomy(limb: Limb, spacing: float = 2.4) -> Anatomy:
    """Build skin, bones and tendon of a limb (LPS mm); the flat proximal cut closes the skin.

    Parameters
    ----------
    limb : the residuum.
    spacing : of the grid on which the skin is contoured, mm (bones: two thirds of it, the tendon: half).
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
