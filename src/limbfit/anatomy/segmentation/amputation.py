"""Virtual amputation of a label map, or of closed surfaces by way of one: an intact leg as a residuum.

Bones end at the plane. Soft tissue covers them as a surgeon's flap does: the limb's cross-section at the
plane is carried on distally and rounded off, so that the limb ends ``pad_mm`` beyond the bones.
"""

from dataclasses import replace

import numpy as np
import pyvista as pv
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import distance_transform_edt, gaussian_filter, map_coordinates

from ...arrays import Array, Mask
from ...errors import LabelError
from ..grid import SOFT_TISSUE, Grid, LabelMap, find_proximal_end
from ..morphology import find_largest_piece
from ..surfaces.extraction import compute_signed_distance_to
from ..surfaces.surfaces import Anatomy, build_anatomy, normalise_plane
from ..surfaces.triangles import Surface

_STEP_MM = 0.5  # of the cross-section
_SMOOTH_MM = 1.0  # of its outline
_THICKEST_MM = 1.5  # of a slice; thicker ones would make steps of the rounded end
_MOST_OBLIQUE_DEG = 60.0  # of the plane's normal to the limb
_ROUNDING = 2.0  # the end is flat only further from the outline than this many pads
VOXEL_MM = 1.0  # as fine as an image of a limb; build_anatomy smooths its steps away
_MARGIN_MM = 4.0  # of empty voxels beside and below the limb


def amputate_limb(
    labels: LabelMap,
    plane_point: ArrayLike,
    plane_normal: ArrayLike,
    pad_mm: float = 15.0,
    proximal: Array | None = None,
) -> LabelMap:
    """The leg cut at a plane, with a rounded pad of soft tissue over the cut bones.

    Bones and soft tissue distal of the pad are gone. Slices thicker than 1.5 mm are divided evenly, with the
    shape of each label interpolated, so that the end is round and not a stair. Raises `LabelError` for a
    plane that misses the limb, lies along it, points distally or cuts no bone off, or an image too short for
    the pad; `SurfaceError` for a normal of no length.

    Parameters
    ----------
    labels : an intact leg.
    plane_point, plane_normal : LPS mm; the normal points proximally, to what is kept.
    pad_mm : soft tissue distal of the bones, on the limb's middle; towards the outline it thins as a
        quarter ellipse.
    proximal : (3,) LPS, where proximal is; by default as :func:`find_proximal_end` finds it.
    """
    point, normal = normalise_plane(plane_point, plane_normal)
    if pad_mm <= 0:
        raise LabelError(f"the pad of soft tissue must be thicker than {pad_mm} mm")
    _check_direction(labels, normal, proximal)
    for axis in range(3):
        parts = int(np.ceil(labels.spacing[axis] / _THICKEST_MM))
        if parts > 1:
            labels = _divide_along(labels, axis, parts)
    height = labels.compute_heights(point, normal)
    corner, axes, section, is_whole = _cut_section(labels, point, normal)
    _check_bones(labels, height)
    array = np.where(height >= 0, labels.array, 0).astype(np.uint8)
    near = np.nonzero((height < 0) & (height > -pad_mm))
    place = (labels.index_to_point(np.column_stack(near[::-1])) - corner) @ axes / _STEP_MM
    depth = map_coordinates(section, place.T, order=1, mode="constant", cval=0.0)
    share = np.clip(depth / min(float(section.max()), _ROUNDING * pad_mm), 0, 1)
    end = pad_mm * np.sqrt(1 - (1 - share) ** 2)  # a quarter ellipse, upright at the outline
    kept = -height[near] < end
    array[tuple(axis[kept] for axis in near)] = labels.soft_value
    _check_room(array, is_whole, height, pad_mm)
    return labels.with_array(array)


def _divide_along(labels: LabelMap, axis: int, parts: int) -> LabelMap:
    """Thick slices divided, the shape of each label interpolated (Raya and Udupa 1990)."""
    count = labels.size[axis]
    place = (np.arange(count * parts) + 0.5) / parts - 0.5
    spacing, start = labels.spacing.copy(), np.zeros(3)
    spacing[axis] /= parts
    start[axis] = place[0]
    present = set(np.unique(labels.array).tolist()) - {0, labels.soft_value}
    bones = {labels.value(name) for name in labels.bone_names}
    order = sorted(present, key=lambda value: (value in bones, value))  # where they overlap bone stays whole
    masks = {0: labels.limb} | {value: labels.array == value for value in order}
    inside = {
        value: _interpolate_along(compute_signed_distance_to(mask, labels), place, 2 - axis) > 0
        for value, mask in masks.items()
    }
    array = np.where(inside.pop(0), labels.soft_value, 0).astype(np.uint8)
    for value, mask in inside.items():
        array[mask] = value
    return replace(labels, array=array, spacing=spacing, origin=labels.index_to_point(start))


def _interpolate_along(field: NDArray[np.float32], place: Array, axis: int) -> NDArray[np.float32]:
    """Linear interpolation along one array axis, constant beyond the ends."""
    last = field.shape[axis] - 1
    place = np.clip(place, 0, last)
    low = np.minimum(place.astype(int), max(last - 1, 0))
    part = np.expand_dims((place - low).astype(np.float32), tuple(n for n in range(3) if n != axis))
    below, above = np.take(field, low, axis), np.take(field, np.minimum(low + 1, last), axis)
    return below + part * (above - below)


