"""Which stages there are, what each depends on, and runs of one study or many that do what is missing."""

import json
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict
from functools import partial
from pathlib import Path
from time import perf_counter
from typing import Any

from ..._version import __version__
from ...errors import InputError, LimbfitError, RunError
from ...execution import make_executor, run_in_background, share_executor
from ...fe import are_compiled, compile_kernels
from ...fe.solution.simulation import limit_numpy_threads
from ...results.identification import CalibrationResult, PredictResult
from ...results.runs import ExperimentRecord, MachineFacts, RunResult, StageRecord, StudyName
from ...results.uncertainty import ModelsResult
from ...study import Site, Study, load_study
from ..engine.context import Context, Listener, Progress, build_executor, ignore_progress, write_journal
from ..engine.digests import compute_file_digest, to_plain
from ..engine.provenance import (
    Keys,
    Stage,
    StageKey,
    collect_versions,
    compute_input_digests,
    describe_causes,
    describe_machine,
    record_settings,
)
from ..engine.store import Store, keep_hand_labels, lock, read_json, write_result
from ..identification.calibrate import check_calibrate, run_calibrate
from ..identification.predict import run_predict
from ..limb.mesh import run_mesh
from ..limb.segment import run_segment
from ..limb.sites import run_sites
from ..limb.surfaces import run_surfaces
from ..records.record_checks import choose_surface_points, tell_flags
from ..records.secondary_measurements import read_motion
from ..records.traces import run_traces
from ..simulation.limb_geometry import LimbGeometry
from ..socket.measured import run_sensors
from .experiments import EXPERIMENTS, check_experiment, compute_experiment_key, list_experiment_states
from .report import run_report

_PLACE = ("name", "position", "near", "axis", "edge", "region", "fitted", "indenter")
_WAVES = ("shear_waves", "shear_waves_sd_m_s", "shear_waves_bias_m_s")
_SEEN = ("ultrasound", "ultrasound_sd_mm", "surface", "surface_sd_mm", "surface_frame", *_WAVES)
_RECORD = ("trace", "touch_down_s", "peak_s", "control", *_SEEN)
_NAMED = ("site", "name")
# Of tables of the mesh: how pins press (how wide they are counts), and how long a mesh may take to be made.
_PRESSING = ("force_N", "angles_degrees", "levels_mm", "clamping_s", "settling_s")
_NO_SHAPE = (*(f"clamps.{key}" for key in _PRESSING), "mesh.time_limit_s")
_NOT_SENSED = ("socket.design", "socket.worn_s")  # of a socket as its sensors measured

STAGES = (
    Stage("segment", run_segment, (), ("image", "segmentation")),
    Stage("surfaces", run_surfaces, ("segment",), ("geometry", "surfaces")),
    Stage("sites", run_sites, ("surfaces",), ("indenter", "indenters"), _PLACE, (*_NAMED, "indenter")),
    Stage("traces", run_traces, (), ("traces",), ("name", *_RECORD), (*_NAMED, *_RECORD)),
    Stage(
        "mesh", run_mesh, ("surfaces", "sites"), ("geometry", "mesh", "clamps"), ("name",), apart=_NO_SHAPE
    ),
    Stage("sensors", run_sensors, ("surfaces",), ("socket", "geometry", "mesh"), apart=_NOT_SENSED),
    Stage(
        "calibrate",
        run_calibrate,
        ("sites", "traces", "mesh", "sensors"),
        # It meshes once more, and does without a mesh that takes too long.
        ("material", "calibration", "solver", "indenter", "indenters", "clamps", "mesh"),
        ("name", "fitted", "weight", "edge", "indenter"),
        (*_NAMED, "indenter"),
    ),
    Stage("predict", run_predict, ("sites", "traces", "mesh", "calibrate"), (), ("name", "edge"), _NAMED),
    Stage("report", run_report, ("predict",), ("study",), ("name", "region")),
)
STAGE_NAMES = tuple(stage.name for stage in STAGES)
_FOLDERS = frozenset(("compare", "export", "log", "models", "simulate", *STAGE_NAMES))  # of results


