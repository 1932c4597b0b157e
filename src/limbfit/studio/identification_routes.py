"""The view Identification: runs started and stopped, how far they are, how the search goes, what came out."""

import json
from pathlib import Path

from fastapi import APIRouter

from ..pipeline.commands.run import STAGE_NAMES
from ..pipeline.simulation.simulations import find_newest_simulation
from ..results.base import read_curves
from ..results.identification import CalibrationResult
from .folder import Json, StudyFolder
from .processes import find_running, find_starting, start_run, stop_run
from .study_routes import Folder, StrictModel, list_stage_states, list_stages

router = APIRouter(prefix="/api/identification")
LAST_LINES = 40  # of the log
LOGS_SEARCHED = 5  # for the iterates of a search that was stopped
_ENDS = {"end": "ended", "failed": "failed", "interrupted": "stopped"}


class RunRequest(StrictModel):
    """The last stage of a run, the stage to repeat from, and single stages to repeat."""

    until: str | None = None
    start: str | None = None
    force: tuple[str, ...] = ()


@router.get("")
def get_identification(folder: Folder) -> Json:
    """The stages and their states, the current or last run, the iterates of the search, and its answer."""
    recorded, stages = folder.load().recorded, list_stages(folder)
    calibration = CalibrationResult.find(folder.results)
    run = find_running(folder)
    state = next(row["state"] for row in stages if row["stage"] == "calibrate")
    return {
        "stages": stages,
        "chain": [row["stage"] for row in stages if row["stage"] in STAGE_NAMES],
        "run": run,
        "starting": find_starting(folder) if run is None else None,
        "last": describe_last_run(folder, run is not None),
        "iterates": _collect_iterates(folder, state, calibration),
        "sites": [{"site": one.name, "fitted": one.fitted, "forced": one.forced} for one in recorded],
        "answer": calibration and _describe_answer(calibration) | {"state": state},
    }


@router.get("/curves/{name}")
def get_curves(folder: Folder, name: str) -> Json:
    """A record's measured force, and the simulated ones: predicted, or the newest while it is searched.

    Time in s from touch-down, displacement in mm, force in N; under a stated force it is the displacements
    that are measured and simulated. ``of`` is null where nothing is simulated yet.
    """
    site = folder.load().indentation(name)
    states = list_stage_states(folder)
    live = _read_newest(folder, site.name) if states["calibrate"] != "done" else None
    stored = folder.results / "predict" / f"{site.name}.csv"
    measured = folder.results / "traces" / f"{site.name}.csv"
    if live is not None and measured.is_file():
        curves = {key: values.tolist() for key, values in read_curves(measured).items()}
        what, unit = ("displacement", "mm") if site.forced else ("force", "N")
        curves[f"{what}_measured_{unit}"] = curves.pop(f"{what}_{unit}")
        curves[f"{what}_simulated_{unit}"] = live
        return {"site": site.name, "of": "the newest simulation of the search", **curves}
    if stored.is_file():
        of = "the prediction" if states["predict"] == "done" else "the last prediction, which is stale"
        return {"site": site.name, "of": of, **{k: v.tolist() for k, v in read_curves(stored).items()}}
    return {"site": site.name, "of": None}


@router.post("/start")
def post_start(folder: Folder, request: RunRequest) -> Json:
    """Start or resume ``limbfit run`` with these options, as a process of its own."""
    return start_run(folder, request.until, request.start, request.force)


@router.post("/stop")
def post_stop(folder: Folder) -> Json:
    """Stop the run; what it has finished is kept, and another run goes on from there."""
    return stop_run(folder)


def _describe_answer(calibration: CalibrationResult) -> Json:
    keys = {"name", "cost", "evaluations", "converged", "reason", "parameters"}
    known = {"intervals_95", "correlation", "verdict", "at_bound", "combinations"}
    return {
        "stages": [stage.model_dump(include=keys) for stage in calibration.stages],
        "parameters": calibration.parameters,
        "warnings": calibration.warnings,
        **calibration.uncertainty.model_dump(include=known),
    }


def _collect_iterates(folder: StudyFolder, state: str, calibration: CalibrationResult | None) -> Json:
    """The iterates of a search that runs or was stopped; those of the stored answer otherwise."""
    if state != "done":
        stamp = folder.store.stamp("calibrate")
        finished = stamp.finished if stamp else ""
        for log in reversed(folder.logs[-LOGS_SEARCHED:]):
            fits = [row for row in _read_events(log) if row["event"] == "fit" and row.get("facts")]
            fits = [row for row in fits if row.get("stage") == "calibrate"]
            facts = [row["facts"] for row in fits if row["time"] > finished]
            if facts:
                return {"of": "log", "rows": facts}
    if calibration is None:
        return {"of": "nothing", "rows": []}
    keys = {"parameters", "cost", "error_percent", "error_percent_by_site"}
    stages = calibration.stages
    rows = [{"of": one.name, **row.model_dump(include=keys)} for one in stages for row in one.iterations]
    return {"of": "answer", "rows": rows}


def describe_last_run(folder: StudyFolder, is_running: bool) -> Json | None:
    """The run of the newest log: its command, how it ended, and its last progress; None without a log."""
    if not folder.logs:
        return None
    events = _read_events(folder.logs[-1])
    progress = [row for row in events if row["event"] in ("progress", "fit")]
    end = _ENDS.get(events[-1]["event"]) if events else None
    if end is None:
        end = "running" if is_running else "ended without a message: it was killed, or memory ran out"
    keys = ("stage", "done", "total", "text")
    lines = [{"seconds": row["seconds"], **{k: row.get(k) for k in keys}} for row in progress[-LAST_LINES:]]
    return {
        "what": events[0].get("what") if events else None,
        "state": end,
        "error": events[-1].get("text") if end == "failed" else None,
        "now": {key: progress[-1].get(key) for key in keys} if progress else None,
        "lines": lines,
    }


def _read_events(log: Path) -> list[Json]:
    """The events of a log; the last line may be half written."""
    events = []
    for line in log.read_text(encoding="utf-8", errors="replace").splitlines():
        try:
            row = json.loads(line)
        except ValueError:
            continue
        if isinstance(row, dict) and isinstance(row.get("event"), str):
            events.append(row)
    return events


def _read_newest(folder: StudyFolder, site: str) -> list[float] | None:
    for runs in sorted(folder.results.glob(".work-calibrate-*/runs")):
        simulation = find_newest_simulation(runs, site)
        if simulation is not None and simulation.completed:
            return list(map(float, simulation.force_N))
    return None
