"""The view Results: parameters and errors, fields to play, runs kept for comparison, files to download."""

import re
import shutil
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import pyvista as pv
from fastapi import APIRouter, Response
from pydantic import Field

from ..errors import InputError, RunError
from ..mesh import read_grid, read_vtu
from ..phases import find_loading_end, find_phases
from ..pipeline.commands.other_solvers import export_study
from ..pipeline.engine.store import read_json, write_json
from ..results.base import read_curves
from ..results.identification import CalibrationResult, PredictResult
from ..results.runs import SimulateResult, is_current
from ..web import to_volume_shape
from . import processes
from .folder import Json, StudyFolder, compute_fingerprint
from .study_routes import Folder, StrictModel, list_stage_states, respond_block

router = APIRouter(prefix="/api/results")
KEPT, ABOUT = "kept", "kept.json"
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_. -]{0,39}")
_FILES = (CalibrationResult.FILE, PredictResult.FILE)
_SITE_KEYS = {
    *("site", "record", "region", "fitted", "completed", "warnings"),
    *("error_percent", "error_one_material_percent", "peak_force_N", "penetration_mm"),
}
_MEAN_KEYS = {f"{kind}_error_{use}_percent" for kind in ("mean", "sd") for use in ("fitted", "heldout")}
_FRAME = re.compile(r'<DataSet timestep="([^"]+)" part="0" file="[^"/]+/(step-\d{4,}\.vtu)"/>')


@dataclass(frozen=True)
class StoredField:
    """A quantity that is stored: its array on cells or points, and which component; None is the length."""

    title: str
    unit: str
    array: str
    on_cells: bool = True
    component: int | None = 0


FIELDS = {
    "displacement": StoredField("displacement", "mm", "displacement_mm", False, None),
    "von_mises": StoredField("von Mises stress", "kPa", "von_mises_kPa"),
    **{
        f"cauchy_{name}": StoredField(f"Cauchy stress {name}", "kPa", "cauchy_kPa", True, i)
        for i, name in enumerate(("xx", "yy", "zz", "xy", "yz", "zx"))
    },
    "largest_stretch": StoredField("largest principal stretch", "–", "largest_stretch"),
    "middle_stretch": StoredField("middle principal stretch", "–", "middle_stretch"),
    "smallest_stretch": StoredField("smallest principal stretch", "–", "smallest_stretch"),
    "J": StoredField("volume ratio J", "–", "J"),
    "contact_pressure": StoredField("contact pressure", "kPa", "contact_pressure_kPa", False),
    "energy_density": StoredField("strain energy density", "kPa", "energy_density_kPa"),
}


class KeptRunName(StrictModel):
    """The name under which a run is kept."""

    name: Annotated[str, Field(min_length=1, max_length=40)]


@router.get("")
def get_outcome(folder: Folder, kept: str | None = None) -> Json:
    """Parameters with intervals and verdicts, errors by site and their means, what is outside the records.

    ``kept`` is the name of a kept run; by default the study's own results are read, and tables are empty
    where nothing is stored. The names of kept runs and the files to download come with them.
    """
    place = folder.results if kept is None else _find_kept_run(folder, kept)
    calibration, predicted = CalibrationResult.find(place), PredictResult.find(place)
    return {
        "stages": [
            stage.model_dump(include={"name", "parameters", "converged", "reason"})
            | {"iterates": len(stage.iterations)}
            for stage in (calibration.stages if calibration else ())
        ],
        "intervals_95": calibration.uncertainty.intervals_95 if calibration else {},
        "verdict": calibration.uncertainty.verdict if calibration else {},
        "sites": [row.model_dump(include=_SITE_KEYS) for row in (predicted.sites if predicted else ())],
        "outside": predicted.outside_text if predicted else [],
        "means": predicted.model_dump(include=_MEAN_KEYS) if predicted else {},
        "kept": _list_kept_runs(folder),
        "downloads": _list_downloads(folder),
    }


@router.get("/site/{site}")
def get_site(folder: Folder, site: str) -> Json:
    """The stored fields and files of a site, and the state of its simulation."""
    return {
        "sources": list(_iterate_sources(folder, folder.load().indentation(site).name)),
        "downloads": _list_site_downloads(folder, site),
        "simulating": processes.find_simulating(folder),
        "failure": processes.read_failure(folder, site),
    }


@router.get("/curves/{site}")
def get_curves(folder: Folder, site: str, kept: str | None = None) -> dict[str, list[float]]:
    """Columns of the predicted forces of a site (s, mm, N); `FileNotFoundError` where none are stored."""
    if kept is not None:
        _find_kept_run(folder, kept)
    parts = ("predict",) if kept is None else (KEPT, kept)
    curves = read_curves(folder.artefact(*parts, f"{site}.csv"))
    return {name: values.tolist() for name, values in curves.items()}