def _check_direction(labels: LabelMap, normal: Array, proximal: Array | None) -> None:
    """Refuse a normal that points distally, or that is not along the limb at all."""
    along = float(find_proximal_end(labels.limb, labels, normal=proximal).direction(labels) @ normal)
    angle = float(np.degrees(np.arccos(np.clip(along, -1, 1))))
    if angle > 180 - _MOST_OBLIQUE_DEG:
        raise LabelError(
            "the normal of the amputation plane points distally",
            remedy="reverse it: it points to the part that is kept",
        )
    if angle > _MOST_OBLIQUE_DEG:
        raise LabelError(
            f"the amputation plane does not cross the limb: its normal is {angle:.0f} degrees off the limb",
            remedy="give a normal that points proximally along the limb",
        )


def _check_bones(labels: LabelMap, height: Array) -> None:
    """Refuse a plane that has all bones on one side."""
    bones = height[np.isin(labels.array, [labels.value(name) for name in labels.bone_names])]
    if not (bones > 0).any():
        raise LabelError("no bone is left proximal of the amputation plane", remedy="move the plane distally")
    if not (bones < 0).any():
        raise LabelError(
            "the amputation plane cuts nothing off: no bone lies distal of it",
            remedy="move the plane proximally",
        )


def _cut_section(labels: LabelMap, point: Array, normal: Array) -> tuple[Array, Array, Array, bool]:
    """Where the plane cuts the limb; of several pieces the largest.

    Returns a corner (3,), LPS mm, and the axes (3, 2) of a raster of the plane; the depth below the outline
    on it, mm, 0 outside; and whether the image holds all of the section.
    """
    axes = np.linalg.svd(normal[None])[2][1:].T
    flat = (labels.index_to_point(labels.corners) - point) @ axes
    low, high = flat.min(axis=0), flat.max(axis=0)
    u, v = (np.arange(a, b + _STEP_MM, _STEP_MM) for a, b in zip(low, high))
    points = point + u[:, None, None] * axes[:, 0] + v[None, :, None] * axes[:, 1]
    index = labels.point_to_index(points)[..., ::-1]
    cover = map_coordinates(
        labels.limb.astype(np.float32), np.moveaxis(index, -1, 0), order=1, mode="constant", cval=0.0
    )
    inside = gaussian_filter(cover, _SMOOTH_MM / _STEP_MM) > 0.5
    if not inside.any():
        raise LabelError("the amputation plane misses the limb", remedy="move its point into the limb")
    inside = find_largest_piece(inside)
    image = np.all((index > -0.5) & (index < np.array(labels.array.shape) - 0.5), axis=-1)
    rim = inside & (distance_transform_edt(image) <= 1.0)
    return point + axes @ low, axes, distance_transform_edt(inside) * _STEP_MM, not rim.any()


def _check_room(array: NDArray[np.uint8], is_whole: bool, height: Array, pad: float) -> None:
    if not is_whole:
        raise LabelError(
            "the image ends within the limb's cross-section at the amputation plane",
            remedy="move the plane proximally",
        )
    border = np.ones(array.shape, dtype=bool)
    border[1:-1, 1:-1, 1:-1] = False
    if np.any(border & (array > 0) & (height < 0)):
        raise LabelError(
            f"the image ends less than {pad:g} mm distal of the amputation plane",
            remedy="move the plane proximally, or make amputation_pad_mm smaller",
        )


def amputate_anatomy(
    anatomy: Anatomy, plane_point: ArrayLike, plane_normal: ArrayLike, pad_mm: float, edge_mm: float
) -> Anatomy:
    """An anatomy cut at a plane, with a pad over the cut bones. Raises as :func:`amputate_limb`.

    Parameters
    ----------
    anatomy : closed surfaces of a whole limb.
    plane_point, plane_normal, pad_mm : as for :func:`amputate_limb`.
    edge_mm : edge length of the new triangles.
    """
    voxels = voxelise_anatomy(anatomy, pad_mm + _MARGIN_MM)
    labels = amputate_limb(voxels, plane_point, plane_normal, pad_mm, anatomy.cut_normal)
    return build_anatomy(labels, edge_mm, (anatomy.cut_point, anatomy.cut_normal))


def voxelise_anatomy(anatomy: Anatomy, distal_mm: float = _MARGIN_MM) -> LabelMap:
    """The label map of an anatomy: cubic voxels in layers along the cut, the last just distal of it.

    ``distal_mm`` of empty voxels are left beyond the limb's end.
    """
    frame = anatomy.frame
    points = frame.to_limb(anatomy.skin.points)
    low = points.min(axis=0) - [_MARGIN_MM, _MARGIN_MM, distal_mm]
    high = np.array([*(points.max(axis=0)[:2] + _MARGIN_MM), 0.0])
    size = np.ceil((high - low) / VOXEL_MM).astype(int)
    corner = np.array([*low[:2], -size[2] * VOXEL_MM]) + VOXEL_MM / 2
    empty = np.zeros(size[::-1], dtype=np.uint8)
    grid = Grid(empty, np.full(3, VOXEL_MM), frame.to_patient(corner), frame.rotation.T)
    array = fill_surface(anatomy.skin, grid).astype(np.uint8)
    names = {1: SOFT_TISSUE}
    inner = {**anatomy.regions, **anatomy.bones}  # bones last: they stay whole where the two overlap
    for value, (name, body) in enumerate(inner.items(), start=2):
        array[fill_surface(body, grid)] = value
        names[value] = name
    return LabelMap(array, *grid.geometry, names, {name: name for name in anatomy.regions})


def fill_surface(surface: Surface, grid: Grid) -> Mask:
    """``[k, j, i]``: which voxels' centres lie inside a closed surface."""
    body = Surface(grid.point_to_index(surface.points), surface.faces).to_pyvista()
    image = body.voxelize_binary_mask(reference_volume=pv.ImageData(dimensions=grid.size))
    return np.asarray(image["mask"]).reshape(grid.array.shape).astype(bool)
