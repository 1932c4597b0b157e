"""Simulations of a calibration's records: with derivatives for the search, and on the study's own meshes."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from ...arrays import Array
from ...execution import Executor
from ...fe import SimulationWarning
from ...identify.fit.objective import SiteResponse
from ...identify.uncertainty.intervals import EvaluationStore
from ...indentation import Simulation, SimulationJob
from ..records.records import RecordSet
from ..simulation.simulations import SimulationCache

Responses = list[SiteResponse]
# Takes a line in words, and `Progress.fit` and `Progress.facts` where it has some.
Report = Callable[..., None]
# In logarithms of parameters: another simulation's states save work as first guesses as far as the first, and
# half of it within the second; one that is farther than that is the next one's start.
MAX_START_DISTANCE, MAX_SHORT_DISTANCE, MAX_WARM_STARTS = 1.5, 0.35, 8


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
    """Simulates records at parameters (p,), on an executor; what a cache holds is not done again.

    ``report`` is given a line for each simulation. A search leaves behind the number of its ``evaluations``,
    those that were complete (``store``), the penalty of contact by site (``penalties``), and ``warnings``.
    """

    def __init__(
        self, records: RecordSet, cache: SimulationCache, executor: Executor, report: Report
    ) -> None:
        self.records, self.cache, self.executor, self.report = records, cache, executor, report
        self.starts, self.store, self.evaluations = WarmStarts(), EvaluationStore(), 0
        self.penalties: dict[str, float | None] = {}
        self.warnings: list[SearchWarning] = []
        self._corrections = 0

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
