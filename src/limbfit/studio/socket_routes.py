"""The routes of the view Socket: stored runs of ``limbfit socket`` and its designs, step by step."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import igl
import numpy as np
from fastapi import APIRouter, Response

from ..errors import InputError
from ..mesh import read_vtu
from ..pipeline.shared.socket_shape import regions_of
from ..web.arrays import pack
from ..web.shapes import patient_frame, volume_of
from .folder import StudyFolder, fingerprint, stored
from .playback import arrays_of
from .scene import anatomy_of
from .study_routes import Folder

router = APIRouter(prefix="/api/socket")
SOCKET = "socket"  # the run of `limbfit socket`; others are designs, by their names
_FIELDS = {"pressure": "pressure_kPa", "shear": "shear_kPa"}


def runs_of(folder: StudyFolder) -> list[dict[str, Any]]:
    """Stored runs: ``run``, ``steps`` (name, regions, settling_mm), ``mark``, which other fields change."""
    single = stored(folder.results / "socket" / "socket.json")
    found = {SOCKET: single} if single else {}
    designed = stored(folder.results / "socket_design" / "socket_design.json")
    found |= {one["name"]: one["simulation"] for one in designed.get("designs", [])}
    rows = []
    for name, content in found.items():
        steps = [{"name": "donning"} | content["donning"], *content["loads"]]
        files = [_file(folder, name, i) for i in range(len(steps))]
        rows.append({"run": name, "steps": [_step(one) for one in steps], "mark": fingerprint(files)})
    return rows


def _step(held: dict[str, Any]) -> dict[str, Any]:
    keys = ("region", "mean_kPa", "peak_kPa", "shear_kPa", "interval_kPa")
    regions = [{key: row[key] for key in keys} for row in held["regions"]]
    return {"name": held["name"], "settling_mm": held.get("settling_mm"), "regions": regions}


def _file(folder: StudyFolder, run: str, step: int) -> Path:
    if run == SOCKET:
        return folder.artefact("socket", f"held-{step}.vtu")
    return folder.artefact("socket_design", f"{run}-{step}.vtu")


@router.get("")
def get_runs(folder: Folder) -> dict[str, Any]:
    """Stored runs, and the patient's sides."""
    anatomy = anatomy_of(folder, folder.load())
    frame = patient_frame(None if anatomy is None else anatomy.cut_normal)
    return {"runs": runs_of(folder), "frame": frame.tolist()}


@router.get("/mesh/{run}")
def get_mesh(folder: Folder, run: str) -> Response:
    """The limb of a run as arrays of `VolumeShape`; ``place`` (n,): number of each node in ``places``."""
    mesh = read_vtu(_file(folder, run, 0))
    volume = volume_of(mesh)
    place, places = _places(folder, volume.points.astype(float))
    facts = {"regions": list(mesh.region_names), "places": places}
    return _block(volume.arrays() | {"place": place}, facts)


def _places(folder: StudyFolder, points: np.ndarray) -> tuple[np.ndarray, list[str]]:
    """The regions of the nearest skin, in words: a number of each point (n,), and the words."""
    study = folder.load()
    anatomy = anatomy_of(folder, study)
    if anatomy is None:
        return np.zeros(len(points), np.uint16), [""]
    skin, regions = anatomy.skin, regions_of(study, anatomy)
    nearest = igl.point_mesh_squared_distance(points, skin.points, skin.faces)[1]
    inside = np.column_stack([region.faces[nearest] for region in regions.values()])
    kinds, place = np.unique(inside, axis=0, return_inverse=True)
    names = np.array(list(regions))
    return place.reshape(-1).astype(np.uint16), [", ".join(names[kind]) for kind in kinds]


@router.get("/step/{run}/{step}/{field}")
def get_step(folder: Folder, run: str, step: int, field: str) -> Response:
    """``values`` (n,) of a field in kPa at the drawn nodes, when a step has been held."""
    if field not in _FIELDS:
        raise InputError("no such field is stored", remedy="fields are " + ", ".join(_FIELDS))
    arrays = arrays_of(_file(folder, run, step))
    nodes = np.unique(arrays["cells"][:, :4])
    return _block({"values": arrays[_FIELDS[field]].reshape(-1)[nodes].astype(np.float32)}, {})


def _block(arrays: dict[str, Any], facts: dict[str, Any]) -> Response:
    return Response(pack(arrays, facts), media_type="application/octet-stream")
