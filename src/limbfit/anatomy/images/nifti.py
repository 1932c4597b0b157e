"""What ITK does not say of a NIfTI file: that it is cut short, that it holds voxels that are not numbers, or
that its two statements of where it lies contradict each other.

ITK leaves what is missing as it was in memory, and makes voxels that are not numbers zero. Of the qform and
the sform it takes one without a word.
"""

from __future__ import annotations

import gzip
import struct
import zlib
from pathlib import Path
from typing import IO, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from ...arrays import Array
from ...errors import ImageError

_HEADER = 348  # bytes
_CHUNK = 1 << 22
_FLOATS = {16: "f4", 64: "f8"}  # codes of datatype
_SAME_VOXELS = 0.5  # within which two statements of a voxel's place are one
_UNITS_MM = {1: 1000.0, 2: 1.0, 3: 1e-3}  # by the code of the unit of length


def check_nifti(path: Path) -> None:
    """Refuse a NIfTI file that is cut short, holds voxels that are not numbers, or contradicts itself on left
    and right.

    Raises
    ------
    ImageError
    """
    try:
        with _open(path) as stream:
            header = stream.read(_HEADER)
            length, bad = _count_bytes_and_nans(stream, header)
        whole = length >= _compute_length(header)
    except (OSError, EOFError, zlib.error, struct.error, ValueError, OverflowError):
        whole, bad = False, 0
    if not whole:
        raise ImageError("the image is cut short or damaged", file=path, remedy="copy or export it again")
    if bad:
        raise ImageError(f"{bad} voxels are not numbers", file=path, remedy="export the image again")
    forms = _read_forms(path)
    if forms is not None and np.linalg.det(forms.qform[:3, :3]) * np.linalg.det(forms.sform[:3, :3]) < 0.0:
        raise ImageError(
            "the qform and the sform mirror each other: left in one is right in the other",
            file=path,
            remedy="convert the image again from its DICOM files, or set the code of the wrong one to 0",
        )


class _HeaderForms(NamedTuple):
    """What a header says twice: affine matrices (4, 4) from indices to RAS mm, for an image of a size."""

    qform: Array
    sform: Array
    size: Array


def describe_forms(path: Path, affine: Array) -> tuple[str, ...]:
    """Say which of a file's qform and sform an image lies by, where they differ.

    Parameters
    ----------
    affine : (4, 4) of the image that was read, from indices to LPS mm.
    """
    forms = _read_forms(path)
    if forms is None:
        return ()
    corners = np.stack(np.meshgrid(*np.column_stack([np.zeros(3), forms.size - 1]), [1.0]), -1).reshape(-1, 4)
    apart = float(np.linalg.norm(corners @ (forms.qform - forms.sform).T, axis=1).max())
    if apart <= _SAME_VOXELS * np.linalg.norm(affine[:3, :3], axis=0).min():
        return ()
    here = np.diag([-1.0, -1.0, 1.0, 1.0]) @ affine
    is_qform = np.abs(here - forms.qform).max() <= np.abs(here - forms.sform).max()
    used, other = ("qform", "sform") if is_qform else ("sform", "qform")
    return (
        f"its qform and sform differ by up to {apart:.1f} mm; the {used} is used: where sites or labels are "
        f"off by that, set the {used}'s code to 0, and the {other} is",
    )


def _read_forms(path: Path) -> _HeaderForms | None:
    """The qform and the sform of a file; None where it does not state both."""
    with _open(path) as stream:
        header = stream.read(_HEADER)
    if len(header) < _HEADER:
        return None
    parts = (
        (40, "8h"),
        (76, "8f"),
        (123, "B"),
        (252, "2h"),
        (256, "6f"),
        (280, "12f"),
    )  # offset in bytes, type
    dim, pixdim, (unit,), codes, place, rows = (
        np.array(struct.unpack_from(_order(header) + kind, header, offset), dtype=np.float64)
        for offset, kind in parts
    )
    if not codes.all() or not np.isfinite(np.concatenate([pixdim, place, rows])).all():
        return None
    b, c, d = place[:3]
    turn = Rotation.from_quat([b, c, d, np.sqrt(max(0.0, 1.0 - b * b - c * c - d * d))]).as_matrix()
    qform, sform = np.eye(4), np.vstack([rows.reshape(3, 4), [0.0, 0.0, 0.0, 1.0]])
    qform[:3, :3] = turn * pixdim[1:4] * [1.0, 1.0, -1.0 if pixdim[0] < 0.0 else 1.0]
    qform[:3, 3] = place[3:]
    scale = np.diag([*[_UNITS_MM.get(int(unit) & 7, 1.0)] * 3, 1.0])
    return _HeaderForms(scale @ qform, scale @ sform, dim[1:4])


def _open(path: Path) -> IO[bytes] | gzip.GzipFile:
    return gzip.open(path) if path.name.lower().endswith(".gz") else path.open("rb")


def _count_bytes_and_nans(stream: IO[bytes] | gzip.GzipFile, header: bytes) -> tuple[int, int]:
    """Length of the file in bytes, and how many of its voxels are not numbers."""
    length, bad = len(header), 0
    kind = _FLOATS.get(struct.unpack(f"{_order(header)}h", header[70:72])[0])
    first = max(int(struct.unpack(f"{_order(header)}f", header[108:112])[0]), _HEADER)
    length += len(stream.read(first - length))
    while chunk := stream.read(_CHUNK):
        length += len(chunk)
        if kind is not None:
            whole = len(chunk) - len(chunk) % int(kind[1])
            bad += int((~np.isfinite(np.frombuffer(chunk[:whole], _order(header) + kind))).sum())
    return length, bad


def _order(header: bytes) -> str:
    return "<" if header[:4] == struct.pack("<i", _HEADER) else ">"


def _compute_length(header: bytes) -> float:
    """Bytes that a NIfTI-1 file of this header holds (dim at 40, bitpix at 72, vox_offset at 108)."""
    order = _order(header)
    if struct.unpack(f"{order}i", header[:4])[0] != _HEADER:
        return 0.0  # NIfTI-2 or not NIfTI at all: for ITK to say
    dim = struct.unpack(f"{order}8h", header[40:56])
    bits = struct.unpack(f"{order}h", header[72:74])[0]
    offset = struct.unpack(f"{order}f", header[108:112])[0]
    return offset + float(np.prod(dim[1 : 1 + max(dim[0], 0)], dtype=float)) * bits / 8
