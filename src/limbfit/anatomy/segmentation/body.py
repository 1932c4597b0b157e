"""The limb in the image: whether it is one, its outline without supports, bias field, muscle and fat.

T1 and UTE images are alike, by grey levels relative to muscle. CT has Hounsfield units.

Supports are tables and cushions that touch the limb. Such a slab is thinner than the limb. Opened by a ball
wider than it, the mask keeps the limb and loses the slab but for the strip under the limb; what is lost and
reaches far out is slab, and the hull of both its wings closes the strip between them.

Subcutaneous fat is what is bright and joined to the skin over more than a thin septum. The skin itself
belongs to it, as in the skin–adipose layer of the model. Marrow, fat between muscles and the septa of fat
that reach in from the skin do not.
"""

from typing import Literal

import numpy as np
import SimpleITK as sitk  # noqa: N813
from scipy import ndimage
from scipy.spatial import ConvexHull, QhullError

from ...arrays import Array, Mask
from ...errors import ImageError
from .. import morphology
from ..grid import Grid, Volume, find_longest_axis, resample_cubic
from ..labels.labelfiles import fill_even_odd
from ..morphology import Field, find_box, find_largest_piece

Contrast = Literal["auto", "T1", "UTE", "CT"]

AIR_HU = -1000.0
_LIGHTEST_HU = -200.0  # every CT of a limb shows something lighter than fat
_DENSEST_AIR_HU = -400.0  # no air is denser, where a grey-value window cut it off
_AIR_WIDTH_HU = 100.0  # half the width of its peak in the histogram
_AIR_SHARE = 0.03  # of the voxels: fewer are an artefact of resampling
_TOP_HU = 100.0  # for the outline bone and soft tissue are the same
_SMOOTH_MM = 0.6
_TISSUE_SHARE = 0.45  # of the median of the tissue: between the noise of air and muscle
_CLOSE_MM = 3.5
_OPEN_MM = 1.5
_RIM_MM = 2.5  # the outline is at half of the brightest tissue this near
_BIAS_GRID_MM = 5.0
_BIAS_ITERATIONS = [25, 20, 15]
_SMALLEST_LIMB_MM3 = 5.0e4
BALL_MM = 20.0  # half the thickness of the thickest slab
_REACH_MM = 15.0  # a support sticks out of the limb by more
_WING_SHARE = 0.15  # of the limb's length, along which it does
_STRIP_MM = 10.0  # how deep the strip under the limb may be
_STEP_MM = 2.0
_COARSE_MM = 4.0
_MIN_SECTION_SHARE = 0.3  # of the largest cross-section of the slice: less is a table, a coil or a marker
_SMALLEST_MM2 = 700.0
_MAX_ELONGATION = 2.5  # a cross-section is rounder than this; a limb cut lengthwise is not
_TWO_LIMBS_SHARE = 0.3  # of the slices with a cross-section
_MIN_SLICES = 8  # slices
SKIN_MM = 1.5  # skin is darker than fat; so deep everything counts as skin
SEPTUM_MM = 1.5  # sheets of fat thinner than twice this are septa
_VESSEL_MM2 = 60.0  # cross-section of the largest vessel in the fat
FAT_HU = (-200.0, -25.0)
_MIN_FAT_LEVEL = 1.5  # of muscle: fat is at least this bright
_USUAL_FAT_LEVEL = 2.0  # where nothing tells how bright fat is
_RIND_MM = 20.0  # tissue so near to the skin shows both fat and muscle
_NEAR_MM, _NEAR_STEP_MM = 14.0, 8.0  # half the edge of a neighbourhood, and how far apart they are
_LOW, _HIGH = 25, 93  # percentiles between which the level is looked for
_ROUNDS = 10
_MIN_SAMPLES = 50  # samples in a neighbourhood
_SAMPLE_MM = 2.5
_NOISE_MM = 0.9


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


