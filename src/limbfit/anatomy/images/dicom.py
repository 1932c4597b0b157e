"""DICOM series on disk: which there are, whether one is a whole volume, and its voxels.

Headers are read with pydicom and only the tags that geometry needs, so that no identity enters the program.
No message to the user could identify a person: slices are named by their number along the normal, files by
their number in the order of names, and by name only where that holds nothing but counters.
"""

import os
import re
import sys
from collections import defaultdict
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pydicom
import SimpleITK as sitk  # noqa: N813
from numpy.typing import NDArray
from pydicom.uid import UID

from ...arrays import Array
from ...errors import ImageError, add_location
from ...folders import list_files
from ..grid import Volume, check_voxel_count
from .dicom_headers import SliceHeader, read_headers, redact_errors

_PLAIN_WORDS = {"dcm", "dicom", "ima", "im", "img", "image", "i", "slice", "mr", "ct", "pt", "ser", "series"}
_MAX_COUNT = 9999  # of files; a larger number may be that of a person
_VOLUMES = ("MR", "CT", "PT")
_PLACE_TOLERANCE = 0.02  # of the slice spacing
_AXIS_TOLERANCE = 1e-4
_FINEST_MM = 0.02


Series = list[SliceHeader]  # images that belong together, in the order in which they were found


def list_series(folder: str | Path) -> list[Series]:
    """The image series in a folder and those below it, ordered by UID; other files are passed over. Raises
    `ImageError` for a folder without images, or a damaged file in it.
    """
    groups: dict[str, Series] = defaultdict(list)
    files = list_files(Path(folder))
    for number, path in enumerate(files, 1):
        place = f"file {number} of {len(files)} by name{_redact_name(path.relative_to(folder))}"
        with add_location(file=folder, place=place):
            headers = read_headers(path)
        for header in headers or ():
            groups[header.series_uid].append(header)
    if not groups:
        raise ImageError(
            "no DICOM images in this folder", file=folder, remedy="give the folder that holds the slices"
        )
    series = [groups[uid] for uid in sorted(groups)]
    return [[single[0] for single in series]] if _is_one_stack(series) else series


def _redact_name(path: Path) -> str:
    """The name of a file in brackets, if it holds only words of machines and counters."""
    words, numbers = re.findall(r"[^\W\d_]+", str(path)), re.findall(r"\d+", str(path))
    is_plain = all(word.lower() in _PLAIN_WORDS for word in words)
    return f" ({path.as_posix()})" if is_plain and all(int(n) <= _MAX_COUNT for n in numbers) else ""


