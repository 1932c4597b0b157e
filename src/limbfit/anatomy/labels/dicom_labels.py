"""Label maps that are DICOM objects: which file holds one, and of which kind."""

from __future__ import annotations

from pathlib import Path

import pydicom
from pydicom.errors import InvalidDicomError

from ...errors import LabelError
from ..grid import LabelMap, Volume
from ..images.dicom_headers import silence_readers
from .dicom_seg import SEGMENTATION, read_dicom_seg
from .rtstruct import STRUCTURE_SET, read_rtstruct


def find_dicom_labels(path: Path) -> Path | None:
    """The DICOM-SEG or RTSTRUCT that ``path`` is, or that is the only one in it; None for another file.

    Raises
    ------
    LabelError
        For a folder without or with several of them, and for DICOM of another kind.
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
                file=path,
                remedy="name the file",
            )
        return found[0]
    if not path.is_file() or not _is_dicom(path):
        return None
    if _find_storage_class(path) is None:
        raise LabelError(
            "DICOM, but no segmentation and no structure set",
            file=path,
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
        raise LabelError("a damaged DICOM file", file=path, remedy="export it again") from None
    return kind if kind in (*SEGMENTATION, STRUCTURE_SET) else None
