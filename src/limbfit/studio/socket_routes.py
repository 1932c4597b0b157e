"""The routes of the view Socket: the shape with its areas, and stored runs and designs, step by step."""

from collections.abc import Mapping
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Any

import igl
import numpy as np
from fastapi import APIRouter, Response
from pydantic import Field, FiniteFloat

from ..errors import InputError, SurfaceError
from ..mesh import read_vtu
from ..pipeline.engine.digests import compute_digest
from ..pipeline.socket.shape import build_regions, build_socket, place_errors, trim_of
from ..results.socket import SocketDesignResult, SocketLoad, SocketResult, SocketSimulation, SocketState
from ..socket import Socket
from ..socket.rays import compute_profile
from ..socket.rectify import Trim, find_brim, trim_limb, wrap_trimline
from ..study import Study
from ..web import build_patient_frame, to_volume_shape
from .editing import remove_table, set_area, set_trimline
from .folder import Json, StudyFolder, compute_fingerprint
from .identification_routes import describe_last_run
from .model_routes import Place, Text, compute_surfaces_fingerprint, project_to_skin_of_study, read_anatomy
from .processes import find_running, find_starting, start_socket
from .results_routes import read_arrays
from .study_routes import Folder, StrictModel, respond_block

router = APIRouter(prefix="/api/socket")
SOCKET = "socket"  # the run of `limbfit socket`; others are designs, by their names
NO_LIMB_YET = "there is no limb yet to draw a socket around: run the stages until surfaces"
_FIELDS = {"pressure": "pressure_kPa", "shear": "shear_kPa"}
HANDLE_COUNT = 16  # along a brim that is no stated line


class AreaRequest(StrictModel):
    """An area of the page: at a ``position`` that was clicked, or at the middle of a ``region``."""

    name: Text
    position: Place | None = None
    region: Text | None = None
    radius_mm: FiniteFloat
    depth_mm: FiniteFloat


class TrimlineRequest(StrictModel):
    """A trimline of the page: ``points`` in order around the limb (LPS, mm), each put on its skin."""

    points: Annotated[list[Place], Field(min_length=3, max_length=60)]


class SocketRunRequest(StrictModel):
    """Which command to run: that of the socket, or its design."""

    design: bool = False


def list_runs(folder: StudyFolder) -> list[Json]:
    """Stored runs: ``run``, ``steps`` (name, regions, settling_mm), ``mark``, which other fields change.

    ``outside``: what it does to the tissue that no fitted record did, in words. ``sensors`` and
    ``agreement``: measured pressures, as `SocketResult` has them.
    """
    single, designed = SocketResult.find(folder.results), SocketDesignResult.find(folder.results)
    runs: dict[str, SocketSimulation] = {SOCKET: single} if single else {}
    runs |= {one.name: one.simulation for one in designed.designs} if designed else {}
    return [
        {
            "run": name,
            "steps": [_describe_step(title, state) for title, state in run.states.items()],
            **_describe_measured(run if isinstance(run, SocketResult) else None),
            "mark": compute_fingerprint(_find_file(folder, name, i) for i in range(len(run.states))),
        }
        for name, run in runs.items()
    ]


def _describe_measured(run: SocketResult | None) -> Json:
    return {
        "outside": run.outside_text if run else [],
        "sensors": [one.model_dump(include={"name", "load", "cells"}) for one in run.sensors] if run else [],
        "agreement": [one.model_dump() for one in run.agreement] if run else [],
    }


def _describe_step(name: str, state: SocketState) -> Json:
    keys = {"region", "mean_kPa", "peak_kPa", "shear_kPa", "interval_kPa"}
    settling_mm = state.settling_mm if isinstance(state, SocketLoad) else None
    regions = [row.model_dump(include=keys) for row in state.regions]
    return {"name": name, "settling_mm": settling_mm, "regions": regions}


def _find_file(folder: StudyFolder, run: str, step: int) -> Path:
    if run == SOCKET:
        return folder.artefact("socket", f"held-{step}.vtu")
    return folder.artefact("socket_design", f"{run}-{step}.vtu")


@router.get("")
def get_runs(folder: Folder) -> Json:
    """Stored runs, the patient's sides, and the run that goes on or begins."""
    anatomy = read_anatomy(folder, folder.load())
    frame = build_patient_frame(None if anatomy is None else anatomy.cut_normal)
    run = find_running(folder)
    more = {"run": run, "starting": find_starting(folder), "last": describe_last_run(folder, run is not None)}
    return {"runs": list_runs(folder), "frame": frame.tolist()} | more


@router.get("/mesh/{run}")
def get_mesh(folder: Folder, run: str) -> Response:
    """The limb of a run as arrays of `VolumeShape`; ``place`` (n,): number of each node in ``places``."""
    mesh = read_vtu(_find_file(folder, run, 0))
    volume = to_volume_shape(mesh)
    place, places = _name_places(folder, volume.points.astype(float))
    facts = {"regions": list(mesh.region_names), "places": places}
    return respond_block(volume.arrays() | {"place": place}, facts)


def _name_places(folder: StudyFolder, points: np.ndarray) -> tuple[np.ndarray, list[str]]:
    """The regions of the nearest skin, in words: a number of each point (n,), and the words."""
    study = folder.load()
    anatomy = read_anatomy(folder, study)
    if anatomy is None:
        return np.zeros(len(points), np.uint16), [""]
    skin, regions = anatomy.skin, build_regions(study, anatomy)
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
    arrays = read_arrays(_find_file(folder, run, step))
    nodes = np.unique(arrays["cells"][:, :4])
    return respond_block({"values": arrays[_FIELDS[field]].reshape(-1)[nodes].astype(np.float32)})


