"""The experiment ``uncertainty``: what the records determine, and what else would change the answer."""

from collections.abc import Sequence
from functools import partial
from itertools import cycle
from pathlib import Path
from typing import Any

import numpy as np

from ...arrays import Array
from ...identify.fit.multifidelity import MeshCorrection
from ...identify.fit.objective import SiteResponse
from ...identify.fit.parameters import build_space
from ...identify.uncertainty.exploration import Exploration, ExplorationSettings, explore_posterior
from ...identify.uncertainty.likelihood import Likelihood
from ...identify.uncertainty.model_comparison import compare_models, fit_alternative
from ...identify.uncertainty.uncertainty import FitSensitivity
from ...indentation import SimulationJob
from ...results.identification import CalibrationResult
from ...results.uncertainty import EvidenceComparison
from ...study import Study
from ..engine.context import Context
from ..identification.fine_meshes import correct_to_fine_meshes
from ..identification.intervals import estimate_linearised
from ..identification.predict import Answer, build_answer_jobs
from ..identification.problem import CalibrationProblem, build_problem
from ..identification.record_simulator import RecordSimulator
from ..records.records import SiteRecord, load_records, to_response
from ..simulation.simulations import SimulationCache, open_experiment_cache
from .result import Findings, write_results
from .sources import simulate_sources

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

    def simulate(points: Sequence[Array]) -> list[list[SiteResponse]]:
        """All sites at parameters (p,), with derivatives; they start as in the calibration, or from the
        answer, itself from rest."""
        jobs, responses = list[SimulationJob](), list[SiteResponse]()
        for point in points:
            is_best = np.array_equal(point, best)
            starts = () if is_best else earlier.get(tuple(point.tolist()), (best,))
            jobs += [record.job(point, starts=starts) for record in records.searched]
        for record, simulation in zip(cycle(records.own), cache.run(jobs, context.executor)):
            responses.append(record.respond(simulation))
            context.tell(NAME, len(responses), len(jobs), f"site {simulation.site}")
        n = len(records.own)
        return [correction.as_fine(responses[i : i + n]) for i in range(0, len(responses), n)]

    explored = explore_posterior(
        simulate,
        known,
        [np.array(point) for point in sorted(earlier)],
        ExplorationSettings(table.runs, max(4, table.runs // 4), checked=table.checked, seed=table.seed),
        report=report,
    )
    evidence = _compare_groupings(context, problem, explored) if len(problem.stages) > 1 else None
    gain = FitSensitivity.linearise(known, correction.responses)
    changes = simulate_sources(context, folder, cache, records, best) if table.sources else []
    relaxation = calibration.uncertainty.relaxation
    found = Findings(known, explored, evidence, gain, tuple(changes), relaxation)
    write_results(folder, study, found, _predict_records(context, cache, calibration))
    return {"runs": explored.rounds[-1].runs}


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
    context: Context, problem: CalibrationProblem, explored: Exploration
) -> EvidenceComparison:
    """One material against the study's own, on one emulator and covariance, and where nothing was fitted."""
    unknowns, titles, likelihood = problem.unknowns, problem.titles, explored.likelihood
    space = build_space(unknowns, problem.stages[0])
    single = Likelihood(likelihood.emulator, likelihood.measured, likelihood.model, unknowns, space)
    start = context.study.vector(context.results.calibration.stages[0].parameters)
    one, _ = fit_alternative(titles[0], single, space.reduce(np.log(start)))
    several, _ = fit_alternative(titles[1], likelihood, explored.best.z)
    return compare_models(one, several, *context.results.predict.compare_held_out())


def _predict_records(
    context: Context, cache: SimulationCache, calibration: CalibrationResult
) -> list[tuple[SiteRecord, SiteResponse]]:
    """Every record at the identified parameters, from what the stage ``predict`` has simulated."""
    study, records = context.study, load_records(context, context.study.recorded)
    jobs = build_answer_jobs(records, Answer.of(calibration.stages[-1], study))
    responses = [to_response(simulation) for simulation in cache.run(jobs, context.executor)]
    if records.is_coarsened:
        n = len(records.own)
        responses = MeshCorrection(responses[n:], responses[:n])(responses[n:])
    return list(zip(records.searched, responses, strict=True))
