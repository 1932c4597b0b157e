"""From records and meshes to identified parameters: the stage ``calibrate``."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from ...identify.fit.multifidelity import CorrectionRound
from ...identify.fit.multistart import MultistartResult, describe_starts
from ...identify.fit.objective import MeasuredCurve
from ...identify.fit.state import Calibration
from ...identify.uncertainty.relaxation import assess_relaxation
from ...identify.uncertainty.uncertainty import Uncertainty
from ...indentation import Parameters
from ...laws import FIBRED, FUNG, is_ogden
from ...priors import SOURCE
from ...study import Study
from ..engine.context import Context
from ..engine.storage import write_json
from ..records.records import load_records
from ..simulation.simulations import SimulationCache
from .fine_meshes import correct_answer, mesh_coarser_in_background
from .intervals import sample_intervals
from .problem import CalibrationProblem, build_problem
from .record_simulator import RecordSimulator, WarmStarts
from .search import search_from_starts
from .simulation_warnings import contact_to_dict, warnings_to_dict


def run_calibrate(context: Context, folder: Path) -> dict[str, Any]:
    """One material, then each tissue its own, on the fitted sites; simulations are kept.

    A run taken up again repeats the interrupted one from its kept simulations.
    """
    study, report = context.study, partial(context.tell, "calibrate", 0, 0)
    records = load_records(context, study.records_at(*study.fitted), secondary=True)
    problem = build_problem(study)
    cache = SimulationCache(folder / "runs", also=[context.store["calibrate"] / "runs"])
    simulator = RecordSimulator(records, cache, context.executor, report)
    with mesh_coarser_in_background(context, records, folder / "coarser") as wait:
        starts, rounds = search_from_starts(study, problem, simulator)
        wait()
    best = starts.best
    correction, spent = correct_answer(
        context, simulator, best.parameters, list(best.responses), folder / "coarser"
    )
    found, known = sample_intervals(context, problem, simulator, best, correction, spent)
    simulations = simulator.run_answer(found.parameters)
    answers = {one.site: one for one in records.select_forces(simulations)}
    warnings = {site: list(one.warnings) for site, one in answers.items() if one.warnings}
    for site, texts in warnings.items():
        report(f"warning: site {site}, at the answer: {'; '.join(texts)}")
    log = simulator.log
    content = _calibration_to_dict(study, problem, found, known, simulator)
    content["uncertainty"] |= _assess_relaxation(study, problem, found, known, records.measured)
    content |= {
        "corrections": [_round_record(one, found.sites, problem, study) for one in rounds],
        "multistart": _multistart_to_dict(starts, study) if study.calibration.starts > 1 else None,
        "warnings": warnings,
        "contact": contact_to_dict(
            answers,
            log.penalties,
            records.select_forces(simulator.respond(simulations)),
            records.select_forces(found.responses),
        ),
        "doubts": warnings_to_dict(log.warnings, answers, log.evaluations * records.simulations, found),
    }
    write_json(folder / "calibration.json", content)
    return {}


def _calibration_to_dict(
    study: Study,
    problem: CalibrationProblem,
    found: Calibration,
    known: Uncertainty,
    simulator: RecordSimulator,
) -> dict[str, Any]:
    """What ``calibration.json`` holds."""
    cache, bounds = simulator.cache, problem.unknowns
    example = cache.example()
    return {
        "stages": [
            _stage_to_dict(found, i, problem, study, simulator.starts) for i in range(len(found.stages))
        ],
        "bounds": {
            "lower": study.by_tissue(bounds.lower),
            "upper": study.by_tissue(bounds.upper),
        },
        "law": study.law.record(),
        "objective": study.calibration.objective,
        "uncertainty": _uncertainty_to_dict(known, study),
        "forward_runs": len(cache),
        "forward_runs_with_sensitivities": cache.with_sensitivities(),
        "linear_solver": example.facts["linear_solver"] if example else None,
        "element": example.facts["element"] if example else None,
    }


def _stage_to_dict(
    found: Calibration, number: int, problem: CalibrationProblem, study: Study, warm_starts: WarmStarts
) -> dict[str, Any]:
    """One stage: from the start of the problem, or the end of the stage before, to its own end."""
    stage = found.stages[number]
    before = np.array(found.stages[number - 1].parameters) if number else problem.unknowns.start
    iterates = [iterate for iterate in found.history if iterate.stage == number]

    def starts(parameters: Sequence[float]) -> list[Parameters]:
        return [study.by_tissue(one) for one in warm_starts.find(np.array(parameters))]

    return {
        "name": problem.titles[number],
        "start": study.by_tissue(before),
        "parameters": study.by_tissue(np.array(stage.parameters)),
        "cost": stage.cost,
        "evaluations": stage.evaluations,
        "converged": stage.converged,
        "reason": stage.reason,
        "iterations": [
            {
                "iteration": i,
                "parameters": study.by_tissue(np.array(iterate.parameters)),
                "starts": starts(iterate.parameters),
                "cost": iterate.cost,
                "error_percent": float(np.mean(iterate.errors_percent)),
                "error_percent_by_site": dict(zip(found.sites, iterate.errors_percent, strict=True)),
            }
            for i, iterate in enumerate(iterates)
        ],
    }


def _round_record(
    one: CorrectionRound, sites: Sequence[str], problem: CalibrationProblem, study: Study
) -> dict[str, Any]:
    """One correction of the search by the whole meshes; percentages are of each site's largest force."""
    return {
        "stage": problem.titles[one.stage] if one.stage >= 0 else "start",
        "parameters": study.by_tissue(np.array(one.parameters)),
        "scale_by_site": dict(zip(sites, one.scales, strict=True)),
        "difference_percent_by_site": dict(zip(sites, one.difference_percent, strict=True)),
        "change_percent_by_site": dict(zip(sites, one.expected_percent, strict=True)),
        "reason": one.reason,
    }


