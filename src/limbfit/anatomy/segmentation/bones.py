"""Bones in T1- or UTE-like contrast, bright marrow enclosed by dark cortex, and in CT.

The *escape level* of a voxel is the brightest that the darkest point of a way out of the limb's slice can
be. Marrow cannot get out without crossing cortex, so its escape level is dark; subcutaneous fat, fat between
muscles and vessels get out through tissue. (Grey-scale hole filling by reconstruction, Soille 2003, of the
negative image.) Grey levels are relative to muscle throughout.

Bones are named by size and place, or by seeds: points that a user put into them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import SimpleITK as sitk  # noqa: N813
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import binary_propagation, distance_transform_edt, find_objects
from scipy.ndimage import label as connected

from ...arrays import Array, Mask
from ...errors import ImageError
from .. import morphology
from ..grid import Grid
from ..morphology import Field, find_box
from ..surfaces.extraction import compute_signed_distance_to

MUSCLE_HU = 50.0
_DENSE_HU = 200.0  # cancellous bone is denser, muscle and contrast-free vessels are not
_MAX_BONE_HU = 1200.0  # denser than this counts as this, so that metal does not move outlines
_RIM_MM = 2.5  # in CT the outline is at half of the densest bone this near
_CLOSE_MM = 2.0  # gaps in thin cortex
_SMOOTH_MM = 1.0
_MARROW_LEVEL = 1.15  # marrow is brighter
_MAX_ESCAPE_LEVEL = 0.78  # and cannot get out without crossing something darker
_CORTEX_LEVEL = 0.65  # cortex: half-way between muscle (1) and cortical bone (0.2 to 0.3 with partial volume)
_SKIN_MM = 2.0  # no bone this near to the outline, where partial volume with air is dark too
_CORTEX_MM = 9.0  # thickest cortex: the anterior crest of the tibia
_TAIL_MM = 2.0  # dark fascia and vessels thinner than twice this are taken off the bone
_SEED_PART = 0.15  # of the smallest bone's volume, for its marrow to count
_STEP_IN_MM, _STEP_OUT_MM = 2.0, 6.0  # how far a bone's outline may move from slice to slice
_AREA_RATIOS = (0.6, 1.8)
_NEAR_MM = 3.0  # a seed this near to a bone is in it


def find_bones(levels: Field, limb: Mask, spacing: Array, smallest_mm3: float) -> list[Mask]:
    """Masks of the bones, largest first.

    Parameters
    ----------
    levels : ``[k, j, i]`` grey level over that of muscle, k along the limb.
    limb : everything inside the skin.
    spacing : mm along i, j, k.
    smallest_mm3 : bones smaller than this are left out.
    """
    deep = morphology.compute_depth(limb, spacing) > _SKIN_MM
    marrow = deep & (levels > _MARROW_LEVEL) & (compute_escape_level(levels, limb) < _MAX_ESCAPE_LEVEL)
    parts = _number_cavities(marrow, _SEED_PART * smallest_mm3 / float(np.prod(spacing)))
    if parts.max() == 0:
        return []
    for value, place in enumerate(find_objects(parts), start=1):
        _continue_cavity(parts, value, place[0], levels, deep, spacing)
    parts = _join_cavities(parts)
    box = find_box(parts > 0, np.ceil(_CORTEX_MM / spacing[::-1]).astype(int) + 1)
    owned = np.zeros_like(parts)
    owned[box] = _add_cortex(parts[box], levels[box], deep[box], spacing)
    sizes = np.bincount(owned[box].ravel())[1:]
    large = 1 + np.flatnonzero(sizes * np.prod(spacing) >= max(smallest_mm3, 1))
    return [owned == value for value in sorted(large, key=lambda value: -sizes[value - 1])]


def compute_escape_level(levels: Field, limb: Mask) -> Field:
    """Per slice, the largest level that some way from the voxel to the outside never falls below."""
    outside = np.float32(levels.max() + 1)
    found = np.empty_like(levels)
    for k, (plane, inside) in enumerate(zip(levels, limb)):
        relief = np.pad(-np.where(inside, plane, outside), 1, constant_values=-outside)
        filled = sitk.GrayscaleFillhole(sitk.GetImageFromArray(relief))
        found[k] = -sitk.GetArrayFromImage(filled)[1:-1, 1:-1]
    return found


def _number_cavities(marrow: Mask, smallest: float) -> NDArray[np.int32]:
    """Connected cavities of at least ``smallest`` voxels, numbered from 1."""
    found, count = connected(marrow, np.ones((3, 3, 3)))
    keep = np.bincount(found.ravel(), minlength=count + 1) >= max(smallest, 4)
    keep[0] = False
    return np.where(keep, np.cumsum(keep), 0).astype(np.int32)[found]


def _continue_cavity(
    parts: NDArray[np.int32], value: int, slices: slice, levels: Field, deep: Mask, spacing: Array
) -> None:
    """Go on beyond a part's slices where the cortex is too thin to enclose the marrow, as near a joint.

    Changes ``parts`` in place.
    """
    margin = np.ceil(_STEP_OUT_MM / spacing[1::-1]).astype(int) + 1
    for step, k in ((-1, slices.start), (1, slices.stop - 1)):
        while 0 <= k + step < len(parts):
            box = find_box(parts[k] == value, margin)
            previous = morphology.fill_slices((parts[k][box] == value)[None])[0]
            k += step
            here = parts[k][box]
            free = deep[k][box] & ((here == 0) | (here == value))
            found = _find_next_section(previous, levels[k][box], free, spacing)
            if found is None:
                break
            here[found] = value


def _find_next_section(previous: Mask, plane: Field, free: Mask, spacing: Array) -> Mask | None:
    """The marrow in the next slice, split from fat around it along the darkest line (watershed)."""
    inside = morphology.erode_mask(previous, _STEP_IN_MM, spacing) & free
    allowed = morphology.dilate_mask(previous, _STEP_OUT_MM, spacing) & free
    if not inside.any():
        return None
    markers = np.where(allowed, 0, 2).astype(np.uint8)
    markers[inside] = 1
    basins = sitk.MorphologicalWatershedFromMarkers(
        sitk.GetImageFromArray(-plane), sitk.GetImageFromArray(markers), False, True
    )
    section = (sitk.GetArrayFromImage(basins) == 1) & (plane > _MARROW_LEVEL)
    section = morphology.open_mask(section, _STEP_IN_MM, spacing)
    ratio = section.sum() / previous.sum()
    return section if _AREA_RATIOS[0] <= ratio <= _AREA_RATIOS[1] else None


def _join_cavities(parts: NDArray[np.int32]) -> NDArray[np.int32]:
    """Cavities that lie on each other in neighbouring slices are one: a leak in the ring parted them."""
    root = np.arange(parts.max() + 1)
    for low, high in pairwise(parts):
        both = (low > 0) & (high > 0) & (low != high)
        for a, b in np.unique(np.column_stack([low[both], high[both]]), axis=0):
            shared = int((both & (low == a) & (high == b)).sum())
            if shared > 0.5 * min(int((low == a).sum()), int((high == b).sum())):
                root[root == root[b]] = root[a]
    return np.unique(root, return_inverse=True)[1].astype(np.int32)[parts]


def _add_cortex(parts: NDArray[np.int32], levels: Field, deep: Mask, spacing: Array) -> NDArray[np.int32]:
    """Each cavity with the dark cortex around it, without the fascia and vessels that hang on."""
    marrow = parts > 0
    distance, nearest = distance_transform_edt(~marrow, sampling=spacing[::-1], return_indices=True)
    dark = deep & (levels < _CORTEX_LEVEL) & (distance < _CORTEX_MM)
    bone = binary_propagation(marrow, mask=morphology.fill_slices(marrow | dark))
    bone = morphology.open_mask(bone, _TAIL_MM, spacing) | marrow
    bone = binary_propagation(marrow, mask=morphology.fill_slices(bone))
    return np.where(bone, parts[tuple(nearest)], 0)


def find_dense_bones(hounsfield: Field, limb: Mask, spacing: Array, smallest_mm3: float) -> list[Mask]:
    """As `find_bones` in CT, by Hounsfield units ``[k, j, i]``; bones that touch are one."""
    compact = np.minimum(hounsfield, _MAX_BONE_HU)
    half = (morphology.find_local_maximum(compact, _RIM_MM, spacing) + MUSCLE_HU) / 2
    dense = limb & (compact > _DENSE_HU)
    sharp = dense & (compact > half)
    # Cancellous bone is below half of the cortex beside it, which encloses it.
    parts, _ = connected(sharp | (dense & _fill_bone(sharp, spacing)))
    voxel = float(np.prod(spacing))
    found = []
    for value, box in enumerate(find_objects(parts), start=1):
        if (parts[box] == value).sum() * voxel < 0.1 * smallest_mm3:
            continue
        bone = np.zeros(limb.shape, dtype=bool)
        bone[box] = _fill_bone(parts[box] == value, spacing)
        bone &= limb
        if bone.sum() * voxel >= smallest_mm3:
            found.append(bone)
    return sorted(found, key=lambda bone: -int(bone.sum()))


def _fill_bone(part: Mask, spacing: Array) -> Mask:
    """Close a bone over gaps of its cortex, fill it slice by slice and take its spikes off."""
    padded = np.pad(part, ((0, 0), (1, 1), (1, 1)))  # a bone goes on beyond its ends, not beside them
    closed = morphology.fill_slices(morphology.close_mask(padded, _CLOSE_MM, spacing))
    opened = morphology.open_mask(closed, _SMOOTH_MM, spacing) | padded
    return np.asarray(opened[:, 1:-1, 1:-1])


def name_bones(bones: list[Mask], spacing: Array) -> list[str]:
    """Names by size and place; slices run from distal to proximal, ``bones`` from large to small.

    The femur is the upper of two large bones that lie one above the other; the tibia the largest below it;
    the fibula the slender one beside the tibia, at most half of it; the patella the compact one at the
    femur's height. One long bone alone is a thigh's or an upper arm's, two of a size are a forearm's. What
    fits none of these is ``bone-1`` and so on.
    """
    shapes = [_Extent.from_mask(bone, spacing) for bone in bones]
    names: dict[int, str] = {}
    if not bones:
        return []
    large = [n for n, shape in enumerate(shapes) if shape.volume > 0.25 * shapes[0].volume]
    stacked = len(large) >= 2 and shapes[large[0]].overlap(shapes[large[1]]) < 0.3
    if stacked:
        lower, upper = sorted(large[:2], key=lambda n: shapes[n].middle)
        names |= {lower: "tibia", upper: "femur"}
    else:
        lower, upper = 0, None
    rest = [n for n in range(len(bones)) if n not in (lower, upper)]
    for n in rest:
        shape = shapes[n]
        if "fibula" not in names.values() and shape.is_fibula_of(shapes[lower]):
            names |= {lower: "tibia", n: "fibula"}
        elif "patella" not in names.values() and upper is not None and shape.overlap(shapes[upper]) > 0.5:
            names[n] = "patella"
    unknown = iter(range(1, len(bones) + 1))
    return [names[n] if n in names else f"bone-{next(unknown)}" for n in range(len(bones))]


@dataclass(frozen=True)
class _Extent:
    """A bone along the limb, mm."""

    low: float
    high: float
    middle: float
    volume: float

    @classmethod
    def from_mask(cls, bone: Mask, spacing: Array) -> _Extent:
        areas = bone.sum(axis=(1, 2))
        filled = np.flatnonzero(areas)
        return cls(
            low=float(filled[0] * spacing[2]),
            high=float((filled[-1] + 1) * spacing[2]),
            middle=float((areas @ np.arange(len(areas))) / areas.sum() * spacing[2]),
            volume=float(areas.sum() * np.prod(spacing)),
        )

    def is_fibula_of(self, tibia: _Extent) -> bool:
        """More than two and a half times as long as wide, beside the tibia, and at most half of it."""
        length = self.high - self.low
        slender = length > 2.5 * float(np.sqrt(self.volume / length))
        return slender and self.overlap(tibia) > 0.5 and self.volume <= 0.5 * tibia.volume

    def overlap(self, other: _Extent) -> float:
        """Part of the shorter one's length that both share."""
        shared = min(self.high, other.high) - max(self.low, other.low)
        return shared / min(self.high - self.low, other.high - other.low)