def list_stages(study: Study) -> tuple[Stage, ...]:
    """The stages that a study has: without an image there is nothing to segment.

    The sensors in its socket are placed where their pressures count in the calibration.
    """
    left_out = {"segment": study.image is None, "sensors": not study.calibration.use_socket_pressures}
    return tuple(stage for stage in STAGES if not left_out.get(stage.name))


def compute_keys(study: Study, until: str = "report") -> dict[str, str]:
    """The key of every stage ``until`` one: a digest of its settings, input files, code and lower stages.

    The calibration's is the one that it has in the study of its fitted sites alone: whatever is held out can
    change, come and go without it. The report's covers the experiments and other models that it shows.
    """
    return {name: key.digest for name, key in _compute_chain(Keys(study), until).items()}


def _compute_chain(keys: Keys, until: str = "report") -> dict[str, StageKey]:
    """See `compute_keys`."""
    fitted = _select_calibration_inputs(keys.study)
    plain = [site.model_copy(update={"region": "", "fitted": False}) for site in keys.study.sites]
    unlabelled = keys.study.model_copy(update={"sites": tuple(plain)})
    chain: dict[str, StageKey] = {}
    below, alone, placed = dict[str, str](), dict[str, str](), dict[str, str]()
    for stage in list_stages(keys.study):
        options: dict[str, Any] = {}
        if stage.name == "report":
            states = list_experiment_states(keys, below)
            shown = [key.digest for state, key, _ in states if state.state == "done"]
            models = keys.study.results / ModelsResult.FILE
            shown += [compute_file_digest(models)] if models.is_file() else []
            options = {"experiments": shown} if shown else {}
        if stage.name == "sites":  # where they are decides their meshes, and not what else is said of them
            placed = {"sites": keys.compute_key(stage, below, study=unlabelled).digest}
        key = keys.compute_key(stage, below | placed if stage.name == "mesh" else below, options)
        if "calibrate" not in below:
            key_alone = keys.compute_key(stage, alone, study=fitted)
            alone[stage.name] = key_alone.digest
            key = key_alone if stage.name == "calibrate" else key
        chain[stage.name], below[stage.name] = key, key.digest
        if stage.name == until:
            break
    return chain


def is_done(study: Study, stage: str) -> bool:
    """True where what a stage has stored is of the study as it is now."""
    return Store(study.results).state(stage, compute_keys(study, stage)[stage]).state == "done"


def _select_calibration_inputs(study: Study) -> Study:
    """The study's fitted sites; with markers the others' places too, since each marker goes to one site."""
    sites = [site.model_copy(update={"region": ""}) for site in study.fitted]
    if any(site.near is not None for site in sites):
        others = [site for site in study.sites if not site.fitted and site.near is not None]
        sites += [Site(name=site.name, near=site.near) for site in others]
    fitted = {site.name for site in study.fitted}
    records = tuple(record for record in study.records if record.site in fitted)
    return study.model_copy(update={"sites": tuple(sites), "records": records})


def study_status(study: Study) -> list[dict[str, Any]]:
    """State of every stage: done, begun, stale (made from other inputs, settings or code) or missing.

    ``why`` names what changed since a stale one was made. Below the stages: the experiments that were begun
    or done.
    """
    store, keys = Store(study.results), Keys(study)
    chain = _compute_chain(keys)
    below = {name: key.digest for name, key in chain.items()}
    found = [(store.state(name, key.digest), key) for name, key in chain.items()]
    experiments = list_experiment_states(keys, below)
    found += [(state, key) for state, key, _ in experiments if state.state != "missing"]
    rows = []
    for state, key in found:
        stamp = store.stamp(state.stage) if state.state == "stale" else None
        rows.append(asdict(state) | {"why": describe_causes(stamp.parts, key.parts) if stamp else []})
    return rows