def smooth_image(volume: Volume) -> Field:
    """The image without its finest noise: a Gaussian of 0.6 mm, at most 0.6 voxels."""
    sigma = np.minimum(_SMOOTH_MM / volume.spacing[::-1], 0.6)
    return ndimage.gaussian_filter(volume.array, sigma)


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
    darkest = _TISSUE_SHARE * float(np.median(smooth[smooth > _compute_otsu_threshold(smooth)]))
    body = find_largest_piece(smooth > darkest)
    box = find_box(body, np.ceil(_CLOSE_MM / volume.spacing[::-1]).astype(int))
    smooth = smooth[box]
    rough = find_largest_piece(remove_supports(_fill_limb(body[box], volume), volume))
    if rough.sum() * volume.voxel_mm3 < _SMALLEST_LIMB_MM3:
        raise ImageError("no limb was found in the image", remedy="check the series and its contrast")
    half = 0.5 * morphology.find_local_maximum(smooth, _RIM_MM, volume.spacing)
    core = morphology.erode_mask(rough, _RIM_MM, volume.spacing)
    bright = core | (rough & (smooth > np.maximum(half, darkest)))
    limb = np.zeros(body.shape, dtype=bool)
    limb[box] = find_largest_piece(_fill_limb(bright, volume))
    return limb


def _compute_otsu_threshold(array: Field) -> float:
    """Otsu's threshold between air and tissue."""
    found = sitk.OtsuThresholdImageFilter()
    found.Execute(sitk.GetImageFromArray(np.ascontiguousarray(array)))
    return float(found.GetThreshold())


def _fill_limb(mask: Mask, volume: Volume) -> Mask:
    """Close a mask over dark skin and bone, fill it slice by slice and take its spikes off."""
    filled = morphology.fill_slices(morphology.close_mask(mask, _CLOSE_MM, volume.spacing))
    return morphology.fill_slices(morphology.open_mask(filled, _OPEN_MM, volume.spacing))


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


def remove_supports(mask: Mask, grid: Grid) -> Mask:
    """The mask ``[k, j, i]`` (k along the limb) without slabs of up to 40 mm that stick out of the limb."""
    steps = np.maximum((_STEP_MM / grid.spacing[::-1]).astype(int), 1)
    coarse = mask[:: steps[0], :: steps[1], :: steps[2]]
    sampling = grid.spacing[::-1] * steps
    body = _open_limb(coarse, sampling)
    wings = _find_wings(coarse & ~body, body, sampling)
    if not wings.any():
        return mask
    strip = _compute_hulls(wings) & (ndimage.distance_transform_edt(body, sampling=sampling) < _STRIP_MM)
    support = wings | strip
    for axis, step in enumerate(steps):
        support = np.repeat(support, step, axis=axis)
    return np.asarray(mask & ~support[: mask.shape[0], : mask.shape[1], : mask.shape[2]])


def _open_limb(mask: Mask, sampling: Array) -> Mask:
    """Opened by a large ball; beyond the image the limb goes on, beside it there is nothing."""
    reach = np.ceil(2 * BALL_MM / sampling).astype(int) + 1
    padded = np.pad(mask, [(reach[0], reach[0]), (0, 0), (0, 0)], mode="edge")
    padded = np.pad(padded, [(0, 0), (reach[1], reach[1]), (reach[2], reach[2])])
    inner = ndimage.distance_transform_edt(padded, sampling=sampling) > BALL_MM
    opened = ndimage.distance_transform_edt(~inner, sampling=sampling) <= BALL_MM
    return np.asarray(opened[tuple(slice(r, -r) for r in reach)]) & mask


def _find_wings(residue: Mask, body: Mask, sampling: Array) -> Mask:
    """Pieces of the residue that stick far out of the body along much of it."""
    away = ndimage.distance_transform_edt(~body, sampling=sampling)
    length = np.ptp(np.flatnonzero(body.any(axis=(1, 2)))) + 1 if body.any() else 1
    parts, _ = ndimage.label(residue, np.ones((3, 3, 3)))
    wings = np.zeros(residue.shape, dtype=bool)
    for value, box in enumerate(ndimage.find_objects(parts), start=1):
        piece = parts[box] == value
        far = piece & (away[box] > _REACH_MM)
        beside = far.any(axis=(1, 2)) & body[box[0]].any(axis=(1, 2))  # else it is a thin end of the limb
        if beside.sum() > _WING_SHARE * length:
            wings[box] |= piece
    return wings


