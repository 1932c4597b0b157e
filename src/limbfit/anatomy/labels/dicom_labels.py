"""Label maps that are DICOM objects: segmentations (DICOM-SEG) and sets of contours (RTSTRUCT).

A DICOM-SEG has a frame for each slice and segment, as binary masks or as a label map. Frames may cover any
part of the slices, in any order (DICOM PS3.3, A.51). They are put on a grid of their own, and from there on
that of the image.
"""

from pathlib import Path

import numpy as np
import pydicom
from pydicom.dataset import Dataset, FileDataset
from pydicom.errors import InvalidDicomError

from ...arrays import Array, Indices, Mask
from ...errors import LabelError
from ...folders import list_files
from ..grid import Grid, LabelMap, Volume
from ..images.dicom_headers import find_functional_group, redact_errors
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
        found = [file for file in list_files(path) if _find_storage_class(file)]
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
    with redact_errors(LabelError("a damaged DICOM file", remedy="export it again")):
        try:
            kind = str(pydicom.dcmread(path, specific_tags=["SOPClassUID"]).get("SOPClassUID", ""))
        except (InvalidDicomError, OSError):
            return None
    return kind if kind in (*SEGMENTATION, STRUCTURE_SET) else None


def read_dicom_seg(path: Path) -> LabelMap:
    """The segments of a DICOM-SEG file by their labels, on the grid of its own frames. Raises `LabelError`
    for a fractional segmentation, frames without a place or out of a stack, or a damaged file.
    """
    what = "the DICOM segmentation is damaged or cannot be decoded"
    with redact_errors(LabelError(what, remedy="export it again")):
        grid, masks, labels = _read_masks(pydicom.dcmread(path))
        array, names = flatten(masks, [normalise_name(label) for label in labels])
    return LabelMap(array, *grid.geometry, names)


def _read_masks(data: FileDataset) -> tuple[Grid, list[Mask], list[str]]:
    """The smallest grid that holds all frames, and a mask on it and the label of each segment.

    A label map may describe its background as a segment, too (``PixelPaddingValue``): that is none.
    """
    kind = str(data.get("SegmentationType", ""))
    if kind not in ("BINARY", "LABELMAP"):
        raise LabelError("a fractional segmentation", remedy="export a binary one")
    shared = data.SharedFunctionalGroupsSequence[0]
    groups = [(group, shared) for group in data.PerFrameFunctionalGroupsSequence]
    pixels = data.pixel_array.reshape(len(groups), data.Rows, data.Columns)
    grid, slices = _stack_frames(groups, pixels.shape[1:])
    labels = {int(segment.SegmentNumber): segment.SegmentLabel for segment in data.SegmentSequence}
    if kind == "LABELMAP":
        labels.pop(int(data.get("PixelPaddingValue", 0)), None)
    masks = {number: np.zeros(grid.array.shape, dtype=bool) for number in labels}
    for group, plane, k in zip(groups, pixels, slices, strict=True):
        if kind == "BINARY":
            identity = find_functional_group(group, "SegmentIdentificationSequence")
            plane = np.where(plane > 0, int(identity.ReferencedSegmentNumber), 0)
        for number, mask in masks.items():
            mask[k] |= plane == number
    return grid, list(masks.values()), list(labels.values())


def _stack_frames(groups: list[tuple[Dataset, Dataset]], shape: tuple[int, ...]) -> tuple[Grid, Indices]:
    """The grid of frames with these functional groups and a shape (rows, columns), and the slice of each."""
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
    rows, columns = orientations[0, :3], orientations[0, 3:]
    normal = np.cross(rows, columns)
    heights = positions @ normal
    first = positions[np.argmin(heights)]
    sideways = positions - first - np.outer(heights - heights.min(), normal)
    spacing = _find_slice_spacing(heights, tuple(float(s) for s in stated if s))
    if np.abs(sideways).max() > _TILT_MM or spacing is None:
        raise LabelError("frames that are no stack of slices", remedy="export it with the image as reference")
    index = np.rint((heights - heights.min()) / spacing).astype(np.int64)
    pixel = np.array(measures.PixelSpacing, dtype=float)
    grid = Grid(
        np.zeros((index.max() + 1, *shape), np.uint8),
        np.array([pixel[1], pixel[0], spacing]),
        first,
        np.column_stack([rows, columns, normal]),
    )
    return grid, index


def _find_slice_spacing(heights: Array, header_mm: tuple[float, ...]) -> float | None:
    """A step of which all distances between frames are multiples: the header's, or the smallest gap."""
    above = heights - heights.min()
    gaps = np.diff(np.unique(above))
    for step in (*header_mm, *gaps[gaps > 1e-3 * max(header_mm, default=1.0)][:1]):
        off = np.abs(above / step - np.rint(above / step)).max()
        if step > 0 and off <= _ON_SLICE:
            return float(step)
    return None


def read_rtstruct(path: Path, like: Volume | None) -> LabelMap:
    """The structures with closed contours, by their names, on the grid of the image.

    Raises
    ------
    LabelError
        Without an image, for contours that do not lie on its slices or leave slices out, or a damaged file.
    """
    if like is None:
        raise LabelError("contours need the image on which they were drawn")
    with redact_errors(LabelError("the structure set is damaged", remedy="export it again")):
        contours = _read_contours(pydicom.dcmread(path))
    return build_labels(contours, like)


def _read_contours(data: FileDataset) -> list[tuple[str, list[Array]]]:
    """Each structure's name and closed contours, LPS mm; structures without any are left out."""
    names = {int(roi.ROINumber): normalise_name(roi.ROIName) for roi in data.StructureSetROISequence}
    found: dict[int, list[Array]] = {}
    for item in data.ROIContourSequence:
        closed = [
            np.array(contour.ContourData, dtype=float).reshape(-1, 3)
            for contour in item.get("ContourSequence") or []
            if str(contour.ContourGeometricType) in ("CLOSED_PLANAR", "CLOSEDPLANAR_XOR")
        ]
        if closed:
            found.setdefault(int(item.ReferencedROINumber), []).extend(closed)
    return [(names[number], closed) for number, closed in found.items()]
