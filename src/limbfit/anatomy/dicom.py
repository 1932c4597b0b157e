"""DICOM series on disk: which there are, whether one is a whole volume, and its voxels.

Headers are read with pydicom and only the tags named here, so that no identity enters the program; pixels
with SimpleITK (GDCM), which applies each slice's own rescale. Nothing said to the user names a file inside
the folder or a tag that could identify a person: slices are named by their number along the normal.
"""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pydicom
import SimpleITK as sitk  # noqa: N813
from numpy.typing import NDArray
from pydicom.errors import InvalidDicomError

from ..errors import ImageError
from .grid import Volume

Array = NDArray[np.float64]

_TAGS = [
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
    "NumberOfFrames",
]
_VOLUMES = ("MR", "CT", "PT")
_PLACE_TOLERANCE = 0.02  # of the slice spacing
_AXIS_TOLERANCE = 1e-4


@dataclass(frozen=True)
class SliceHeader:
    """Where one DICOM image lies; ``position`` and ``orientation`` are None when the file does not say."""

    path: Path
    series_uid: str
    series_number: str
    modality: str
    rows: int
    columns: int
    samples: int
    frames: int
    position: Array | None
    orientation: Array | None
    pixel_spacing: Array | None
    stated_spacing: float | None
    thickness: float | None


@dataclass(frozen=True)
class Series:
    """Images that belong together, in the order in which they were found."""

    uid: str
    slices: tuple[SliceHeader, ...]

    @property
    def summary(self) -> str:
        first = self.slices[0]
        number = f"series {first.series_number}, " if first.series_number else ""
        return f"{number}{len(self.slices)} x {first.rows} x {first.columns}, UID {self.uid}"


def list_series(folder: str | Path) -> list[Series]:
    """The image series of a folder, ordered by UID; files that are not DICOM images are passed over."""
    groups: dict[str, list[SliceHeader]] = defaultdict(list)
    for path in sorted(Path(folder).iterdir()):
        header = _read_header(path) if path.is_file() else None
        if header is not None:
            groups[header.series_uid].append(header)
    series = [Series(uid, tuple(slices)) for uid, slices in sorted(groups.items())]
    return [_joined(series)] if _is_one_stack(series) else series


def read_series(folder: str | Path, series_uid: str | None = None) -> Volume:
    """The volume of a DICOM folder.

    Parameters
    ----------
    folder : holds the files of one or more series, in any order, with any names.
    series_uid : which series, where there are several.

    Raises
    ------
    ImageError
        For no or several series, slices missing, doubled, tilted or of different geometry.
    """
    series = _choose(Path(folder), list_series(folder), series_uid)
    try:
        return _read_volume(series)
    except ImageError as error:
        raise ImageError(error.what, file=folder, place=error.place, remedy=error.remedy) from None


def _choose(folder: Path, found: list[Series], uid: str | None) -> Series:
    if not found:
        raise ImageError(
            "no DICOM images in this folder", file=folder, remedy="give the folder that holds the slices"
        )
    if uid is not None:
        chosen = [series for series in found if series.uid == uid]
        if chosen:
            return chosen[0]
        listing = "; ".join(series.summary for series in found)
        raise ImageError(
            "no series of this folder has the UID asked for", file=folder, remedy=f"there are: {listing}"
        )
    if len(found) > 1:
        shown = "; ".join(series.summary for series in found[:6])
        more = f"; and {len(found) - 6} more" if len(found) > 6 else ""
        raise ImageError(
            f"{len(found)} series in one folder",
            file=folder,
            remedy=f"choose one by its UID (image.series in study.toml): {shown}{more}",
        )
    return found[0]