def _compute_hulls(wings: Mask) -> Mask:
    """The convex hull of each slice."""
    found = wings.copy()
    for k, plane in enumerate(wings):
        points = np.argwhere(plane)[:, ::-1].astype(float)
        if len(points) < 3:
            continue
        try:
            corners = points[ConvexHull(points).vertices]
        except QhullError:  # all on one line
            continue
        found[k] |= fill_even_odd([corners], plane.shape[1], plane.shape[0])
    return found


def check_one_limb(volume: Volume) -> None:
    """Refuse an image whose slices across some axis show two large, roundish sections side by side. Raises
    `ImageError` with the remedy: crop, or give labels.
    """
    tissue, step = _find_tissue(volume)
    for axis in range(3):
        counts = np.array([_count_sections(plane, step) for plane in np.moveaxis(tissue, axis, 0)])
        if (counts > 0).sum() >= _MIN_SLICES and (counts > 1).sum() > _TWO_LIMBS_SHARE * (counts > 0).sum():
            raise ImageError(
                "two limbs in one image",
                remedy="crop the image to one limb, or give its labels (segmentation.labels in study.toml)",
            )


def _find_tissue(volume: Volume) -> tuple[Mask, float]:
    """What is brighter than air (Otsu) on coarse cubic voxels, closed over thin dark bone; their edge, mm."""
    step = max(_COARSE_MM, float(volume.spacing.max()))
    image = sitk.SmoothingRecursiveGaussian(volume.to_sitk(), step / 2)
    coarse = resample_cubic(image, volume, step, sitk.sitkLinear, 0.0)
    tissue = sitk.GetArrayFromImage(sitk.OtsuThreshold(coarse, 0, 1)).astype(bool)
    padded = ndimage.binary_closing(np.pad(tissue, 2), np.ones((3, 3, 3)))
    return padded[2:-2, 2:-2, 2:-2] | tissue, step


def _count_sections(plane: Mask, step: float) -> int:
    """Count the large, roundish sections in a slice."""
    solid = ndimage.binary_opening(np.pad(ndimage.binary_fill_holes(plane), 1, mode="edge"), np.ones((3, 3)))
    parts, count = ndimage.label(solid)
    if count == 0:
        return 0
    areas = np.bincount(parts.ravel())[1:]
    large = (areas > _MIN_SECTION_SHARE * areas.max()) & (areas * step**2 > _SMALLEST_MM2)
    extents = [[part.stop - part.start for part in box] for box in ndimage.find_objects(parts)]
    round_ = np.array([max(sides) <= _MAX_ELONGATION * min(sides) for sides in extents])
    return int((large & round_).sum())


def find_bright_fat(levels: Field, limb: Mask, bones: Mask, depth: Field, spacing: Array) -> Mask:
    """Voxels nearer to fat than to muscle in MRI, as bright as these are in their neighbourhood.

    ``levels`` are relative to muscle, ``depth`` is that below the skin (:func:`compute_depth`). What a coil
    sees less of is darker, fat and muscle alike, and N4 leaves some of that.
    """
    rind = limb & ~bones & (depth < _RIND_MM)
    sigma = _NOISE_MM / spacing[::-1]
    weight = ndimage.gaussian_filter(limb.astype(np.float32), sigma, mode="nearest")
    total = ndimage.gaussian_filter(np.where(limb, levels, 0).astype(np.float32), sigma, mode="nearest")
    mean = total / np.maximum(weight, 1e-3)  # of the neighbourhood inside the limb
    return np.asarray(limb & (mean > _compute_half_way_level(levels, rind, spacing)))


