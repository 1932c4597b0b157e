"""A label map that came from outside: what is stray is dropped and said, what is ambiguous is refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_fill_holes
from scipy.ndimage import label as connected

from ...errors import LabelError
from ..grid import SOFT_NAMES, LabelMap

Mask = NDArray[np.bool_]

# A second piece this large beside the largest is no stray: another limb, or another bone.
_ISLAND = 0.2
_MOSTLY_BONE = 0.8


def clean_labels(labels: LabelMap, path: Path) -> tuple[LabelMap, list[str]]:
    """The map with one connected limb and each bone in one piece, and sentences on what was changed.

    Raises
    ------
    LabelError
        For values without a name, no soft tissue, two limbs, or a bone in two large pieces.
    """
    try:
        _check_names(labels)
        labels, notes = _keep_one_limb(labels)
        for name in labels.bone_names:
            labels, dropped = _keep_one_piece(labels, name)
            notes += dropped
    except LabelError as error:
        raise LabelError(error.what, file=path, place=error.place, remedy=error.remedy) from None
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
    parts, sizes = _number_pieces(labels.limb)
    if len(sizes) > 1 and np.sort(sizes)[-2] > _ISLAND * sizes.max():
        raise LabelError(
            "two limbs, or a limb in two pieces, in one label map",
            remedy="keep the labels of one limb, in one piece",
        )
    largest = parts == int(np.argmax(sizes)) + 1
    notes = []
    stray = labels.limb & ~largest
    if stray.any():
        notes.append(f"dropped {_describe_pieces(len(sizes) - 1, stray, labels)} apart from the limb")
    array = np.where(largest, labels.array, 0)
    holes = binary_fill_holes(largest) & ~largest
    if holes.any():
        array[holes] = labels.soft_value
        notes.append(
            f"filled {_describe_pieces(len(_number_pieces(holes)[1]), holes, labels, 'hole')} inside the limb"
        )
    return labels.with_array(array), notes


def _keep_one_piece(labels: LabelMap, name: str) -> tuple[LabelMap, list[str]]:
    mask = labels.mask(name)
    if mask.sum() > _MOSTLY_BONE * labels.limb.sum():
        raise LabelError(
            f"{name!r} takes up more than {_MOSTLY_BONE:.0%} of the limb",
            remedy="if it is the soft tissue, name it 'soft tissue'",
        )
    parts, sizes = _number_pieces(mask)
    if len(sizes) < 2:
        return labels, []
    if np.sort(sizes)[-2] > _ISLAND * sizes.max():
        raise LabelError(
            f"{name!r} lies in {int((sizes > _ISLAND * sizes.max()).sum())} large pieces",
            remedy="give each bone its own name, or join the pieces",
        )
    stray = mask & (parts != int(np.argmax(sizes)) + 1)
    array = np.where(stray, labels.soft_value, labels.array)
    pieces = _describe_pieces(len(sizes) - 1, stray, labels)
    said = f"{pieces} of {name!r} apart from the bone became soft tissue"
    return labels.with_array(array), [said]


def _number_pieces(mask: Mask) -> tuple[NDArray[np.int32], NDArray[np.int64]]:
    """The pieces that share faces, numbered from 1, and their sizes in voxels."""
    parts, _ = connected(mask)
    return parts, np.bincount(parts.ravel())[1:]


def _describe_pieces(count: int, mask: Mask, labels: LabelMap, noun: str = "piece") -> str:
    volume = float(mask.sum()) * labels.voxel_mm3 / 1000
    return f"{count} {noun}{'s' if count != 1 else ''} ({volume:.2g} cm3)"
