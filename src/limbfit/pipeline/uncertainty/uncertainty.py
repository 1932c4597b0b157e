"""The experiment ``uncertainty``: what the records determine, and what else would change the answer."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from itertools import cycle
from pathlib import Path
from typing import Any

import numpy as np

from ...arrays import Array
from ...identify.fit.multifidelity import MeshCorrection
from ...identify.fit.objective import SiteResponse
from ...identify.fit.parameters import build_space, group_by_kind
from ...identify.uncertainty.exploration import Exploration, ExplorationSettings, explore_posterior
from ...identify.uncertainty.likelihood import Likelihood
from ...identify.uncertainty.model_comparison import compare_models, fit_alternative
from ...identify.uncertainty.uncertainty import FitSensitivity
from ...results.identification import CalibrationResult, RecordPrediction
from ...results.uncertainty import EvidenceComparison
from ...study import Study
from ..engine.context import Context
from ..identification.fine_meshes import FineMeshCorrection, correct_to_fine_meshes
from ..identification.intervals import estimate_linearised
from ..identification.predict import Answer, build_answer_jobs
from ..identification.problem import CalibrationProblem, build_problem
from ..identification.record_simulator import RecordSimulator
from ..records.deviations import estimate_site_deviation, estimate_site_noise
from ..records.records import load_records, to_response
from ..simulation.simulations import SimulationCache, open_experiment_cache
from .result import Found, Predicted, write_results
from .sources import Change, build_variants, simulate_changes

_NEAR = 4.0  # runs of the calibration whose error is at most this many times the least, plus 3 %, are used
NAME = "uncertainty"


def run_uncertainty(context: Context, folder: Path) -> dict[str, Any]:
    """Posterior, profiles, evidence, further sources and prediction intervals (see docs/uncertainty.md)."""
    study, report = context.study, partial(context.tell, NAME, 0, 0)
    calibration = context.results.calibration
    best = study.vector(calibration.parameters)
    earlier = _select_earlier_points(study, calibration)
    problem, table = build_problem(study), study.uncertainty
    records = load_records(context, study.records_at(*study.fitted), secondary=True)
    cache = open_experiment_cache(context, folder)
    simulator = RecordSimulator(records, cache, context.executor, report)
    correction = correct_to_fine_meshes(problem, simulator, best)
    known = estimate_linearised(problem, records.own, best, correction)
    explored = explore_posterior(
        partial(_simulate_points, context, simulator, correction, best, earlier),
        known,
        [np.array(point) for point in sorted(earlier)],
        ExplorationSettings(table.runs, max(4, table.runs // 4), checked=table.checked, seed=table.seed),
        report=report,
    )
    evidence = None
    if len(study.tissues) > 1:
        predicted = context.results.predict.sites
        evidence = _compare_groupings(study, problem, explored, calibration, predicted)
    gain = FitSensitivity.linearise(known, correction.responses)
    changes: list[Change] = []
    if table.sources:
        changes = simulate_changes(
            context, cache, build_variants(context, folder, records, best), records.own
        )
    found = Found(known, explored, evidence, gain, tuple(changes), problem.unknowns)
    write_results(folder, found, _predict_sites(context, cache, calibration))
    return {"runs": explored.rounds[-1].runs}


def _simulate_points(
    context: Context,
    simulator: RecordSimulator,
    correction: FineMeshCorrection,
    best: Array,
    earlier: Mapping[tuple[float, ...], Sequence[Array]],
    points: Sequence[Array],
) -> list[list[SiteResponse]]:
    """Responses of all sites, with derivatives, at several parameters (p,); brought to the fine meshes.

    Simulations start as in the calibration (``earlier``), or from the answer ``best``, itself from rest.
    """
    records, jobs = simulator.records, []
    for point in points:
        starts = earlier.get(tuple(point.tolist()), (best,))
        if np.array_equal(point, best):
            starts = ()
        jobs += [record.job(point, starts=starts) for record in records.searched]
    responses: list[SiteResponse] = []
    for record, simulation in zip(cycle(records.own), simulator.cache.run(jobs, simulator.executor)):
        responses.append(record.respond(simulation))
        context.tell(NAME, len(responses), len(jobs), f"site {simulation.site}")
    n = len(records.own)
    return [correction.as_fine(responses[i : i + n]) for i in range(0, len(responses), n)]


def _select_earlier_points(
    study: Study, calibration: CalibrationResult
) -> dict[tuple[float, ...], Sequence[Array]]:
    """Parameters of the calibration's iterates that came near the records, and where it started them from."""
    iterates = [iterate for stage in calibration.stages for iterate in stage.iterations]
    least = min(iterate.error_percent for iterate in iterates)
    return {
        tuple(study.vector(one.parameters).tolist()): [study.vector(s) for s in one.starts]
        for one in iterates
        if one.error_percent <= _NEAR * least + 3.0
    }


def _compare_groupings(
    study: Study,
    problem: CalibrationProblem,
    explored: Exploration,
    calibration: CalibrationResult,
    predicted: Sequence[RecordPrediction],
) -> EvidenceComparison:
    """One material against the study's own, on one emulator and covariance, and where nothing was fitted.

    ``predicted`` are the records of ``predict.json``.
    """
    unknowns, titles, likelihood = problem.unknowns, problem.titles, explored.likelihood
    space = build_space(unknowns, group_by_kind(unknowns.names))
    single = Likelihood(likelihood.emulator, likelihood.measured, likelihood.model, unknowns, space)
    start = study.vector(calibration.stages[0].parameters)
    one, _ = fit_alternative(titles[0], single, space.reduce(np.log(start)))
    several, _ = fit_alternative(titles[1], likelihood, explored.best.z)
    errors = [
        (row.error_one_material_percent, row.error_percent)
        for row in predicted
        if not row.fitted and row.error_one_material_percent is not None and row.error_percent is not None
    ]
    return compare_models(one, several, [first for first, _ in errors], [second for _, second in errors])


def _predict_sites(
    context: Context, cache: SimulationCache, calibration: CalibrationResult
) -> list[Predicted]:
    """Every recorded site at the identified parameters, from what the stage ``predict`` has simulated."""
    study, records = context.study, load_records(context, context.study.recorded)
    jobs = build_answer_jobs(records, Answer.of(calibration.stages[-1], study))
    responses = [to_response(simulation) for simulation in cache.run(jobs, context.executor)]
    if records.is_coarsened:
        n = len(records.own)
        responses = MeshCorrection(responses[n:], responses[:n])(responses[n:])
    best, found = study.vector(calibration.parameters), []
    for record, end in zip(records.searched, responses):
        noise, of_site = None, np.zeros(len(record.compared))
        if end.completed:
            noise = estimate_site_noise(study, record, end.force_N)
            if not record.site.fitted:
                of_site = estimate_site_deviation(study, record, end, best)
        found.append(Predicted(record, end, noise, of_site))
    return found
