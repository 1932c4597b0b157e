"""What the headers of DICOM images say of their geometry: one image per file, or many frames in one.

Only the tags named here are read, so that no identity enters the program. An enhanced multi-frame file
(Enhanced MR or CT) holds its geometry in functional groups: those shared by all frames, and those of each
(DICOM PS3.3, C.7.6.16).
"""

from __future__ import annotations

import hashlib
import logging
import re
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pydicom
import SimpleITK as sitk  # noqa: N813
from pydicom.dataset import Dataset, FileDataset
from pydicom.errors import InvalidDicomError

from ...arrays import Array
from ...errors import ImageError

_TAGS = [
    "SOPClassUID",
    "SeriesInstanceUID",
    "SeriesNumber",
    "Modality",
    "ImagePositionPatient",
    "ImageOrientationPatient",
    "PixelSpacing",
    "SpacingBetweenSlices",
    "SliceThickness",
    "Rows",
    "Columns",
    "SamplesPerPixel",
    "PhotometricInterpretation",
    "NumberOfFrames",
    "RescaleSlope",
    "RescaleIntercept",
    "SharedFunctionalGroupsSequence",
    "PerFrameFunctionalGroupsSequence",
]
_PREAMBLE = 128  # bytes before "DICM"
_IMAGE_CLASS = "Image Storage"
_ENHANCED = ("Enhanced MR Image Storage", "Enhanced CT Image Storage", "Enhanced PET Image Storage")


@dataclass(frozen=True)
class SliceHeader:
    """Where one slice lies; ``position``, ``orientation``, ``pixel_spacing`` are None where nothing says it.

    ``frame`` is the slice's index in a file of many frames, and None in a file of one image; ``rescale`` is
    slope and intercept of its stored values.
    """

    path: Path
    series_uid: str
    series_number: str
    modality: str
    rows: int
    columns: int
    samples: int
    photometric: str
    position: Array | None
    orientation: Array | None
    pixel_spacing: Array | None
    stated_spacing: float | None
    thickness: float | None
    syntax: str
    frame: int | None = None
    rescale: tuple[float, float] = (1.0, 0.0)


@contextmanager
def silence_readers() -> Iterator[None]:
    """Silence pydicom and ITK, whose warnings quote values of tags and names of files."""
    log = logging.getLogger("pydicom")
    shown, disabled = sitk.ProcessObject.GetGlobalWarningDisplay(), log.disabled
    sitk.ProcessObject.SetGlobalWarningDisplay(False)
    log.disabled = True
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        sitk.ProcessObject.SetGlobalWarningDisplay(shown)
        log.disabled = disabled


def read_headers(path: Path) -> list[SliceHeader] | None:
    """The slices of one file; an empty list for DICOM without an image, None for what is not DICOM at all.

    Raises
    ------
    ImageError
        For a damaged file; its text does not name it.
    """
    damaged = ImageError("the DICOM file is cut short or damaged", remedy="export the series again")
    try:
        with silence_readers():
            tags = pydicom.dcmread(path, stop_before_pixels=True, specific_tags=list(_TAGS))
            if _is_segmentation(tags):
                return []
            if "Rows" not in tags or "Columns" not in tags:
                if _is_image_class(tags):
                    raise damaged
                return []
            return _read_frames(tags, path) if _is_enhanced(tags) else [_read_single(tags, path)]
    except InvalidDicomError:
        if _is_torn(path):
            raise damaged from None
        return None
    except ImageError:
        raise
    except Exception:  # pydicom raises whatever a damaged value makes it raise, with the value in the text
        raise damaged from None


def _is_torn(path: Path) -> bool:
    """Whether something that is not DICOM looks like the beginning of it, or like nothing at all."""
    head = path.read_bytes()[: _PREAMBLE + 4] if path.stat().st_size < 10_000 else b"?"
    is_zero = len(head) < _PREAMBLE + 4 and not any(head)
    return is_zero or path.suffix.lower() in (".dcm", ".ima")


def _is_image_class(tags: FileDataset) -> bool:
    """Whether a file without rows and columns is of a class that has them, or breaks off before its class."""
    kind = tags.file_meta.get("MediaStorageSOPClassUID") or tags.get("SOPClassUID")
    return kind is None or kind.name.endswith(_IMAGE_CLASS)


def _is_segmentation(tags: FileDataset) -> bool:
    """A DICOM-SEG beside its image has rows and frames too, but is not one of its series."""
    kind = tags.get("SOPClassUID")
    return kind is not None and "Segmentation" in kind.name


