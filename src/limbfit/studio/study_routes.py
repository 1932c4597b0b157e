"""What every view needs: the study, its stages, what changed, and files to download."""

from __future__ import annotations

from collections.abc import Mapping
from threading import Lock
from typing import Annotated, Any

from fastapi import APIRouter, Depends, Request, Response
from fastapi.responses import FileResponse
from pydantic import BaseModel, ConfigDict

from ..pipeline import study_status
from ..pipeline.engine.provenance import list_input_files
from ..study import Study
from ..web.arrays import pack
from .folder import StudyFolder, compute_fingerprint
from .processes import find_running

router = APIRouter(prefix="/api")
# A report has scripts of its own: shown in a browser, it is kept apart from this page and its cookie.
REPORT_POLICY = (
    "sandbox allow-scripts allow-downloads; default-src 'none'; img-src data: blob:; "
    "script-src 'unsafe-inline'; style-src 'unsafe-inline'; font-src data:; connect-src 'none'"
)


def get_study_folder(request: Request) -> StudyFolder:
    """The folder that this server shows."""
    return request.app.state.folder


Folder = Annotated[StudyFolder, Depends(get_study_folder)]


class StrictModel(BaseModel):
    """The body of a request; unknown keys are refused."""

    model_config = ConfigDict(extra="forbid")


def respond_block(arrays: Mapping[str, Any], facts: Mapping[str, Any] | None = None) -> Response:
    """Arrays and facts as a block that a script reads (see ``limbfit/web/arrays.py``)."""
    return Response(pack(arrays, facts), media_type="application/octet-stream")


@router.get("/study")
def get_study(folder: Folder) -> dict[str, Any]:
    """The tables of the study without the paths of its inputs, and the name of its folder."""
    study = folder.load()
    return {
        "name": study.study.name,
        "description": study.study.description,
        "folder": folder.folder.resolve().name,
        "has_image": study.image is not None,
        "tissues": list(study.tissues),
        "material": study.material.model_dump(mode="json"),
        "indenter": study.indenter.model_dump(mode="json", exclude={"file"}),
        "sites": [
            {
                **site.model_dump(mode="json", exclude={"trace"}),
                "has_trace": bool(study.records_at(site)),
                "is_recorded": study.is_recorded(site),
            }
            for site in study.sites
        ],
        "indentations": [
            {
                "name": indentation.name,
                "region": indentation.region,
                "fitted": indentation.fitted,
                "has_trace": indentation.trace is not None,
                "is_recorded": indentation.trace is not None and study.path(indentation.trace).is_file(),
                "touch_down_s": indentation.touch_down_s,
                "peak_s": indentation.peak_s,
            }
            for indentation in study.indentations
        ],
        "notes": list(study.notes),
    }


@router.get("/stages")
def get_stages(folder: Folder) -> dict[str, Any]:
    """The state of every stage, as ``limbfit status`` reports it, and the current run, if any."""
    return {"stages": list_stages(folder), "run": find_running(folder)}


@router.get("/changes")
def get_changes(folder: Folder) -> dict[str, Any]:
    """Fingerprints by topic; a page reads a topic again when its fingerprint has changed."""
    return {**folder.changes(), "run": find_running(folder)}


@router.get("/files/{stage}/{name}")
def get_file(folder: Folder, stage: str, name: str, download: bool = False) -> FileResponse:
    """A stored artefact ``results/<stage>/<name>``; with ``download`` as a file to keep."""
    return _respond_file(folder, (stage, name), download)


@router.get("/files/{stage}/{group}/{name}")
def get_file_of_group(
    folder: Folder, stage: str, group: str, name: str, download: bool = False
) -> FileResponse:
    """A stored artefact ``results/<stage>/<group>/<name>``, such as a table of the report."""
    return _respond_file(folder, (stage, group, name), download)


def _respond_file(folder: StudyFolder, parts: tuple[str, ...], download: bool) -> FileResponse:
    path = folder.artefact(*parts)
    headers = {}
    if path.suffix.lower() in (".html", ".htm", ".svg", ".xml"):
        headers["Content-Security-Policy"] = REPORT_POLICY
    return FileResponse(path, filename=parts[-1] if download else None, headers=headers)


class _Remembered:
    """The states of the stages as last computed, with the mark of the files they depend on."""

    def __init__(self) -> None:
        self.lock = Lock()
        self.mark, self.rows = "", []  # type: str, list[dict[str, Any]]


_remembered = _Remembered()


def list_stages(folder: StudyFolder) -> list[dict[str, Any]]:
    """The rows of `study_status`; they are computed again only when an input or a result has changed."""
    study = folder.load()
    mark = _mark(folder, study)
    with _remembered.lock:
        if _remembered.mark != mark:
            _remembered.rows = study_status(study)
            _remembered.mark = mark
        return _remembered.rows


def list_stage_states(folder: StudyFolder) -> dict[str, str]:
    """The state of each stage, by its name."""
    return {row["stage"]: row["state"] for row in list_stages(folder)}


def _mark(folder: StudyFolder, study: Study) -> str:
    inputs = {study.path(path) for paths in list_input_files(study).values() for path in paths}
    below = [
        file for path in sorted(inputs) for file in (sorted(path.rglob("*")) if path.is_dir() else [path])
    ]
    changes = folder.changes()
    return repr(
        (str(folder.file), changes["study"], changes["stages"], changes["labels"], compute_fingerprint(below))
    )
