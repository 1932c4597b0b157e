"""From records and meshes to an identified model: the stages ``traces``, ``calibrate``, ``predict``."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from itertools import zip_longest
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from ..errors import StudyError, TraceError
from ..identify.calibration import Calibration, CalibrationSettings, State, calibrate
from ..identify.objective import Measured, SiteResponse
from ..identify.parameters import Unknowns
from ..identify.prediction import error_percent, prediction_sd, summarise
from ..identify.uncertainty import Uncertainty, estimate_uncertainty
from ..indentation import (
    Parameters,
    Simulation,
    SimulationJob,
    SiteModel,
    flat_names,
    simulate_fields,
    to_parameters,
    to_vector,
)
from ..study import Site, Study
from ..traces import Regularised, Trace, find_touch_down, read_trace, regularise
from .context import Context
from .simulations import CURVE_POINTS, SimulationCache, recorded_model
from .store import read_json, write_json

Array = NDArray[np.float64]
COUNTS = ("no", "one", "two", "three", "four", "five", "six")


def stage_titles(tissues: Sequence[str]) -> tuple[str, ...]:
    """Names of the stages of the identification; a single tissue has one."""
    n = len(tissues)
    return ("one material", f"{COUNTS[n] if n < len(COUNTS) else n} materials")[: min(n, 2)]


def read_site_trace(study: Study, site: Site) -> tuple[Trace, Regularised, dict[str, Any]]:
    """A site's record, its regularised curves and the facts that ``traces.json`` holds."""
    assert site.trace is not None
    table = study.traces
    file = study.path(site.trace)
    trace = read_trace(file, (table.time_s, table.displacement_mm, table.force_N))
    try:
        touch = find_touch_down(trace)
        smooth = regularise(trace, touch, table.smoothing)
    except TraceError as error:
        raise TraceError(error.what, file=file, place=error.place, remedy=error.remedy) from None
    facts = {
        "touch_down_s": touch.time_s,
        "touch_down_mm": touch.displacement_mm,
        "touch_down_uncertainty_mm": touch.uncertainty_mm,
        "peak_force_N": smooth.peak_force_N,
        "depth_mm": smooth.depth_mm,
        "noise_N": smooth.noise_N,
        "speed_load_mm_s": smooth.speed_load_mm_s,
        "speed_unload_mm_s": None if np.isnan(smooth.speed_unload_mm_s) else smooth.speed_unload_mm_s,
        "knots_s": smooth.knots_s.tolist(),
        "knots_mm": smooth.knots_mm.tolist(),
    }
    return trace, smooth, facts


def run_traces(context: Context, folder: Path) -> dict[str, Any]:
    """Records to regularised curves, counted from touch-down."""
    recorded = [site for site in context.study.sites if site.trace is not None]
    facts = {}
    for i, site in enumerate(recorded):
        context.tell("traces", i, len(recorded), f"site {site.name}")
        trace, smooth, facts[site.name] = read_site_trace(context.study, site)
        write_curves(
            folder / f"{site.name}-raw.csv",
            time_s=trace.time_s,
            displacement_mm=trace.displacement_mm,
            force_N=trace.force_N,
        )
        even = smooth.resample(CURVE_POINTS)
        write_curves(
            folder / f"{site.name}.csv",
            time_s=even.time_s,
            displacement_mm=even.displacement_mm,
            force_N=even.force_N,
        )
    write_json(folder / "traces.json", {"sites": facts})
    return {}


def write_curves(file: Path, **columns: Array) -> None:
    """A CSV with named columns."""
    table = np.column_stack(list(columns.values()))
    np.savetxt(file, table, fmt="%.9g", delimiter=",", header=",".join(columns), comments="")


def read_curves(file: Path) -> dict[str, Array]:
    """The columns of a CSV that ``write_curves`` made."""
    names = file.read_text(encoding="utf-8").split("\n", 1)[0].split(",")
    return dict(zip(names, np.loadtxt(file, delimiter=",", skiprows=1, unpack=True), strict=True))


@dataclass(frozen=True)
class SiteRecord:
    """A site with its record: what a simulation needs, and the forces it is compared with."""

    site: Site
    tissues: tuple[str, ...]
    model: SiteModel
    times_s: Array
    displacement_mm: Array
    force_N: Array

    def job(self, parameters: Array, sensitivities: bool = True) -> SimulationJob:
        values, times = tuple(map(float, parameters)), tuple(map(float, self.times_s))
        return SimulationJob(self.model, self.tissues, values, times, sensitivities)


def site_record(context: Context, site: Site) -> SiteRecord:
    curves = read_curves(context.store["traces"] / f"{site.name}.csv")
    return SiteRecord(
        site=site,
        tissues=context.study.tissues,
        model=recorded_model(context, site),
        times_s=curves["time_s"],
        displacement_mm=curves["displacement_mm"],
        force_N=curves["force_N"],
    )