def _is_enhanced(tags: FileDataset) -> bool:
    kind = tags.get("SOPClassUID")
    return "PerFrameFunctionalGroupsSequence" in tags or (kind is not None and kind.name in _ENHANCED)


def _read_single(tags: FileDataset, path: Path) -> SliceHeader:
    if int(tags.get("NumberOfFrames", 1) or 1) > 1:
        raise ImageError(
            "multi-frame images without a place for each frame",
            file=path.parent,
            remedy="export the original series, as enhanced MR or CT or as one file per slice",
        )
    return SliceHeader(
        **_read_file_geometry(tags, path),
        position=_to_numbers(tags.get("ImagePositionPatient"), 3),
        orientation=_to_numbers(tags.get("ImageOrientationPatient"), 6),
        pixel_spacing=_to_numbers(tags.get("PixelSpacing"), 2),
        stated_spacing=_number(tags.get("SpacingBetweenSlices")),
        thickness=_number(tags.get("SliceThickness")),
        rescale=_rescale(tags),
    )


def _rescale(tags: Dataset) -> tuple[float, float]:
    slope, intercept = _number(tags.get("RescaleSlope")), _number(tags.get("RescaleIntercept"))
    return (1.0 if slope is None else slope, 0.0 if intercept is None else intercept)


def _read_file_geometry(tags: FileDataset, path: Path) -> dict:
    return {
        "path": path,
        "series_uid": _redact_uid(str(tags.get("SeriesInstanceUID", ""))),
        "series_number": str(tags.get("SeriesNumber", "") or ""),
        "modality": str(tags.get("Modality", "")),
        "rows": int(tags.Rows),
        "columns": int(tags.Columns),
        "samples": int(tags.get("SamplesPerPixel", 1)),
        "photometric": str(tags.get("PhotometricInterpretation", "")),
        "syntax": str(tags.file_meta.get("TransferSyntaxUID", "")),
    }


def _redact_uid(uid: str) -> str:
    """The UID as it will be shown; one that is not digits and dots (someone typed into it) as a digest."""
    is_uid = re.fullmatch(r"[0-9.]{0,64}", uid) is not None
    return uid if is_uid else "x" + hashlib.sha256(uid.encode()).hexdigest()[:12]


def _read_frames(tags: FileDataset, path: Path) -> list[SliceHeader]:
    """A slice for each frame of an enhanced file."""
    groups = tags.get("PerFrameFunctionalGroupsSequence") or []
    if not groups or len(groups) != int(tags.get("NumberOfFrames", 1) or 1):
        raise ImageError(
            "an enhanced DICOM file does not say where each of its frames lies",
            file=path.parent,
            remedy="export the series again, or as one file per slice",
        )
    shared = (tags.get("SharedFunctionalGroupsSequence") or [Dataset()])[0]
    file = _read_file_geometry(tags, path)
    return [_read_frame(n, (group, shared), file) for n, group in enumerate(groups)]


def _read_frame(number: int, groups: tuple[Dataset, Dataset], file: dict) -> SliceHeader:
    measures = find_functional_group(groups, "PixelMeasuresSequence")
    values = find_functional_group(groups, "PixelValueTransformationSequence")
    return SliceHeader(
        **file,
        position=_to_numbers(
            find_functional_group(groups, "PlanePositionSequence").get("ImagePositionPatient"), 3
        ),
        orientation=_to_numbers(
            find_functional_group(groups, "PlaneOrientationSequence").get("ImageOrientationPatient"), 6
        ),
        pixel_spacing=_to_numbers(measures.get("PixelSpacing"), 2),
        stated_spacing=_number(measures.get("SpacingBetweenSlices")),
        thickness=_number(measures.get("SliceThickness")),
        frame=number,
        rescale=_rescale(values),
    )


def find_functional_group(groups: tuple[Dataset, Dataset], name: str) -> Dataset:
    """A functional group of a frame: its own, else the one shared by all frames, else an empty one."""
    for group in groups:
        items = group.get(name)
        if items:
            return items[0]
    return Dataset()


def _to_numbers(value: object, count: int) -> Array | None:
    if value is None or not hasattr(value, "__len__") or len(value) != count:
        return None
    numbers = np.array([float(v) for v in value])  # type: ignore[attr-defined]
    return numbers if np.all(np.isfinite(numbers)) else None


def _number(value: object) -> float | None:
    return float(str(value)) if value not in (None, "") else None
