"""What lies in a folder that a study could name: images by series, surfaces, label maps, records."""

from pathlib import Path
from typing import Any

from pydicom.misc import is_dicom

from ...anatomy.images.dicom import describe_series
from ...anatomy.images.formats import IMAGE_FORMATS
from ...anatomy.surfaces.files import SUFFIXES
from ...errors import ImageError, InputError
from ...traces.formats import BINARY_SUFFIXES, TEXT_SUFFIXES
from .acquire import FOLDER

_SKIPPED = {"results", FOLDER}  # what limbfit has written
_SUFFIXES = {
    "images": tuple(suffix for form in IMAGE_FORMATS for suffix in form.suffixes),
    "surfaces": SUFFIXES,
    "records": (*TEXT_SUFFIXES, *BINARY_SUFFIXES),
}


def list_inputs(folder: str | Path) -> dict[str, list[dict[str, Any]]]:
    """Files of a folder that a study could name, by kind, each with its ``path`` below the folder.

    Returns ``images`` (of a folder of DICOM one row a series, with what `describe_series` says of it),
    ``surfaces`` and ``records``. Raises `InputError` where there is no such folder.
    """
    root = Path(folder)
    if not root.is_dir():
        raise InputError("no such folder", file=root, remedy="name the folder of the new study")
    found: dict[str, list[dict[str, Any]]] = {kind: [] for kind in _SUFFIXES}
    for place in [root, *(path for path in sorted(root.rglob("*")) if path.is_dir())]:
        below = place.relative_to(root)
        if any(part.startswith(".") for part in below.parts) or set(below.parts[:1]) & _SKIPPED:
            continue
        files = sorted(path for path in place.iterdir() if path.is_file() and not path.name.startswith("."))
        for path in files:
            name = path.name.lower()
            for kind, suffixes in _SUFFIXES.items():
                if name.endswith(suffixes) and not name.endswith(".seg.nrrd"):  # a label map
                    found[kind].append({"path": path.relative_to(root).as_posix()})
        if any(is_dicom(path) for path in files[:3]):
            found["images"] += [{"path": below.as_posix(), **series} for series in _describe(place)]
    return found


def _describe(folder: Path) -> list[dict[str, Any]]:
    try:
        return describe_series(folder)
    except ImageError as error:
        return [{"whole": False, "why_not": error.what}]