def run_calibrate(context: Context, folder: Path) -> dict[str, Any]:
    """One material, then each tissue its own, on the fitted sites; simulations and iterates are kept."""
    study = context.study
    if not study.fitted:
        raise StudyError("no site is fitted", file=study.file, place="sites", remedy="set fitted = true")
    records = [site_record(context, site) for site in study.fitted]
    measured = [Measured(record.site.name, record.force_N) for record in records]
    cache = SimulationCache(folder / "runs", also=[context.store["calibrate"] / "runs"])
    state_file = folder / "state.json"
    evaluations = 0

    def respond(parameters: Array) -> list[SiteResponse]:
        nonlocal evaluations
        evaluations += 1
        jobs = [record.job(parameters) for record in records]
        responses = []
        for simulation in cache.run(jobs, context.executor):
            responses.append(_response(simulation))
            text = f"evaluation {evaluations}, site {simulation.site}"
            context.tell("calibrate", 0, 0, text)
        return responses

    def keep(state: State) -> None:
        write_json(state_file, state.to_dict())
        context.tell("calibrate", 0, 0, _describe(state, study.tissues))

    found = calibrate(
        respond,
        measured,
        unknowns(study),
        CalibrationSettings(
            objective=study.calibration.objective,
            relative_tolerance=study.calibration.relative_tolerance,
            max_iterations=study.calibration.max_iterations,
        ),
        on_iterate=keep,
        state=State.from_dict(read_json(state_file)) if state_file.is_file() else None,
    )
    known = estimate_uncertainty(found.parameters, found.responses, measured, unknowns(study))
    ends = list(cache.run([record.job(found.parameters) for record in records], context.executor))
    warnings = {end.site: list(end.warnings) for end in ends if end.warnings}
    content = _calibration_record(context, found, known, folder) | {"warnings": warnings}
    write_json(folder / "calibration.json", content)
    return {}


def _response(simulation: Simulation) -> SiteResponse:
    assert simulation.jacobian is not None
    return SiteResponse(simulation.force_N, simulation.jacobian, simulation.completed, simulation.reason)


def unknowns(study: Study) -> Unknowns:
    """The four parameters of each tissue with the study's start and bounds."""
    material, tissues = study.material, study.tissues

    def flat(which: Literal["start", "lower", "upper"]) -> Array:
        return to_vector({tissue: material.of(tissue, which) for tissue in tissues}, tissues)

    names = tuple(f"{tissue}.{name}" for tissue, name in flat_names(tissues))
    return Unknowns(names, flat("start"), flat("lower"), flat("upper"))


def _describe(state: State, tissues: Sequence[str]) -> str:
    last = state.history[-1]
    values = to_parameters(np.array(last.parameters), tissues)
    words = " | ".join(
        f"{tissue} c {v['c_kPa']:.3g} kPa, m {v['m']:.3g}, gamma {v['gamma']:.3g}, tau {v['tau_s']:.3g} s"
        for tissue, v in values.items()
    )
    return f"{stage_titles(tissues)[last.stage]}: error {np.mean(last.errors_percent):.2f} % | {words}"


def _calibration_record(
    context: Context, found: Calibration, known: Uncertainty, folder: Path
) -> dict[str, Any]:
    """What ``calibration.json`` holds."""
    study, tissues = context.study, context.study.tissues
    bounds = unknowns(study)
    cache = SimulationCache(folder / "runs")
    example = cache.example()
    return {
        "stages": [_stage_record(found, i, bounds.start, tissues) for i in range(len(found.stages))],
        "bounds": {
            "lower": to_parameters(bounds.lower, tissues),
            "upper": to_parameters(bounds.upper, tissues),
        },
        "objective": study.calibration.objective,
        "uncertainty": _uncertainty_record(known, tissues),
        "forward_runs": len(cache),
        "linear_solver": example.facts["linear_solver"] if example else None,
        "element": example.facts["element"] if example else None,
    }


def _stage_record(found: Calibration, number: int, start: Array, tissues: Sequence[str]) -> dict[str, Any]:
    """One stage: from ``start`` (the first) or the end of the stage before to its own end."""
    stage = found.stages[number]
    before = np.array(found.stages[number - 1].parameters) if number else start
    iterates = [iterate for iterate in found.history if iterate.stage == number]
    return {
        "name": stage_titles(tissues)[number],
        "start": to_parameters(before, tissues),
        "parameters": to_parameters(np.array(stage.parameters), tissues),
        "cost": stage.cost,
        "evaluations": stage.evaluations,
        "converged": stage.converged,
        "reason": stage.reason,
        "iterations": [
            {
                "iteration": i,
                "parameters": to_parameters(np.array(iterate.parameters), tissues),
                "cost": iterate.cost,
                "error_percent": float(np.mean(iterate.errors_percent)),
                "error_percent_by_site": dict(zip(found.sites, iterate.errors_percent, strict=True)),
            }
            for i, iterate in enumerate(iterates)
        ],
    }