def run_study(
    study: Study,
    *,
    until: str | None = None,
    start: str | None = None,
    force: Sequence[str] = (),
    check: Callable[[LimbGeometry], None] | None = None,
    listener: Listener = ignore_progress,
) -> dict[str, Any]:
    """Do every stage that is not done, in order; return the summary of the study.

    Raises `InputError` when an input cannot be used; and `RunError` when another run holds the study, or the
    disk is full.

    Parameters
    ----------
    until : name of the last stage to do; default all.
    start : name of a stage that is done anew, and all after it.
    force : names of stages that are done anew. Kept simulations count: the same ones would come out.
    check : is given the limb before anything is meshed, and raises `InputError` for one that it refuses.
    listener : is told of progress; ``results/log`` too.
    """
    anew = select_stages_to_redo(study, until, start, force)
    if until not in ("segment", "surfaces"):
        study.refuse_no_site()
    with _open_run(study, "run", listener) as context:
        kept = keep_hand_labels(study)
        if kept is not None:
            context.tell("segment", 0, 1, f"label map corrected by hand: kept as {kept}")
        chain = _compute_chain(Keys(study))
        wanted = [stage for stage in STAGES if stage.name in chain]
        if until is not None:
            wanted = wanted[: list(chain).index(until) + 1]
        states = {stage.name: context.store.state(stage.name, chain[stage.name].digest) for stage in wanted}
        missing = {name for name, state in states.items() if name in anew or state.state != "done"}
        if "calibrate" in missing:
            check_calibrate(study)
        # Records need no limb: what is wrong with them is said at once.
        wanted.sort(key=lambda stage: stage.name != "traces")
        with compile_in_background("calibrate" in missing) as compiled:
            for stage in wanted:
                name = stage.name
                if name == "mesh":
                    _check_limb(context, check, name in missing, "calibrate" in missing)
                if name == "calibrate":
                    compiled()
                    if name in missing:
                        tell_flags(context)
                if name in missing:
                    _do(context, stage, chain[name])
                else:
                    context.tell(name, 1, 1, "is up to date")
        after = [context.store.state(name, key.digest) for name, key in chain.items()]
    summary = summarise(study, [one.stage for one in after if one.state == "done"])
    return summary if until is None else summary | {"until": until}


def _check_limb(
    context: Context, check: Callable[[LimbGeometry], None] | None, meshing: bool, calibrating: bool
) -> None:
    """Refuse what surfaces, sites and records rule out, before anything is meshed."""
    study, store = context.study, context.store
    if not (meshing or check):
        return
    limb = LimbGeometry.from_store(store)
    if meshing and calibrating:
        check_calibrate(study, limb)
    if meshing:
        facts = store.results.traces.sites
        moving = [one for one in study.recorded if (seen := facts[one.name].surface) and seen.compared]
        limb.clamping_pins(study)
        choose_surface_points(limb, study, {one.name: read_motion(store["traces"], one) for one in moving})
    if check is not None:
        check(limb)


def select_stages_to_redo(
    study: Study, until: str | None, start: str | None, force: Sequence[str]
) -> set[str]:
    """Stages that are done whether they are up to date or not."""
    names = [stage.name for stage in list_stages(study)]
    for name in (until, start, *force):
        if name is not None and name not in names:
            raise InputError(f"no stage is named {name!r}", remedy="stages are " + ", ".join(names))
    for name in filter(None, (start, *force)):
        if until is not None and names.index(name) > names.index(until):
            raise InputError(f"{name} comes after {until}", remedy="leave out one of the two")
    return {*force, *(names[names.index(start) :] if start is not None else ())}


_BATCH_KEYS = ("mean_error_fitted_percent", "mean_error_heldout_percent", "report")


