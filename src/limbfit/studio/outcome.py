"""What the view Results tells of a run, of this one or of one that was kept for comparison."""

from __future__ import annotations

import re
import shutil
import tempfile
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from ..errors import InputError, RunError
from ..pipeline import export_study
from ..pipeline.engine.storage import read_curves, write_json
from ..study import Record
from .folder import StudyFolder, read_stored
from .study_routes import list_stages

KEPT, ABOUT = "kept", "kept.json"
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_. -]{0,39}")
_FILES = ("calibrate/calibration.json", "predict/predict.json")
_COLUMNS = (
    "error_percent",
    "error_one_material_percent",
    "peak_force_N",
    "penetration_mm",
    "completed",
    "warnings",
)


def collect_outcome(folder: StudyFolder, kept: str | None = None) -> dict[str, Any]:
    """Parameters with intervals and verdicts, errors by site and their means, what is outside the records.

    Empty where nothing is stored.

    Parameters
    ----------
    kept : name of a kept run; by default the study's own results.
    """
    place = folder.results if kept is None else _find_kept_run(folder, kept)
    calibration, predicted = (read_stored(place / name) for name in _FILES)
    uncertainty = calibration.get("uncertainty") or {}
    return {
        "stages": [
            {key: stage.get(key) for key in ("name", "parameters", "converged", "reason")}
            | {"iterates": len(stage.get("iterations") or ())}
            for stage in calibration.get("stages", [])
        ],
        "intervals_95": uncertainty.get("intervals_95") or {},
        "verdict": uncertainty.get("verdict") or {},
        "sites": [
            {key: row.get(key) for key in ("site", "record", "region", "fitted", *_COLUMNS)}
            for row in predicted.get("sites", [])
        ],
        "outside": predicted.get("outside_text", []),
        "means": {key: value for key, value in predicted.items() if key.endswith("_percent")},
    }


def read_site_curves(folder: StudyFolder, site: str, kept: str | None = None) -> dict[str, list[float]]:
    """Columns of the predicted forces of a site (s, mm, N).

    Raises
    ------
    FileNotFoundError
        Where none are stored.
    """
    if kept is None:
        file = folder.artefact("predict", f"{site}.csv")
    else:
        _find_kept_run(folder, kept)
        file = folder.artefact(KEPT, kept, f"{site}.csv")
    return {name: values.tolist() for name, values in read_curves(file).items()}


def list_kept_runs(folder: StudyFolder) -> list[dict[str, Any]]:
    """``name`` and ``since`` of the runs that were kept, newest first."""
    found = [
        {"name": file.parent.name, "since": read_stored(file).get("since", "")}
        for file in (folder.results / KEPT).glob(f"*/{ABOUT}")
    ]
    return sorted(found, key=lambda row: str(row["since"]), reverse=True)


def keep_run(folder: StudyFolder, name: str) -> dict[str, Any]:
    """Copy what the page shows of this run to ``results/kept/<name>``, to compare later runs with it.

    Raises
    ------
    InputError
        For a name that is no plain one, or is taken.
    RunError
        Where the study has no finished prediction.
    """
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


def drop_run(folder: StudyFolder, name: str) -> None:
    """Remove a kept run."""
    shutil.rmtree(_find_kept_run(folder, name))


def _find_kept_run(folder: StudyFolder, name: str) -> Path:
    """The folder of a kept run.

    Raises
    ------
    FileNotFoundError
        Where none has this name.
    """
    if not _NAME.fullmatch(name) or not (folder.results / KEPT / name / ABOUT).is_file():
        raise FileNotFoundError("the kept run")
    return folder.artefact(KEPT, name, ABOUT).parent


def list_downloads(folder: StudyFolder) -> list[dict[str, str]]:
    """Files to keep: ``title`` and ``path`` below ``/api/files``."""
    wanted = [("report", "report.html", "report (HTML)"), ("report", "methods.md", "methods (Markdown)")]
    found = [
        {"title": title, "path": f"{stage}/{name}"}
        for stage, name, title in wanted
        if (folder.results / stage / name).is_file()
    ]
    for file in sorted((folder.results / "report" / "tables").glob("*.csv")):
        found.append({"title": f"table {file.stem} (CSV)", "path": f"report/tables/{file.name}"})
    return found


def list_site_downloads(folder: StudyFolder, site: str) -> list[dict[str, str]]:
    """The same for one site: curves, fields, the FEBio input where it was written."""
    study = folder.load()
    one = study.indentation(site)
    name, place = one.name, one.site.name if isinstance(one, Record) else one.name
    wanted = [
        ("predict", f"{name}.csv", "predicted curves (CSV)"),
        ("traces", f"{name}.csv", "regularised record (CSV)"),
        ("predict", f"{name}.vtu", "fields at the deepest point (VTU)"),
        ("simulate", f"{name}.csv", "simulated curve (CSV)"),
        ("simulate", f"{name}.vtu", "simulated fields (VTU)"),
        ("mesh", f"{place}.vtu", "mesh (VTU)"),
        ("export", f"{name}.feb", "FEBio input (.feb)"),
    ]
    return [
        {"title": title, "path": f"{stage}/{file}"}
        for stage, file, title in wanted
        if (folder.results / stage / file).is_file()
    ]


def write_feb_of(folder: StudyFolder, site: str) -> dict[str, str]:
    """Write a site as an input of FEBio; the path of the file below ``/api/files``.

    Raises
    ------
    RunError
        Where meshes are missing or stale: making them is a run.
    """
    study = folder.load()
    name = study.indentation(site).name
    states = {row["stage"]: row["state"] for row in list_stages(folder)}
    if states.get("mesh") != "done":
        raise RunError("the meshes are not up to date; run the study until mesh first")
    export_study(study, "feb", site=name)
    return {"path": f"export/{name}.feb"}
