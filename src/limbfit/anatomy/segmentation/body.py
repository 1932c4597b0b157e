"""The limb in the image: its outline, the bias field, and the grey level of muscle."""

from __future__ import annotations

import numpy as np
import SimpleITK as sitk  # noqa: N813
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, grey_dilation

from ...errors import ImageError
from ..ends import find_longest_axis
from ..grid import Volume
from ..morphology import close_mask, erode_mask, fill_slices, find_box, find_largest_piece, open_mask
from .supports import remove_supports

Mask = NDArray[np.bool_]
Field = NDArray[np.float32]

_SMOOTH_MM = 0.6
_TISSUE = 0.45  # of the median of the tissue: between the noise of air and muscle
_CLOSE_MM = 3.5
_OPEN_MM = 1.5
_RIM_MM = 2.5  # the outline is at half of the brightest tissue this near
_BIAS_GRID_MM = 5.0
_BIAS_ITERATIONS = [25, 20, 15]
_SMALLEST_LIMB_MM3 = 5.0e4


def smooth_image(volume: Volume) -> Field:
    """The image without its finest noise: a Gaussian of 0.6 mm, at most 0.6 voxels."""
    sigma = np.minimum(_SMOOTH_MM / volume.spacing[::-1], 0.6)
    return gaussian_filter(volume.array, sigma)


def find_limb_axis(volume: Volume) -> int:
    """The grid axis (0, 1, 2 for i, j, k) along which the limb is longest."""
    tissue = find_largest_piece(volume.array > _compute_otsu_threshold(volume.array))
    if tissue.sum() * volume.voxel_mm3 < _SMALLEST_LIMB_MM3:
        raise ImageError("no limb was found in the image", remedy="check the series and its contrast")
    return find_longest_axis(tissue, volume)


def find_limb_mask(volume: Volume, smooth: Field) -> Mask:
    """Everything inside the skin.

    Otsu's threshold finds tissue; the largest body, closed and with its dark bones filled, is the limb. Its
    outline is then put where the signal falls to half of the tissue beside it, so that bright fat does not
    push it outward by partial volume.
    """
    tissue = float(np.median(smooth[smooth > _compute_otsu_threshold(smooth)]))
    body = find_largest_piece(smooth > _TISSUE * tissue)
    box = find_box(body, np.ceil(_CLOSE_MM / volume.spacing[::-1]).astype(int))
    limb = np.zeros(body.shape, dtype=bool)
    limb[box] = _outline(body[box], smooth[box], _TISSUE * tissue, volume)
    return limb


def _outline(body: Mask, smooth: Field, darkest: float, volume: Volume) -> Mask:
    """The limb in the box of the largest body, of what is brighter than ``darkest``."""
    rough = find_largest_piece(remove_supports(_fill_limb(body, volume), volume))
    if rough.sum() * volume.voxel_mm3 < _SMALLEST_LIMB_MM3:
        raise ImageError("no limb was found in the image", remedy="check the series and its contrast")
    size = 2 * np.ceil(_RIM_MM / volume.spacing[::-1]).astype(int) + 1
    half = 0.5 * grey_dilation(smooth, size=tuple(size))
    core = erode_mask(rough, _RIM_MM, volume.spacing)
    return find_largest_piece(_fill_limb(core | (rough & (smooth > np.maximum(half, darkest))), volume))


def _compute_otsu_threshold(array: Field) -> float:
    """Otsu's threshold between air and tissue."""
    found = sitk.OtsuThresholdImageFilter()
    found.Execute(sitk.GetImageFromArray(np.ascontiguousarray(array)))
    return float(found.GetThreshold())


def _fill_limb(mask: Mask, volume: Volume) -> Mask:
    """Closed over dark skin and bone, filled slice by slice, without spikes."""
    filled = fill_slices(close_mask(mask, _CLOSE_MM, volume.spacing))
    return fill_slices(open_mask(filled, _OPEN_MM, volume.spacing))


def estimate_bias_field(volume: Volume, limb: Mask) -> Field:
    """The smooth factor of the coil's sensitivity inside the limb (N4, Tustison et al. 2010)."""
    image = volume.to_sitk()
    mask = sitk.GetImageFromArray(limb.astype(np.uint8))
    mask.CopyInformation(image)
    factors = [max(1, round(_BIAS_GRID_MM / s)) for s in volume.spacing]
    n4 = sitk.N4BiasFieldCorrectionImageFilter()
    n4.SetMaximumNumberOfIterations(_BIAS_ITERATIONS)
    n4.Execute(sitk.Shrink(image, factors), sitk.Shrink(mask, factors))
    field = sitk.GetArrayFromImage(n4.GetLogBiasFieldAsImage(image))
    return np.exp(np.clip(field, -1.5, 1.5, out=field), out=field)


def estimate_muscle_level(smooth: Field, limb: Mask) -> float:
    """The commonest grey level inside the limb, air and cortical bone left out."""
    inside = smooth[limb]
    top = float(np.percentile(inside, 99.5))
    counts, edges = np.histogram(inside, 80, (0.0, top))
    counts = np.convolve(counts, np.ones(3) / 3, mode="same")
    start = 8
    best = start + int(np.argmax(counts[start:]))
    return float(edges[best] + edges[best + 1]) / 2