def run_batch(
    paths: Sequence[str | Path],
    *,
    until: str | None = None,
    workers: int = 0,
    listener: Listener = ignore_progress,
) -> Iterator[dict[str, Any]]:
    """Run studies one after the other on the same workers; a study that fails does not stop the others.

    ``paths``: of studies, each a ``study.toml`` or its folder. ``until``: name of the last stage to do;
    default all. ``workers``: how many simulate side by side; 0: one per core. Yields for each study as it
    ends: ``study`` (its path as given), ``state`` (``done`` or ``failed``), ``seconds``, ``error`` (one line,
    where it failed), and its mean errors and report. Raises `InputError` for a stage that there is not.
    """
    if until is not None and until not in STAGE_NAMES:
        raise InputError(f"no stage is named {until!r}", remedy="stages are " + ", ".join(STAGE_NAMES))
    with make_executor(workers) as executor, share_executor(executor):
        for i, path in enumerate(paths):
            start = perf_counter()
            listener(Progress("batch", i, len(paths), str(path)))
            row: dict[str, Any] = {"study": str(path), "state": "done", "error": None}
            try:
                summary = run_study(load_study(path), until=until, listener=listener)
                row |= {key: summary.get(key) for key in _BATCH_KEYS}
            except LimbfitError as error:
                row |= {"state": "failed", "error": str(error)}
            except Exception as error:  # one study's bad luck must not cost the others
                row |= {"state": "failed", "error": f"internal error: {type(error).__name__}: {error}"}
            yield row | {"seconds": round(perf_counter() - start, 1)}
        listener(Progress("batch", len(paths), len(paths), "done"))


def run_experiment(
    study: Study, name: str, *, listener: Listener = ignore_progress, **options: Any
) -> dict[str, Any]:
    """Do an experiment of a study, and before it every stage that it needs and that is not done.

    ``name``: of the experiment. ``options``: as the experiment takes them; left out: its defaults. Returns
    what ``results/<name>/<name>.json`` holds, and ``folder``, where that is; ``limbfit report`` shows it.
    Raises `InputError` for an experiment or option that there is not, or an input that cannot be used; and
    `RunError` when another run holds the study, or the disk is full.
    """
    experiment = EXPERIMENTS[name]
    if name in _FOLDERS:
        raise InputError(f"results/{name} is not for an experiment", remedy="give it another name")
    experiment.check_options(options)
    # As its stamp will hold them: a notebook's numbers and arrays may be those of NumPy.
    chosen = json.loads(json.dumps({**experiment.options, **options}, default=to_plain))
    check_experiment(experiment, study, None, chosen)
    last = [stage.name for stage in STAGES if stage.name in experiment.needs][-1:]
    if last:
        check = partial(check_experiment, experiment, study, options=chosen)
        run_study(study, until=last[0], check=check, listener=listener)
    with _open_run(study, name, listener) as context:
        keys = Keys(study)
        below = {stage: key.digest for stage, key in _compute_chain(keys).items()}
        key = compute_experiment_key(keys, experiment, below, chosen)
        for stage, digest in key.parts.stages.items():
            if context.store.state(stage, digest).state == "stale":
                what = f"an input of the stage {stage} has changed since limbfit was started"
                raise RunError(f"{study.file}: {what}; run the command again")
        if context.store.state(name, key.digest).state == "done":
            context.tell(name, 1, 1, "is up to date")
        else:
            ensure_compiled()
            _do(context, experiment, key, chosen)
        folder = context.store[name]
    return read_json(folder / f"{name}.json") | {"folder": str(folder)}


@contextmanager
def _open_run(study: Study, what: str, listener: Listener) -> Iterator[Context]:
    """Hold a study for a run, which is logged and has the same bits whatever number of threads there is."""
    with (
        limit_numpy_threads(),
        lock(study.results),
        write_journal(study, what, listener) as listener,
        build_executor(study) as executor,
    ):
        yield Context(study, Store(study.results), executor, listener)


def _do(context: Context, stage: Stage, key: StageKey, options: Mapping[str, Any] | None = None) -> None:
    """Do a stage, or an experiment with its ``options``."""
    facts = {"parts": key.parts} | ({} if options is None else {"options": dict(options)})
    if stage.name == "report":
        write_result(context.store.folder / "run.json", run_record(context.study))
    stamp = context.store.make(
        stage.name,
        key.digest,
        lambda folder: {**(stage.run(context, folder, **(options or {})) or {}), **facts},
    )
    context.tell(stage.name, 1, 1, f"done in {stamp.seconds:.1f} s")


