"""The view Results: parameters and errors, fields to play, runs kept for comparison, files to download."""

from __future__ import annotations

import re
import shutil
import tempfile
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Any

from fastapi import APIRouter, Response
from pydantic import Field

from ..errors import InputError, RunError
from ..pipeline.commands.export import export_study
from ..pipeline.engine.storage import read_json, write_json
from ..results.curves import read_curves
from ..results.identification import CalibrationResult, PredictResult
from ..study import Record
from . import playback, processes
from .folder import StudyFolder
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


class KeptRunName(StrictModel):
    """The name under which a run is kept."""

    name: Annotated[str, Field(min_length=1, max_length=40)]


@router.get("")
def get_outcome(folder: Folder, kept: str | None = None) -> dict[str, Any]:
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
def get_site(folder: Folder, site: str) -> dict[str, Any]:
    """The stored fields and files of a site, and the state of its simulation."""
    return {
        "sources": playback.list_sources(folder, folder.load().indentation(site).name),
        "downloads": _list_site_downloads(folder, site),
        "simulating": processes.find_simulating(folder),
        "failure": processes.read_failure(folder, site),
    }


@router.get("/curves/{site}")
def get_curves(folder: Folder, site: str, kept: str | None = None) -> dict[str, list[float]]:
    """Columns of the predicted forces of a site (s, mm, N), of this run or of a kept one. Raises
    `FileNotFoundError` where none are stored.
    """
    if kept is not None:
        _find_kept_run(folder, kept)
    parts = ("predict",) if kept is None else (KEPT, kept)
    curves = read_curves(folder.artefact(*parts, f"{site}.csv"))
    return {name: values.tolist() for name, values in curves.items()}


@router.get("/mesh/{source}/{site}")
def get_mesh(folder: Folder, source: str, site: str) -> Response:
    """The mesh that the fields of a site stand on, as a block of arrays."""
    return respond_block(*playback.read_mesh(folder, source, site))


@router.get("/moment/{source}/{site}/{moment}/{field}")
def get_moment(folder: Folder, source: str, site: str, moment: int, field: str) -> Response:
    """Displacements and a field at one moment, as a block of arrays."""
    return respond_block(*playback.read_moment(folder, source, site, moment, field))


@router.post("/simulate/{site}")
def post_simulation(folder: Folder, site: str) -> dict[str, Any]:
    """Start ``limbfit simulate --animation`` for a site."""
    return processes.start_simulation(folder, site)


@router.post("/stop")
def post_stop(folder: Folder) -> dict[str, Any]:
    """Interrupt the simulation."""
    return processes.stop_simulation(folder)


@router.post("/feb/{site}")
def post_feb(folder: Folder, site: str) -> dict[str, str]:
    """Write a site as an input of FEBio; the path of the file below ``/api/files``. Raises `RunError` where
    meshes are missing or stale: only a run makes them.
    """
    study = folder.load()
    name = study.indentation(site).name
    if list_stage_states(folder).get("mesh") != "done":
        raise RunError("the meshes are not up to date; run the study until mesh first")
    export_study(study, "feb", site=name)
    return {"path": f"export/{name}.feb"}


@router.post("/keep")
def post_kept(folder: Folder, run: KeptRunName) -> dict[str, Any]:
    """Copy what the page shows of this run to ``results/kept/<name>``, to compare later runs with it. Raises
    `InputError` for a name that is no plain one, or is taken, and `RunError` where the study has no finished
    prediction.
    """
    name = run.name
    if not _NAME.fullmatch(name):
        raise InputError(
            "not a name to keep a run under", remedy="use letters, digits, spaces, '-', '_', '.'"
        )
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
def post_drop(folder: Folder, run: KeptRunName) -> dict[str, Any]:
    """Remove a kept run."""
    shutil.rmtree(_find_kept_run(folder, run.name))
    return {}


def _list_kept_runs(folder: StudyFolder) -> list[dict[str, Any]]:
    """``name`` and ``since`` of the runs that were kept, newest first."""
    files = (folder.results / KEPT).glob(f"*/{ABOUT}")
    runs = [{"name": file.parent.name, "since": read_json(file)["since"]} for file in files]
    return sorted(runs, key=lambda row: row["since"], reverse=True)


def _find_kept_run(folder: StudyFolder, name: str) -> Path:
    """The folder of a kept run. Raises `FileNotFoundError` where none has this name."""
    if not _NAME.fullmatch(name) or not (folder.results / KEPT / name / ABOUT).is_file():
        raise FileNotFoundError("the kept run")
    return folder.artefact(KEPT, name, ABOUT).parent


def _list_downloads(folder: StudyFolder) -> list[dict[str, str]]:
    """``title`` and ``path`` below ``/api/files`` of the report and its tables."""
    files = [("report/report.html", "report (HTML)"), ("report/methods.md", "methods (Markdown)")]
    for file in sorted((folder.results / "report" / "tables").glob("*.csv")):
        files.append((f"report/tables/{file.name}", f"table {file.stem} (CSV)"))
    return _select_stored(folder, files)


def _list_site_downloads(folder: StudyFolder, site: str) -> list[dict[str, str]]:
    """The same for one site: curves, fields, the FEBio input where it was written."""
    indentation = folder.load().indentation(site)
    name = indentation.name
    place = indentation.site.name if isinstance(indentation, Record) else name
    files = [
        (f"predict/{name}.csv", "predicted curves (CSV)"),
        (f"traces/{name}.csv", "regularised record (CSV)"),
        (f"predict/{name}.vtu", "fields at the deepest point (VTU)"),
        (f"simulate/{name}.csv", "simulated curve (CSV)"),
        (f"simulate/{name}.vtu", "simulated fields (VTU)"),
        (f"mesh/{place}.vtu", "mesh (VTU)"),
        (f"export/{name}.feb", "FEBio input (.feb)"),
    ]
    return _select_stored(folder, files)


def _select_stored(folder: StudyFolder, files: list[tuple[str, str]]) -> list[dict[str, str]]:
    return [{"title": title, "path": path} for path, title in files if (folder.results / path).is_file()]