def _multistart_to_dict(tried: MultistartResult, study: Study) -> dict[str, Any]:
    """What came of every start."""
    names = [f"{tissue}.{name}" for tissue, name in study.parameters]
    return {
        "summary": describe_starts(tried, names),
        "reached": tried.reached,
        "starts": [
            {
                "start": study.by_tissue(np.array(one.start)),
                "parameters": None if one.parameters is None else study.by_tissue(np.array(one.parameters)),
                **{
                    key: getattr(one, key)
                    for key in ("cost", "evaluations", "converged", "reason", "same", "apart")
                },
            }
            for one in tried.starts
        ],
    }


def _uncertainty_to_dict(known: Uncertainty, study: Study) -> dict[str, Any]:
    """What is stored of the uncertainty; intervals by tissue and name, like the parameters."""
    intervals: dict[str, dict[str, list[float]]] = {tissue: {} for tissue in study.tissues}
    for (tissue, name), interval in zip(study.parameters, known.intervals_95.tolist(), strict=True):
        intervals[tissue][name] = interval
    return {
        "method": known.method,
        "intervals_95": intervals,
        "correlation": {"names": list(known.names), "matrix": known.correlation.tolist()},
        "covariance_log": known.covariance.tolist(),
        "sampling_covariance_log": known.sampling_covariance.tolist(),
        "verdict": dict(zip(known.names, known.verdicts, strict=True)),
        "at_bound": dict(zip(known.names, map(bool, known.at_bound), strict=True)),
        "combinations": [f"{c.text}: {c.verdict}" for c in known.combinations],
        "most_probable": study.by_tissue(known.centre),
        "priors": _priors_to_dict(known, study),
        "residuals": known.residual_model.to_dict(),
        "minus_2_log_evidence": known.minus_2_log_evidence,
    }


def _assess_relaxation(
    study: Study,
    problem: CalibrationProblem,
    found: Calibration,
    known: Uncertainty,
    measured: Sequence[MeasuredCurve],
) -> dict[str, Any]:
    """What is known of relaxation beyond the records, and the verdicts with that; none of other laws."""
    if not is_ogden(study.law.name) and study.law.name not in (FIBRED, FUNG):
        return {"relaxation": None}
    relaxation = assess_relaxation(
        found.parameters, found.responses, measured, known.residual_model, problem.unknowns, problem.space
    )
    if relaxation is None:
        return {"relaxation": None}
    verdicts = dict(zip(known.names, relaxation.qualify_verdicts(known), strict=True))
    return {"verdict": verdicts, "relaxation": relaxation.to_dict(known)}


def _priors_to_dict(known: Uncertainty, study: Study) -> dict[str, Any] | None:
    """The priors that counted, and how much of each interval comes from them; none where none were stated."""
    if not study.priors:
        return None
    stated = study.calibration.prior
    return {
        "stated": {
            name: {**prior.model_dump(), "source": "the study" if name in stated else SOURCE}
            for name, prior in study.priors.items()
        },
        "share": dict(zip(known.names, known.prior_share.tolist(), strict=True)),
        "wider_without": dict(zip(known.names, known.wider_without.tolist(), strict=True)),
    }