def grow_from_seeds(
    bones: Sequence[Mask], seeds: Mapping[str, ArrayLike], grid: Grid
) -> tuple[list[Mask], list[str]]:
    """One bone for each name: the pieces that hold its seeds; a piece with seeds of several names is divided.

    ``bones`` are masks ``[k, j, i]`` on the grid, ``seeds`` (n, 3) points in LPS mm for each name. Raises
    `ImageError` for a seed in no bone.
    """
    names = list(seeds)
    found = [np.zeros(grid.array.shape, dtype=bool) for _ in names]
    holders: dict[int, dict[int, list[tuple[int, int, int]]]] = {}
    for n, name in enumerate(names):
        for point in np.asarray(seeds[name], dtype=float).reshape(-1, 3):
            voxel, piece = _find_piece(point, bones, grid, name)
            holders.setdefault(piece, {}).setdefault(n, []).append(voxel)
    for piece, marked in holders.items():
        if len(marked) == 1:
            found[next(iter(marked))] |= bones[piece]
            continue
        divided = _divide_piece(bones[piece], marked, grid)
        for n in marked:
            found[n] |= divided == n + 1
    return found, names


def _find_piece(
    point: Array, bones: Sequence[Mask], grid: Grid, name: str
) -> tuple[tuple[int, int, int], int]:
    """The voxel ``(k, j, i)`` of the nearest bone, and which bone that is."""
    index = grid.point_to_index(point)
    reach = np.ceil(_NEAR_MM / grid.spacing).astype(int)
    low = np.maximum(np.round(index).astype(int) - reach, 0)[::-1]
    high = np.maximum(np.round(index).astype(int) + reach + 1, 0)[::-1]
    box = tuple(slice(a, b) for a, b in zip(low, high))
    found = [
        (float(np.linalg.norm((voxel[::-1] - index) * grid.spacing)), tuple(voxel.tolist()), piece)
        for piece, bone in enumerate(bones)
        for voxel in np.argwhere(bone[box]) + low
    ]
    away, voxel, piece = min(found, default=(np.inf, (0, 0, 0), 0))
    if away > _NEAR_MM:
        place = ", ".join(f"{x:g}" for x in point)
        raise ImageError(
            f"the seed of {name!r} at ({place}) mm lies in no bone that was found",
            remedy="put it into the bone (LPS, mm), or label the bone by hand (segmentation.labels)",
        )
    return voxel, piece


def _divide_piece(
    bone: Mask, marked: Mapping[int, list[tuple[int, int, int]]], grid: Grid
) -> NDArray[np.uint8]:
    """One piece parted between names where it is thinnest (watershed of the depth); values are name + 1."""
    depth = compute_signed_distance_to(bone, grid)
    markers = np.zeros(bone.shape, dtype=np.uint8)
    markers[~bone] = 255
    for n, voxels in marked.items():
        for voxel in voxels:
            markers[voxel] = n + 1
    basins = sitk.MorphologicalWatershedFromMarkers(
        sitk.GetImageFromArray(-depth), sitk.GetImageFromArray(markers), False, True
    )
    return np.where(bone, sitk.GetArrayFromImage(basins), 0).astype(np.uint8)
