"""What ITK does not say of a NIfTI file: that it is cut short, or that it holds voxels that are not numbers.

ITK leaves what is missing as it was in memory, and makes voxels that are not numbers zero.
"""

from __future__ import annotations

import gzip
import struct
import zlib
from pathlib import Path
from typing import IO

import numpy as np

from ...errors import ImageError

_HEADER = 348  # bytes
_CHUNK = 1 << 22
_FLOATS = {16: "f4", 64: "f8"}  # codes of datatype


def check_nifti(path: Path) -> None:
    """Refuse a NIfTI-1 file that is cut short or holds voxels that are not numbers.

    Raises
    ------
    ImageError
    """
    try:
        opened = gzip.open if path.name.lower().endswith(".gz") else open
        with opened(path, "rb") as stream:
            header = stream.read(_HEADER)
            length, bad = _voxels(stream, header)
        whole = length >= _length(header)
    except (OSError, EOFError, zlib.error, struct.error, ValueError, OverflowError):
        whole, bad = False, 0
    if not whole:
        raise ImageError("the image is cut short or damaged", file=path, remedy="copy or export it again")
    if bad:
        raise ImageError(f"{bad} voxels are not numbers", file=path, remedy="export the image again")


def _voxels(stream: IO[bytes] | gzip.GzipFile, header: bytes) -> tuple[int, int]:
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


def _length(header: bytes) -> float:
    """Bytes that a NIfTI-1 file of this header holds (dim at 40, bitpix at 72, vox_offset at 108)."""
    order = _order(header)
    if struct.unpack(f"{order}i", header[:4])[0] != _HEADER:
        return 0.0  # NIfTI-2 or not NIfTI at all: for ITK to say
    dim = struct.unpack(f"{order}8h", header[40:56])
    bits = struct.unpack(f"{order}h", header[72:74])[0]
    offset = struct.unpack(f"{order}f", header[108:112])[0]
    return offset + float(np.prod(dim[1 : 1 + max(dim[0], 0)], dtype=float)) * bits / 8
