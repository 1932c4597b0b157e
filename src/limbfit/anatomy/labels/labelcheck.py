"""A label map from outside: put on its image's grid, without stray pieces; what is ambiguous is refused."""

from pathlib import Path

import numpy as np
from scipy.ndimage import binary_fill_holes
from scipy.ndimage import label as connected

from ...arrays import Mask
from ...errors import LabelError, add_location
from ..grid import SOFT_NAMES, Grid, LabelMap, Volume
from ..morphology import find_box

# A second piece this large beside the largest is no stray: another limb, or another bone.
_MAX_STRAY_SHARE = 0.2
_MAX_BONE_SHARE = 0.8
_ON_GRID = 0.01  # voxels


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
