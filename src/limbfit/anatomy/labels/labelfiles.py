"""Label maps on disk: the ``.seg.nrrd`` of 3D Slicer, and plain label images.

A ``.seg.nrrd`` as Slicer saves it may be cropped to the segments, may hold several layers of overlapping
segments (a fourth, leading axis), and may be in RAS; all three are brought back to one LPS label map.
Header fields: https://slicer.readthedocs.io/en/latest/developer_guide/modules/segmentations.html
"""

from __future__ import annotations

import bz2
import json
import re
import zlib
from collections.abc import Mapping, Sequence
from math import prod
from pathlib import Path
from typing import Any

import nrrd
import numpy as np
import SimpleITK as sitk  # noqa: N813
from numpy.typing import NDArray

from ...arrays import Array, Mask
from ...errors import LabelError, add_location
from ..grid import DEFAULT_NAMES, LabelMap, check_voxel_count

COLOURS: Mapping[str, tuple[float, float, float]] = {
    "soft tissue": (0.85, 0.55, 0.45),
    "tibia": (0.95, 0.84, 0.57),
    "fibula": (0.56, 0.74, 0.86),
    "femur": (0.62, 0.80, 0.55),
    "patella": (0.78, 0.62, 0.86),
    "fat": (0.98, 0.90, 0.55),
}
_OTHER_COLOURS = ((0.9, 0.6, 0.2), (0.4, 0.6, 0.9), (0.5, 0.8, 0.7), (0.8, 0.5, 0.6))
_LARGEST_TYPE = 8  # bytes of a voxel
_BLOCK = 1 << 20
_SPACES = {
    "left-posterior-superior": np.ones(3),
    "lps": np.ones(3),
    "right-anterior-superior": np.array([-1.0, -1.0, 1.0]),
    "ras": np.array([-1.0, -1.0, 1.0]),
}


def colour_of(name: str, number: int) -> tuple[float, float, float]:
    """The colour of a tissue; those without one of their own take turns by their number."""
    return COLOURS.get(name, _OTHER_COLOURS[number % len(_OTHER_COLOURS)])


def is_seg_nrrd(path: Path) -> bool:
    return path.name.lower().endswith((".seg.nrrd", ".seg.nhdr"))


def read_seg_nrrd(path: Path) -> LabelMap:
    """A ``.seg.nrrd`` on its own, maybe cropped, grid."""
    try:
        _check_packed(path, nrrd.read_header(str(path)))
        voxels, header = nrrd.read(str(path))
    except (nrrd.NRRDError, OSError, ValueError, EOFError, KeyError, zlib.error):
        raise LabelError(
            "not a readable .seg.nrrd", file=path, remedy="save it again from 3D Slicer"
        ) from None
    layers = voxels if voxels.ndim == 4 else voxels[None]
    spacing, origin, direction = _read_nrrd_geometry(header, path)
    segments = _read_segments(header, layers, path)
    masks = [layers[layer] == value for _, layer, value in segments]
    with add_location(file=path):
        flat, names = flatten(masks, [name for name, _, _ in segments])
    return LabelMap(np.transpose(flat, (2, 1, 0)), spacing, origin, direction, names)


def _check_packed(path: Path, header: Mapping[str, Any]) -> None:
    """Refuse a NRRD of too many voxels, or whose data unpack to more than these can take."""
    check_voxel_count(header["sizes"], path)
    encoding = str(header.get("encoding", "raw")).lower()
    if encoding in ("gzip", "gz", "bzip2", "bz2"):
        data_file = header.get("data file", header.get("datafile"))
        unpacker = zlib.decompressobj(47) if encoding.startswith("g") else bz2.BZ2Decompressor()
        place = path if data_file is None else path.parent / str(data_file)
        limit = _LARGEST_TYPE * prod(int(n) for n in header["sizes"])
        if _is_larger_unpacked(place, data_file is None, unpacker, limit):
            raise LabelError(
                "its data unpack to more than its header states", file=path, remedy="save it again"
            )


def _is_larger_unpacked(path: Path, after_header: bool, unpacker: Any, limit: int) -> bool:
    """True if compressed data come to more than ``limit`` bytes; they are not kept."""
    total, waiting = 0, b""
    with path.open("rb") as stream:
        while after_header and stream.readline().strip():  # a header ends with an empty line
            pass
        while total <= limit and not unpacker.eof:
            if not waiting and getattr(unpacker, "needs_input", True):
                waiting = stream.read(_BLOCK)
                if not waiting:
                    break
            total += len(unpacker.decompress(waiting, _BLOCK))
            waiting = getattr(unpacker, "unconsumed_tail", b"")
    return total > limit


