"""What every view needs: the study, its stages, what changed, and files to download."""

from collections.abc import Mapping
from functools import lru_cache
from itertools import chain
from threading import Lock
from typing import Annotated, Any

from fastapi import APIRouter, Depends, Request, Response
from fastapi.responses import FileResponse
from pydantic import BaseModel, ConfigDict

from ..pipeline.commands.run import study_status
from ..pipeline.engine.provenance import list_input_files
from ..study import Study
from ..web import pack
from .folder import Json, StudyFolder, compute_fingerprint
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
    """Arrays and facts as a block that a script reads (see ``limbfit/web/__init__.py``)."""
    return Response(pack(arrays, facts), media_type="application/octet-stream")


@router.get("/study")
def get_study(folder: Folder) -> Json:
    """The name of the study, its sites, and its records and planned indentations, without paths of inputs."""
    if folder.is_new:
        nothing: Json = {"has_image": False, "sites": [], "indentations": []}
        return {"is_new": True, "name": folder.folder.name, **nothing}
    study = folder.load()
    return {
        "is_new": False,
        "name": study.study.name,
        "has_image": study.image is not None,
        "sites": [{"name": site.name} for site in study.sites],
        "indentations": [
            {key: getattr(one, key) for key in ("name", "region", "fitted", "touch_down_s", "peak_s")}
            | {"has_trace": one.trace is not None, "is_recorded": study.is_recorded(one)}
            for one in study.indentations
        ],
    }


@router.get("/stages")
def get_stages(folder: Folder) -> Json:
    """The state of every stage, as ``limbfit status`` reports it, and the current run, if any."""
    return {"stages": [] if folder.is_new else list_stages(folder), "run": find_running(folder)}


@router.get("/changes")
def get_changes(folder: Folder) -> Json:
    """Fingerprints by topic; a page reads a topic again when its fingerprint has changed."""
    return {**folder.changes(), "run": find_running(folder)}


@router.get("/files/{path:path}")
def get_file(folder: Folder, path: str, download: bool = False) -> FileResponse:
    """A stored artefact ``results/<path>``, such as ``report/tables/sites.csv``; ``download``: to keep."""
    file = folder.artefact(*path.split("/"))
    headers = {}
    if file.suffix.lower() in (".html", ".htm", ".svg", ".xml"):
        headers["Content-Security-Policy"] = REPORT_POLICY
    return FileResponse(file, filename=file.name if download else None, headers=headers)


_LOCK = Lock()  # one request computes them while others wait


def list_stages(folder: StudyFolder) -> list[Json]:
    """The rows of `study_status`; they are computed again only when an input or a result has changed."""
    with _LOCK:
        return _read_cached_stages(folder, _compute_fingerprint(folder, folder.load()))


@lru_cache(maxsize=1)
def _read_cached_stages(folder: StudyFolder, fingerprint: str) -> list[Json]:
    return study_status(folder.load())


def list_stage_states(folder: StudyFolder) -> dict[str, str]:
    """The state of each stage, by its name."""
    return {row["stage"]: row["state"] for row in list_stages(folder)}


def _compute_fingerprint(folder: StudyFolder, study: Study) -> str:
    inputs = {study.path(path) for paths in list_input_files(study).values() for path in paths}
    inside = (sorted(path.rglob("*")) if path.is_dir() else [path] for path in sorted(inputs))
    below = chain.from_iterable(inside)
    changes = folder.changes()
    known = (changes[topic] for topic in ("study", "stages", "labels"))
    return repr((str(folder.file), *known, compute_fingerprint(below)))
