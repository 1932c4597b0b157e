"""Automatic segmentation of a limb in MRI or CT: soft tissue, subcutaneous fat and named bones."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import binary_fill_holes
from scipy.ndimage import label as connected

from ...errors import ImageError
from ..ends import ProximalEnd, proximal_end
from ..grid import BONES, DEFAULT_NAMES, FAT, LabelMap, Volume
from .body import bias_field, limb_axis, limb_mask, muscle_level, smoothed
from .bones import find_bones, name_bones
from .contrast import Contrast, above_air, is_ct
from .dense import find_dense_bones
from .fat import FAT_HU, bright_fat, depth_below, subcutaneous
from .seeds import seeded

Mask = NDArray[np.bool_]
Field = NDArray[np.float32]
Seeds = Mapping[str, ArrayLike]

_MARGIN = 2  # voxels around the limb
_SEEDED_MM3 = 100.0  # a piece of bone with a seed in it may be as small


def segment(
    volume: Volume,
    bias_correction: bool = True,
    min_bone_volume_mm3: float = 1000.0,
    contrast: Contrast = "auto",
    seeds: Seeds | None = None,
) -> LabelMap:
    """Soft tissue, subcutaneous fat and bones of one limb in T1 or UTE contrast, or CT.

    In MRI fat and marrow are bright, muscle is grey, cortical bone dark, air black. Bones, cortex and marrow
    together, are named tibia, fibula, femur and patella where size and place allow, else ``bone-1`` and on.

    Parameters
    ----------
    volume : the image; one limb, along any grid axis, cut off by the image proximally.
    bias_correction : divide by the coil's bias field (N4) first; CT has none.
    min_bone_volume_mm3 : smaller bones are left as soft tissue.
    contrast : ``auto`` tells CT from MRI by the grey values.
    seeds : (n, 3) points in LPS mm for the name of each bone; then these bones are labelled and no others.

    Returns
    -------
    LabelMap
        On the image's grid: 0 outside, 1 soft tissue, 2 to 5 the known bones, 6 subcutaneous fat with skin.

    Raises
    ------
    ImageError
        Where no limb or no bone is found, a seed lies in no bone, or the contrast is not the stated one.
    """
    ct = is_ct(volume, contrast)
    visible = above_air(volume) if ct else volume
    axis = limb_axis(visible)
    order = [*(n for n in range(3) if n != axis), axis]
    found = _segment(volume.turned(order), ct, bias_correction, min_bone_volume_mm3, seeds)
    return found.turned([order.index(n) for n in range(3)])


@dataclass(frozen=True)
class _Tissues:
    """What the contrast shows: the limb, bones along the limb's axis, and what is as bright as fat."""

    limb: Mask
    bones: list[Mask]
    end: ProximalEnd
    levels: Field
    ct: bool

    def fat(self, volume: Volume) -> Mask:
        """Subcutaneous fat, worked out in the limb's box."""
        box = _box(self.limb)
        limb, levels = self.limb[box], self.levels[box]
        bone = np.zeros(limb.shape, dtype=bool)
        for mask in self.bones:
            bone |= mask[box]
        depth = depth_below(limb, volume.spacing)
        if self.ct:
            bright = (levels > FAT_HU[0]) & (levels < FAT_HU[1])
        else:
            bright = bright_fat(levels, limb, bone, depth, volume.spacing)
        fat = np.zeros(self.limb.shape, dtype=bool)
        fat[box] = subcutaneous(bright, limb, bone, depth, volume.spacing)
        return fat


def _segment(
    volume: Volume, ct: bool, bias_correction: bool, min_bone_volume_mm3: float, seeds: Seeds | None
) -> LabelMap:
    """The same for a volume whose slices lie across the limb."""
    smallest = _SEEDED_MM3 if seeds else min_bone_volume_mm3
    found = _in_ct(volume, smallest) if ct else _in_mri(volume, bias_correction, smallest)
    if not found.bones:
        raise ImageError(
            "no bone was found in the limb",
            remedy="label the bones by hand and give the label map (segmentation.labels in study.toml)",
        )
    if seeds:
        bones, names = seeded([_one_piece(bone) for bone in found.bones], seeds, volume)
    else:
        bones = [_one_piece(bone) for bone in found.bones]
        names = name_bones([found.end.along(bone) for bone in bones], volume.spacing)
    return _labels(found.limb, found.fat(volume), bones, names, volume)


def _in_mri(volume: Volume, bias_correction: bool, smallest_mm3: float) -> _Tissues:
    smooth = smoothed(volume)
    limb = limb_mask(volume, smooth)
    if bias_correction:
        smooth = smooth / bias_field(volume, limb)
    levels = (smooth / muscle_level(smooth, limb)).astype(np.float32)
    end = proximal_end(limb, volume, axis=2)
    box = _box(limb)
    found = find_bones(end.along(levels[box]), end.along(limb[box]), volume.spacing, smallest_mm3)
    return _Tissues(limb, _whole(found, limb, box, end), end, levels, ct=False)


def _in_ct(volume: Volume, smallest_mm3: float) -> _Tissues:
    visible = above_air(volume)
    limb = limb_mask(visible, smoothed(visible))
    levels = smoothed(volume)
    end = proximal_end(limb, volume, axis=2)
    box = _box(limb)
    found = find_dense_bones(levels[box], limb[box], volume.spacing, smallest_mm3)
    return _Tissues(limb, _whole([end.along(bone) for bone in found], limb, box, end), end, levels, ct=True)


def _whole(found: list[Mask], limb: Mask, box: tuple[slice, ...], end: ProximalEnd) -> list[Mask]:
    """Full-size masks of bones that were found in the limb's box, along its axis."""
    masks = []
    for bone in found:
        mask = np.zeros(limb.shape, dtype=bool)
        end.along(mask[box])[...] = bone
        masks.append(mask)
    return masks


def _box(limb: Mask) -> tuple[slice, ...]:
    box = []
    for axis in range(3):
        others = tuple(n for n in range(3) if n != axis)
        filled = np.flatnonzero(limb.any(axis=others))
        box.append(slice(max(filled[0] - _MARGIN, 0), filled[-1] + 1 + _MARGIN))
    return tuple(box)


def _one_piece(mask: Mask) -> Mask:
    """The largest piece, without holes."""
    parts, count = connected(mask)
    if count > 1:
        mask = parts == int(np.argmax(np.bincount(parts.ravel())[1:])) + 1
    return np.asarray(binary_fill_holes(mask))


def _labels(limb: Mask, fat: Mask, bones: list[Mask], names: list[str], volume: Volume) -> LabelMap:
    array = limb.astype(np.uint8)
    known = dict(DEFAULT_NAMES)
    values = {name: value for value, name in known.items()}
    array[fat] = values[FAT]
    for mask, name in zip(bones, names):
        value = values.get(name, max(known) + 1)
        known[value] = name
        array[mask & limb] = value
    present = {value: name for value, name in known.items() if name not in BONES or name in names}
    return LabelMap(array, volume.spacing, volume.origin, volume.direction, present)
