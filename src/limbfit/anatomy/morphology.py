"""Masks of voxels: morphology by balls in millimetres, holes, pieces and boxes.

A mask dilated by a ball holds what lies within the ball's radius of it. Exact distance maps (Maurer et al.
2003) give that in a time that is linear in the voxels, however fine they are. Masks are ``[k, j, i]``, or
``[j, i]`` for one slice; spacings are mm along i, j and k.
"""

import numpy as np
import SimpleITK as sitk  # noqa: N813
from numpy.typing import NDArray
from scipy.ndimage import binary_fill_holes, grey_dilation
from scipy.ndimage import label as connected

from ..arrays import Array, Indices, Mask

Field = NDArray[np.float32]
Box = tuple[slice, ...]

_ROUNDING = 1e-5  # of a radius: distances are float32


def compute_distance(mask: Mask, spacing: Array) -> Field:
    """Distance of each voxel's centre to that of the nearest voxel of the mask, mm; infinite without any."""
    if not mask.any():
        return np.full(mask.shape, np.inf, dtype=np.float32)
    image = sitk.GetImageFromArray(mask.view(np.uint8))
    image.SetSpacing(spacing[: mask.ndim].tolist())
    found = sitk.SignedMaurerDistanceMap(image, squaredDistance=False, useImageSpacing=True)
    del image
    distance = sitk.GetArrayFromImage(found)
    return np.maximum(distance, 0, out=distance)


def compute_depth(mask: Mask, spacing: Array) -> Field:
    """Distance to the nearest voxel outside the mask, mm; it goes on beyond its first and last slice."""
    padded = np.pad(mask, 1)
    padded[0], padded[-1] = padded[1], padded[-2]
    return compute_distance(~padded, spacing)[1:-1, 1:-1, 1:-1]


def dilate_mask(mask: Mask, radius_mm: float, spacing: Array) -> Mask:
    """The voxels within a radius of the mask."""
    return compute_distance(mask, spacing) <= radius_mm * (1 + _ROUNDING)


def erode_mask(mask: Mask, radius_mm: float, spacing: Array) -> Mask:
    """The voxels of the mask that are farther than a radius from what is outside it, within the array."""
    return compute_distance(~mask, spacing) > radius_mm * (1 + _ROUNDING)


def close_mask(mask: Mask, radius_mm: float, spacing: Array) -> Mask:
    """Close the gaps that a ball does not fit into; beyond the array the mask goes on as at its border."""
    room, inner, box = _make_room(mask, radius_mm, spacing)
    closed = erode_mask(dilate_mask(room, radius_mm, spacing), radius_mm, spacing)
    found = mask.copy()
    found[box] |= closed[inner]
    return found


def open_mask(mask: Mask, radius_mm: float, spacing: Array) -> Mask:
    """Remove what is too thin for a ball; beyond the array the mask goes on as at its border."""
    room, inner, box = _make_room(mask, 2 * radius_mm, spacing)
    opened = dilate_mask(erode_mask(room, radius_mm, spacing), radius_mm, spacing)
    found = np.zeros_like(mask)
    found[box] = opened[inner]
    return found


def _make_room(mask: Mask, reach_mm: float, spacing: Array) -> tuple[Mask, Box, Box]:
    """The mask in its box with room around it; its box there, and its box in the array."""
    reach = np.ceil(reach_mm / spacing[: mask.ndim]).astype(int)[::-1] + 1
    box = find_box(mask)
    wide = tuple(slice(b.start, b.stop + 2 * r) for r, b in zip(reach, box, strict=True))
    inner = tuple(slice(r, r + b.stop - b.start) for r, b in zip(reach, box, strict=True))
    return np.pad(mask, reach[:, None], mode="edge")[wide], inner, box


def find_box(mask: Mask, margin: Indices | int = 0) -> Box:
    """The smallest box of indices that holds a mask, wider by a margin (voxels along each array axis)."""
    box = []
    for axis, more in enumerate(np.broadcast_to(margin, mask.ndim)):
        filled = np.flatnonzero(mask.any(axis=tuple(n for n in range(mask.ndim) if n != axis)))
        low, high = (int(filled[0]), int(filled[-1]) + 1) if len(filled) else (0, 1)
        box.append(slice(max(low - int(more), 0), min(high + int(more), mask.shape[axis])))
    return tuple(box)


def fill_slices(mask: Mask) -> Mask:
    """Holes filled within each slice: a bone that reaches the image's end is a hole there, not in 3-D."""
    return np.stack([binary_fill_holes(plane) for plane in mask])


def find_local_maximum(values: Field, radius_mm: float, spacing: Array) -> Field:
    """The largest value in a box of a radius around each voxel."""
    size = 2 * np.ceil(radius_mm / spacing[::-1]).astype(int) + 1
    return np.asarray(grey_dilation(values, size=tuple(size)))


def find_largest_piece(mask: Mask) -> Mask:
    """The largest of the pieces of a mask that share faces."""
    parts, count = connected(mask)
    if count < 2:
        return mask
    return np.asarray(parts == int(np.argmax(np.bincount(parts[mask])[1:])) + 1)


def fill_largest_piece(mask: Mask) -> Mask:
    """The largest of the pieces of a mask, without holes."""
    box = find_box(mask)
    filled = np.zeros_like(mask)
    filled[box] = binary_fill_holes(find_largest_piece(mask[box]))
    return filled
