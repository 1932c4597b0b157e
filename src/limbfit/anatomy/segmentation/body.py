"""The limb in the image: its outline, the bias field, and the grey level of muscle."""

from __future__ import annotations

import numpy as np
import SimpleITK as sitk  # noqa: N813
from numpy.typing import NDArray
from scipy.ndimage import (
    binary_closing,
    binary_erosion,
    binary_fill_holes,
    binary_opening,
    gaussian_filter,
    grey_dilation,
)
from scipy.ndimage import label as connected

from ...errors import ImageError
from ..ends import longest_axis
from ..grid import Volume
from .supports import without_supports

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


def smoothed(volume: Volume) -> Field:
    """The image without its finest noise: a Gaussian of 0.6 mm, at most 0.6 voxels."""
    sigma = np.minimum(_SMOOTH_MM / volume.spacing[::-1], 0.6)
    return gaussian_filter(volume.array, sigma)


def check_contrast(volume: Volume) -> None:
    """Refuse what the search for markers was not made for."""
    low, high = float(volume.array.min()), float(volume.array.max())
    if high <= low:
        raise ImageError("the image is constant", remedy="check the series")
    if low < -200:
        raise ImageError(
            "the image has the grey values of CT; markers are found in MRI only",
            remedy="give the sites' positions (position in study.toml)",
        )


def limb_axis(volume: Volume) -> int:
    """The grid axis (0, 1, 2 for i, j, k) along which the limb is longest."""
    tissue = _largest(volume.array > _otsu(volume.array))
    if tissue.sum() * volume.voxel_mm3 < _SMALLEST_LIMB_MM3:
        raise ImageError("no limb was found in the image", remedy="check the series and its contrast")
    return longest_axis(tissue, volume)


def limb_mask(volume: Volume, smooth: Field) -> Mask:
    """Everything inside the skin.

    Otsu's threshold finds tissue; the largest body, closed and with its dark bones filled, is the limb. Its
    outline is then put where the signal falls to half of the tissue beside it, so that bright fat does not
    push it outward by partial volume.
    """
    tissue = float(np.median(smooth[smooth > _otsu(smooth)]))
    rough = _largest(smooth > _TISSUE * tissue)
    rough = _largest(without_supports(_solid(rough, volume), volume))
    if rough.sum() * volume.voxel_mm3 < _SMALLEST_LIMB_MM3:
        raise ImageError("no limb was found in the image", remedy="check the series and its contrast")
    size = 2 * np.ceil(_RIM_MM / volume.spacing[::-1]).astype(int) + 1
    half = 0.5 * grey_dilation(smooth, size=tuple(size))
    core = binary_erosion(rough, ball(_RIM_MM, volume.spacing), border_value=1)
    return _largest(_solid(core | (rough & (smooth > np.maximum(half, _TISSUE * tissue))), volume))


def _otsu(array: Field) -> float:
    """Otsu's threshold between air and tissue."""
    found = sitk.OtsuThresholdImageFilter()
    found.Execute(sitk.GetImageFromArray(np.ascontiguousarray(array)))
    return float(found.GetThreshold())


def _solid(mask: Mask, volume: Volume) -> Mask:
    """Closed over dark skin and bone, filled slice by slice, without spikes."""
    reach = np.ceil(_CLOSE_MM / volume.spacing[::-1]).astype(int) + 1
    inner = tuple(slice(r, -r) for r in reach)
    padded = np.pad(mask, [(r, r) for r in reach], mode="edge")
    closed = binary_closing(padded, ball(_CLOSE_MM, volume.spacing))[inner] | mask
    filled = fill_slices(closed)
    opened = binary_opening(
        np.pad(filled, [(r, r) for r in reach], mode="edge"), ball(_OPEN_MM, volume.spacing)
    )
    return fill_slices(opened[inner])


def _largest(mask: Mask) -> Mask:
    parts, count = connected(mask)
    if count == 0:
        return mask
    return parts == int(np.argmax(np.bincount(parts.ravel())[1:])) + 1


def fill_slices(mask: Mask) -> Mask:
    """Holes filled within each slice: a bone that reaches the image's end is a hole there, not in 3-D."""
    return np.stack([binary_fill_holes(plane) for plane in mask])


def ball(radius_mm: float, spacing: NDArray[np.float64]) -> Mask:
    """A ball in physical size as a structuring element ``[k, j, i]``."""
    steps = spacing[::-1]
    axes = [np.arange(-n, n + 1) * s for n, s in zip((radius_mm / steps).astype(int), steps)]
    grid = np.meshgrid(*axes, indexing="ij")
    return sum(x * x for x in grid) <= radius_mm**2 + 1e-9


def bias_field(volume: Volume, limb: Mask) -> Field:
    """The smooth factor of the coil's sensitivity inside the limb (N4, Tustison et al. 2010)."""
    image = volume.to_sitk()
    mask = sitk.GetImageFromArray(limb.astype(np.uint8))
    mask.CopyInformation(image)
    factors = [max(1, round(_BIAS_GRID_MM / s)) for s in volume.spacing]
    n4 = sitk.N4BiasFieldCorrectionImageFilter()
    n4.SetMaximumNumberOfIterations(_BIAS_ITERATIONS)
    n4.Execute(sitk.Shrink(image, factors), sitk.Shrink(mask, factors))
    log_field = sitk.GetArrayFromImage(n4.GetLogBiasFieldAsImage(image))
    return np.exp(np.clip(log_field, -1.5, 1.5))


def muscle_level(smooth: Field, limb: Mask) -> float:
    """The commonest grey level inside the limb, air and cortical bone left out."""
    inside = smooth[limb]
    top = float(np.percentile(inside, 99.5))
    counts, edges = np.histogram(inside, 80, (0.0, top))
    counts = np.convolve(counts, np.ones(3) / 3, mode="same")
    start = 8
    best = start + int(np.argmax(counts[start:]))
    return float(edges[best] + edges[best + 1]) / 2
