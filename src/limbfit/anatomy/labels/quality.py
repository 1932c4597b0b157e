"""What is odd about a label map: volumes, pieces, holes, and slices that do not fit their neighbours."""

import numpy as np
from scipy.ndimage import binary_fill_holes
from scipy.ndimage import label as connected

from ...arrays import Array, Mask
from ...results.limb import LabelMeasures, QualityResult, SuspectSlice
from ..frame import find_longest_axis
from ..grid import SOFT_TISSUE, LabelMap
from ..morphology import find_box

LIMB = "limb"
_OUTLIER = 6.0  # robust standard deviations (1.4826 times the median absolute deviation)
_MIN_AREA_CHANGE, _MIN_AREA_JUMP = 0.08, 0.25  # smaller parts of a slice's area are never odd
_CENTRE_MM = 1.5  # smaller distances of a slice's centroid are never odd
_END_MM = 12.0  # a bone's end is round: its first and last slices may change quickly


def assess_labels(labels: LabelMap) -> QualityResult:
    """Measure every label and the limb as a whole, and name the slices that do not fit their neighbours.

    Slices are counted from 0 along the grid axis of the limb.
    """
    axis = find_longest_axis(labels.limb, labels)
    turned = labels.turn_along(axis)
    masks = {LIMB: turned.limb} | {
        name: turned.mask(name) for _, name in sorted(labels.names.items()) if turned.mask(name).any()
    }
    suspects = [
        SuspectSlice(label=name, slice=k, what=what)
        for name, mask in masks.items()
        if name != SOFT_TISSUE
        for k, what in _find_odd_slices(mask, turned.spacing)
    ]
    return QualityResult(
        axis="ijk"[axis],
        labels={name: _measure_label(mask, turned) for name, mask in masks.items()},
        suspects=sorted(suspects, key=lambda suspect: (suspect.slice, suspect.label)),
    )


def _measure_label(mask: Mask, labels: LabelMap) -> LabelMeasures:
    """Volume, pieces that share faces, closed holes, and the slices from first to last."""
    box = find_box(mask)
    mask = mask[box]
    parts, count = connected(mask)
    sizes = np.bincount(parts[mask])[1:]
    holes = binary_fill_holes(mask) & ~mask
    filled = box[0].start + np.flatnonzero(mask.any(axis=(1, 2)))
    return LabelMeasures(
        volume_cm3=round(float(mask.sum()) * labels.voxel_mm3 / 1000, 3),
        pieces=int(count),
        largest_piece=round(float(sizes.max() / sizes.sum()), 5),
        holes=int(connected(holes)[1]),
        holes_cm3=round(float(holes.sum()) * labels.voxel_mm3 / 1000, 4),
        slices=(int(filled[0]), int(filled[-1])),
        slices_without=int(filled[-1] - filled[0] + 1 - len(filled)),
    )


def _find_odd_slices(mask: Mask, spacing: Array) -> list[tuple[int, str]]:
    """The slices in which a label looks wrong, and why."""
    areas = mask.sum(axis=(1, 2)) * float(spacing[0] * spacing[1])
    filled = np.flatnonzero(areas)
    first, last = int(filled[0]), int(filled[-1])
    empty = [(k, "missing between others") for k in range(first, last) if areas[k] == 0]
    if empty or last - first < 6:
        return empty
    area, centre = areas[first : last + 1], _compute_centroids(mask[first : last + 1], spacing)
    reach = max(1, round(_END_MM / spacing[2]))
    low = reach if first > 0 else 1
    high = len(area) - (reach if last < len(areas) - 1 else 1)
    inner = np.zeros(len(area), dtype=bool)
    inner[low:high] = True
    found = _find_outlying_slices(area, centre, inner)
    known = {k + step for k, _ in found for step in (-1, 0, 1)}
    found += [jump for jump in _find_area_jumps(area, inner) if jump[0] not in known]
    return [(first + k, what) for k, what in found]


def _compute_centroids(mask: Mask, spacing: Array) -> Array:
    """Centroid (n, 2) of each slice, mm."""
    count = mask.sum(axis=(1, 2))
    j, i = np.arange(mask.shape[1]), np.arange(mask.shape[2])
    x = (mask.sum(axis=1) @ i) / count * spacing[0]
    y = (mask.sum(axis=2) @ j) / count * spacing[1]
    return np.column_stack([x, y])


def _find_outlying_slices(area: Array, centre: Array, inner: Mask) -> list[tuple[int, str]]:
    """Slices off the mean of the slice before and the slice after."""
    expected = (area[:-2] + area[2:]) / 2
    off = np.pad((area[1:-1] - expected) / expected, 1)
    aside = np.pad(np.linalg.norm(centre[1:-1] - (centre[:-2] + centre[2:]) / 2, axis=1), 1)
    found = []
    for k in _find_peaks(np.abs(off), np.maximum(_MIN_AREA_CHANGE, _OUTLIER * _spread(off[inner])), inner):
        found.append((k, f"area {off[k]:+.0%} of what its neighbours have"))
    for k in _find_peaks(aside, max(_CENTRE_MM, _OUTLIER * _spread(aside[inner])), inner):
        found.append((k, f"{aside[k]:.1f} mm beside its neighbours"))
    return found


def _find_area_jumps(area: Array, inner: Mask) -> list[tuple[int, str]]:
    """Slices at which the area changes for good."""
    change = np.pad(np.diff(area) / np.maximum(area[1:], area[:-1]), (1, 0))
    limit = max(_MIN_AREA_JUMP, _OUTLIER * _spread(change[inner]))
    return [(k, f"area jumps by {change[k]:+.0%}") for k in _find_peaks(np.abs(change), limit, inner)]


def _spread(values: Array) -> float:
    """Standard deviation of the bulk of the values."""
    return 1.4826 * float(np.median(np.abs(values - np.median(values)))) if len(values) else 0.0


def _find_peaks(values: Array, limit: float, inner: Mask) -> list[int]:
    """Where values pass the limit and are the largest of their neighbours'."""
    padded = np.pad(values, 1)
    highest = (values >= padded[:-2]) & (values >= padded[2:])
    return [int(k) for k in np.flatnonzero(inner & highest & (values > limit))]
