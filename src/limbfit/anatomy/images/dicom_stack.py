"""Whether slices make one rectangular volume, in which order, and how far apart they lie."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ...arrays import Array
from ...errors import ImageError
from .dicom_headers import SliceHeader

_VOLUMES = ("MR", "CT", "PT")
_PLACE_TOLERANCE = 0.02  # of the slice spacing
_AXIS_TOLERANCE = 1e-4
_FINEST_MM = 0.02


def stack_slices(slices: Sequence[SliceHeader]) -> tuple[list[SliceHeader], Array, Array]:
    """Slices in order along their normal, spacing (3,) mm and direction (3, 3) of their grid.

    Raises
    ------
    ImageError
        For images that are no slices, of different geometry, missing, doubled or tilted ones.
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
    heights = np.array([one.position @ normal for one in slices])  # type: ignore[operator]
    ordered = [slices[n] for n in np.argsort(heights, kind="stable")]
    spacing = _slice_spacing(ordered, normal)
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
    for one in slices:
        if one.modality not in _VOLUMES:
            raise ImageError(
                f"images of modality {_redact_modality(one.modality)} are not slices of a volume",
                remedy="give an MR or CT series",
            )
        if one.position is None or one.orientation is None or one.pixel_spacing is None:
            raise ImageError(
                "images do not say where they lie in the patient (position, orientation, pixel spacing)",
                remedy="export the original series, not screen captures",
            )
        if np.any(one.pixel_spacing <= 0):
            raise ImageError("the pixel spacing is not positive", remedy="export the original series again")
        if np.any(one.pixel_spacing < _FINEST_MM):
            raise ImageError(
                f"a pixel spacing of {one.pixel_spacing.min():.3g} mm",
                remedy="it must be in millimetres; export the original series again",
            )
        if not np.all(np.isfinite(one.rescale)) or one.rescale[0] == 0:
            raise ImageError(
                "a rescale slope or intercept that is no usable number", remedy="export the series again"
            )
        if one.samples != 1:
            raise ImageError("colour images", remedy="give the original grey-value series")
        if one.photometric == "MONOCHROME1":
            raise ImageError("inverted grey values (MONOCHROME1)", remedy="export the series as MONOCHROME2")
    if len(slices) < 3:
        raise ImageError(
            f"a volume needs at least three slices, this series has {len(slices)}",
            remedy="give the folder that holds all slices",
        )


def _redact_modality(modality: str) -> str:
    """The modality for a message: a code of DICOM, never free text that someone typed into the tag."""
    is_code = 2 <= len(modality) <= 10 and modality.isascii() and modality.isupper() and modality.isalpha()
    return modality if is_code and len(modality) <= 3 else "unknown"


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
