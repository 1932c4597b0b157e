"""From records and meshes to identified parameters: the stage ``calibrate``."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from ...identify.fit.calibration import Calibration
from ...identify.fit.multifidelity import CorrectionRound
from ...identify.fit.multistart import MultistartResult, describe_starts
from ...identify.fit.objective import SiteResponse
from ...identify.uncertainty.relaxation import assess_relaxation, limit_verdicts
from ...identify.uncertainty.uncertainty import Uncertainty
from ...indentation import Parameters, Simulation
from ...laws import FIBRED, FUNG, is_ogden
from ...priors import SOURCE
from ...results import identification as stored
from ...results.base import Interval, Intervals
from ...study import Study
from ..engine.context import Context
from ..engine.store import write_result
from ..limb.remesh import mesh_in_background
from ..records.records import load_records
from ..simulation.limb_geometry import LimbGeometry
from ..simulation.simulations import SimulationCache
from ..socket.socket import check_socket
from .answer import correct_answer, plan_coarser_meshes, sample_intervals
from .pressures import FOLDER, PressureSimulator, count_pressures
from .search import (
    CalibrationProblem,
    RecordSimulator,
    SearchWarning,
    WarmStarts,
    build_problem,
    check_fitted,
    search_from_starts,
)


def check_calibrate(study: Study, limb: LimbGeometry | None = None) -> None:
    """Refuse what `check_fitted` does, and a socket whose pressures count but which cannot be simulated."""
    check_fitted(study)
    if study.calibration.use_socket_pressures:
        check_socket(study, limb, {})


def run_calibrate(context: Context, folder: Path) -> None:
    """One material, then each tissue its own, on the fitted sites; simulations are kept.

    A run taken up again repeats the interrupted one from its kept simulations.
    """
    study = context.study
    report = partial(context.tell, "calibrate", 0, 0)
    records = load_records(context, study.records_at(*study.fitted), secondary=True)
    problem = build_problem(study)
    cache = SimulationCache(folder / "runs", also=[context.store["calibrate"] / "runs"])
    simulator = RecordSimulator(problem, records, cache, context.executor, report)
    coarser = plan_coarser_meshes(context, records, folder / "coarser")
    with mesh_in_background(coarser, context.executor) as wait:
        starts, rounds = search_from_starts(simulator)
        wait()
    correction, pressures = correct_answer(simulator, starts.best, coarser), None
    if study.calibration.use_socket_pressures:
        measured = PressureSimulator(study, context.store, folder / FOLDER, report)
        found, known, pressures = count_pressures(measured, simulator, starts.best, correction)
    else:
        found, known = sample_intervals(simulator, starts.best, correction)
    corrections = [_summarise_round(one, found.sites, problem) for one in rounds]
    at_answer = summarise_answer(simulator, found)
    for site, texts in at_answer["warnings"].items():
        report(f"warning: site {site}, at the answer: {'; '.join(texts)}")
    bounds, kept = problem.unknowns, cache.load_all()
    content = stored.CalibrationResult(
        stages=[_summarise_stage(found, i, problem, simulator.starts) for i in range(len(found.stages))],
        bounds=stored.ParameterBounds(
            lower=study.by_tissue(bounds.lower), upper=study.by_tissue(bounds.upper)
        ),
        law=stored.StoredLaw(**study.law.record()),
        objective=study.calibration.objective,
        uncertainty=_summarise_uncertainty(known, found.responses, study),
        forward_runs=len(kept),
        forward_runs_with_sensitivities=sum(one.jacobian is not None for one in kept),
        linear_solver=kept[0].facts["linear_solver"] if kept else None,
        element=kept[0].facts["element"] if kept else None,
        corrections=corrections,
        socket_pressures=pressures,
        multistart=_summarise_starts(starts, problem) if study.calibration.starts > 1 else None,
        **at_answer,
    )
    write_result(folder / "calibration.json", content)


def _summarise_stage(
    found: Calibration, number: int, problem: CalibrationProblem, warm_starts: WarmStarts
) -> stored.SearchStage:
    """One stage: from the start of the problem, or the end of the stage before, to its own end."""
    study, stage = problem.study, found.stages[number]
    before = np.array(found.stages[number - 1].parameters) if number else problem.unknowns.start
    iterates = [iterate for iterate in found.history if iterate.stage == number]

    def starts(parameters: Sequence[float]) -> list[Parameters]:
        return [study.by_tissue(one) for one in warm_starts.find(np.array(parameters))]

    return stored.SearchStage(
        name=problem.titles[number],
        start=study.by_tissue(before),
        parameters=study.by_tissue(np.array(stage.parameters)),
        cost=stage.cost,
        evaluations=stage.evaluations,
        converged=stage.converged,
        reason=stage.reason,
        iterations=[
            stored.SearchIteration(
                iteration=i,
                parameters=study.by_tissue(np.array(iterate.parameters)),
                starts=starts(iterate.parameters),
                cost=iterate.cost,
                error_percent=float(np.mean(iterate.errors_percent)),
                error_percent_by_site=dict(zip(found.sites, iterate.errors_percent, strict=True)),
            )
            for i, iterate in enumerate(iterates)
        ],
    )


def _summarise_round(
    one: CorrectionRound, sites: Sequence[str], problem: CalibrationProblem
) -> stored.MeshCorrectionRound:
    """One correction of the search by the whole meshes; percentages are of each site's largest force."""
    return stored.MeshCorrectionRound(
        stage=problem.titles[one.stage] if one.stage >= 0 else "start",
        parameters=problem.study.by_tissue(np.array(one.parameters)),
        scale_by_site=dict(zip(sites, one.scales, strict=True)),
        difference_percent_by_site=dict(zip(sites, one.difference_percent, strict=True)),
        change_percent_by_site=dict(zip(sites, one.expected_percent, strict=True)),
        reason=one.reason,
    )


