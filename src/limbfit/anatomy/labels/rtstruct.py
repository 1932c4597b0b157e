"""DICOM RT Structure Sets: closed contours on the slices of an image, as a label map on its grid."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pydicom
from pydicom.dataset import FileDataset

from ...arrays import Array
from ...errors import LabelError
from ..grid import LabelMap, Volume
from ..images.dicom_headers import silence_readers
from .contours import build_labels
from .naming import normalise_name

STRUCTURE_SET = "1.2.840.10008.5.1.4.1.1.481.3"


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
        with silence_readers():
            contours = _read_contours(pydicom.dcmread(path))
    except Exception:  # pydicom's texts quote values of tags
        raise LabelError("the structure set is damaged", file=path, remedy="export it again") from None
    return build_labels(contours, like, path)


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
