"""Automatic segmentation of a limb in MRI: soft tissue and named bones."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..errors import ImageError
from .body import bias_field, check_contrast, limb_axis, limb_mask, muscle_level, smoothed
from .bones import find_bones, name_bones
from .ends import ProximalEnd, proximal_end
from .grid import BONES, DEFAULT_NAMES, LabelMap, Volume

Mask = NDArray[np.bool_]

_MARGIN = 2  # voxels around the limb


def segment(volume: Volume, bias_correction: bool = True, min_bone_volume_mm3: float = 1000.0) -> LabelMap:
    """Soft tissue and bones of one limb in T1- or UTE-like contrast.

    Fat and marrow are bright, muscle is grey, cortical bone dark, air black. Bones, cortex and marrow
    together, are named tibia, fibula, femur and patella where size and place allow, else ``bone-1`` and on.

    Parameters
    ----------
    volume : the image; one limb, along any grid axis, cut off by the image proximally.
    bias_correction : divide by the coil's bias field (N4) first.
    min_bone_volume_mm3 : smaller bones are left as soft tissue.

    Returns
    -------
    LabelMap
        On the image's grid: 0 outside, 1 soft tissue, 2 to 5 the named bones.

    Raises
    ------
    ImageError
        Where no limb or no bone is found, or the contrast is not MRI's.
    """
    check_contrast(volume)
    axis = limb_axis(volume)
    across = [n for n in range(3) if n != axis]
    turned = _segment(volume.turned([*across, axis]), bias_correction, min_bone_volume_mm3)
    return turned.turned([[*across, axis].index(n) for n in range(3)])


def _segment(volume: Volume, bias_correction: bool, min_bone_volume_mm3: float) -> LabelMap:
    """The same for a volume whose slices lie across the limb."""
    smooth = smoothed(volume)
    limb = limb_mask(volume, smooth)
    if bias_correction:
        smooth = smooth / bias_field(volume, limb)
    levels = (smooth / muscle_level(smooth, limb)).astype(np.float32)
    end = proximal_end(limb, volume, axis=2)
    bones, names = _bones(levels, limb, end, volume, min_bone_volume_mm3)
    if not bones:
        raise ImageError(
            "no bone was found in the limb",
            remedy="label the bones by hand and give the label map (segmentation.labels in study.toml)",
        )
    return _labels(limb, bones, names, volume)


def _bones(
    levels: NDArray[np.float32], limb: Mask, end: ProximalEnd, volume: Volume, smallest_mm3: float
) -> tuple[list[Mask], list[str]]:
    """Full-size masks and names of the bones; the work is done in the limb's box, along its axis."""
    box = _box(limb)
    along_levels, along_limb = end.along(levels[box]), end.along(limb[box])
    found = find_bones(along_levels, along_limb, volume.spacing, smallest_mm3)
    masks = []
    for bone in found:
        mask = np.zeros(limb.shape, dtype=bool)
        end.along(mask[box])[...] = bone
        masks.append(mask)
    return masks, name_bones(found, volume.spacing)


def _box(limb: Mask) -> tuple[slice, ...]:
    box = []
    for axis in range(3):
        others = tuple(n for n in range(3) if n != axis)
        filled = np.flatnonzero(limb.any(axis=others))
        box.append(slice(max(filled[0] - _MARGIN, 0), filled[-1] + 1 + _MARGIN))
    return tuple(box)


def _labels(limb: Mask, bones: list[Mask], names: list[str], volume: Volume) -> LabelMap:
    array = limb.astype(np.uint8)
    known = dict(DEFAULT_NAMES)
    values = {name: value for value, name in known.items()}
    for mask, name in zip(bones, names):
        value = values.get(name, max(known) + 1)
        known[value] = name
        array[mask & limb] = value
    present = {value: name for value, name in known.items() if name not in BONES or name in names}
    return LabelMap(array, volume.spacing, volume.origin, volume.direction, present)
