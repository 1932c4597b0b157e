"""A label map from outside: put on its image's grid, without stray pieces; what is ambiguous is refused.

Also what is odd about a label map: volumes, pieces, holes, and slices that do not fit their neighbours.
"""

from pathlib import Path

import numpy as np
from scipy.ndimage import binary_fill_holes
from scipy.ndimage import label as connected

from ...arrays import Array, Mask
from ...errors import LabelError, add_location
from ...results.limb import LabelMeasures, QualityResult, SuspectSlice
from ..grid import SOFT_NAMES, SOFT_TISSUE, Grid, LabelMap, Volume, find_longest_axis
from ..morphology import find_box

# A second piece this large beside the largest is no stray: another limb, or another bone.
_MAX_STRAY_SHARE = 0.2
_MAX_BONE_SHARE = 0.8
_ON_GRID = 0.01  # voxels
LIMB = "limb"
_OUTLIER = 6.0  # robust standard deviations (1.4826 times the median absolute deviation)
_MIN_AREA_CHANGE, _MIN_AREA_JUMP = 0.08, 0.25  # smaller parts of a slice's area are never odd
_CENTRE_MM = 1.5  # smaller distances of a slice's centroid are never odd
_END_MM = 12.0  # a bone's end is round: its first and last slices may change quickly


def clean_labels(labels: LabelMap, path: Path) -> tuple[LabelMap, list[str]]:
    """Return the map with one connected limb and each bone in one piece, and sentences on what was changed.
    Raises `LabelError` for values without a name, no soft tissue, two limbs, or a bone in two large pieces.
    """
    with add_location(file=path):
        _check_names(labels)
        labels, notes = _keep_one_limb(labels)
        for name in labels.bone_names:
            labels, dropped = _keep_one_piece(labels, name)
            notes += dropped
    return labels, notes


def _check_names(labels: LabelMap) -> None:
    present = set(np.unique(labels.array).tolist()) - {0}
    nameless = sorted(present - set(labels.names))
    if nameless:
        raise LabelError(
            "label values without a name: " + ", ".join(str(value) for value in nameless),
            remedy='name them in a file beside it, <file>.json: {"1": "soft tissue", "2": "tibia", ...}',
        )
    if not any(labels.names[value] in SOFT_NAMES for value in present):
        raise LabelError(
            "no label is soft tissue: the map has " + ", ".join(sorted(labels.names[v] for v in present)),
            remedy="label everything inside the skin, the limb's outline too, not only its bones",
        )


def _keep_one_limb(labels: LabelMap) -> tuple[LabelMap, list[str]]:
    largest, others, large = _find_largest(labels.limb)
    if large > 1:
        raise LabelError(
            "two limbs, or a limb in two pieces, in one label map",
            remedy="keep the labels of one limb, in one piece",
        )
    notes = []
    stray = labels.limb & ~largest
    if others:
        notes.append(f"dropped {_describe_pieces(others, stray, labels)} apart from the limb")
    array = np.where(largest, labels.array, 0)
    holes = binary_fill_holes(largest) & ~largest
    if holes.any():
        array[holes] = labels.soft_value
        count = int(connected(holes)[1])
        notes.append(f"filled {_describe_pieces(count, holes, labels, 'hole')} inside the limb")
    return labels.with_array(array), notes


def _keep_one_piece(labels: LabelMap, name: str) -> tuple[LabelMap, list[str]]:
    mask = labels.mask(name)
    if mask.sum() > _MAX_BONE_SHARE * labels.limb.sum():
        raise LabelError(
            f"{name!r} takes up more than {_MAX_BONE_SHARE:.0%} of the limb",
            remedy="if it is the soft tissue, name it 'soft tissue'",
        )
    largest, others, large = _find_largest(mask)
    if not others:
        return labels, []
    if large > 1:
        raise LabelError(
            f"{name!r} lies in {large} large pieces", remedy="give each bone its own name, or join the pieces"
        )
    stray = mask & ~largest
    array = np.where(stray, labels.soft_value, labels.array)
    pieces = _describe_pieces(others, stray, labels)
    return labels.with_array(array), [f"{pieces} of {name!r} apart from the bone became soft tissue"]


def _find_largest(mask: Mask) -> tuple[Mask, int, int]:
    """The largest of the pieces that share faces, how many others there are, and how many are large."""
    parts, count = connected(mask)
    sizes = np.bincount(parts.ravel())[1:]
    large = int((sizes > _MAX_STRAY_SHARE * sizes.max()).sum())
    return parts == int(np.argmax(sizes)) + 1, int(count) - 1, large


