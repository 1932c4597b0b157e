"""Files that would take any memory are refused before they are read: what they state, what they unpack to."""

from __future__ import annotations

import bz2
import re
import zlib
from collections.abc import Mapping, Sequence
from math import prod
from pathlib import Path
from typing import Any

from ..errors import ImageError, LabelError, SurfaceError

MOST_VOXELS = 1_000_000_000  # a leg of 1 m in voxels of 0.4 mm has a quarter of that
MOST_ITEMS = 50_000_000  # points or faces of a surface
_LARGEST_TYPE = 8  # bytes of a voxel
_BLOCK = 1 << 20
_STATED = re.compile(rb"""NumberOf(?:Points|Polys|Strips|Lines|Verts|Tuples)\s*=\s*["'](\d+)["']""")


def check_voxels(size: Sequence[int], path: str | Path) -> None:
    """Refuse an image of more than `MOST_VOXELS`.

    Raises
    ------
    ImageError
    """
    if prod(int(n) for n in size) > MOST_VOXELS:
        shape = " x ".join(str(n) for n in size)
        raise ImageError(
            f"{shape} voxels are more than {MOST_VOXELS:.0e}", file=path, remedy="crop or resample the image"
        )


def check_packed(path: Path, header: Mapping[str, Any]) -> None:
    """Refuse a NRRD of more than `MOST_VOXELS`, or whose data unpack to more than its voxels can take.

    Raises
    ------
    LabelError
    """
    voxels = prod(int(n) for n in header["sizes"])
    if voxels > MOST_VOXELS:
        raise LabelError(
            f"more than {MOST_VOXELS:.0e} voxels", file=path, remedy="crop or resample the label map"
        )
    encoding = str(header.get("encoding", "raw")).lower()
    if encoding in ("gzip", "gz", "bzip2", "bz2"):
        elsewhere = header.get("data file", header.get("datafile"))
        unpacker = zlib.decompressobj(47) if encoding.startswith("g") else bz2.BZ2Decompressor()
        place = path if elsewhere is None else path.parent / str(elsewhere)
        if _is_larger_unpacked(place, elsewhere is None, unpacker, _LARGEST_TYPE * voxels):
            raise LabelError(
                "its data unpack to more than its header states", file=path, remedy="save it again"
            )


def _is_larger_unpacked(path: Path, after_header: bool, unpacker: Any, most: int) -> bool:
    """Whether compressed data come to more than ``most`` bytes; they are not kept."""
    total, waiting = 0, b""
    with path.open("rb") as stream:
        while after_header and stream.readline().strip():  # a header ends with an empty line
            pass
        while total <= most and not unpacker.eof:
            if not waiting and getattr(unpacker, "needs_input", True):
                waiting = stream.read(_BLOCK)
                if not waiting:
                    break
            total += len(unpacker.decompress(waiting, _BLOCK))
            waiting = getattr(unpacker, "unconsumed_tail", b"")
    return total > most


def check_items(path: Path) -> None:
    """Refuse a VTK XML file that states more than `MOST_ITEMS` points, faces or values of an array.

    Raises
    ------
    SurfaceError
    """
    rest = b""
    with path.open("rb") as stream:
        while block := stream.read(_BLOCK):
            text = rest + block
            if any(int(found[1][:20]) > MOST_ITEMS for found in _STATED.finditer(text)):
                raise SurfaceError(
                    f"it states more than {MOST_ITEMS:.0e} points or faces",
                    file=path,
                    remedy="export the surface again, with fewer triangles",
                )
            rest = text[-64:]
