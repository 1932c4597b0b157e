"""From records and meshes to identified parameters: the stage ``calibrate``."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from ..errors import StudyError
from ..identify.calibration import Calibration, CalibrationSettings, State, calibrate
from ..identify.objective import Measured, SiteResponse
from ..identify.parameters import Unknowns
from ..identify.uncertainty import Uncertainty, estimate_uncertainty
from ..indentation import Simulation, flat_names, to_parameters, to_vector
from ..study import Study
from .context import Context
from .simulations import SimulationCache
from .store import read_json, write_json
from .traces_stage import site_record

Array = NDArray[np.float64]
COUNTS = ("no", "one", "two", "three", "four", "five", "six")


def stage_titles(tissues: Sequence[str]) -> tuple[str, ...]:
    """Names of the stages of the identification; a single tissue has one."""
    n = len(tissues)
    return ("one material", f"{COUNTS[n] if n < len(COUNTS) else n} materials")[: min(n, 2)]


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
