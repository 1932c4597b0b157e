"""Automatic segmentation of a limb in MRI or CT: soft tissue, subcutaneous fat and named bones."""

from collections.abc import Mapping

import numpy as np
from numpy.typing import ArrayLike

from ...arrays import Mask
from ...errors import ImageError
from ..grid import BONES, DEFAULT_NAMES, FAT, LabelMap, Volume, find_proximal_end
from ..morphology import Box, compute_depth, fill_largest_piece, find_box
from . import body
from .body import Contrast
from .bones import find_bones, find_dense_bones, grow_from_seeds, name_bones

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
    The map is on the image's grid: 0 outside, 1 soft tissue, 2 to 5 the known bones, 6 subcutaneous fat with
    skin. Raises `ImageError` where no limb or no bone is found, a seed lies in no bone, or the contrast is
    not the stated one.

    Parameters
    ----------
    volume : the image; one limb, along any grid axis, cut off by the image proximally.
    bias_correction : divide by the coil's bias field (N4) first; CT has none.
    min_bone_volume_mm3 : smaller bones are left as soft tissue.
    contrast : ``auto`` tells CT from MRI by the grey values.
    seeds : (n, 3) points in LPS mm for the name of each bone; then these bones are labelled and no others.
    """
    ct = body.is_ct(volume, contrast)
    visible = body.rescale_above_air(volume) if ct else volume
    axis = body.find_limb_axis(visible)
    del visible
    found = _segment(volume.turn_along(axis), ct, bias_correction, min_bone_volume_mm3, seeds)
    return found.align_axes(volume.direction)


def _segment(
    volume: Volume, ct: bool, bias_correction: bool, min_bone_volume_mm3: float, seeds: Seeds | None
) -> LabelMap:
    """As `segment`, for a volume whose slices lie across the limb."""
    spacing, smallest = volume.spacing, _SEEDED_MM3 if seeds else min_bone_volume_mm3
    visible = body.rescale_above_air(volume) if ct else volume
    smooth = body.smooth_image(visible)
    whole = body.find_limb_mask(visible, smooth)
    del visible
    end, box = find_proximal_end(whole, volume, axis=2), find_box(whole, _MARGIN)
    limb = whole[box]
    if ct:
        levels = body.smooth_image(volume)[box]
        pieces = find_dense_bones(levels, limb, spacing, smallest)
    else:
        if bias_correction:
            smooth /= body.estimate_bias_field(volume, whole)
        levels = smooth[box] / np.float32(body.estimate_muscle_level(smooth[box], limb))
        along = end.order_distal_first
        pieces = [along(piece) for piece in find_bones(along(levels), along(limb), spacing, smallest)]
    del smooth
    if not pieces:
        raise ImageError(
            "no bone was found in the limb",
            remedy="label the bones by hand and give the label map (segmentation.labels in study.toml)",
        )
    bones = [fill_largest_piece(piece) for piece in pieces]
    if seeds:
        bones, names = grow_from_seeds(bones, seeds, volume.crop(box))
    else:
        names = name_bones([end.order_distal_first(bone) for bone in bones], spacing)
    bone, depth = np.any(pieces, axis=0), compute_depth(limb, spacing)
    if ct:
        bright = (levels > body.FAT_HU[0]) & (levels < body.FAT_HU[1])
    else:
        bright = body.find_bright_fat(levels, limb, bone, depth, spacing)
    fat = body.select_subcutaneous(bright, limb, bone, depth, spacing)
    return _build_labels(limb, fat, bones, names, volume, box)


def _build_labels(
    limb: Mask, fat: Mask, bones: list[Mask], names: list[str], volume: Volume, box: Box
) -> LabelMap:
    array = limb.astype(np.uint8)
    known = dict(DEFAULT_NAMES)
    values = {name: value for value, name in DEFAULT_NAMES.items()}
    array[fat] = values[FAT]
    for mask, name in zip(bones, names):
        value = values.get(name, max(known) + 1)
        known[value] = name
        array[mask & limb] = value
    present = {value: name for value, name in known.items() if name not in BONES or name in names}
    whole = np.zeros(volume.array.shape, dtype=np.uint8)
    whole[box] = array
    return LabelMap(whole, *volume.geometry, present)
