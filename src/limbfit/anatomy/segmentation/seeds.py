"""Bones chosen and named by seeds: points that a user put into them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import SimpleITK as sitk  # noqa: N813
from numpy.typing import ArrayLike, NDArray

from ...errors import ImageError
from ..grid import Grid
from ..surfaces.extraction import compute_signed_distance_to

Mask = NDArray[np.bool_]

_NEAR_MM = 3.0  # a seed this near to a bone is in it


def grow_from_seeds(
    bones: Sequence[Mask], seeds: Mapping[str, ArrayLike], grid: Grid
) -> tuple[list[Mask], list[str]]:
    """One bone for each name: the pieces that hold its seeds; a piece with seeds of several names is divided.

    Parameters
    ----------
    bones : masks ``[k, j, i]`` on the grid.
    seeds : (n, 3) points in LPS mm for each name.

    Raises
    ------
    ImageError
        For a seed in no bone.
    """
    names = list(seeds)
    found = [np.zeros(grid.array.shape, dtype=bool) for _ in names]
    holders: dict[int, dict[int, list[tuple[int, int, int]]]] = {}
    for n, name in enumerate(names):
        for point in np.asarray(seeds[name], dtype=float).reshape(-1, 3):
            voxel, piece = _find_piece(point, bones, grid, name)
            holders.setdefault(piece, {}).setdefault(n, []).append(voxel)
    for piece, marked in holders.items():
        if len(marked) == 1:
            found[next(iter(marked))] |= bones[piece]
            continue
        divided = _divide_piece(bones[piece], marked, grid)
        for n in marked:
            found[n] |= divided == n + 1
    return found, names


def _find_piece(
    point: NDArray[np.float64], bones: Sequence[Mask], grid: Grid, name: str
) -> tuple[tuple[int, int, int], int]:
    """The voxel ``(k, j, i)`` of the nearest bone, and which bone that is."""
    index = grid.point_to_index(point)
    reach = np.ceil(_NEAR_MM / grid.spacing).astype(int)
    low = np.maximum(np.round(index).astype(int) - reach, 0)[::-1]
    high = np.maximum(np.round(index).astype(int) + reach + 1, 0)[::-1]
    box = tuple(slice(a, b) for a, b in zip(low, high))
    best, nearest = None, _NEAR_MM
    for piece, bone in enumerate(bones):
        inside = np.argwhere(bone[box]) + low
        if len(inside) == 0:
            continue
        away = np.linalg.norm((inside[:, ::-1] - index) * grid.spacing, axis=1)
        if away.min() <= nearest:
            k, j, i = inside[int(away.argmin())]
            best, nearest = ((int(k), int(j), int(i)), piece), float(away.min())
    if best is None:
        place = ", ".join(f"{x:g}" for x in point)
        raise ImageError(
            f"the seed of {name!r} at ({place}) mm lies in no bone that was found",
            remedy="put it into the bone (LPS, mm), or label the bone by hand (segmentation.labels)",
        )
    return best


def _divide_piece(
    bone: Mask, marked: Mapping[int, list[tuple[int, int, int]]], grid: Grid
) -> NDArray[np.uint8]:
    """One piece parted between names where it is thinnest (watershed of the depth); values are name + 1."""
    depth = compute_signed_distance_to(bone, grid)
    markers = np.zeros(bone.shape, dtype=np.uint8)
    markers[~bone] = 255
    for n, voxels in marked.items():
        for voxel in voxels:
            markers[voxel] = n + 1
    basins = sitk.MorphologicalWatershedFromMarkers(
        sitk.GetImageFromArray(-depth), sitk.GetImageFromArray(markers), False, True
    )
    return np.where(bone, sitk.GetArrayFromImage(basins), 0).astype(np.uint8)