def write_seg_nrrd(path: Path, labels: LabelMap) -> None:
    """A ``.seg.nrrd`` in LPS with a segment per name; 3D Slicer shows names and colours."""
    header: dict[str, Any] = {
        "space": "left-posterior-superior",
        "kinds": ["domain", "domain", "domain"],
        "space directions": (labels.direction * labels.spacing).T,
        "space origin": labels.origin,
        "encoding": "gzip",
        "Segmentation_ContainedRepresentationNames": "Binary labelmap|",
        "Segmentation_MasterRepresentation": "Binary labelmap",
        "Segmentation_ReferenceImageExtentOffset": "0 0 0",
    }
    extent = " ".join(f"0 {n - 1}" for n in labels.size)
    for n, (value, name) in enumerate(sorted(labels.names.items())):
        colour = colour_of(name, n)
        header |= {
            f"Segment{n}_ID": f"Segment_{value}",
            f"Segment{n}_Name": name,
            f"Segment{n}_NameAutoGenerated": "0",
            f"Segment{n}_Color": " ".join(f"{c:g}" for c in colour),
            f"Segment{n}_ColorAutoGenerated": "0",
            f"Segment{n}_LabelValue": str(value),
            f"Segment{n}_Layer": "0",
            f"Segment{n}_Extent": extent,
        }
    nrrd.write(str(path), np.transpose(labels.array, (2, 1, 0)), header, index_order="F", compression_level=4)


def read_label_image(path: Path, image: sitk.Image) -> LabelMap:
    """Any scalar label image; names from ``<file>.json`` (``{"2": "tibia"}``) or the default ones."""
    if image.GetNumberOfComponentsPerPixel() != 1:
        raise LabelError("a label image has one value per voxel", file=path)
    names = _read_sidecar_names(path)
    with add_location(file=path):
        return LabelMap.from_sitk(image, names)


def find_sidecar(path: Path) -> Path:
    """The JSON file that holds the names of a plain label image."""
    return path.with_name(path.name + ".json")


def write_sidecar(path: Path, names: Mapping[int, str]) -> None:
    text = json.dumps({str(value): name for value, name in sorted(names.items())}, indent=2)
    find_sidecar(path).write_text(text + "\n", encoding="utf-8")


def _read_sidecar_names(path: Path) -> dict[int, str]:
    file = find_sidecar(path)
    if not file.is_file():
        return dict(DEFAULT_NAMES)
    try:
        return {
            int(value): normalise_name(name) for value, name in json.loads(file.read_text("utf-8")).items()
        }
    except (ValueError, AttributeError):
        raise LabelError(
            "the names of the labels cannot be read", file=file, remedy='write {"2": "tibia", ...}'
        ) from None


def _read_nrrd_geometry(header: Mapping[str, Any], path: Path) -> tuple[Array, Array, Array]:
    sign = _SPACES.get(str(header.get("space", "")).lower())
    if sign is None or "space directions" not in header or "space origin" not in header:
        raise LabelError(
            "the file does not say where it lies in the patient (NRRD space, directions, origin)",
            file=path,
            remedy="save it again from 3D Slicer",
        )
    steps = np.asarray(header["space directions"], dtype=float)[-3:].T * sign[:, None]
    spacing = np.linalg.norm(steps, axis=0)
    return spacing, np.asarray(header["space origin"], dtype=float) * sign, steps / spacing


def _read_segments(header: Mapping[str, Any], layers: NDArray[Any], path: Path) -> list[tuple[str, int, int]]:
    """Name, layer and value of each segment of the header."""
    found = []
    for n in range(256):
        if f"Segment{n}_ID" not in header and f"Segment{n}_Name" not in header:
            break
        name = str(header.get(f"Segment{n}_Name", f"segment {n + 1}")).strip()
        layer = int(header.get(f"Segment{n}_Layer", 0))
        value = int(header.get(f"Segment{n}_LabelValue", 1))
        if not 0 <= layer < len(layers):
            raise LabelError(f"segment {name!r} is in a layer that the file does not have", file=path)
        found.append((normalise_name(name), layer, value))
    return found


def normalise_name(name: str) -> str:
    """Users of other programs write ``Soft Tissue`` or ``soft_tissue``; here it is lower case with spaces.

    Names become names of files, so whatever is not a letter, a digit or one of ``().+-`` becomes a space.
    """
    words = re.sub(r"[^\w().+-]|_", " ", str(name).lower()).strip(" .").split()
    return " ".join(words)[:40] or "unnamed"


def flatten(masks: Sequence[Mask], names: Sequence[str]) -> tuple[NDArray[np.uint8], dict[int, str]]:
    """Overlapping segments as one map: where two overlap the smaller wins, as a bone in a limb does.

    Raises
    ------
    LabelError
        For no segment, or two of one name.
    """
    if not names:
        raise LabelError("the file names no segment", remedy="export it again with its segments")
    if len(set(names)) < len(names):
        raise LabelError("two segments have the same name", remedy="give them different names")
    values = _label_values(names)
    flat = np.zeros(masks[0].shape, dtype=np.uint8)
    for n in sorted(range(len(masks)), key=lambda n: -int(masks[n].sum())):
        flat[masks[n]] = values[n]
    return flat, dict(zip(values, names))


def _label_values(names: Sequence[str]) -> list[int]:
    """The default value of a known name, free values for others."""
    default = {name: value for value, name in DEFAULT_NAMES.items()}
    free = iter(range(len(default) + 1, 256))
    return [default[name] if name in default else next(free) for name in names]