def _describe_pieces(count: int, mask: Mask, labels: LabelMap, noun: str = "piece") -> str:
    volume = float(mask.sum()) * labels.voxel_mm3 / 1000
    return f"{count} {noun}{'s' if count != 1 else ''} ({volume:.2g} cm3)"


def place_on_grid(labels: LabelMap, like: Volume) -> LabelMap:
    """A map of any extent, order and sense of axes on the whole grid of ``like``, voxel by voxel. Raises
    `LabelError` where the voxels of the two do not coincide, or labelled ones lie outside the image.
    """
    if labels.has_same_grid(like):
        return labels
    original, labels = labels, labels.align_axes(like.direction)
    if labels.array.any():  # a margin of zeros may lie outside the image
        labels = labels.crop(find_box(labels.limb))
    place = like.point_to_index(labels.index_to_point(labels.corners))
    offset = np.round(place[0]).astype(np.int64)
    if np.abs(place - offset - labels.corners).max() > _ON_GRID:
        raise LabelError(
            "the label map is on a different grid from the image",
            remedy=f"image {_format_shape(like)}, labels {_format_shape(original)}: "
            "export it with the image as reference geometry",
        )
    last = offset + np.array(labels.size)
    if np.any(offset < 0) or np.any(last > np.array(like.size)):
        raise LabelError(
            "the label map is on a different grid from the image: labelled voxels lie outside the image",
            remedy="give the image that was labelled, or export the labels with it as reference geometry",
        )
    full = np.zeros(like.array.shape, dtype=np.uint8)
    full[tuple(slice(a, b) for a, b in zip(offset[::-1], last[::-1]))] = labels.array
    return LabelMap(full, *like.geometry, labels.names)


def _format_shape(grid: Grid) -> str:
    size = " x ".join(str(n) for n in grid.size)
    return f"{size} voxels of {' x '.join(f'{s:.3g}' for s in grid.spacing)} mm"


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
    expected = (area[:-2] + area[2:]) / 2  # the mean of the slice before and the slice after
    off = np.pad((area[1:-1] - expected) / expected, 1)
    aside = np.pad(np.linalg.norm(centre[1:-1] - (centre[:-2] + centre[2:]) / 2, axis=1), 1)
    change = np.pad(np.diff(area) / np.maximum(area[1:], area[:-1]), (1, 0))
    reach = max(1, round(_END_MM / spacing[2]))
    low = reach if first > 0 else 1
    high = len(area) - (reach if last < len(areas) - 1 else 1)
    inner = np.zeros(len(area), dtype=bool)
    inner[low:high] = True
    places = _find_peaks(off, _MIN_AREA_CHANGE, inner)
    found = [(k, f"area {off[k]:+.0%} of what its neighbours have") for k in places]
    places = _find_peaks(aside, _CENTRE_MM, inner)
    found += [(k, f"{aside[k]:.1f} mm beside its neighbours") for k in places]
    known = {k + step for k, _ in found for step in (-1, 0, 1)}
    places = [k for k in _find_peaks(change, _MIN_AREA_JUMP, inner) if k not in known]
    found += [(k, f"area jumps by {change[k]:+.0%}") for k in places]
    return [(first + k, what) for k, what in found]


def _compute_centroids(mask: Mask, spacing: Array) -> Array:
    """Centroid (n, 2) of each slice, mm."""
    count = mask.sum(axis=(1, 2))
    j, i = np.arange(mask.shape[1]), np.arange(mask.shape[2])
    x = (mask.sum(axis=1) @ i) / count * spacing[0]
    y = (mask.sum(axis=2) @ j) / count * spacing[1]
    return np.column_stack([x, y])


def _find_peaks(values: Array, least: float, inner: Mask) -> list[int]:
    """Slices whose values are far from 0: by more than ``least``, than the bulk of them, and than beside."""
    size, bulk = np.abs(values), values[inner]
    spread = 1.4826 * float(np.median(np.abs(bulk - np.median(bulk)))) if len(bulk) else 0.0
    padded = np.pad(size, 1)
    highest = (size >= padded[:-2]) & (size >= padded[2:])
    return [int(k) for k in np.flatnonzero(inner & highest & (size > max(least, _OUTLIER * spread)))]
