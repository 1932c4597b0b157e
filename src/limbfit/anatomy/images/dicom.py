"""DICOM series on disk: which there are, whether one is a whole volume, and its voxels.

Headers are read with pydicom and only the tags that geometry needs, so that no identity enters the program.
Nothing said to the user could identify a person: slices are named by their number along the normal, files by
their number in the order of names, and by name only where that holds nothing but counters.
"""

from __future__ import annotations

import re
from collections import defaultdict
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ...errors import ImageError
from ..bounds import check_voxels
from ..grid import Volume
from .dicom_headers import SliceHeader, read_headers
from .dicom_pixels import read_pixels
from .dicom_stack import has_same_plane, stack_slices

_PLAIN_WORDS = {"dcm", "dicom", "ima", "im", "img", "image", "i", "slice", "mr", "ct", "pt", "ser", "series"}
_MAX_COUNT = 9999  # of files; a larger number may be that of a person


@dataclass(frozen=True)
class Series:
    """Images that belong together, in the order in which they were found."""

    uid: str
    slices: tuple[SliceHeader, ...]

    @property
    def summary(self) -> str:
        first = self.slices[0]
        number = f"series {first.series_number}, " if first.series_number.isdecimal() else ""
        return f"{number}{len(self.slices)} x {first.rows} x {first.columns}, UID {self.uid}"


def list_series(folder: str | Path) -> list[Series]:
    """The image series in a folder and those below it, ordered by UID; other files are passed over."""
    groups: dict[str, list[SliceHeader]] = defaultdict(list)
    files = [path for path in sorted(Path(folder).rglob("*")) if path.is_file()]
    for number, path in enumerate(files, 1):
        try:
            headers = read_headers(path)
        except ImageError as error:
            place = f"file {number} of {len(files)} by name{_redact_name(path.relative_to(folder))}"
            raise ImageError(error.what, file=folder, place=place, remedy=error.remedy) from None
        for header in headers or ():
            groups[header.series_uid].append(header)
    series = [Series(uid, tuple(slices)) for uid, slices in sorted(groups.items())]
    return [_join_series(series)] if _is_one_stack(series) else series


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
    found = list_series(folder)
    if not found:
        raise _build_none_error(folder)
    return [_collect_facts(series) for series in found]


def _collect_facts(series: Series) -> dict[str, Any]:
    first = series.slices[0]
    facts: dict[str, Any] = {
        "uid": series.uid,
        "number": first.series_number if first.series_number.isdecimal() else "",
        "modality": first.modality if first.modality.isalpha() and len(first.modality) <= 3 else "",
        "slices": len(series.slices),
        "rows": first.rows,
        "columns": first.columns,
        "spacing_mm": None,
        "whole": True,
        "why_not": None,
    }
    try:
        _, spacing, _ = stack_slices(series.slices)
    except ImageError as error:
        return facts | {"whole": False, "why_not": str(error)}
    return facts | {"spacing_mm": [round(float(step), 6) for step in spacing]}


def read_series(folder: str | Path, series_uid: str | None = None) -> Volume:
    """The volume of a DICOM folder.

    Parameters
    ----------
    folder : holds the files of one or more series, in any order, with any names, one image or many frames
        in each.
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


def _read_volume(series: Series) -> Volume:
    slices, spacing, direction = stack_slices(series.slices)
    origin = slices[0].position
    assert origin is not None
    check_voxels((slices[0].columns, slices[0].rows, len(slices)), slices[0].path)
    return Volume(read_pixels(slices), spacing, origin, direction, slices[0].modality)


def _build_none_error(folder: Path) -> ImageError:
    return ImageError(
        "no DICOM images in this folder", file=folder, remedy="give the folder that holds the slices"
    )


def _choose(folder: Path, found: list[Series], uid: str | None) -> Series:
    if not found:
        raise _build_none_error(folder)
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
        other.series_number == first.series_number and has_same_plane(first, other) for other in slices
    )


def _join_series(series: list[Series]) -> Series:
    return Series(series[0].uid, tuple(one.slices[0] for one in series))
