"""CT: whether an image is one, its outline as that of an MRI, and its bones.

T1 and UTE images are segmented alike, by grey levels relative to muscle. CT has Hounsfield units.
"""

from typing import Literal

import numpy as np
from scipy.ndimage import find_objects
from scipy.ndimage import label as connected

from ...arrays import Array, Mask
from ...errors import ImageError
from ..grid import Volume
from ..morphology import Field, close_mask, fill_slices, find_local_maximum, open_mask

Contrast = Literal["auto", "T1", "UTE", "CT"]

AIR_HU, MUSCLE_HU = -1000.0, 50.0
_LIGHTEST_HU = -200.0  # every CT of a limb shows something lighter than fat
_DENSEST_AIR_HU = -400.0  # no air is denser, where a grey-value window cut it off
_AIR_WIDTH_HU = 100.0  # half the width of its peak in the histogram
_AIR_SHARE = 0.03  # of the voxels: fewer are an artefact of resampling
_TOP_HU = 100.0  # for the outline bone and soft tissue are the same
_DENSE_HU = 200.0  # cancellous bone is denser, muscle and contrast-free vessels are not
_MAX_BONE_HU = 1200.0  # denser than this counts as this, so that metal does not move outlines
_RIM_MM = 2.5  # the outline is at half of the densest bone this near
_CLOSE_MM = 2.0  # gaps in thin cortex
_SMOOTH_MM = 1.0


def is_ct(volume: Volume, expected: Contrast = "auto") -> bool:
    """True if an image has Hounsfield units, by its DICOM modality or else the peak of air in its histogram.

    Without a modality an expected ``CT`` needs no such peak, only grey values below those of fat. Raises
    `ImageError` for a constant image, a CT without Hounsfield units, or one that contradicts ``expected``.
    """
    low, high = float(volume.array.min()), float(volume.array.max())
    if high <= low:
        raise ImageError("the image is constant", remedy="check the series")
    if volume.modality in ("CT", "MR"):
        found, evidence = volume.modality == "CT", f"the DICOM modality {volume.modality} does"
    else:
        found = _has_air_peak(volume, low) or (expected == "CT" and low < _LIGHTEST_HU)
        evidence = f"the grey values, {low:.0f} to {high:.0f}, do"
    if expected != "auto" and found != (expected == "CT"):
        raise ImageError(
            f"{evidence} not fit {expected}",
            remedy='check the series, or give segmentation.contrast = "auto"',
        )
    if found and low > _LIGHTEST_HU:
        raise ImageError(
            f"the grey values of this CT, {low:.0f} to {high:.0f}, are not Hounsfield units",
            remedy="export the original series again",
        )
    return found


def _has_air_peak(volume: Volume, low: float) -> bool:
    """True if the histogram has a peak at -1000, or at the end of a grey-value window.

    Resampling of MRI by B-splines overshoots to negative values too, but in few voxels, the fewer the lower.
    """
    air = max(low, AIR_HU)
    span = (air - _AIR_WIDTH_HU, air + _AIR_WIDTH_HU)
    count = int(np.histogram(volume.array, bins=1, range=span)[0][0])
    return air < _DENSEST_AIR_HU and count > _AIR_SHARE * volume.array.size


def rescale_above_air(volume: Volume) -> Volume:
    """A CT image as an MRI-like one for the outline: air 0, soft tissue about 1000, bone no brighter."""
    return volume.with_array(np.clip(volume.array, AIR_HU, _TOP_HU) - AIR_HU)


def find_dense_bones(hounsfield: Field, limb: Mask, spacing: Array, smallest_mm3: float) -> list[Mask]:
    """Masks of the bones, largest first; bones that touch are one.

    Parameters
    ----------
    hounsfield : ``[k, j, i]``, k along the limb.
    limb : everything inside the skin.
    spacing : mm along i, j, k.
    smallest_mm3 : bones smaller than this are left out.
    """
    compact = np.minimum(hounsfield, _MAX_BONE_HU)
    half = (find_local_maximum(compact, _RIM_MM, spacing) + MUSCLE_HU) / 2
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
    closed = fill_slices(close_mask(padded, _CLOSE_MM, spacing))
    opened = open_mask(closed, _SMOOTH_MM, spacing) | padded
    return np.asarray(opened[:, 1:-1, 1:-1])