def _compute_half_way_level(levels: Field, rind: Mask, spacing: Array) -> Field:
    """Half-way between muscle and fat around each voxel."""
    every = np.maximum((_SAMPLE_MM / spacing[::-1]).astype(int), 1)
    thinned = tuple(slice(None, None, n) for n in every)
    values, inside = levels[thinned], rind[thinned]
    sampling = spacing[::-1] * every
    half = np.maximum(np.round(_NEAR_MM / sampling).astype(int), 1)
    centres = [
        np.linspace(0, n - 1, max(2, round(n / max(step, 1.0)) + 1))
        for n, step in zip(values.shape, _NEAR_STEP_MM / sampling)
    ]
    found = np.full([len(c) for c in centres], np.nan)
    for place in np.ndindex(*found.shape):
        middle = [int(c[n]) for c, n in zip(centres, place)]
        box = tuple(slice(max(m - h, 0), m + h + 1) for m, h in zip(middle, half))
        near = values[box][inside[box]]
        if len(near) >= _MIN_SAMPLES:
            found[place] = _compute_isodata_level(near)
    if np.isfinite(found).any():
        nearest = ndimage.distance_transform_edt(np.isnan(found), return_distances=False, return_indices=True)
        found = found[tuple(nearest)]
    else:
        found[:] = (1 + _USUAL_FAT_LEVEL) / 2
    k, j, i = (
        _interpolate_places(np.interp(np.arange(n) / e, c, np.arange(len(c))), len(c))
        for n, e, c in zip(levels.shape, every, centres)
    )
    return np.asarray(j @ np.tensordot(k, found.astype(np.float32), 1) @ i.T, dtype=np.float32)


def _compute_isodata_level(values: Field) -> float:
    """The level half-way between two kinds of tissue (isodata); not a number where there is one kind."""
    level = float(np.mean(np.percentile(values, (_LOW, _HIGH))))
    for _ in range(_ROUNDS):
        above = values > level
        if above.all() or not above.any():
            return np.nan
        low, high = float(values[~above].mean()), float(values[above].mean())
        level, before = (low + high) / 2, level
        if level == before:  # more rounds would change nothing
            break
    return level if high > _MIN_FAT_LEVEL * low else np.nan


def _interpolate_places(places: Array, count: int) -> Field:
    """The matrix (n, count) that interpolates ``count`` values linearly at fractional indices (n,)."""
    low = np.minimum(places.astype(int), count - 2)
    rows, part = np.arange(len(places)), (places - low).astype(np.float32)
    weights = np.zeros((len(places), count), dtype=np.float32)
    weights[rows, low], weights[rows, low + 1] = 1 - part, part
    return weights


def select_subcutaneous(bright: Mask, limb: Mask, bones: Mask, depth: Field, spacing: Array) -> Mask:
    """The part of ``bright`` that belongs to the skin's layer, skin included; all masks ``[k, j, i]``.

    The image's ends (first and last k) do not count as skin.
    """
    outer = ~limb | (depth < SKIN_MM)
    layer = _fill_small_holes(bright | outer, spacing) & ~bones
    opened = morphology.open_mask(layer, SEPTUM_MM, spacing)
    joined = ndimage.binary_propagation(outer & opened, mask=opened) | outer
    # What the layer parts from the inner limb belongs to it too.
    rest = limb & ~joined
    joined |= rest & ~find_largest_piece(rest)
    return np.asarray(joined & limb & ~bones)


def _fill_small_holes(mask: Mask, spacing: Array) -> Mask:
    """Vessels and nerves in the fat filled, slice by slice."""
    in_slice = np.zeros((3, 3, 3), dtype=int)
    in_slice[1] = [[0, 1, 0], [1, 1, 1], [0, 1, 0]]
    parts, _ = ndimage.label(~mask, in_slice)
    small = np.bincount(parts.ravel()) * float(spacing[0] * spacing[1]) < _VESSEL_MM2
    small[0] = False
    return np.asarray(mask | small[parts])
