"""DICOM RT Structure Sets: closed contours on the slices of an image, as a label map on its grid.

A voxel belongs to a structure where its centre lies inside an odd number of the structure's contours of that
slice, so a contour inside another is a hole, as is the inner part of a keyhole contour (DICOM PS3.3,
C.8.8.6).
"""

from __future__ import annotations

from collections import defaultdict
from pathlib import Path

import numpy as np
import pydicom
from numpy.typing import NDArray
from pydicom.dataset import FileDataset

from ..errors import LabelError
from .dicom_headers import quiet
from .grid import Grid, LabelMap, Volume
from .naming import flatten, plain_name

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

STRUCTURE_SET = "1.2.840.10008.5.1.4.1.1.481.3"
_OFF_SLICE = 0.1  # slices: farther off, a contour was not drawn on this image


def read_rtstruct(path: Path, like: Volume | None) -> LabelMap:
    """The structures with closed contours, by their names, on the grid of the image.

    Raises
    ------
    LabelError
        Without an image, for contours that do not lie on its slices or leave slices out, or a damaged file.
    """
    if like is None:
        raise LabelError("contours need the image on which they were drawn", file=path)
    try:
        with quiet():
            contours = _contours(pydicom.dcmread(path))
    except Exception:  # pydicom's texts quote values of tags
        raise LabelError("the structure set is damaged", file=path, remedy="export it again") from None
    masks = []
    for name, found in contours.items():
        try:
            masks.append(rasterised(found, like))
        except LabelError as error:
            raise LabelError(error.what, file=path, place=name, remedy=error.remedy) from None
    try:
        array, names = flatten(masks, list(contours))
    except LabelError as error:
        raise LabelError(error.what, file=path, remedy=error.remedy) from None
    return LabelMap(array, like.spacing, like.origin, like.direction, names)


def _contours(data: FileDataset) -> dict[str, list[Array]]:
    """Closed contours, LPS mm, by the name of their structure; structures without any are left out."""
    names = {int(roi.ROINumber): plain_name(roi.ROIName) for roi in data.StructureSetROISequence}
    found: dict[str, list[Array]] = {}
    for item in data.ROIContourSequence:
        closed = [
            np.array(contour.ContourData, dtype=float).reshape(-1, 3)
            for contour in item.get("ContourSequence") or []
            if str(contour.ContourGeometricType) in ("CLOSED_PLANAR", "CLOSEDPLANAR_XOR")
        ]
        if closed:
            found.setdefault(names[int(item.ReferencedROINumber)], []).extend(closed)
    return found


def rasterised(contours: list[Array], grid: Grid) -> Mask:
    """``[k, j, i]`` voxels whose centre lies inside, by even-odd; ``contours`` (n, 3) each, LPS mm."""
    slices: dict[int, list[Array]] = defaultdict(list)
    for contour in contours:
        index = grid.point_to_index(contour)
        k = round(float(index[:, 2].mean()))
        if np.abs(index[:, 2] - k).max() > _OFF_SLICE:
            raise LabelError(
                "contours that do not lie on the slices of the image",
                remedy="give the image on which they were drawn",
            )
        slices[k].append(index[:, :2])
    if min(slices) < 0 or max(slices) >= grid.size[2]:
        raise LabelError("contours outside the image", remedy="give the image on which they were drawn")
    absent = max(slices) - min(slices) + 1 - len(slices)
    if absent:
        raise LabelError(
            f"{absent} slices without a contour between others",
            remedy="interpolate the contours in the program that drew them",
        )
    mask = np.zeros(grid.array.shape, dtype=bool)
    for k, polygons in slices.items():
        mask[k] = even_odd(polygons, grid.size[0], grid.size[1])
    return mask


def even_odd(polygons: list[Array], columns: int, rows: int) -> Mask:
    """(rows, columns) pixels whose centre (i, j) lies inside an odd number of polygons (n, 2).

    Each edge that passes a row's centre line toggles all pixels to its right; an edge takes its lower end and
    not its upper one, so that a corner on the line counts once.
    """
    toggles = np.zeros((rows, columns + 1), dtype=np.int64)
    for polygon in polygons:
        for (x0, y0), (x1, y1) in zip(polygon, np.roll(polygon, -1, axis=0)):
            low, high = min(y0, y1), max(y0, y1)
            j = np.arange(max(int(np.ceil(low)), 0), min(int(np.ceil(high)), rows))
            if len(j) == 0:
                continue
            crossing = x0 + (j - y0) * (x1 - x0) / (y1 - y0)
            np.add.at(toggles, (j, np.clip(np.ceil(crossing), 0, columns).astype(np.int64)), 1)
    return np.cumsum(toggles[:, :columns], axis=1) % 2 == 1
