"""The search for parameters: from several starts, inwards from bounds, corrected by the finer meshes."""

from collections.abc import Sequence
from functools import partial

import numpy as np

from ...identify.fit.calibration import Calibration, SearchState, calibrate
from ...identify.fit.multifidelity import (
    CorrectionRound,
    CorrectionSettings,
    SearchResult,
    calibrate_with_correction,
)
from ...identify.fit.multistart import MultistartResult, continue_from_bound, run_multistart
from ...identify.fit.parameters import Grouping, Unknowns
from .problem import CalibrationProblem
from .record_simulator import RecordSimulator


def search_from_starts(
    problem: CalibrationProblem, simulator: RecordSimulator
) -> tuple[MultistartResult, tuple[CorrectionRound, ...]]:
    """Search from each of ``calibration.starts``: what came of them, and the corrections of the best."""
    table, corrections = problem.study.calibration, dict[int, tuple[CorrectionRound, ...]]()

    def run(number: int, start: Unknowns) -> Calibration:
        if number:
            simulator.report(f"start {number + 1} of {table.starts}")
        found = search_parameters(problem, simulator, start, problem.stages)
        corrections[number] = found.rounds
        return found.calibration

    starts = run_multistart(run, problem.unknowns, table.starts, table.seed, problem.stages[0])
    return starts, corrections[starts.number]


def search_parameters(
    problem: CalibrationProblem,
    simulator: RecordSimulator,
    start: Unknowns,
    stages: Sequence[Grouping],
) -> SearchResult:
    """The parameters of some records as the study wants them found, and the corrections made.

    Where the last of the ``stages`` ends at a bound, it is searched again from inside.
    """

    search = partial(_search_once, problem, simulator)
    first = search(start, stages)
    if problem.settings.stopping == "paper":
        return first
    return continue_from_bound(first, start, stages, search, simulator.report)


def _search_once(
    problem: CalibrationProblem,
    simulator: RecordSimulator,
    start: Unknowns,
    stages: Sequence[Grouping],
) -> SearchResult:
    study, records = problem.study, simulator.records
    table = study.calibration
    titles = problem.titles[-len(stages) :]

    def report(state: SearchState) -> None:
        last = state.history[-1]
        title, parameters = titles[last.stage], study.by_tissue(np.array(last.parameters))
        errors = map(float, last.errors_percent)
        facts = {
            "of": title,
            "iterate": len(state.history) - 1,
            "evaluations": simulator.evaluations,
            "cost": last.cost,
            "error_percent": float(np.mean(last.errors_percent)),
            "error_percent_by_site": dict(zip((one.name for one in records.own), errors, strict=True)),
            "parameters": parameters,
        }
        words = " | ".join(
            f"{tissue} "
            + ", ".join(f"{p.name} {v[p.key]:.3g} {p.unit}".rstrip() for p in study.law.parameters)
            for tissue, v in parameters.items()
        )
        simulator.report(f"{title}: error {facts['error_percent']:.2f} % | {words}", fit=True, facts=facts)

    if not records.is_coarsened:
        found = calibrate(
            simulator.search, records.measured, start, problem.settings, stages=stages, on_iterate=report
        )
        return SearchResult(found)
    return calibrate_with_correction(
        simulator.search, simulator.check, records.measured, start, problem.settings,
        CorrectionSettings(table.corrections, table.correction_tolerance_percent),
        stages=stages, on_iterate=report,
    )  # fmt: skip