def run_record(study: Study) -> RunResult:
    """``run.json``: versions, settings, digests of the inputs, how long each stage took."""
    store, inputs, keys = Store(study.results), compute_input_digests(study), Keys(study)
    below = {name: key.digest for name, key in _compute_chain(keys).items()}
    settings = record_settings(study, inputs)
    return RunResult(
        limbfit=__version__,
        study=StudyName(**settings["study"]),
        settings=settings,
        versions=collect_versions(),
        machine=MachineFacts(**describe_machine()),
        inputs=inputs,
        stages={name: StageRecord.model_validate(stamp) for name in below if (stamp := store.stamp(name))},
        experiments={
            state.pop("stage"): ExperimentRecord(**state, options=options, key=key.digest)
            for one, key, options in list_experiment_states(keys, below)
            if (state := asdict(one))["state"] in ("done", "stale")
        },
    )


def report_study(study: Study, *, listener: Listener = ignore_progress) -> dict[str, Any]:
    """Make the report anew from what is stored, stale or not; nothing is solved.

    That of a stale prediction, or of none yet, is stale too: the next run makes it anew.
    """
    with lock(study.results), build_executor(study) as executor:
        context, keys = Context(study, Store(study.results), executor, listener), Keys(study)
        chain, predicted = _compute_chain(keys), context.store.stamp("predict")
        key = chain["report"]
        if predicted is None or predicted.key != chain["predict"].digest:
            key = keys.compute_key(STAGES[-1], {} if predicted is None else {"predict": predicted.key})
        _do(context, STAGES[-1], key)
        return summarise(study, STAGE_NAMES)


def summarise(study: Study, stages: Collection[str]) -> dict[str, Any]:
    """The figures of a study from what ``stages`` have stored: parameters, sites with errors, the report."""
    summary: dict[str, Any] = {"study": study.study.name, "results": str(study.results)}
    if "calibrate" in stages and (calibration := CalibrationResult.find(study.results)) is not None:
        summary["parameters"] = calibration.parameters
        summary["intervals_95"] = calibration.uncertainty.to_plain()["intervals_95"]
        if calibration.uncertainty.relaxation is not None:
            relaxation = calibration.uncertainty.relaxation.to_plain()
            summary["relaxation"] = {key: relaxation[key] for key in ("prefers", "words", "moduli")}
    if "predict" in stages and (found := PredictResult.find(study.results)) is not None:
        predicted = found.to_plain()
        columns = ("site", "record", "region", "fitted", "peak_force_N", "error_percent", "warnings")
        summary["sites"] = [
            {key: row[key] for key in (*columns, "outside_records")} for row in predicted["sites"]
        ]
        keys = ("outside_text", "mean_error_fitted_percent", "mean_error_heldout_percent", "flags")
        summary |= {key: predicted[key] for key in keys}
        summary["fit_quality"] = found.fit_quality.verdict
    report = study.results / "report" / "report.html"
    if "report" in stages and report.is_file():
        summary["report"] = str(report)
    return summary


@contextmanager
def compile_in_background(wanted: bool = True) -> Iterator[Callable[[], None]]:
    """The block is given a function that waits until the kernels are there, where they are ``wanted``.

    Where they are not stored yet, one process compiles them while the block goes on: workers that began to
    solve at the same time would each compile them all.
    """
    if not wanted or are_compiled():
        yield lambda: None
        return
    with run_in_background(_compile, None) as wait:
        yield wait


def ensure_compiled() -> None:
    """Have the kernels stored before this process solves.

    Kernels that a process has compiled for itself give other last digits (1 part in 1e11) than stored ones.
    """
    with compile_in_background() as wait:
        wait()


def _compile(_: None) -> None:
    compile_kernels()