@router.get("/shape")
def get_shape(folder: Folder) -> Json:
    """The socket's shape as ``[socket]`` states it, and whether its face can be drawn around the bare skin.

    ``areas`` with their places, ``regions`` to choose from, ``file`` where the face is read from one;
    ``trim``: ``points`` where the brim runs on the skin, and whether they are those of a line; ``mark``,
    which another face changes, ``problem`` in words or None, ``has_limb``, ``volume_cm3``.
    """
    study = folder.load()
    table, anatomy = study.socket, read_anatomy(folder, study)
    regions = {} if anatomy is None else build_regions(study, anatomy)
    fingerprint = _compute_shape_fingerprint(folder, study)
    face = _build_face(folder, fingerprint)
    return {
        "file": None if table.file is None else table.file.name,
        "reduction_percent": table.reduction_percent,
        "trim": {"points": _find_handles(folder, study), "is_line": bool(table.trimline)},
        "areas": [
            area.model_dump(include={"name", "region", "radius_mm", "depth_mm"})
            | {"position_mm": _place(area.position, area.region, regions)}
            for area in table.areas
        ],
        "regions": list(regions),
        "mark": fingerprint,
        "problem": None if isinstance(face, Socket) else face,
        "has_limb": anatomy is not None,
        "volume_cm3": face.volume_mm3 / 1000.0 if isinstance(face, Socket) else None,
    }


def _place(position: Any, region: str | None, regions: Mapping[str, Any]) -> list[float] | None:
    if position is None and region is not None and region in regions:
        position = regions[region].position
    return None if position is None else [float(x) for x in position]


def _find_handles(folder: StudyFolder, study: Study) -> list[list[float]]:
    """Where the brim can be dragged: the points of the study's line alone, else some all around the brim."""
    anatomy, table = read_anatomy(folder, study), study.socket
    if anatomy is None or table.file is not None:
        return []
    try:
        limb, frame = compute_profile(anatomy.skin, anatomy.frame), anatomy.frame
        if table.trimline and not table.trim_planes:
            return [[*map(float, row)] for row in wrap_trimline(limb, frame, np.array(table.trimline))]
        return [[*map(float, row)] for row in find_brim(limb, frame, trim_of(study, anatomy), HANDLE_COUNT)]
    except SurfaceError:
        return []  # `problem` says why there is no face


@router.get("/face")
def get_face(folder: Folder) -> Response:
    """The face as a block of arrays: ``points`` (n, 3), ``faces`` (m, 3), ``values`` (n,): offset, mm.

    Offsets are from the bare skin, negative where the face is pressed in. Raises `InputError` where there is
    none.
    """
    study = folder.load()
    face = _build_face(folder, _compute_shape_fingerprint(folder, study))
    anatomy = read_anatomy(folder, study)
    if not isinstance(face, Socket) or anatomy is None:
        raise InputError(face if isinstance(face, str) else NO_LIMB_YET)
    arrays = {
        "points": face.points.astype(np.float32),
        "faces": face.faces.astype(np.uint32),
        "values": (-face.offset(anatomy.skin)).astype(np.float32),
    }
    return respond_block(arrays)


def _compute_shape_fingerprint(folder: StudyFolder, study: Study) -> str:
    """Changes with the limb's surfaces, the socket's file and what the table says of the shape."""
    table = study.socket
    file = compute_fingerprint([] if table.file is None else [study.path(table.file)])
    settings = compute_digest(table.model_dump(mode="json", exclude={"design", "loads"}))
    return f"{compute_surfaces_fingerprint(folder, study)} {file} {settings}"


@lru_cache(maxsize=2)
def _build_face(folder: StudyFolder, fingerprint: str) -> Socket | str:
    """The face around the bare skin, or why there is none; the last ones are kept, by ``fingerprint``."""
    study = folder.load()
    try:
        anatomy = read_anatomy(folder, study)
        return NO_LIMB_YET if anatomy is None else build_socket(study, anatomy, anatomy.skin)
    except InputError as error:
        return f"{error.what}; {error.remedy}" if error.remedy else error.what


@router.post("/areas")
def post_area(folder: Folder, area: AreaRequest) -> Json:
    """Add an area to the study file, or change the area of that name; returns the changed shape."""
    values = area.model_dump(exclude={"name"})
    if area.position is not None:
        values["position"] = project_to_skin_of_study(folder, area.position)
    set_area(folder.file, area.name, values)
    return get_shape(folder)


@router.post("/areas/{name}/remove")
def post_removal(folder: Folder, name: str) -> Json:
    """Take an area out of the study file."""
    remove_table(folder.file, "socket.areas", name)
    return get_shape(folder)


@router.post("/trimline")
def post_trimline(folder: Folder, line: TrimlineRequest) -> Json:
    """Replace the brim in the study file by a trimline; returns the changed shape. Raises `InputError` where
    it does not go once around the limb, or leaves no socket; the file is left as it was.
    """
    study = folder.load()
    anatomy = read_anatomy(folder, study)
    if anatomy is None:
        raise InputError(NO_LIMB_YET)
    with place_errors(study, "socket.trimline"):
        limb, frame = compute_profile(anatomy.skin, anatomy.frame), anatomy.frame
        points = wrap_trimline(limb, frame, np.array(line.points))
        trim_limb(limb, frame, Trim(line=points))
    set_trimline(folder.file, points.tolist())
    return get_shape(folder)


@router.post("/trimline/remove")
def post_default_brim(folder: Folder) -> Json:
    """Take the trimline out of the study file: the brim is the default one."""
    set_trimline(folder.file, None)
    return get_shape(folder)


@router.post("/start")
def post_start(folder: Folder, request: SocketRunRequest) -> Json:
    """Start ``limbfit socket`` or ``limbfit socket design``, as a process of its own."""
    return start_socket(folder, design=request.design)