def _read_header(path: Path) -> SliceHeader | None:
    """The geometry tags of one file, or None if it is not a DICOM image."""
    try:
        tags = pydicom.dcmread(path, stop_before_pixels=True, specific_tags=list(_TAGS))
        if "Rows" not in tags or "Columns" not in tags:
            return None
        return SliceHeader(
            path=path,
            series_uid=str(tags.get("SeriesInstanceUID", "")),
            series_number=str(tags.get("SeriesNumber", "") or ""),
            modality=str(tags.get("Modality", "")),
            rows=int(tags.Rows),
            columns=int(tags.Columns),
            samples=int(tags.get("SamplesPerPixel", 1)),
            frames=int(tags.get("NumberOfFrames", 1) or 1),
            position=_numbers(tags.get("ImagePositionPatient"), 3),
            orientation=_numbers(tags.get("ImageOrientationPatient"), 6),
            pixel_spacing=_numbers(tags.get("PixelSpacing"), 2),
            stated_spacing=_number(tags.get("SpacingBetweenSlices")),
            thickness=_number(tags.get("SliceThickness")),
        )
    except InvalidDicomError:
        return None
    except Exception:  # pydicom raises whatever a damaged value makes it raise, with the value in the text
        raise ImageError(
            "a DICOM file of this folder is damaged", file=path.parent, remedy="export the series again"
        ) from None


def _numbers(value: object, count: int) -> Array | None:
    if value is None or not hasattr(value, "__len__") or len(value) != count:
        return None
    numbers = np.array([float(v) for v in value])  # type: ignore[attr-defined]
    return numbers if np.all(np.isfinite(numbers)) else None


def _number(value: object) -> float | None:
    return float(str(value)) if value not in (None, "") else None


def _is_one_stack(series: list[Series]) -> bool:
    """Whether an anonymiser gave each slice of one series its own UID.

    So it is where every series has one image, there are at least three, all with the same series number and
    geometry: two true series would not interleave into one stack, which the gap check still verifies.
    """
    if len(series) < 3 or any(len(one.slices) > 1 for one in series):
        return False
    slices = [one.slices[0] for one in series]
    first = slices[0]
    return all(
        other.series_number == first.series_number and _same_plane_geometry(first, other) for other in slices
    )


def _joined(series: list[Series]) -> Series:
    return Series(series[0].uid, tuple(one.slices[0] for one in series))


def _same_plane_geometry(a: SliceHeader, b: SliceHeader) -> bool:
    return (
        (a.rows, a.columns, a.modality) == (b.rows, b.columns, b.modality)
        and _close(a.orientation, b.orientation)
        and _close(a.pixel_spacing, b.pixel_spacing)
    )


def _close(a: Array | None, b: Array | None) -> bool:
    if a is None or b is None:
        return a is b
    return bool(np.abs(a - b).max() <= _AXIS_TOLERANCE)


def _read_volume(series: Series) -> Volume:
    first = series.slices[0]
    if any(one.frames > 1 for one in series.slices):
        raise ImageError(
            "enhanced multi-frame DICOM is not read",
            remedy="export it as one file per slice, NIfTI or NRRD",
        )
    _check_kind(series)
    for other in series.slices:
        if not _same_plane_geometry(first, other):
            raise ImageError(
                "slices of one series differ in orientation, size or pixel spacing",
                remedy="leave out scout images, or choose another series",
            )
    rows, columns = _axes(first)
    normal = np.cross(rows, columns)
    heights = np.array([slice_.position @ normal for slice_ in series.slices])  # type: ignore[operator]
    order = np.argsort(heights, kind="stable")
    slices = [series.slices[n] for n in order]
    spacing = _slice_spacing(slices, normal)
    array = _read_pixels(slices)
    assert first.pixel_spacing is not None
    return Volume(
        array,
        spacing=np.array([first.pixel_spacing[1], first.pixel_spacing[0], spacing]),
        origin=slices[0].position,
        direction=np.column_stack([rows, columns, normal]),
    )


