"""Which stages there are, what each depends on, and the run that does what is missing."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from .. import __version__
from ..errors import InputError
from ..execution import make_executor
from ..study import Study
from .calibrate_stage import run_calibrate
from .context import Context, Listener
from .corrections import keep_corrections
from .geometry_stages import run_mesh, run_segment, run_sites, run_surfaces
from .predict_stage import run_predict
from .provenance import code_digest, input_digests, input_files, machine, settings_record, versions
from .report_stage import run_report
from .store import Store, digest, file_digest, lock, write_json
from .traces_stage import run_traces


@dataclass(frozen=True)
class Stage:
    """A stage: what it stands on, the study tables it reads, the rooms whose code makes it."""

    name: str
    run: Callable[[Context, Path], dict[str, Any]]
    needs: tuple[str, ...] = ()
    tables: tuple[str, ...] = ()
    site_keys: tuple[str, ...] = ()
    rooms: tuple[str, ...] = ()


_PLACE = ("name", "position", "near", "axis", "region", "fitted")
_UNSEEN: dict[str, Any] = {"region": "", "trace": None, "axis": None, "edge": None}
_IDENTIFY = ("calibration", "objective", "parameters", "prediction", "trust_region", "uncertainty")
_MECHANICS = (
    *("fe", "indentation", "mesh", "pipeline/simulations", "pipeline/traces_stage"),
    *(f"identify/{name}" for name in _IDENTIFY),
)
STAGES = (
    Stage("segment", run_segment, (), ("image", "segmentation"), rooms=("anatomy",)),
    Stage("surfaces", run_surfaces, ("segment",), ("geometry", "surfaces"), rooms=("anatomy",)),
    Stage("sites", run_sites, ("surfaces",), ("indenter",), _PLACE, ("anatomy",)),
    Stage("traces", run_traces, (), ("traces",), ("name", "trace"), ("traces",)),
    Stage("mesh", run_mesh, ("surfaces", "sites"), ("geometry", "mesh"), ("name",), ("anatomy", "mesh")),
    Stage(
        "calibrate",
        run_calibrate,
        ("sites", "traces", "mesh"),
        ("material", "calibration", "solver", "indenter"),
        ("name", "fitted", "edge"),
        (*_MECHANICS, "pipeline/calibrate_stage"),
    ),
    Stage(
        "predict",
        run_predict,
        ("sites", "traces", "mesh", "calibrate"),
        (),
        ("name", "edge"),
        (*_MECHANICS, "pipeline/predict_stage", "fields"),
    ),
    Stage("report", run_report, ("predict",), ("study",), ("name", "region"), ("report", "pipeline")),
)
STAGE_NAMES = tuple(stage.name for stage in STAGES)


def stages_of(study: Study) -> tuple[Stage, ...]:
    """The stages that a study has: without an image there is nothing to segment."""
    return tuple(stage for stage in STAGES if stage.name != "segment" or study.image is not None)


def keys(study: Study) -> dict[str, str]:
    """The key of every stage: a digest of its settings, input files, code and of the stages it stands on.

    The calibration's is the one that it has in the study of its fitted sites alone: whatever is held out can
    change, come and go without it.
    """
    named = {path for paths in input_files(study).values() for path in paths}
    digests = {path: file_digest(study.path(path)) for path in named}
    calibrate = _keys(_seen_by_calibration(study), digests)["calibrate"]
    return _keys(study, digests, {"calibrate": calibrate})


def _keys(
    study: Study, digests: Mapping[Path, str], known: Mapping[str, str] | None = None
) -> dict[str, str]:
    stated = study.model_dump(mode="json")
    files = {
        stage: {str(path): digests[path] for path in paths} for stage, paths in input_files(study).items()
    }
    found: dict[str, str] = {}
    for stage in stages_of(study):
        found[stage.name] = (known or {}).get(stage.name) or digest(
            stage.name,
            {table: stated[table] for table in stage.tables},
            [{key: site[key] for key in stage.site_keys} for site in stated["sites"]],
            files.get(stage.name),
            code_digest(stage.rooms),
            [found.get(below) for below in stage.needs],
        )
    return found


def _seen_by_calibration(study: Study) -> Study:
    """The study's fitted sites; with markers the others' places too, since each marker goes to one site."""
    sites = [site.model_copy(update={"region": ""}) for site in study.fitted]
    if any(site.near is not None for site in sites):
        others = [site for site in study.sites if not site.fitted and site.near is not None]
        sites += [site.model_copy(update=_UNSEEN) for site in others]
    return study.model_copy(update={"sites": tuple(sites)})


def study_status(study: Study) -> list[dict[str, Any]]:
    """State of every stage: done, begun, stale (made from other inputs, settings or code) or missing."""
    store, wanted = Store(study.results), keys(study)
    rows = []
    for stage in stages_of(study):
        state = store.state(stage.name, wanted[stage.name])
        rows.append(
            {
                "stage": stage.name,
                "state": state.state,
                "seconds": state.seconds,
                "finished": state.finished,
            }
        )
    return rows


def run_study(study: Study, *, until: str | None = None, listener: Listener) -> dict[str, Any]:
    """Do every stage that is not done, in order; return the summary of the study.

    Parameters
    ----------
    study : a checked study.
    until : name of the last stage to do; default all.
    listener : is told of progress.

    Raises
    ------
    InputError
        When an input cannot be used.
    RunError
        When another run holds the study, or the disk is full.
    """
    if until is not None and until not in STAGE_NAMES:
        raise InputError(f"no stage is named {until!r}", remedy="stages are " + ", ".join(STAGE_NAMES))
    store = Store(study.results)
    with lock(study.results), make_executor(study.execution.workers) as executor:
        context = Context(study, store, executor, listener)
        kept = keep_corrections(study)
        if kept is not None:
            context.tell("segment", 0, 1, f"label map corrected by hand: kept as {kept}")
        for stage, key in keys(study).items():
            if store.state(stage, key).state != "done":
                _do(context, stage, key)
            else:
                context.tell(stage, 1, 1, "is up to date")
            if stage == until:
                break
        summary = summarise(study)
    if until is not None:
        summary["until"] = until
    return summary


def _do(context: Context, name: str, key: str) -> None:
    stage = next(stage for stage in STAGES if stage.name == name)
    if name == "report":
        write_json(context.store.folder / "run.json", run_record(context.study))
    stamp = context.store.make(name, key, lambda folder: stage.run(context, folder))
    context.tell(name, 1, 1, f"done in {stamp['seconds']:.1f} s")


def run_record(study: Study) -> dict[str, Any]:
    """``run.json``: versions, settings, digests of the inputs, how long each stage took."""
    store = Store(study.results)
    stamps = {stage.name: store.stamp(stage.name) for stage in stages_of(study)}
    inputs = input_digests(study)
    return {
        "limbfit": __version__,
        "study": study.study.model_dump(mode="json"),
        "settings": settings_record(study, inputs),
        "versions": versions(),
        "machine": machine(),
        "inputs": inputs,
        "stages": {
            name: {"seconds": stamp["seconds"], "finished": stamp["finished"], "key": stamp["key"]}
            for name, stamp in stamps.items()
            if stamp
        },
    }


def report_study(study: Study, *, listener: Listener) -> dict[str, Any]:
    """Make the report anew from what is stored, stale or not; nothing is solved."""
    store = Store(study.results)
    with lock(study.results), make_executor(study.execution.workers) as executor:
        context = Context(study, store, executor, listener)
        _do(context, "report", keys(study)["report"])
        return summarise(study)


def summarise(study: Study) -> dict[str, Any]:
    """The figures of a study from what is stored: parameters, sites with errors, where the report is."""
    store = Store(study.results)
    summary: dict[str, Any] = {"study": study.study.name, "results": str(study.results)}
    if (store["calibrate"] / "calibration.json").is_file():
        calibration = store.read("calibrate", "calibration.json")
        summary["parameters"] = calibration["stages"][-1]["parameters"]
        summary["intervals_95"] = calibration["uncertainty"]["intervals_95"]
    if (store["predict"] / "predict.json").is_file():
        predicted = store.read("predict", "predict.json")
        columns = ("site", "region", "fitted", "peak_force_N", "error_percent")
        summary["sites"] = [
            {**{key: row[key] for key in columns}, "warnings": row.get("warnings", [])}
            for row in predicted["sites"]
        ]
        for key in ("mean_error_fitted_percent", "mean_error_heldout_percent"):
            summary[key] = predicted[key]
    report = store["report"] / "report.html"
    if report.is_file():
        summary["report"] = str(report)
    return summary