@router.get("/mesh/{source}/{site}")
def get_mesh(folder: Folder, source: str, site: str) -> Response:
    """The mesh of a site's fields: the arrays of `VolumeShape`; facts: names of regions, stored fields."""
    file = _find_file(folder, source, site, 0)
    mesh, arrays = read_vtu(file), read_arrays(file)
    fields = [
        {"name": name, "title": field.title, "unit": field.unit}
        for name, field in FIELDS.items()
        if field.array in arrays
    ]
    facts = {"regions": list(mesh.region_names), "fields": fields, "cells": len(mesh.cells)}
    return respond_block(to_volume_shape(mesh).arrays(), facts)


@router.get("/moment/{source}/{site}/{moment}/{name}")
def get_moment(folder: Folder, source: str, site: str, moment: int, name: str) -> Response:
    """``moved`` (n, 3) of the drawn nodes in mm, and ``values`` of a field on cells or drawn nodes. Raises
    `InputError` for an unknown field, or one that is not stored, and `FileNotFoundError` for a moment that is
    not there.
    """
    field = FIELDS.get(name)
    arrays = read_arrays(_find_file(folder, source, site, moment))
    if field is None or field.array not in arrays:
        raise InputError("no such field is stored", remedy="fields are " + ", ".join(FIELDS))
    nodes = np.unique(arrays["cells"][:, :4])
    values = arrays[field.array]
    if values.ndim == 2:
        values = np.linalg.norm(values, axis=1) if field.component is None else values[:, field.component]
    drawn = {
        "moved": arrays["displacement_mm"][nodes].astype(np.float32),
        "values": (values if field.on_cells else values[nodes]).astype(np.float32),
    }
    return respond_block(drawn, {"on": "cells" if field.on_cells else "nodes"})


@router.post("/simulate/{site}")
def post_simulation(folder: Folder, site: str) -> Json:
    """Start ``limbfit simulate --animation`` for a site."""
    return processes.start_simulation(folder, site)


@router.post("/stop")
def post_stop(folder: Folder) -> Json:
    """Interrupt the simulation."""
    return processes.stop_simulation(folder)


@router.post("/feb/{site}")
def post_feb(folder: Folder, site: str) -> dict[str, str]:
    """Write a site as an input of FEBio below ``/api/files``; `RunError` where meshes are not up to date."""
    study = folder.load()
    name = study.indentation(site).name
    if list_stage_states(folder).get("mesh") != "done":
        raise RunError("the meshes are not up to date; run the study until mesh first")
    export_study(study, "feb", site=name)
    return {"path": f"export/{name}.feb"}


@router.post("/keep")
def post_kept(folder: Folder, run: KeptRunName) -> Json:
    """Copy what the page shows of this run to ``results/kept/<name>``, to compare later runs with it. Raises
    `InputError` for a name that is no plain one, or is taken, and `RunError` where the study has no finished
    prediction.
    """
    name = run.name
    if not _NAME.fullmatch(name):
        raise InputError("no name to keep a run under", remedy="use letters, digits, spaces, '-', '_', '.'")
    place = folder.results / KEPT / name
    if place.exists():
        raise InputError(f"a run is already kept as {name!r}", remedy="choose another name")
    if not (folder.results / _FILES[1]).is_file():
        raise RunError("there is no finished prediction to keep; run the study first")
    place.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=".", dir=place.parent) as work:
        draft = Path(work) / "run"
        for file in (*_FILES, *(f"predict/{csv.name}" for csv in (folder.results / "predict").glob("*.csv"))):
            source = folder.results / file
            target = draft / (file if file in _FILES else source.name)
            target.parent.mkdir(parents=True, exist_ok=True)
            if source.is_file():
                shutil.copyfile(source, target)
        write_json(draft / ABOUT, {"since": datetime.now(UTC).isoformat(timespec="seconds")})
        draft.rename(place)
    return {"name": name}


@router.post("/drop")
def post_drop(folder: Folder, run: KeptRunName) -> Json:
    """Remove a kept run."""
    shutil.rmtree(_find_kept_run(folder, run.name))
    return {}


def _list_kept_runs(folder: StudyFolder) -> list[Json]:
    """``name`` and ``since`` of the runs that were kept, newest first."""
    files = (folder.results / KEPT).glob(f"*/{ABOUT}")
    runs = [{"name": file.parent.name, "since": read_json(file)["since"]} for file in files]
    return sorted(runs, key=lambda row: row["since"], reverse=True)


def _find_kept_run(folder: StudyFolder, name: str) -> Path:
    """The folder of a kept run. Raises `FileNotFoundError` where none has this name."""
    if not _NAME.fullmatch(name) or not (folder.results / KEPT / name / ABOUT).is_file():
        raise FileNotFoundError("the kept run")
    return folder.artefact(KEPT, name, ABOUT).parent