def _check_kind(series: Series) -> None:
    for one in series.slices:
        if one.modality not in _VOLUMES:
            raise ImageError(
                f"images of modality {one.modality or 'unknown'} are not slices of a volume",
                remedy="give an MR or CT series",
            )
        if one.position is None or one.orientation is None or one.pixel_spacing is None:
            raise ImageError(
                "images do not say where they lie in the patient (position, orientation, pixel spacing)",
                remedy="export the original series, not screen captures",
            )
        if one.samples != 1:
            raise ImageError("colour images", remedy="give the original grey-value series")
    if len(series.slices) < 3:
        raise ImageError(
            f"a volume needs at least three slices, this series has {len(series.slices)}",
            remedy="give the folder that holds all slices",
        )


def _axes(header: SliceHeader) -> tuple[Array, Array]:
    assert header.orientation is not None
    rows, columns = header.orientation[:3], header.orientation[3:]
    lengths = np.linalg.norm(rows), np.linalg.norm(columns)
    if abs(rows @ columns) > 1e-3 or max(abs(length - 1) for length in lengths) > 1e-3:
        raise ImageError("the orientation of the slices is not a pair of perpendicular unit vectors")
    rows = rows / lengths[0]
    columns = columns - (columns @ rows) * rows
    return rows, columns / np.linalg.norm(columns)


def _slice_spacing(slices: list[SliceHeader], normal: Array) -> float:
    """The uniform distance between slices sorted along the normal."""
    places = np.array([one.position for one in slices])
    gaps = np.diff(places @ normal)
    usual = float(np.median(gaps))
    tolerance = _PLACE_TOLERANCE * max(usual, 0.1)
    if usual <= tolerance or gaps.min() <= tolerance:
        n = int(np.argmin(gaps)) + 1
        raise ImageError(
            "two slices lie at the same place",
            place=f"slices {n} and {n + 1} of {len(slices)}",
            remedy="leave only one echo, time point or copy in the folder, or choose another series",
        )
    worst = int(np.argmax(np.abs(gaps - usual)))
    if abs(gaps[worst] - usual) > tolerance:
        raise ImageError(
            f"a gap of {gaps[worst]:.3g} mm where slices are {usual:.3g} mm apart: a slice is missing",
            place=f"between slices {worst + 1} and {worst + 2} of {len(slices)}",
            remedy="export the whole series again",
        )
    _check_stated(slices[0], usual)
    _check_tilt(places, normal, usual)
    return float(gaps.mean())


def _check_stated(header: SliceHeader, usual: float) -> None:
    """Every second slice missing leaves even gaps; only the header's own spacing tells."""
    stated, thickness = header.stated_spacing, header.thickness
    if stated and thickness and stated >= 0.999 * thickness and usual > 1.5 * stated:
        raise ImageError(
            f"slices lie {usual:.3g} mm apart but were taken {stated:.3g} mm apart: slices are missing",
            remedy="export the whole series again",
        )


def _check_tilt(places: Array, normal: Array, usual: float) -> None:
    steps = np.diff(places, axis=0)
    sideways = np.linalg.norm(steps - np.outer(steps @ normal, normal), axis=1).max()
    if sideways > _PLACE_TOLERANCE * max(usual, 0.1):
        raise ImageError(
            f"slices shift sideways by {sideways:.3g} mm from one to the next (gantry tilt)",
            remedy="resample the series to a rectangular grid",
        )


def _read_pixels(slices: list[SliceHeader]) -> NDArray[np.float32]:
    reader = sitk.ImageSeriesReader()
    reader.SetFileNames([str(one.path) for one in slices])
    reader.SetOutputPixelType(sitk.sitkFloat32)
    try:
        array = sitk.GetArrayFromImage(reader.Execute())
    except RuntimeError:  # its text holds file names
        raise ImageError("the pixels cannot be decoded", remedy="export the series again") from None
    if array.shape != (len(slices), slices[0].rows, slices[0].columns):
        raise ImageError("the pixels do not match the headers", remedy="export the series again")
    return array
