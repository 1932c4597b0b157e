"""The search for parameters: what a study asks of it, simulations of its records, and how they are searched.

A study states parameters with their bounds, stages, and when the search ends. Records are simulated with
derivatives for the search, and on the finer meshes that correct it; it begins at several starts, and goes on
inwards from bounds.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, fields, replace
from functools import partial
from typing import Literal

import numpy as np

from ...arrays import Array
from ...errors import StudyError, add_location
from ...execution import Executor
from ...fe import SimulationWarning
from ...identify.fit.calibration import Calibration, CalibrationSettings, SearchState, calibrate
from ...identify.fit.multifidelity import (
    CorrectionRound,
    CorrectionSettings,
    SearchResult,
    calibrate_with_correction,
)
from ...identify.fit.multistart import MultistartResult, continue_from_bound, run_multistart
from ...identify.fit.objective import SiteResponse
from ...identify.fit.parameters import (
    Grouping,
    Prior,
    SearchSpace,
    Unknowns,
    build_space,
    build_stage_groupings,
    constrain,
    group_by_kind,
)
from ...identify.fit.readings import LinearisedReadings
from ...identify.uncertainty.intervals import EvaluationStore
from ...indentation import Simulation, SimulationJob
from ...results.identification import CalibrationResult
from ...study import Study
from ..records.records import RecordSet
from ..simulation.simulations import SimulationCache

COUNTS = ("no", "one", "two", "three", "four", "five", "six")
Responses = list[SiteResponse]
# Takes a line in words, and `Progress.fit` and `Progress.facts` where it has some.
Report = Callable[..., None]
# In logarithms of parameters: another simulation's states save work as first guesses as far as the first, and
# half of it within the second; one that is farther than that is the next one's start.
MAX_START_DISTANCE, MAX_SHORT_DISTANCE, MAX_WARM_STARTS = 1.5, 0.35, 8


@dataclass(frozen=True)
class CalibrationProblem:
    """What a ``study`` asks of its calibration: the ``unknowns``, and which of them move together in each of
    the ``stages``, whose ``titles`` are in words.

    ``space`` is that of the last stage; ``is_moved`` says that the answer is what is most probable.
    """

    study: Study
    unknowns: Unknowns
    stages: tuple[Grouping, ...]
    titles: tuple[str, ...]
    settings: CalibrationSettings
    space: SearchSpace
    is_moved: bool


def check_fitted(study: Study) -> None:
    """Refuse a study that has nothing to identify parameters from, or no parameter to identify.

    Raises `StudyError` with the remedy.
    """
    if not study.fitted:
        remedy = "set fitted = true where there is a record, or stop before it: limbfit run --until mesh"
        raise StudyError("no site is fitted", file=study.file, place="sites", remedy=remedy)
    with add_location(file=study.file, place="calibration"):
        build_problem(study)


def build_problem(study: Study, calibrated: CalibrationResult | None = None) -> CalibrationProblem:
    """The problem that a study states; with the pressures of a socket as they counted at the end of the
    ``calibrated`` one.
    """
    table, tissues = study.calibration, len(study.tissues)
    unknowns, stages = build_unknowns(study), build_groupings(study)
    if calibrated is not None and (counted := calibrated.socket_pressures) is not None:
        readings = LinearisedReadings(np.array(counted.rows), np.array(counted.target))
        unknowns = replace(unknowns, readings=readings)
    one, several = "one material", f"{COUNTS[tissues] if tissues < len(COUNTS) else tissues} materials"
    is_one = stages[-1] == group_by_kind(unknowns.names)
    settings = {one.name: getattr(table, one.name) for one in fields(CalibrationSettings)}
    return CalibrationProblem(
        study=study,
        unknowns=unknowns,
        stages=stages,
        # What a study fixes or ties may leave nothing to a second stage.
        titles=(one, several) if len(stages) > 1 else (one if is_one else several,),
        settings=CalibrationSettings(**settings),
        space=build_space(unknowns, stages[-1]),
        is_moved=is_moved(study),
    )


def is_moved(study: Study) -> bool:
    """Whether the answer is what is most probable, and not the least squares.

    As the study states; else where a fitted site has more than one record of force, or pressures count. What
    the records' own doubts weigh decides then: errors of touch-down and site that one fit to everything would
    take for tissue.
    """
    table, records = study.calibration, study.records_at(*study.fitted)
    if table.answer is not None:
        return table.answer == "most probable"
    more = len(records) > len(study.fitted) or any(record.observed for record in records)
    more |= table.use_socket_pressures
    return more and "paper" not in (table.objective, table.stopping)


def build_unknowns(study: Study) -> Unknowns:
    """The parameters of each tissue with the study's start and bounds."""

    def flatten(which: Literal["start", "lower", "upper"]) -> Array:
        return study.vector({tissue: study.material.get(tissue, which) for tissue in study.tissues})

    names = tuple(f"{tissue}.{name}" for tissue, name in study.parameters)
    priors = tuple(Prior(name, p.median, p.factor) for name, p in study.priors.items())
    return Unknowns(names, flatten("start"), flatten("lower"), flatten("upper"), priors)