def _summarise_starts(tried: MultistartResult, problem: CalibrationProblem) -> stored.SearchStarts:
    study, starts = problem.study, []
    for one in tried.starts:
        found = None if one.parameters is None else study.by_tissue(np.array(one.parameters))
        vectors = {"start": study.by_tissue(np.array(one.start)), "parameters": found}
        starts.append(stored.SearchStart(**vars(one) | vectors))
    return stored.SearchStarts(
        summary=describe_starts(tried, problem.unknowns.names), reached=tried.reached_count, starts=starts
    )


def _summarise_uncertainty(
    known: Uncertainty, responses: Sequence[SiteResponse], study: Study
) -> stored.CalibrationUncertainty:
    """What is stored of the uncertainty; intervals by tissue and name, like the parameters."""
    relaxation = None
    if is_ogden(study.law.name) or study.law.name in (FIBRED, FUNG):
        assessed = assess_relaxation(known, responses)
        relaxation = None if assessed is None else assessed.summarise()
    verdicts = limit_verdicts(known.verdicts, known, relaxation)
    return stored.CalibrationUncertainty(
        method=known.method,
        intervals_95=group_intervals(known, study),
        correlation=stored.CorrelationMatrix(names=known.names, matrix=known.correlation.tolist()),
        covariance_log=known.covariance.tolist(),
        sampling_covariance_log=known.sampling_covariance.tolist(),
        verdict=dict(zip(known.names, verdicts, strict=True)),
        at_bound=dict(zip(known.names, map(bool, known.at_bound), strict=True)),
        combinations=[f"{c.text}: {c.verdict}" for c in known.combinations],
        most_probable=study.by_tissue(known.centre),
        priors=_summarise_priors(known, study),
        residuals=known.residual_model.summarise(),
        minus_2_log_evidence=known.minus_2_log_evidence,
        relaxation=relaxation,
    )