def _uncertainty_record(known: Uncertainty, tissues: Sequence[str]) -> dict[str, Any]:
    """What is stored of the uncertainty; intervals by tissue and name, like the parameters."""
    intervals: dict[str, dict[str, list[float]]] = {tissue: {} for tissue in tissues}
    for (tissue, name), interval in zip(flat_names(tissues), known.intervals_95.tolist(), strict=True):
        intervals[tissue][name] = interval
    return {
        "intervals_95": intervals,
        "correlation": {"names": list(known.names), "matrix": known.correlation.tolist()},
        "covariance_log": known.covariance.tolist(),
        "verdict": dict(zip(known.names, known.verdicts, strict=True)),
        "at_bound": dict(zip(known.names, map(bool, known.at_bound), strict=True)),
        "combinations": [f"{c.text}: {c.verdict}" for c in known.combinations],
        "residual_sd_N": {noise.name: noise.sd_N for noise in known.noise},
    }


def run_predict(context: Context, folder: Path) -> dict[str, Any]:
    """Force at every recorded site with all materials and with one, intervals, and the fields at the peak."""
    study = context.study
    calibration = context.stored("calibrate", "calibration.json")
    found = [to_vector(stage["parameters"], study.tissues) for stage in calibration["stages"]]
    one, best = found[0], found[-1]
    covariance = np.array(calibration["uncertainty"]["covariance_log"])
    records = [site_record(context, site) for site in study.sites if site.trace is not None]
    cache = SimulationCache(
        folder / "runs", also=[context.store[stage] / "runs" for stage in ("calibrate", "predict")]
    )
    jobs = [record.job(best) for record in records]
    # At the fitted sites the calibration has simulated the one-material optimum already, with sensitivities.
    if len(found) > 1:
        jobs += [record.job(one, sensitivities=record.site.fitted) for record in records]
    simulations = []
    for simulation in cache.run(jobs, context.executor):
        simulations.append(simulation)
        context.tell("predict", len(simulations), len(jobs) + len(records), f"site {simulation.site}")
    ours, simple = simulations[: len(records)], simulations[len(records) :]
    _write_fields(context, folder, records, best, len(jobs))
    rows = []
    for record, with_all, with_one in zip_longest(records, ours, simple):
        _write_prediction(folder, record, with_all, with_one, best, covariance)
        rows.append(_row(record, with_all, with_one))
    write_json(folder / "predict.json", {"sites": rows, **_means(rows)})
    return {}


@dataclass(frozen=True)
class FieldJob:
    """Fields at the deepest point of a site, to be computed and stored by a worker."""

    model: SiteModel
    parameters: Parameters
    file: Path


def store_fields(job: FieldJob) -> str:
    simulate_fields(job.model, job.parameters, job.file)
    return job.model.name


def _write_fields(
    context: Context, folder: Path, records: Sequence[SiteRecord], vector: Array, before: int
) -> None:
    parameters = to_parameters(vector, context.study.tissues)
    jobs = [FieldJob(record.model, parameters, folder / f"{record.site.name}.vtu") for record in records]
    missing = [job for job in jobs if not job.file.is_file()]
    names = [job.model.name for job in missing]
    for i, name in enumerate(context.executor.map(store_fields, missing, keys=names)):
        total = before + len(missing)
        context.tell("predict", before + i + 1, total, f"fields of site {name}")


def _write_prediction(
    folder: Path, record: SiteRecord, ours: Simulation, one: Simulation | None, best: Array, covariance: Array
) -> None:
    assert ours.jacobian is not None
    sd = prediction_sd(ours.jacobian, best, covariance)
    write_curves(
        folder / f"{record.site.name}.csv",
        time_s=record.times_s,
        displacement_mm=record.displacement_mm,
        force_measured_N=record.force_N,
        force_simulated_N=ours.force_N,
        **({} if one is None else {"force_one_material_N": one.force_N}),
        force_low_N=np.maximum(ours.force_N - 1.96 * sd, 0.0),
        force_high_N=ours.force_N + 1.96 * sd,
    )


def _row(record: SiteRecord, ours: Simulation, one: Simulation | None) -> dict[str, Any]:
    def error(simulation: Simulation | None) -> float | None:
        if simulation is None or not simulation.completed:
            return None
        return error_percent(simulation.force_N, record.force_N)

    return {
        "site": record.site.name,
        "region": record.site.region,
        "fitted": record.site.fitted,
        "peak_force_N": float(record.force_N.max()),
        "error_percent": error(ours),
        "error_one_material_percent": error(one),
        "penetration_mm": ours.penetration_mm,
        "completed": ours.completed,
        "reason": ours.reason,
        "warnings": list(ours.warnings),
        "steps": ours.facts["steps"],
        "element": ours.facts["element"],
    }


def _means(rows: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Mean and standard deviation of the errors of fitted and held-out sites; None where there are none."""
    found: dict[str, Any] = {}
    for kind, fitted in (("fitted", True), ("heldout", False)):
        errors = [
            r["error_percent"] for r in rows if r["fitted"] == fitted and r["error_percent"] is not None
        ]
        summary = asdict(summarise(errors))
        for key in ("mean_percent", "sd_percent"):
            name = f"{key.removesuffix('_percent')}_error_{kind}_percent"
            found[name] = None if np.isnan(summary[key]) else summary[key]
    return found
