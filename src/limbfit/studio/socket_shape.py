"""The socket's shape on the page: its face with offsets from the limb, areas written into the study file."""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import tomlkit
from tomlkit.items import AoT

from ..errors import InputError, StudyError
from ..pipeline.shared.socket_shape import regions_of, socket_of
from ..pipeline.shared.store import digest
from ..socket import Socket
from ..study import Study
from ..web.arrays import pack
from .editing import assign, edit_study
from .folder import StudyFolder, fingerprint
from .scene import anatomy_of

NONE_YET = "there is no limb yet to draw a socket around: run the stages until surfaces"


def shape_of(folder: StudyFolder) -> dict[str, Any]:
    """What ``[socket]`` says of the shape, and whether such a face can be drawn around the bare skin.

    ``areas`` with their places, ``regions`` to choose from, ``file`` where the face is read from one,
    ``mark``, which another face changes, ``problem`` in words or None, ``volume_cm3``.
    """
    study = folder.load()
    table, anatomy = study.socket, anatomy_of(folder, study)
    regions = {} if anatomy is None else regions_of(study, anatomy)
    mark = _mark(folder, study)
    found = _drawn(folder, mark)
    drawn = isinstance(found, Socket)
    return {
        "file": None if table.file is None else table.file.name,
        "reduction_percent": table.reduction_percent,
        "areas": [
            {
                "name": area.name,
                "position_mm": _place(area.position, area.region, regions),
                "region": area.region,
                "radius_mm": area.radius_mm,
                "depth_mm": area.depth_mm,
            }
            for area in table.areas
        ],
        "regions": list(regions),
        "mark": mark,
        "problem": None if drawn else found,
        "volume_cm3": found.volume_mm3 / 1000.0 if isinstance(found, Socket) else None,
    }


def _place(position: Any, region: str | None, regions: Mapping[str, Any]) -> list[float] | None:
    if position is not None:
        return [float(x) for x in position]
    return [float(x) for x in regions[region].position] if region in regions else None


def face_block(folder: StudyFolder) -> bytes:
    """The face as a block of arrays: ``points`` (n, 3), ``faces`` (m, 3), ``values`` (n,): offset, mm.

    Offsets are from the bare skin, negative where the face is pressed in.

    Raises
    ------
    InputError
        Where there is none.
    """
    study = folder.load()
    found, anatomy = _drawn(folder, _mark(folder, study)), anatomy_of(folder, study)
    if not isinstance(found, Socket) or anatomy is None:
        raise InputError(found if isinstance(found, str) else NONE_YET)
    arrays = {
        "points": found.points.astype(np.float32),
        "faces": found.faces.astype(np.uint32),
        "values": (-found.offset(anatomy.skin)).astype(np.float32),
    }
    return pack(arrays, {})


def _mark(folder: StudyFolder, study: Study) -> str:
    """Changes with the limb's surfaces, the socket's file and what the table says of the shape."""
    table, given = study.socket, study.surfaces
    files = [folder.results / "surfaces" / "surfaces.json"]
    files += [study.path(path) for path in (() if given is None else (given.skin, *given.bones.values()))]
    files += [] if table.file is None else [study.path(table.file)]
    return f"{fingerprint(files)} {digest(table.model_dump(mode='json', exclude={'design', 'loads'}))}"


@lru_cache(maxsize=2)
def _drawn(folder: StudyFolder, mark: str) -> Socket | str:
    """The face around the bare skin, or why there is none; the last ones are kept, by their ``mark``."""
    study = folder.load()
    try:
        anatomy = anatomy_of(folder, study)
        return NONE_YET if anatomy is None else socket_of(study, anatomy, anatomy.skin)
    except InputError as error:
        return f"{error.what}; {error.remedy}" if error.remedy else error.what


def set_area(file: Path, name: str, values: Mapping[str, Any]) -> Study:
    """Change an area of ``[[socket.areas]]``, or add one of that name; None removes a key."""

    def change(document: tomlkit.TOMLDocument) -> None:
        rows = _areas(document)
        known = next((row for row in rows if str(row.get("name")) == name), None)
        if known is None:
            known = tomlkit.table() if isinstance(rows, AoT) else tomlkit.inline_table()
            assign(known, {"name": name, **values})
            rows.append(known)
        else:
            assign(known, values)

    return edit_study(file, change)


def remove_area(file: Path, name: str) -> Study:
    """Take an area out of the study file.

    Raises
    ------
    StudyError
        Where there is none of that name.
    """

    def change(document: tomlkit.TOMLDocument) -> None:
        rows = _areas(document)
        names = [str(row.get("name")) for row in rows]
        if name not in names:
            raise StudyError(f"no area is named {name!r}", file=file, place="socket.areas")
        del rows[names.index(name)]

    return edit_study(file, change)


def _areas(document: tomlkit.TOMLDocument) -> Any:
    """The list of areas, made where there is none."""
    if "socket" not in document:
        document["socket"] = tomlkit.table()
    table: Any = document["socket"]
    if "areas" not in table:
        table["areas"] = tomlkit.aot()
    return table["areas"]
