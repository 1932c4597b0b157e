"""The view Traces: raw and regularised records, warnings about them, and stated touch-downs and peaks."""

from functools import lru_cache
from typing import NamedTuple

import numpy as np
from fastapi import APIRouter
from pydantic import ConfigDict

from ..anatomy.surfaces.surfaces import load_anatomy
from ..arrays import Array
from ..errors import InputError
from ..pipeline.records.record_checks import record_flags
from ..pipeline.records.traces import read_record, read_trace_file
from ..results.identification import PredictResult
from ..results.limb import SitesResult, TraceFacts
from ..study import Record, Study
from ..traces.numerics import average_in_bins
from .editing import set_record, set_site
from .folder import Json, StudyFolder, compute_fingerprint, resolve_inside
from .study_routes import Folder, StrictModel, list_stage_states

router = APIRouter(prefix="/api/traces")
MAX_POINTS, CURVE_POINTS = 2000, 400  # of a raw record and of a regularised one on the page


class Times(StrictModel):
    """When the indenter meets the skin and when its way in ends (s of the record); null: found by limbfit."""

    model_config = ConfigDict(allow_inf_nan=False)

    touch_down_s: float | None = None
    peak_s: float | None = None


class NewRecord(StrictModel):
    """A file below the study's folder that becomes a site's record."""

    path: str
    fitted: bool


@router.get("")
def get_records(folder: Folder) -> Json:
    """Every record and planned indentation, ``site`` its name, with the error of its file; and flags."""
    study = folder.load()
    rows: list[Json] = []
    records: dict[str, _ReadRecord] = {}
    for indentation in study.indentations:
        error = None
        if isinstance(indentation, Record) and study.is_recorded(indentation):
            try:
                records[indentation.name] = _read(folder, study, indentation)
            except InputError as reason:
                error = str(reason)
        rows.append({"site": indentation.name, "error": error})
    return {"sites": rows, "flags": _collect_flags(folder, study, records)}


@router.get("/{name}")
def get_record(folder: Folder, name: str) -> Json:
    """One record raw and regularised; times in s of the record, displacement in mm, force in N."""
    study = folder.load()
    return _read(folder, study, _find_record(study, name)).content


@router.post("/{name}/preview")
def preview_record(folder: Folder, name: str, times: Times) -> Json:
    """The record as other times would change it; nothing is stored."""
    study = folder.load()
    return _read(folder, study, _replace_times(_find_record(study, name), times)).content


@router.post("/{name}")
def post_times(folder: Folder, name: str, times: Times) -> Json:
    """Store the times in the study file, or remove them; the stage ``traces`` turns stale."""
    study = folder.load()
    record = _replace_times(_find_record(study, name), times)
    content = _read(folder, study, record).content
    set_record(folder.file, record, {"touch_down_s": record.touch_down_s, "peak_s": record.peak_s})
    return content


@router.post("/{name}/record")
def post_record(folder: Folder, name: str, given: NewRecord) -> Json:
    """Make a file the record of a site, where it can be one; its facts."""
    study = folder.load()
    file = resolve_inside(folder.folder, *given.path.split("/"))
    _, _, facts = read_trace_file(file, study.traces)
    values = {"trace": given.path, "depth_mm": None, "speed_mm_s": None, "fitted": given.fitted}
    set_site(folder.file, study.site(name).name, values)
    return facts.to_plain()


def _find_record(study: Study, name: str) -> Record:
    record = study.indentation(name)
    if not isinstance(record, Record):
        raise InputError(f"site {name} has no record", file=study.file, place=f"sites.{name}")
    return record


def _replace_times(record: Record, times: Times) -> Record:
    rounded = {key: None if at is None else round(at, 4) for key, at in times.model_dump().items()}
    return record.model_copy(update=rounded)


class _ReadRecord(NamedTuple):
    """A record that was read, and what the page shows of it."""

    facts: TraceFacts
    content: Json


def _read(folder: StudyFolder, study: Study, record: Record) -> _ReadRecord:
    """A record with its curves; it is read again only when its file, its times or the table has changed."""
    file = study.path(record.trace)
    return _read_cached_record(folder, record, f"{file} {compute_fingerprint([file])} {study.traces!r}")


@lru_cache(maxsize=64)
def _read_cached_record(folder: StudyFolder, record: Record, fingerprint: str) -> _ReadRecord:
    trace, smooth, facts = read_record(folder.load(), record)
    even = smooth.resample(CURVE_POINTS)
    time, force, _ = average_in_bins(trace.time_s, trace.force_N, MAX_POINTS)
    _, moved, _ = average_in_bins(trace.time_s, trace.displacement_mm, MAX_POINTS)
    content = {
        "site": record.name,
        "facts": {key: value for key, value in facts.to_plain().items() if not key.startswith("knots")},
        "stated": {"touch_down_s": record.touch_down_s, "peak_s": record.peak_s},
        "samples": len(trace.time_s),
        "step_s": float(np.median(np.diff(trace.time_s))),
        "raw": _round_curves(time, moved, force),
        "regularised": _round_curves(even.time_s + facts.touch_down_s, even.displacement_mm, even.force_N),
    }
    return _ReadRecord(facts, content)


def _round_curves(time_s: Array, displacement_mm: Array, force_N: Array) -> dict[str, list[float]]:
    curves = {"time_s": time_s, "displacement_mm": displacement_mm, "force_N": force_N}
    return {name: np.round(values, 5).tolist() for name, values in curves.items()}


def _collect_flags(folder: StudyFolder, study: Study, records: dict[str, _ReadRecord]) -> list[Json]:
    """Flags on the records as they are now, and flags of the last prediction against the model."""
    sites = SitesResult.find(folder.results)
    placed = {row.site: row for row in sites.sites} if sites else {}
    anatomy = load_anatomy(folder.results / "surfaces") if sites else None
    facts = {name: record.facts for name, record in records.items()}
    steps = {name: record.content["step_s"] for name, record in records.items()}
    flags = [flag.to_dict() for flag in record_flags(study, facts, steps, placed, anatomy)]
    if (predicted := PredictResult.find(folder.results)) is not None:
        states = list_stage_states(folder)
        old = "" if states.get("predict") == "done" else " (of the last prediction, which is stale)"
        for flag in predicted.flags:
            if flag.found == "against the model":
                flags.append(flag.to_plain() | {"text": flag.text + old})
    return flags
