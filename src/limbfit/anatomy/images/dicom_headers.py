"""The geometry in the headers of DICOM images: one image per file, or many frames in one.

Only the tags named here are read, so that no identity enters the program. An enhanced multi-frame file
(Enhanced MR or CT) holds its geometry in functional groups: those shared by all frames, and those of each
(DICOM PS3.3, C.7.6.16).
"""

import hashlib
import logging
import re
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pydicom
import SimpleITK as sitk  # noqa: N813
from pydicom.dataset import Dataset, FileDataset
from pydicom.errors import InvalidDicomError

from ...arrays import Array
from ...errors import ImageError, InputError

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
def redact_errors(error: InputError) -> Iterator[None]:
    """Raise ``error`` in place of whatever pydicom and ITK raise, and silence them; limbfit's errors pass.

    Their errors and warnings quote values of tags and names of files.
    """
    log = logging.getLogger("pydicom")
    shown, disabled = sitk.ProcessObject.GetGlobalWarningDisplay(), log.disabled
    sitk.ProcessObject.SetGlobalWarningDisplay(False)
    log.disabled = True
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    except InputError:
        raise
    except Exception:
        raise error from None
    finally:
        sitk.ProcessObject.SetGlobalWarningDisplay(shown)
        log.disabled = disabled


def read_headers(path: Path) -> list[SliceHeader] | None:
    """The slices of one file; an empty list for DICOM without an image, None for what is not DICOM at all.
    Raises `ImageError` for a damaged file; its text does not name it.
    """
    damaged = ImageError("the DICOM file is cut short or damaged", remedy="export the series again")
    with redact_errors(damaged):
        try:
            tags = pydicom.dcmread(path, stop_before_pixels=True, specific_tags=list(_TAGS))
        except InvalidDicomError:
            head = path.read_bytes()[: _PREAMBLE + 4] if path.stat().st_size < 10_000 else b"?"
            is_zero = len(head) < _PREAMBLE + 4 and not any(head)
            if is_zero or path.suffix.lower() in (".dcm", ".ima"):  # the beginning of one, or all zeros
                raise damaged from None
            return None
        if "Segmentation" in _find_class_name(tags):  # beside its image, not one of its series
            return []
        if "Rows" not in tags or "Columns" not in tags:
            kind = tags.file_meta.get("MediaStorageSOPClassUID") or tags.get("SOPClassUID")
            if kind is None or kind.name.endswith(_IMAGE_CLASS):  # one that has them, or cut short before
                raise damaged
            return []
        return _read_slices(tags, path)


def _find_class_name(tags: FileDataset) -> str:
    """The name of the storage class; empty where the file ends before it."""
    return tags.SOPClassUID.name if tags.get("SOPClassUID") is not None else ""


def _read_slices(tags: FileDataset, path: Path) -> list[SliceHeader]:
    """A slice for each frame of an enhanced file, and the one of any other file."""
    frames = int(tags.get("NumberOfFrames", 1) or 1)
    if "PerFrameFunctionalGroupsSequence" not in tags and _find_class_name(tags) not in _ENHANCED:
        if frames > 1:
            raise ImageError(
                "multi-frame images without a place for each frame",
                file=path.parent,
                remedy="export the original series, as enhanced MR or CT or as one file per slice",
            )
        return [_read_slice(tags, path, lambda _, tag: tags.get(tag))]
    groups = tags.get("PerFrameFunctionalGroupsSequence") or []
    if len(groups) != frames:
        raise ImageError(
            "an enhanced DICOM file does not say where each of its frames lies",
            file=path.parent,
            remedy="export the series again, or as one file per slice",
        )
    shared = (tags.get("SharedFunctionalGroupsSequence") or [Dataset()])[0]

    def read_from(group: Dataset) -> Callable[[str, str], object]:
        return lambda sequence, tag: find_functional_group((group, shared), sequence).get(tag)

    return [_read_slice(tags, path, read_from(group), n) for n, group in enumerate(groups)]


def _read_slice(
    tags: FileDataset, path: Path, read: Callable[[str, str], object], frame: int | None = None
) -> SliceHeader:
    """One slice; ``read`` gives the value of a tag in the functional group of a name."""
    slope = _to_number(read("PixelValueTransformationSequence", "RescaleSlope"))
    intercept = _to_number(read("PixelValueTransformationSequence", "RescaleIntercept"))
    uid = str(tags.get("SeriesInstanceUID", ""))
    if re.fullmatch(r"[0-9.]{0,64}", uid) is None:  # someone typed into it, and it will be shown
        uid = "x" + hashlib.sha256(uid.encode()).hexdigest()[:12]
    return SliceHeader(
        path=path,
        series_uid=uid,
        series_number=str(tags.get("SeriesNumber", "") or ""),
        modality=str(tags.get("Modality", "")),
        rows=int(tags.Rows),
        columns=int(tags.Columns),
        samples=int(tags.get("SamplesPerPixel", 1)),
        photometric=str(tags.get("PhotometricInterpretation", "")),
        position=_to_numbers(read("PlanePositionSequence", "ImagePositionPatient"), 3),
        orientation=_to_numbers(read("PlaneOrientationSequence", "ImageOrientationPatient"), 6),
        pixel_spacing=_to_numbers(read("PixelMeasuresSequence", "PixelSpacing"), 2),
        stated_spacing=_to_number(read("PixelMeasuresSequence", "SpacingBetweenSlices")),
        thickness=_to_number(read("PixelMeasuresSequence", "SliceThickness")),
        syntax=str(tags.file_meta.get("TransferSyntaxUID", "")),
        frame=frame,
        rescale=(1.0 if slope is None else slope, 0.0 if intercept is None else intercept),
    )


def find_functional_group(groups: tuple[Dataset, Dataset], name: str) -> Dataset:
    """A functional group of a frame: its own, else the one shared by all frames, else an empty one."""
    return next((items[0] for group in groups if (items := group.get(name))), Dataset())


def _to_numbers(value: object, count: int) -> Array | None:
    if value is None or not hasattr(value, "__len__") or len(value) != count:
        return None
    numbers = np.array([float(v) for v in value])  # type: ignore[attr-defined]
    return numbers if np.all(np.isfinite(numbers)) else None


def _to_number(value: object) -> float | None:
    return float(str(value)) if value not in (None, "") else None