def build_groupings(study: Study) -> tuple[Grouping, ...]:
    """Which parameters move together in each stage, as far as the study lets them move."""
    names = build_unknowns(study).names
    made = [
        constrain(one, names, study.fixed, study.calibration.tied) for one in build_stage_groupings(names)
    ]
    return tuple(dict.fromkeys(made))


class WarmStarts:
    """Parameters whose simulations give first guesses to others.

    They follow from the parameters asked for before: a run taken up again asks for the same ones.
    """

    def __init__(self) -> None:
        self._chain: tuple[Array, ...] = ()
        self._found: dict[bytes, tuple[Array, ...]] = {}

    def find(self, parameters: Array) -> tuple[Array, ...]:
        """Those from which parameters (p,) start, each the next one's first guess; none: from rest."""
        key = parameters.tobytes()
        if key not in self._found:
            is_full = len(self._chain) == MAX_WARM_STARTS
            if self._chain and not self._reaches(
                parameters, MAX_SHORT_DISTANCE if is_full else MAX_START_DISTANCE
            ):
                self._chain = ()
            self._found[key] = self._chain
            if not self._chain or not self._reaches(parameters, MAX_SHORT_DISTANCE):
                self._chain = (*self._chain, parameters)
        return self._found[key]

    def _reaches(self, parameters: Array, distance: float) -> bool:
        return bool(np.max(np.abs(np.log(parameters / self._chain[-1]))) <= distance)


@dataclass(frozen=True)
class SearchWarning:
    """A doubt about a simulation of the search: in which evaluation, where, with which parameters."""

    evaluation: int
    site: str
    parameters: tuple[float, ...]
    doubt: SimulationWarning


