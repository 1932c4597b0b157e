"""Bones in CT: whatever is dense, with the marrow that it encloses."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import find_objects, grey_dilation
from scipy.ndimage import label as connected

from ..morphology import close_mask, fill_slices, open_mask
from .contrast import MUSCLE_HU

Mask = NDArray[np.bool_]
Field = NDArray[np.float32]
Spacing = NDArray[np.float64]

_DENSE_HU = 200.0  # cancellous bone is denser, muscle and contrast-free vessels are not
_COMPACT_HU = 1200.0  # denser than this counts as this, so that metal does not move outlines
_RIM_MM = 2.5  # the outline is at half of the densest bone this near
_CLOSE_MM = 2.0  # gaps in thin cortex
_SMOOTH_MM = 1.0


def find_dense_bones(hounsfield: Field, limb: Mask, spacing: Spacing, smallest_mm3: float) -> list[Mask]:
    """Masks of the bones, largest first; bones that touch are one.

    Parameters
    ----------
    hounsfield : ``[k, j, i]``, k along the limb.
    limb : everything inside the skin.
    spacing : mm along i, j, k.
    smallest_mm3 : bones smaller than this are left out.
    """
    compact = np.minimum(hounsfield, _COMPACT_HU)
    size = 2 * np.ceil(_RIM_MM / spacing[::-1]).astype(int) + 1
    half = (grey_dilation(compact, size=tuple(size)) + MUSCLE_HU) / 2
    dense = limb & (compact > _DENSE_HU)
    sharp = dense & (compact > half)
    parts, _ = connected(sharp | (dense & _find_enclosed(sharp, dense, spacing)))
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


def _find_enclosed(sharp: Mask, dense: Mask, spacing: Spacing) -> Mask:
    """Dense voxels that sharp ones enclose: cancellous bone, which is below half of the cortex beside it."""
    return _fill_bone(sharp, spacing) & dense


def _fill_bone(part: Mask, spacing: Spacing) -> Mask:
    """Closed over gaps of the cortex, filled slice by slice, without spikes."""
    padded = np.pad(part, ((0, 0), (1, 1), (1, 1)))  # a bone goes on beyond its ends, not beside them
    closed = fill_slices(close_mask(padded, _CLOSE_MM, spacing))
    opened = open_mask(closed, _SMOOTH_MM, spacing) | padded
    return np.asarray(opened[:, 1:-1, 1:-1])