def describe_series(folder: str | Path) -> list[dict[str, Any]]:
    """What a user needs to choose a series: facts without identity.

    Returns
    -------
    list of dict
        ``uid``, ``number``, ``modality``, ``slices``, ``rows``, ``columns``, ``spacing_mm`` along row, column
        and slice (None where the series is no volume), ``whole``, and ``why_not`` where it is not.

    Raises
    ------
    ImageError
        For a path that is no folder, one without images, or a damaged file in it.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise ImageError("no such folder", file=folder, remedy="give the folder that holds the DICOM files")
    found = []
    for series in list_series(folder):
        first, spacing_mm, why_not = series[0], None, None
        try:
            spacing_mm = [round(float(step), 6) for step in stack_slices(series)[1]]
        except ImageError as error:
            why_not = str(error)
        found.append(
            {
                "uid": first.series_uid,
                "number": first.series_number if first.series_number.isdecimal() else "",
                "modality": _redact_modality(first.modality),
                "slices": len(series),
                "rows": first.rows,
                "columns": first.columns,
                "spacing_mm": spacing_mm,
                "whole": why_not is None,
                "why_not": why_not,
            }
        )
    return found


def read_series(folder: str | Path, series_uid: str | None = None) -> Volume:
    """The volume of a DICOM folder, of the series ``series_uid`` where it holds several.

    The files may be in any order, with any names, one image or many frames in each. Raises `ImageError` for
    no or several series, slices missing, doubled, tilted or of different geometry.
    """
    series = _choose_series(Path(folder), list_series(folder), series_uid)
    with add_location(file=folder):
        slices, spacing, direction = stack_slices(series)
        first = slices[0]
        assert first.position is not None
        check_voxel_count((first.columns, first.rows, len(slices)), folder)
        return Volume(read_pixels(slices), spacing, first.position, direction, first.modality)


def _choose_series(folder: Path, series_list: list[Series], uid: str | None) -> Series:
    if uid is not None:
        chosen = [series for series in series_list if series[0].series_uid == uid]
        if chosen:
            return chosen[0]
        listing = "; ".join(map(_summarise_series, series_list))
        raise ImageError(
            "no series of this folder has the UID asked for", file=folder, remedy=f"there are: {listing}"
        )
    if len(series_list) > 1:
        shown = "; ".join(map(_summarise_series, series_list[:6]))
        more = f"; and {len(series_list) - 6} more" if len(series_list) > 6 else ""
        raise ImageError(
            f"{len(series_list)} series in one folder",
            file=folder,
            remedy=f"choose one by its UID (image.series in study.toml): {shown}{more}",
        )
    return series_list[0]


def _summarise_series(series: Series) -> str:
    first = series[0]
    number = f"series {first.series_number}, " if first.series_number.isdecimal() else ""
    return f"{number}{len(series)} x {first.rows} x {first.columns}, UID {first.series_uid}"


def _is_one_stack(series: list[Series]) -> bool:
    """True if an anonymiser gave each slice of one series its own UID.

    Then every series has one image, and there are at least three, all with the same series number and
    geometry: two true series would not interleave into one stack, which the gap check still verifies.
    """
    first = series[0][0]
    return len(series) > 2 and all(
        len(single) == 1
        and single[0].series_number == first.series_number
        and has_same_plane(first, single[0])
        for single in series
    )


def stack_slices(slices: Sequence[SliceHeader]) -> tuple[list[SliceHeader], Array, Array]:
    """Slices in order along their normal, spacing (3,) mm and direction (3, 3) of their grid. Raises
    `ImageError` for images that are no slices, of different geometry, missing, doubled or tilted ones.
    """
    first = slices[0]
    _check_kind(slices)
    for other in slices:
        if not has_same_plane(first, other):
            raise ImageError(
                "slices of one series differ in orientation, size or pixel spacing",
                remedy="leave out scout images, or choose another series",
            )
    rows, columns = _compute_axes(first)
    normal = np.cross(rows, columns)
    heights = np.array([header.position @ normal for header in slices])  # type: ignore[operator]
    ordered = [slices[n] for n in np.argsort(heights, kind="stable")]
    spacing = _find_slice_spacing(ordered, normal)
    assert first.pixel_spacing is not None
    return (
        ordered,
        np.array([first.pixel_spacing[1], first.pixel_spacing[0], spacing]),
        np.column_stack([rows, columns, normal]),
    )


def has_same_plane(a: SliceHeader, b: SliceHeader) -> bool:
    return (
        (a.rows, a.columns, a.modality) == (b.rows, b.columns, b.modality)
        and _close(a.orientation, b.orientation)
        and _close(a.pixel_spacing, b.pixel_spacing)
    )


def _close(a: Array | None, b: Array | None) -> bool:
    if a is None or b is None:
        return a is b
    return bool(np.abs(a - b).max() <= _AXIS_TOLERANCE)


def _check_kind(slices: Sequence[SliceHeader]) -> None:
    for header in slices:
        if header.modality not in _VOLUMES:
            kind = _redact_modality(header.modality) or "unknown"
            raise ImageError(
                f"images of modality {kind} are not slices of a volume", remedy="give an MR or CT series"
            )
        if header.position is None or header.orientation is None or header.pixel_spacing is None:
            raise ImageError(
                "images do not say where they lie in the patient (position, orientation, pixel spacing)",
                remedy="export the original series, not screen captures",
            )
        if np.any(header.pixel_spacing <= 0):
            raise ImageError("the pixel spacing is not positive", remedy="export the original series again")
        if np.any(header.pixel_spacing < _FINEST_MM):
            raise ImageError(
                f"a pixel spacing of {header.pixel_spacing.min():.3g} mm",
                remedy="it must be in millimetres; export the original series again",
            )
        if not np.all(np.isfinite(header.rescale)) or header.rescale[0] == 0:
            raise ImageError(
                "a rescale slope or intercept that is no usable number", remedy="export the series again"
            )
        if header.samples != 1:
            raise ImageError("colour images", remedy="give the original grey-value series")
        if header.photometric == "MONOCHROME1":
            raise ImageError("inverted grey values (MONOCHROME1)", remedy="export the series as MONOCHROME2")
    if len(slices) < 3:
        raise ImageError(
            f"a volume needs at least three slices, this series has {len(slices)}",
            remedy="give the folder that holds all slices",
        )


def _redact_modality(modality: str) -> str:
    """The modality for a message: a code of DICOM, never free text that someone typed into the tag."""
    return modality if re.fullmatch("[A-Z]{2,3}", modality) else ""


def _compute_axes(header: SliceHeader) -> tuple[Array, Array]:
    assert header.orientation is not None
    rows, columns = header.orientation[:3], header.orientation[3:]
    lengths = np.linalg.norm(rows), np.linalg.norm(columns)
    if abs(rows @ columns) > 1e-3 or max(abs(length - 1) for length in lengths) > 1e-3:
        raise ImageError(
            "the orientation of the slices is not a pair of perpendicular unit vectors",
            remedy="export the original series again",
        )
    rows = rows / lengths[0]
    columns = columns - (columns @ rows) * rows
    return rows, columns / np.linalg.norm(columns)


def _find_slice_spacing(slices: list[SliceHeader], normal: Array) -> float:
    """The uniform distance between slices sorted along the normal."""
    places = np.array([header.position for header in slices])
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
    # A series that lacks every second slice has even gaps: only its header shows it.
    stated, thickness = slices[0].stated_spacing, slices[0].thickness
    if stated and thickness and stated >= 0.999 * thickness and usual > 1.5 * stated:
        raise ImageError(
            f"slices lie {usual:.3g} mm apart but were taken {stated:.3g} mm apart: slices are missing",
            remedy="export the whole series again",
        )
    steps = np.diff(places, axis=0)
    sideways = np.linalg.norm(steps - np.outer(steps @ normal, normal), axis=1).max()
    if sideways > tolerance:
        raise ImageError(
            f"slices shift sideways by {sideways:.3g} mm from one to the next (gantry tilt)",
            remedy="resample the series to a rectangular grid",
        )
    return float(gaps.mean())


def read_pixels(slices: Sequence[SliceHeader]) -> NDArray[np.float32]:
    """``[k, j, i]`` rescaled grey values of slices in their order. Raises `ImageError` for pixels that are
    cut short, cannot be decoded or do not match the headers.
    """
    with redact_errors(_build_decoding_error({header.syntax for header in slices})):
        array = _read_files(slices) if slices[0].frame is None else _read_frames(slices)
    if array.shape != (len(slices), slices[0].rows, slices[0].columns):
        raise ImageError("the pixels do not match the headers", remedy="export the series again")
    return array


def _read_files(slices: Sequence[SliceHeader]) -> NDArray[np.float32]:
    """GDCM applies each image's own slope and intercept."""
    reader = sitk.ImageSeriesReader()
    reader.SetFileNames([str(header.path) for header in slices])
    reader.SetOutputPixelType(sitk.sitkFloat32)
    with mute_libraries():
        return sitk.GetArrayFromImage(reader.Execute())


