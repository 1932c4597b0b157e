"""A label map on the grid of its image: by geometry, without interpolation, or not at all."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...errors import LabelError
from ..grid import Grid, LabelMap, Volume

_ON_GRID = 0.01  # voxels


def place_on_grid(labels: LabelMap, like: Volume, path: Path) -> LabelMap:
    """A map of any extent, order and sense of axes on the whole grid of ``like``, voxel by voxel.

    Raises
    ------
    LabelError
        Where the voxels of the two do not coincide, or labelled ones lie outside the image.
    """
    if labels.same_grid(like):
        return labels
    given, labels = labels, _crop_labels(labels.along(like.direction))
    offset = _offset(labels, like)
    if offset is None:
        raise LabelError(
            "the label map is on a different grid from the image",
            file=path,
            remedy=f"image {_format_shape(like)}, labels {_format_shape(given)}: "
            "export it with the image as reference geometry",
        )
    last = offset + np.array(labels.size)
    if np.any(offset < 0) or np.any(last > np.array(like.size)):
        raise LabelError(
            "the label map is on a different grid from the image: labelled voxels lie outside the image",
            file=path,
            remedy="give the image that was labelled, or export the labels with it as reference geometry",
        )
    full = np.zeros(like.array.shape, dtype=np.uint8)
    full[tuple(slice(a, b) for a, b in zip(offset[::-1], last[::-1]))] = labels.array
    return LabelMap(full, like.spacing, like.origin, like.direction, labels.names)


def _crop_labels(labels: LabelMap) -> LabelMap:
    """Without the empty layers around what is labelled; a margin of zeros may lie outside the image."""
    if not labels.array.any():
        return labels
    box = []
    for axis in range(3):
        filled = np.flatnonzero(labels.array.any(axis=tuple(n for n in range(3) if n != axis)))
        box.append(slice(filled[0], filled[-1] + 1))
    start = [part.start for part in box[::-1]]
    return replace(labels, array=labels.array[tuple(box)], origin=labels.index_to_point(start))


def _offset(labels: Grid, like: Grid) -> NDArray[np.int64] | None:
    """First voxel (i, j, k) of ``labels`` on the grid of ``like``, None if voxels do not coincide."""
    ends = np.array(np.meshgrid([0, 1], [0, 1], [0, 1])).reshape(3, -1).T * (np.array(labels.size) - 1.0)
    seen = like.point_to_index(labels.index_to_point(ends))
    whole = np.round(seen[0])
    if np.abs(seen - whole - ends).max() > _ON_GRID:
        return None
    return whole.astype(np.int64)


def _format_shape(grid: Grid) -> str:
    size = " x ".join(str(n) for n in grid.size)
    return f"{size} voxels of {' x '.join(f'{s:.3g}' for s in grid.spacing)} mm"