class RecordSimulator:
    """Simulates a problem's records at parameters (p,), on an executor; what a cache holds is not done again.

    ``report`` is given a line for each simulation. A search leaves behind the number of its ``evaluations``,
    those that were complete (``store``), the penalty of contact by site (``penalties``), and ``warnings``.
    """

    def __init__(
        self,
        problem: CalibrationProblem,
        records: RecordSet,
        cache: SimulationCache,
        executor: Executor,
        report: Report,
    ) -> None:
        self.problem = problem
        self.records, self.cache, self.executor, self.report = records, cache, executor, report
        self.starts, self.store, self.evaluations = WarmStarts(), EvaluationStore(), 0
        self.penalties: dict[str, float | None] = {}
        self.warnings: list[SearchWarning] = []
        self._corrections = 0

    def count_readings(self, readings: LinearisedReadings) -> None:
        """Let readings count in the problem from now on, in the place of earlier ones."""
        unknowns = replace(self.problem.unknowns, readings=readings)
        self.problem = replace(self.problem, unknowns=unknowns)

    def search(self, parameters: Array) -> Responses:
        """Force and derivatives on the meshes of the search; they are remembered."""
        self.evaluations += 1
        starts = self.starts.find(parameters)
        jobs = [record.job(parameters, starts=starts) for record in self.records.searched]
        simulations = self.run(jobs, f"evaluation {self.evaluations}")
        for simulation in self.records.select_forces(simulations):
            self.penalties[simulation.site] = simulation.facts.get("penalty_per_mm")
            self.warnings += [
                SearchWarning(self.evaluations, simulation.site, tuple(parameters.tolist()), doubt)
                for doubt in simulation.doubts
            ]
        responses = self.respond(simulations)
        self.store.add(parameters, responses)
        return responses

    def check(self, parameters: Array) -> Responses:
        """Force on the study's own meshes; what failed before is tried again."""
        return self.respond(self.run_own(parameters))

    def run_own(self, parameters: Array) -> list[Simulation]:
        """The simulations of `check`."""
        self._corrections += 1
        starts = self.starts.find(parameters)
        jobs = [record.own_job(parameters, starts) for record in self.records.own]
        return self.run(jobs, f"correction {self._corrections}", again=True)

    def run_answer(self, parameters: Array) -> list[Simulation]:
        """The simulations of an answer as all that follows takes them: on the study's own meshes."""
        if self.records.is_coarsened:
            return self.run_own(parameters)
        return self.run([record.job(parameters) for record in self.records.own], "the answer, from rest")

    def run(self, jobs: Sequence[SimulationJob], title: str, again: bool = False) -> list[Simulation]:
        """The simulations of one job a record; with ``again`` those that failed are tried once more."""
        simulations = []
        done = self.cache.run(jobs, self.executor, again)
        for record, simulation in zip(self.records.own, done, strict=True):
            simulations.append(simulation)
            if record.seen is None:
                self.report(f"{title}, site {simulation.site}")
        return simulations

    def respond(self, simulations: Iterable[Simulation]) -> Responses:
        """What the records would show of their simulations."""
        pairs = zip(self.records.own, simulations, strict=True)
        return [record.respond(simulation) for record, simulation in pairs]


def search_from_starts(simulator: RecordSimulator) -> tuple[MultistartResult, tuple[CorrectionRound, ...]]:
    """Search from each of ``calibration.starts``: what came of them, and the corrections of the best."""
    problem, corrections = simulator.problem, dict[int, tuple[CorrectionRound, ...]]()
    table = problem.study.calibration

    def run(number: int, start: Unknowns) -> Calibration:
        if number:
            simulator.report(f"start {number + 1} of {table.starts}")
        found = search_parameters(simulator, start, problem.stages)
        corrections[number] = found.rounds
        return found.calibration

    starts = run_multistart(run, problem.unknowns, table.starts, table.seed, problem.stages[0])
    return starts, corrections[starts.number]


def search_parameters(
    simulator: RecordSimulator, start: Unknowns, stages: Sequence[Grouping]
) -> SearchResult:
    """The parameters of some records as the study wants them found, and the corrections made.

    Where the last of the ``stages`` ends at a bound, it is searched again from inside.
    """
    search = partial(_search_once, simulator)
    first = search(start, stages)
    if simulator.problem.settings.stopping == "paper":
        return first
    return continue_from_bound(first, start, stages, search, simulator.report)


def _search_once(simulator: RecordSimulator, start: Unknowns, stages: Sequence[Grouping]) -> SearchResult:
    problem, records, study = simulator.problem, simulator.records, simulator.problem.study
    table, titles = study.calibration, problem.titles[-len(stages) :]

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
            simulator.search, records.curves, start, problem.settings, stages=stages, on_iterate=report
        )
        return SearchResult(found)
    return calibrate_with_correction(
        simulator.search, simulator.check, records.curves, start, problem.settings,
        CorrectionSettings(table.corrections, table.correction_tolerance_percent),
        stages=stages, on_iterate=report,
    )  # fmt: skip
