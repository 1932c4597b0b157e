"""Label maps that are DICOM objects: segmentations (DICOM-SEG) and sets of contours (RTSTRUCT).

A DICOM-SEG has a frame for each slice and segment, as binary masks or as a label map. Frames may cover any
part of the slices, in any order (DICOM PS3.3, A.51). They are put on a grid of their own, and from there on
that of the image.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pydicom
from numpy.typing import NDArray
from pydicom.dataset import FileDataset
from pydicom.errors import InvalidDicomError

from ...arrays import Array, Indices, Mask
from ...errors import LabelError
from ..grid import Grid, LabelMap, Volume
from ..images.dicom_headers import find_functional_group, silence_readers
from .contours import build_labels
from .labelfiles import flatten, normalise_name

SEGMENTATION = ("1.2.840.10008.5.1.4.1.1.66.4", "1.2.840.10008.5.1.4.1.1.66.7")
_ON_SLICE = 0.01  # of the slice spacing
_TILT_MM = 0.01
STRUCTURE_SET = "1.2.840.10008.5.1.4.1.1.481.3"


def find_dicom_labels(path: Path) -> Path | None:
    """The DICOM-SEG or RTSTRUCT that ``path`` is, or that is the only one in it; None for another file.
    Raises `LabelError` for a folder without or with several of them, and for DICOM of another kind.
    """
    if path.is_dir():
        found = [
            file
            for file in sorted(path.rglob("*"))
            if file.is_file() and _find_storage_class(file) is not None
        ]
        if len(found) != 1:
            raise LabelError(
                f"{len(found) or 'no'} DICOM segmentations or structure sets in this folder",
                remedy="name the file",
            )
        return found[0]
    if not path.is_file() or not _is_dicom(path):
        return None
    if _find_storage_class(path) is None:
        raise LabelError(
            "DICOM, but no segmentation and no structure set",
            remedy="give a DICOM-SEG or RTSTRUCT file",
        )
    return path


def read_dicom_labels(path: Path, like: Volume | None) -> LabelMap:
    """The label map of a file that :func:`find_dicom_labels` found."""
    return read_rtstruct(path, like) if _find_storage_class(path) == STRUCTURE_SET else read_dicom_seg(path)


def _is_dicom(path: Path) -> bool:
    with path.open("rb") as stream:
        return stream.read(132)[128:] == b"DICM" or path.suffix.lower() == ".dcm"


def _find_storage_class(path: Path) -> str | None:
    """The storage class, if it is one of a label map."""
    try:
        with silence_readers():
            kind = str(pydicom.dcmread(path, specific_tags=["SOPClassUID"]).get("SOPClassUID", ""))
    except (InvalidDicomError, OSError):
        return None
    except Exception:  # pydicom's texts quote values of tags
        raise LabelError("a damaged DICOM file", remedy="export it again") from None
    return kind if kind in (*SEGMENTATION, STRUCTURE_SET) else None


@dataclass(frozen=True)
class _SegmentFrames:
    """``pixels`` (n, rows, columns); ``segments`` (n,) their numbers, 0 where the pixels are numbers."""

    pixels: NDArray[np.uint16]
    segments: Indices
    positions: Array
    orientation: Array
    pixel_spacing: Array
    slice_spacings: tuple[float, ...]
    names: dict[int, str]


def read_dicom_seg(path: Path) -> LabelMap:
    """The segments of a DICOM-SEG file by their labels, on the grid of its own frames. Raises `LabelError`
    for a fractional segmentation, frames without a place or out of a stack, or a damaged file.
    """
    try:
        with silence_readers():
            frames = _read_frames(pydicom.dcmread(path))
        grid, index = _stack_frames(frames)
        masks = [_build_mask(frames, grid, index, number) for number in frames.names]
        array, names = flatten(masks, list(frames.names.values()))
    except LabelError:
        raise
    except Exception:  # pydicom's texts quote values of tags
        raise LabelError(
            "the DICOM segmentation is damaged or cannot be decoded", remedy="export it again"
        ) from None
    return LabelMap(array, grid.spacing, grid.origin, grid.direction, names)


def _read_frames(data: FileDataset) -> _SegmentFrames:
    kind = str(data.get("SegmentationType", ""))
    if kind not in ("BINARY", "LABELMAP"):
        raise LabelError("a fractional segmentation", remedy="export a binary one")
    groups = [
        (group, data.SharedFunctionalGroupsSequence[0]) for group in data.PerFrameFunctionalGroupsSequence
    ]
    orientations, positions = (
        np.array([getattr(find_functional_group(group, sequence), name) for group in groups], dtype=float)
        for sequence, name in (
            ("PlaneOrientationSequence", "ImageOrientationPatient"),
            ("PlanePositionSequence", "ImagePositionPatient"),
        )
    )
    if np.abs(orientations - orientations[0]).max() > 1e-4:
        raise LabelError("frames of several orientations", remedy="export one for each orientation")
    measures = find_functional_group(groups[0], "PixelMeasuresSequence")
    stated = (measures.get("SpacingBetweenSlices"), measures.get("SliceThickness"))
    segments = [0] * len(groups)
    if kind == "BINARY":
        identities = [find_functional_group(group, "SegmentIdentificationSequence") for group in groups]
        segments = [int(identity.ReferencedSegmentNumber) for identity in identities]
    return _SegmentFrames(
        data.pixel_array.reshape(len(groups), data.Rows, data.Columns),
        np.array(segments),
        positions,
        orientations[0],
        np.array(measures.PixelSpacing, dtype=float),
        tuple(float(s) for s in stated if s),
        {
            int(segment.SegmentNumber): normalise_name(segment.SegmentLabel)
            for segment in data.SegmentSequence
        },
    )


def _stack_frames(frames: _SegmentFrames) -> tuple[Grid, Indices]:
    """The smallest grid that holds all frames, and the slice (n,) of each."""
    rows, columns = frames.orientation[:3], frames.orientation[3:]
    normal = np.cross(rows, columns)
    heights = frames.positions @ normal
    first = frames.positions[np.argmin(heights)]
    sideways = frames.positions - first - np.outer(heights - heights.min(), normal)
    spacing = _slice_spacing(heights, frames.slice_spacings)
    if np.abs(sideways).max() > _TILT_MM or spacing is None:
        raise LabelError("frames that are no stack of slices", remedy="export it with the image as reference")
    index = np.rint((heights - heights.min()) / spacing).astype(np.int64)
    grid = Grid(
        np.zeros((index.max() + 1, *frames.pixels.shape[1:]), np.uint8),
        [frames.pixel_spacing[1], frames.pixel_spacing[0], spacing],  # type: ignore[arg-type]
        first,
        np.column_stack([rows, columns, normal]),
    )
    return grid, index


def _slice_spacing(heights: Array, stated: tuple[float, ...]) -> float | None:
    """A step of which all distances between frames are multiples: the header's, or the smallest gap."""
    above = heights - heights.min()
    gaps = np.diff(np.unique(above))
    for step in (*stated, *gaps[gaps > 1e-3 * max(stated, default=1.0)][:1]):
        off = np.abs(above / step - np.rint(above / step)).max()
        if step > 0 and off <= _ON_SLICE:
            return float(step)
    return None


def _build_mask(frames: _SegmentFrames, grid: Grid, index: Indices, number: int) -> Mask:
    mask = np.zeros(grid.array.shape, dtype=bool)
    for pixels, segment, k in zip(frames.pixels, frames.segments, index):
        if segment == 0:
            mask[k] |= pixels == number
        elif segment == number:
            mask[k] |= pixels > 0
    return mask


def read_rtstruct(path: Path, like: Volume | None) -> LabelMap:
    """The structures with closed contours, by their names, on the grid of the image.

    Raises
    ------
    LabelError
        Without an image, for contours that do not lie on its slices or leave slices out, or a damaged file.
    """
    if like is None:
        raise LabelError("contours need the image on which they were drawn")
    try:
        with silence_readers():
            contours = _read_contours(pydicom.dcmread(path))
    except Exception:  # pydicom's texts quote values of tags
        raise LabelError("the structure set is damaged", remedy="export it again") from None
    return build_labels(contours, like)


def _read_contours(data: FileDataset) -> dict[str, list[Array]]:
    """Closed contours, LPS mm, by the name of their structure; structures without any are left out."""
    names = {int(roi.ROINumber): normalise_name(roi.ROIName) for roi in data.StructureSetROISequence}
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
