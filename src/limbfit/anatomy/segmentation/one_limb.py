"""Whether an image shows one limb: of two side by side one would be taken for all, or both for one."""

from __future__ import annotations

import numpy as np
import SimpleITK as sitk  # noqa: N813
from numpy.typing import NDArray
from scipy.ndimage import binary_closing, binary_fill_holes, binary_opening, find_objects
from scipy.ndimage import label as connected

from ...errors import ImageError
from ..grid import Volume

Mask = NDArray[np.bool_]

_COARSE_MM = 4.0
_OTHER = 0.3  # of the largest cross-section of the slice: less is a table, a coil or a marker
_SMALLEST_MM2 = 700.0
_LONGEST = 2.5  # a cross-section is rounder than this; a limb cut lengthwise is not
_SHARE = 0.3  # of the slices with a cross-section
_FEWEST = 8  # slices


def check_one_limb(volume: Volume) -> None:
    """Refuse an image whose slices across some axis show two large, roundish sections side by side.

    Raises
    ------
    ImageError
        With the remedy: crop, or give labels.
    """
    tissue, step = _find_tissue(volume)
    for axis in range(3):
        counts = np.array([_count_sections(plane, step) for plane in np.moveaxis(tissue, axis, 0)])
        if (counts > 0).sum() >= _FEWEST and (counts > 1).sum() > _SHARE * (counts > 0).sum():
            raise ImageError(
                "two limbs in one image",
                remedy="crop the image to one limb, or give its labels (segmentation.labels in study.toml)",
            )


def _find_tissue(volume: Volume) -> tuple[Mask, float]:
    """What is brighter than air (Otsu) on coarse cubic voxels, closed over thin dark bone; their edge, mm."""
    step = max(_COARSE_MM, float(volume.spacing.max()))
    size = np.maximum(np.floor((np.array(volume.size) - 1) * volume.spacing / step).astype(int) + 1, 1)
    image = sitk.SmoothingRecursiveGaussian(volume.to_sitk(), step / 2)
    coarse = sitk.Resample(
        image,
        size.tolist(),
        sitk.Transform(),
        sitk.sitkLinear,
        volume.origin.tolist(),
        [step] * 3,
        volume.direction.ravel().tolist(),
        0.0,
        sitk.sitkFloat32,
    )
    tissue = sitk.GetArrayFromImage(sitk.OtsuThreshold(coarse, 0, 1)).astype(bool)
    padded = binary_closing(np.pad(tissue, 2), np.ones((3, 3, 3)))
    return padded[2:-2, 2:-2, 2:-2] | tissue, step


def _count_sections(plane: Mask, step: float) -> int:
    """How many large roundish sections a slice shows."""
    solid = binary_opening(np.pad(binary_fill_holes(plane), 1, mode="edge"), np.ones((3, 3)))
    parts, count = connected(solid)
    if count == 0:
        return 0
    areas = np.bincount(parts.ravel())[1:]
    large = (areas > _OTHER * areas.max()) & (areas * step**2 > _SMALLEST_MM2)
    extents = [[part.stop - part.start for part in box] for box in find_objects(parts)]
    round_ = np.array([max(sides) <= _LONGEST * min(sides) for sides in extents])
    return int((large & round_).sum())