def _iterate_sources(folder: StudyFolder, site: str) -> Iterator[Json]:
    """The stored fields of a site: every step of a simulation, or the deepest point of the prediction.

    Each has ``source``, ``title``, ``times_s``, ``deepest`` (which of them), ``parameters_from``, and
    ``mark``, which other fields change.
    """
    moments = _list_moments(folder, site)
    if moments:
        times_s = [time for time, _ in moments]
        simulated = SimulateResult.find(folder.results, site)
        of = simulated and simulated.parameters_from
        if simulated and not is_current(simulated, CalibrationResult.find(folder.results)):
            of = f"{of}, before the study was identified anew"
        curve, deepest = folder.results / "simulate" / f"{site}.csv", len(times_s) - 1
        if curve.is_file():  # else the simulation goes on
            deepest = int(np.argmin(np.abs(np.array(times_s) - _find_peak_time(curve))))
        yield {
            "source": "simulate",
            "title": "every step, simulated",
            "times_s": times_s,
            "deepest": deepest,
            "parameters_from": of,
            "mark": compute_fingerprint(file for _, file in moments),
        }
    predicted = folder.results / "predict" / f"{site}.vtu"
    if predicted.is_file():
        yield {
            "source": "predict",
            "title": "the deepest point, predicted",
            "times_s": [_find_peak_time(folder.artefact("predict", f"{site}.csv"))],
            "deepest": 0,
            "parameters_from": "identified",
            "mark": compute_fingerprint([predicted]),
        }


def _list_moments(folder: StudyFolder, site: str) -> list[tuple[float, Path]]:
    """The time (s) and file of every stored step of an animation."""
    collection = folder.results / "simulate" / f"{site}.pvd"
    if not collection.is_file():
        return []
    named = _FRAME.findall(collection.read_text(encoding="utf-8"))
    files = [(float(time), collection.with_suffix("") / name) for time, name in named]
    return [(time, file) for time, file in files if file.is_file()]


def _find_peak_time(curve: Path) -> float:
    columns = read_curves(curve)
    motion = columns["displacement_mm"] if "displacement_mm" in columns else columns["force_N"]
    loading = find_loading_end(find_phases(columns["time_s"], motion))
    return 0.0 if loading is None else loading.end_s


def _find_file(folder: StudyFolder, source: str, site: str, moment: int) -> Path:
    if source == "predict":
        return folder.artefact("predict", f"{site}.vtu")
    if source != "simulate":
        raise InputError("fields are those of simulate or predict")
    folder.artefact("simulate", f"{site}.pvd")  # a plain name, inside the study
    moments = _list_moments(folder, site)
    if not 0 <= moment < len(moments):
        raise FileNotFoundError(f"moment {moment} of site {site}")
    return folder.artefact("simulate", site, moments[moment][1].name)


def read_arrays(file: Path) -> dict[str, np.ndarray]:
    """The point and cell arrays of a VTU file, and its ``cells`` (m, k)."""
    grid: Any = pv.wrap(read_grid(file))
    cells = grid.cell_connectivity.reshape(grid.n_cells, -1)
    return {**grid.point_data, **grid.cell_data, "cells": cells}


def _list_downloads(folder: StudyFolder) -> list[dict[str, str]]:
    """``title`` and ``path`` below ``/api/files`` of the report and its tables."""
    tables = sorted((folder.results / "report" / "tables").glob("*.csv"))
    named = {f"report/tables/{file.name}": f"table {file.stem} (CSV)" for file in tables}
    files = {"report/report.html": "report (HTML)", "report/methods.md": "methods (Markdown)", **named}
    return _select_stored(folder, files)


def _list_site_downloads(folder: StudyFolder, site: str) -> list[dict[str, str]]:
    """The same for one site: curves, fields, the FEBio input where it was written."""
    indentation = folder.load().indentation(site)
    name, place = indentation.name, indentation.site.name
    files = {
        f"predict/{name}.csv": "predicted curves (CSV)",
        f"traces/{name}.csv": "regularised record (CSV)",
        f"predict/{name}.vtu": "fields at the deepest point (VTU)",
        f"simulate/{name}.csv": "simulated curve (CSV)",
        f"simulate/{name}.vtu": "simulated fields (VTU)",
        f"mesh/{place}.vtu": "mesh (VTU)",
        f"export/{name}.feb": "FEBio input (.feb)",
    }
    return _select_stored(folder, files)


def _select_stored(folder: StudyFolder, files: dict[str, str]) -> list[dict[str, str]]:
    return [
        {"title": title, "path": path} for path, title in files.items() if (folder.results / path).is_file()
    ]
