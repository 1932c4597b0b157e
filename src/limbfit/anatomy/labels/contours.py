"""Contours: closed polygons on the slices of an image, as masks, as label maps and as one CSV file.

A voxel belongs to a structure where its centre lies inside an odd number of the structure's contours of that
slice, so a contour inside another is a hole, as is the inner part of a keyhole contour (DICOM PS3.3,
C.8.8.6).

The file has one row for each point, with the header ``label,slice,contour,x_mm,y_mm,z_mm``: the name of the
structure; the slice of the image, counted from 0; the number of the contour on that slice; the point in LPS
mm. The last point of a contour is joined to its first. The points decide; the slice is for readers.
"""

import csv
from collections import defaultdict
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from contourpy import contour_generator

from ...arrays import Array, Mask
from ...errors import LabelError, add_location
from ..grid import SOFT_TISSUE, Grid, LabelMap, Volume
from .labelfiles import flatten, normalise_name

COLUMNS = ("label", "slice", "contour", "x_mm", "y_mm", "z_mm")
_OFF_SLICE = 0.1  # slices: farther off, a contour was not drawn on this image
_FORMAT = "give the columns " + ",".join(COLUMNS)


def rasterise_polygons(polygons: Sequence[Array], like: Grid) -> Mask:
    """``[k, j, i]`` voxels whose centre lies inside, by even-odd; ``polygons`` (n, 3) each, LPS mm. Raises
    `LabelError` for polygons that do not lie on the grid's slices, lie outside it, or leave slices out.
    """
    slices: dict[int, list[Array]] = defaultdict(list)
    for polygon in polygons:
        index = like.point_to_index(polygon)
        k = round(float(index[:, 2].mean()))
        if np.abs(index[:, 2] - k).max() > _OFF_SLICE:
            raise LabelError(
                "contours that do not lie on the slices of the image",
                remedy="give the image on which they were drawn",
            )
        slices[k].append(index[:, :2])
    if not slices:
        raise LabelError("no contours", remedy="draw at least one closed contour")
    if min(slices) < 0 or max(slices) >= like.size[2]:
        raise LabelError("contours outside the image", remedy="give the image on which they were drawn")
    absent = max(slices) - min(slices) + 1 - len(slices)
    if absent:
        raise LabelError(
            f"{absent} slices without a contour between others",
            remedy="interpolate the contours in the program that drew them",
        )
    mask = np.zeros(like.array.shape, dtype=bool)
    for k, found in slices.items():
        mask[k] = fill_even_odd(found, like.size[0], like.size[1])
    return mask


def fill_even_odd(polygons: Sequence[Array], columns: int, rows: int) -> Mask:
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


def find_outlines(mask: Mask) -> list[Array]:
    """Closed polygons (n, 2) of a slice's mask ``[j, i]`` as (i, j), half-way between pixel centres."""
    if not mask.any():
        return []
    padded = np.pad(mask, 1).astype(float)
    lines = contour_generator(z=padded).lines(0.5)
    return [np.asarray(line)[:-1] - 1.0 for line in lines]


def write_contours(path: str | Path, labels: LabelMap) -> None:
    """Contours of a label map: of the whole limb, named ``soft tissue``, and of each other label.

    Read again on the same grid they give the same label map: where structures overlap, the smaller wins.
    """
    masks = {SOFT_TISSUE: labels.limb}
    masks |= {name: labels.mask(name) for name in labels.names.values() if name != SOFT_TISSUE}
    with Path(path).open("w", encoding="utf-8", newline="") as stream:
        rows = csv.writer(stream)
        rows.writerow(COLUMNS)
        for name, mask in masks.items():
            for k in np.flatnonzero(mask.any(axis=(1, 2))):
                for n, line in enumerate(find_outlines(mask[k])):
                    index = np.column_stack([line, np.full(len(line), k)])
                    points = labels.index_to_point(index)
                    rows.writerows([name, k, n, *(f"{x:.4f}" for x in point)] for point in points)


def read_contours(path: str | Path, like: Volume) -> LabelMap:
    """The label map of a contour file on the grid of the image on which the contours were drawn.

    Raises
    ------
    LabelError
        With the file and the line or the structure.
    """
    with add_location(file=path):
        return build_labels([*_read_polygons(Path(path)).items()], like)


def _read_polygons(path: Path) -> dict[str, list[Array]]:
    """The contours (n, 3) of each structure of a file, LPS mm."""
    found: dict[str, dict[tuple[int, int], list[list[float]]]] = defaultdict(lambda: defaultdict(list))
    for line, row in _read_rows(path):
        try:
            name, key = normalise_name(row["label"]), (int(row["slice"]), int(row["contour"]))
            point = [float(row[axis]) for axis in COLUMNS[3:]]
        except (TypeError, ValueError):
            point = []
        if not point or not np.all(np.isfinite(point)):
            raise LabelError("not a point of a contour", place=f"line {line}", remedy=_FORMAT)
        found[name][key].append(point)
    for name, contours in found.items():
        short = [key for key, points in contours.items() if len(points) < 3]
        if short:
            raise LabelError("a contour of fewer than 3 points", place=f"{name}, slice {short[0][0]}")
    return {name: [np.array(points) for points in contours.values()] for name, contours in found.items()}


def build_labels(structures: Sequence[tuple[str, Sequence[Array]]], like: Grid) -> LabelMap:
    """Structures, by name and contours (LPS mm), as a label map on the grid of ``like``.

    Raises
    ------
    LabelError
        With the structure that cannot be rasterised, or for two of one name.
    """
    masks = []
    for name, polygons in structures:
        with add_location(place=name):
            masks.append(rasterise_polygons(polygons, like))
    array, names = flatten(masks, [name for name, _ in structures])
    return LabelMap(array, *like.geometry, names)


def _read_rows(path: Path) -> Iterator[tuple[int, dict[str, str]]]:
    """Rows of the file with the number of their line."""
    try:
        with path.open(encoding="utf-8-sig", newline="") as stream:
            rows = csv.DictReader(stream)
            if rows.fieldnames is None or any(name not in rows.fieldnames for name in COLUMNS):
                raise LabelError("not a file of contours", remedy=_FORMAT)
            for row in rows:
                yield rows.line_num, row
    except (OSError, UnicodeDecodeError, csv.Error):
        raise LabelError("the contours cannot be read", remedy=_FORMAT) from None