def group_intervals(known: Uncertainty, study: Study) -> Intervals:
    """The 95 % intervals by tissue and name."""
    intervals: dict[str, dict[str, Interval]] = {tissue: {} for tissue in study.tissues}
    for (tissue, name), (low, high) in zip(study.parameters, known.intervals_95.tolist(), strict=True):
        intervals[tissue][name] = (low, high)
    return intervals


def _summarise_priors(known: Uncertainty, study: Study) -> stored.PriorShares | None:
    """The priors that counted, and how much of each interval comes from them; none where none were stated."""
    if not study.priors:
        return None
    stated = study.calibration.prior
    sources = {name: "the study" if name in stated else SOURCE for name in study.priors}
    return stored.PriorShares(
        stated={
            name: stored.StatedPrior(median=prior.median, factor=prior.factor, source=sources[name])
            for name, prior in study.priors.items()
        },
        share=dict(zip(known.names, known.prior_share.tolist(), strict=True)),
        wider_without=dict(zip(known.names, known.wider_without.tolist(), strict=True)),
    )


def summarise_answer(simulator: RecordSimulator, found: Calibration) -> dict[str, Any]:
    """Simulate the answer, and summarise its ``warnings``, ``contact`` and ``doubts``, as they are stored."""
    records, simulations = simulator.records, simulator.run_answer(found.parameters)
    answers = {one.site: one for one in records.select_forces(simulations)}
    rested, fitted = map(records.select_forces, (simulator.respond(simulations), found.responses))
    count = simulator.evaluations * records.simulations
    return {
        "warnings": {site: list(one.warnings) for site, one in answers.items() if one.warnings},
        "contact": summarise_contact(answers, simulator.penalties, rested, fitted),
        "doubts": summarise_doubts(simulator.warnings, answers, count, found),
    }


def summarise_contact(
    answers: Mapping[str, Simulation],
    searched: Mapping[str, float | None],
    rested: Sequence[SiteResponse],
    fitted: Sequence[SiteResponse],
) -> dict[str, stored.ContactSummary]:
    """Per site the penalty that all of its simulations hold, and what contact does at the answer.

    ``search_penalty_per_mm`` is that of the mesh on which parameters are searched; ``from_rest_percent`` how
    far the answer's force from rest is from the fitted one, in percent of its largest.
    """
    content = {}
    for (site, simulation), answer, fit in zip(answers.items(), rested, fitted, strict=True):
        off = np.max(np.abs(answer.force_N - fit.force_N)) / np.max(np.abs(fit.force_N))
        content[site] = stored.ContactSummary(
            penalty_per_mm=simulation.facts.get("penalty_per_mm"),
            sunk_steps=simulation.facts.get("sunk_steps"),
            unbalanced_steps=simulation.facts.get("unbalanced_steps"),
            search_penalty_per_mm=searched.get(site),
            penetration_mm=simulation.penetration_mm,
            from_rest_percent=100 * float(off) if np.isfinite(off) else None,
        )
    return content


def summarise_doubts(
    searched: Sequence[SearchWarning], answers: Mapping[str, Simulation], simulations: int, found: Calibration
) -> stored.SimulationDoubts:
    """How many of the ``simulations`` of the search are doubtful, which, and what is at the answer.

    ``iterate`` is the number of the accepted iterate that a doubt belongs to, from the beginning of the best
    start; None for a trial that was not accepted.
    """
    accepted: dict[tuple[float, ...], int] = {}
    for number, iterate in enumerate(found.history):
        accepted.setdefault(iterate.parameters, number)
    rows = [
        stored.SearchDoubt(
            evaluation=one.evaluation,
            iterate=accepted.get(one.parameters),
            site=one.site,
            parameters=dict(zip(found.names, one.parameters, strict=True)),
            **asdict(one.doubt),
        )
        for one in searched
    ]
    return stored.SimulationDoubts(
        simulations=simulations,
        doubtful=len({(one.evaluation, one.site) for one in searched}),
        search=rows,
        answer={
            site: [stored.SimulationDoubt.model_validate(doubt) for doubt in one.doubts]
            for site, one in answers.items()
            if one.doubts
        },
    )