@contextmanager
def mute_libraries() -> Iterator[None]:
    """Keep the C libraries below ITK from writing to the terminal, which they do past every setting."""
    sys.stdout.flush()
    sys.stderr.flush()
    kept = [(stream, os.dup(stream)) for stream in (1, 2)]
    nowhere = os.open(os.devnull, os.O_WRONLY)
    try:
        for stream, _ in kept:
            os.dup2(nowhere, stream)
        yield
    finally:
        for stream, copy in kept:
            os.dup2(copy, stream)
            os.close(copy)
        os.close(nowhere)


def _read_frames(slices: Sequence[SliceHeader]) -> NDArray[np.float32]:
    files = {header.path: pydicom.dcmread(header.path).pixel_array for header in slices}
    planes = []
    for header in slices:
        stored = files[header.path]
        plane = stored if stored.ndim == 2 else stored[header.frame]
        slope, intercept = header.rescale
        planes.append(plane.astype(np.float32) * np.float32(slope) + np.float32(intercept))
    return np.stack(planes)


def _build_decoding_error(syntaxes: set[str]) -> ImageError:
    """What is wrong with pixels that no decoder took."""
    uids = [UID(text, pydicom.config.IGNORE) for text in syntaxes]  # a warning would quote them
    known = [uid for uid in uids if uid.is_valid and not uid.is_private and uid.is_transfer_syntax]
    names = sorted(uid.name for uid in known if uid.is_compressed)
    if names:
        return ImageError(
            f"the pixels, compressed as {', '.join(names)}, cannot be decoded",
            remedy="export the series again, uncompressed",
        )
    return ImageError("the pixels are cut short or cannot be decoded", remedy="export the series again")
