"""The simulations of a calibration's records, and what the study wants of their parameters."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np

from ...anatomy.meshing.meshing import MeshSettings
from ...arrays import Array
from ...errors import RunError
from ...identify.fit.calibration import calibrate, move_answer
from ...identify.fit.correction import MeshCorrection
from ...identify.fit.multifidelity import CorrectionSettings, calibrate_with_correction
from ...identify.fit.multistart import SearchResult, continue_from_bound
from ...identify.fit.objective import MeasuredCurve, SiteResponse
from ...identify.fit.parameters import (
    Grouping,
    Prior,
    Unknowns,
    build_space,
    build_stage_groupings,
    constrain,
)
from ...identify.fit.state import Calibration, CalibrationSettings, SearchState
from ...identify.uncertainty.intervals import EvaluationStore, count_further_evaluations, sample_uncertainty
from ...identify.uncertainty.uncertainty import LINEARISED, Uncertainty, estimate_uncertainty
from ...indentation import Simulation, SimulationJob, SiteModel
from ...study import Record, Study
from ...study.meshing import MeshTable
from ..engine.context import Context
from ..limb.mesh import mesh_settings
from ..limb.remesh import mesh_in_background, mesh_where_possible, scale_edges
from ..records.deviations import estimate_site_deviation, estimate_site_noise
from ..records.records import (
    SiteRecord,
    coarsen_records,
    is_moved,
    load_site_record,
    select_compared_records,
)
from ..simulation.extrapolation import MESH_ORDERS, estimate_fine_error
from ..simulation.simulations import SimulationCache
from .simulation_warnings import SearchWarning

Responses = list[SiteResponse]
COARSER = 1.3  # times the edges: another mesh that tells the error of the study's own
# In logarithms of parameters: another simulation's states save work as first guesses as far as NEAR, and half
# of it within CLOSE; one that is farther than that is the next one's start.
NEAR, CLOSE, MOST_STARTS = 1.5, 0.35, 8
ONLY_LINEARISED = "too few simulations completed near the answer: its intervals are linearised, too narrow"
STAYS = "what is most probable cannot be simulated, and the least squares are the answer"
COUNTS = ("no", "one", "two", "three", "four", "five", "six")


def list_stage_titles(tissues: Sequence[str]) -> tuple[str, ...]:
    """Names of the stages of the identification; a single tissue has one."""
    n = len(tissues)
    return ("one material", f"{COUNTS[n] if n < len(COUNTS) else n} materials")[: min(n, 2)]


@dataclass(frozen=True)
class FineMeshCorrection:
    """Responses at an answer, what brings those of a search to the study's own meshes as they were there,
    and one standard deviation (n,) N of what these lack at every site: none where no other mesh tells."""

    responses: Responses
    as_fine: Callable[[Responses], Responses]
    mesh_N: tuple[Array, ...]


class RecordSimulator:
    """Simulates some records: with derivatives as parameters are searched, without on their own whole meshes.

    ``title`` is the stage or experiment that is told of progress.
    """

    def __init__(
        self, context: Context, cache: SimulationCache, records: Sequence[Record], title: str = "calibrate"
    ) -> None:
        self.context, self.cache = context, cache
        self.title = title
        self.records = select_compared_records(
            context, [load_site_record(context, record) for record in records]
        )
        self.searched = coarsen_records(context, self.records)
        self.evaluations = self.corrections = 0
        self.warnings: dict[str, list[str]] = {}
        self.latest: dict[str, Simulation] = {}
        self.penalties: dict[str, float | None] = {}
        self.doubts: list[SearchWarning] = []
        self.kept = EvaluationStore()
        self._chain: tuple[Array, ...] = ()
        self._starts: dict[bytes, tuple[Array, ...]] = {}

    @property
    def is_apart(self) -> bool:
        """Whether parameters are searched on something smaller than the sites' own meshes."""
        return self.searched is not self.records

    @property
    def simulated(self) -> int:
        """How many simulations an evaluation takes: one of each record."""
        return sum(record.seen is None for record in self.records)

    def of_records(self, responses: Sequence[SiteResponse]) -> Responses:
        """Those of the records themselves, without what ultrasound saw beside them."""
        pairs = zip(self.records, responses, strict=True)
        return [response for record, response in pairs if record.seen is None]

    @property
    def measured(self) -> list[MeasuredCurve]:
        return [record.measured for record in self.records]

    def search(self, parameters: Array) -> Responses:
        """Force and derivatives where parameters are searched."""
        self.evaluations += 1
        starts = self.starts(parameters)
        jobs = [record.job(parameters, starts=starts) for record in self.searched]
        found = self._run(jobs, f"evaluation {self.evaluations}", searched=parameters)
        self.kept.add(parameters, found)
        return found

    def starts(self, parameters: Array) -> tuple[Array, ...]:
        """Parameters whose simulations give the first guesses of these, each the next one's; none: from rest.

        They follow from the parameters asked for before: a run taken up again asks for the same ones.
        """

        def is_within(distance: float) -> bool:
            return bool(np.max(np.abs(np.log(parameters / self._chain[-1]))) <= distance)

        key = parameters.tobytes()
        if key not in self._starts:
            reach = CLOSE if len(self._chain) == MOST_STARTS else NEAR
            if self._chain and not is_within(reach):
                self._chain = ()
            self._starts[key] = self._chain
            if not self._chain or not is_within(CLOSE):
                self._chain = (*self._chain, parameters)
        return self._starts[key]

    def answer(self, parameters: Array) -> Responses:
        """The forces of an answer as all that follows takes them; ``warnings`` are then theirs."""
        if self.is_apart:
            return self.check(parameters)
        return self._run([record.job(parameters) for record in self.records], "the answer, from rest")

    def check(self, parameters: Array) -> Responses:
        """Force on the study's own meshes; what failed before is tried again."""
        self.corrections += 1
        starts = self.starts(parameters)
        jobs = [record.own_job(parameters, starts) for record in self.records]
        return self._run(jobs, f"correction {self.corrections}", again=True)

    def anchored(self, parameters: Array) -> FineMeshCorrection:
        """The responses at an answer, and what brings those of `search` to the study's own meshes.

        Raises
        ------
        RunError
            Where a site cannot be simulated there.
        """
        anchored = FineMeshCorrection(found := self.search(parameters), list, ())
        if self.is_apart:
            correction = MeshCorrection(found, self.check(parameters))
            anchored = FineMeshCorrection(correction(found), correction, ())
        if self.context.study.mesh.coarse is not None:
            anchored = replace(anchored, mesh_N=self._mesh_error(parameters, found, self.records))
        for one in anchored.responses:
            if not one.completed:
                raise RunError(f"site {one.site} cannot be simulated at the answer: {one.reason}")
        return anchored

    def uncertainty(
        self, found: Calibration, grouping: Grouping, meshes: Path, moves: bool = True
    ) -> tuple[Calibration, Uncertainty]:
        """The answer, which ``moves`` to what is most probable where that is wanted, and what is known of it.

        Sampled on what was simulated near it and a little more; linearised, and the answer stays, where that
        cannot be for simulations that fail. ``meshes`` is a folder for the coarser meshes that tell the error
        of the study's own, where it has no others.
        """
        study, spent = self.context.study, 0
        anchored = FineMeshCorrection(list(found.responses), list, ())
        if self.is_apart:
            anchored = self.anchored(found.parameters)
        if study.mesh.coarse is None and any(coarser := self._coarser(meshes)):
            searched = self.search(found.parameters) if self.is_apart else anchored.responses
            anchored = replace(anchored, mesh_N=self._mesh_error(found.parameters, searched, coarser))
            spent = self.simulated
        known = estimate_linearised(self.context, self.records, found.parameters, anchored)
        kept = EvaluationStore()
        for point, run in zip(self.kept.points, self.kept.responses, strict=True):
            kept.add(point, anchored.as_fine(list(run)))

        def simulate(parameters: Array) -> Responses:
            self.context.tell(self.title, 0, 0, "a further evaluation, for the intervals")
            return anchored.as_fine(self.search(parameters))

        space = build_space(bounds := build_unknowns(study), grouping)
        evaluations = count_further_evaluations(self.simulated, spent)
        about = known, self.measured, bounds, space, kept, simulate, evaluations
        moves = moves and is_moved(study)
        sampled = sample_uncertainty(*about, move_answer=moves)
        if sampled.method == LINEARISED:
            self.context.tell(self.title, 0, 0, f"warning: {ONLY_LINEARISED}")
        if not moves or sampled.method == LINEARISED:
            return found, sampled
        answer = move_answer(found, sampled.parameters, self.measured, simulate(sampled.parameters), bounds)
        if isinstance(answer, Calibration):
            return answer, sampled
        self.context.tell(self.title, 0, 0, f"warning: {STAYS}: {answer}")
        return found, sample_uncertainty(*about, move_answer=False)

    @contextmanager
    def meshing(self, folder: Path) -> Iterator[Callable[[], None]]:
        """The coarser meshes that `uncertainty` will want in ``folder``, made beside the block; it is given a
        function that waits for them."""
        if self.context.study.mesh.coarse is not None:
            yield lambda: None
            return
        with mesh_in_background(self.context, folder, self._models, self._coarser_edges) as wait:
            yield wait

    @property
    def _models(self) -> list[SiteModel]:
        return [record.model for record in self.records]

    @property
    def _coarser_edges(self) -> MeshSettings:
        return scale_edges(mesh_settings(self.context.study), COARSER)

    def _coarser(self, folder: Path) -> list[SiteRecord | None]:
        """The records on coarser meshes than the study's own, which are made in ``folder``.

        None for a site of which none can be made: a line says so.
        """
        lost = "intervals do not count the error of the site's own mesh"
        edges, title = self._coarser_edges, self.title
        models = mesh_where_possible(self.context, folder, self._models, edges, title, lost)
        pairs = zip(self.records, models, strict=True)
        return [replace(record, model=model) if model else None for record, model in pairs]

    def _mesh_error(
        self, parameters: Array, searched: Responses, others: Sequence[SiteRecord | None]
    ) -> tuple[Array, ...]:
        """One standard deviation (n,) N of what the study's meshes lack at every site.

        It follows from the difference of what is ``searched`` and of the same on ``others``, meshes of other
        edges. Zero where there are none, or these cannot be simulated: a line says so.
        """
        study, lacking = self.context.study, [0.0 * record.compared for record in self.records]
        share = estimate_own_mesh_error(study.mesh)
        there = [(i, other) for i, other in enumerate(others) if other is not None]
        near = [replace(one, model=replace(one.model, within_mm=study.within_mm)) for _, one in there]
        jobs = [other.job(parameters, sensitivities=False) for other in near]
        done = self.cache.run(jobs, self.context.executor, again=True)
        for (i, _), simulation in zip(there, done, strict=True):
            found, known = self.records[i].respond(simulation), searched[i]
            told = f"another mesh, site {simulation.site}"
            if not found.completed:
                told = f"warning: site {simulation.site}: the error of its mesh is not known: {found.reason}"
            self.context.tell(self.title, 0, 0, told)
            if found.completed and known.completed:
                lacking[i] = share * (known.force_N - found.force_N)
        return tuple(lacking)

    def _facts(self, state: SearchState) -> dict[str, Any]:
        """The newest iterate in numbers: error in percent of the largest force, parameters, cost."""
        last = state.history[-1]
        return {
            "iterate": len(state.history) - 1,
            "evaluations": self.evaluations,
            "cost": last.cost,
            "error_percent": float(np.mean(last.errors_percent)),
            "error_percent_by_site": dict(
                zip(
                    (record.name for record in self.records),
                    map(float, last.errors_percent),
                    strict=True,
                )
            ),
            "parameters": self.context.study.by_tissue(last.parameters),
        }

    def _run(
        self, jobs: Sequence[SimulationJob], what: str, again: bool = False, searched: Array | None = None
    ) -> Responses:
        """Responses to the jobs; doubts about those of the search, with ``searched`` parameters, are kept."""
        found = []
        self.warnings, self.latest = {}, {}
        done = self.cache.run(jobs, self.context.executor, again)
        for record, simulation in zip(self.records, done, strict=True):
            found.append(record.respond(simulation))
            if record.seen is not None:  # of the simulation before
                continue
            self.latest[simulation.site] = simulation
            if simulation.warnings:
                self.warnings[simulation.site] = list(simulation.warnings)
            if searched is not None:
                self.penalties[simulation.site] = simulation.facts.get("penalty_per_mm")
                self.doubts += [
                    SearchWarning(self.evaluations, simulation.site, tuple(searched.tolist()), doubt)
                    for doubt in simulation.doubts
                ]
            self.context.tell(self.title, 0, 0, f"{what}, site {simulation.site}")
        return found

    def identify(self, start: Unknowns, stages: Sequence[Grouping]) -> SearchResult:
        """The parameters of the sites' records as the study wants them found, and the corrections made.

        Where the last stage ends at a bound, it is searched again from inside.
        """
        first = self._identify(start, stages)
        if self.context.study.calibration.stopping == "paper":
            return first
        report = partial(self.context.tell, self.title, 0, 0)
        return continue_from_bound(first, start, stages, self._identify, report)

    def _identify(self, start: Unknowns, stages: Sequence[Grouping]) -> SearchResult:
        study, table = self.context.study, self.context.study.calibration
        titles = list_stage_titles(study.tissues)[-len(stages) :]

        def tell(state: SearchState) -> None:
            name = titles[state.history[-1].stage]
            facts = {"of": name, **self._facts(state)}
            words = f"{name}: {_describe(state, study)}"
            self.context.tell(self.title, 0, 0, words, fit=True, facts=facts)

        if not self.is_apart:
            found = calibrate(
                self.search, self.measured, start, build_settings(study), stages=stages, on_iterate=tell
            )
            return found, ()
        corrected = calibrate_with_correction(
            self.search, self.check, self.measured, start, build_settings(study),
            CorrectionSettings(table.corrections, table.correction_tolerance_percent),
            stages=stages, on_iterate=tell,
        )  # fmt: skip
        return corrected.calibration, corrected.rounds


def estimate_linearised(
    context: Context, records: Sequence[SiteRecord], parameters: Array, at: FineMeshCorrection
) -> Uncertainty:
    """What fitted records tell about ``parameters`` (p,), whose responses are given."""
    study = context.study
    pairs = list(zip(records, at.responses, strict=True))
    noise = [estimate_site_noise(study, record, response.force_N) for record, response in pairs]
    off = [estimate_site_deviation(context, record, response, parameters) for record, response in pairs]
    measured = [record.measured for record in records]
    return estimate_uncertainty(
        parameters,
        at.responses,
        measured,
        build_unknowns(study),
        noise,
        build_groupings(study)[-1],
        build_settings(study),
        at.mesh_N,
        off,
    )


def estimate_own_mesh_error(table: MeshTable) -> float:
    """One standard deviation of what the study's own mesh lacks, over its difference from the coarser one."""
    ratio = COARSER if table.coarse is None else table.coarse.edge_near_mm / table.edge_near_mm
    return estimate_fine_error(MESH_ORDERS[table.element], ratio)


def build_settings(study: Study) -> CalibrationSettings:
    """How the study wants its parameters found."""
    table = study.calibration
    return CalibrationSettings(
        objective=table.objective,
        relative_tolerance=table.relative_tolerance,
        max_iterations=table.max_iterations,
        stopping=table.stopping,
        force_error_percent=table.force_error_percent,
    )


def build_groupings(study: Study) -> tuple[Grouping, ...]:
    """Which parameters move together in each stage, as far as the study lets them move."""
    names = build_unknowns(study).names
    made = [
        constrain(one, names, study.fixed, study.calibration.tied) for one in build_stage_groupings(names)
    ]
    return tuple(dict.fromkeys(made))


def build_unknowns(study: Study) -> Unknowns:
    """The parameters of each tissue with the study's start and bounds."""

    def flat(which: Literal["start", "lower", "upper"]) -> Array:
        return study.vector({tissue: study.material.of(tissue, which) for tissue in study.tissues})

    names = tuple(f"{tissue}.{name}" for tissue, name in study.parameters)
    priors = tuple(Prior(name, p.median, p.factor) for name, p in study.priors.items())
    return Unknowns(names, flat("start"), flat("lower"), flat("upper"), priors)


def _describe(state: SearchState, study: Study) -> str:
    last = state.history[-1]
    words = " | ".join(
        f"{tissue} " + ", ".join(f"{p.name} {v[p.key]:.3g} {p.unit}".rstrip() for p in study.law.parameters)
        for tissue, v in study.by_tissue(last.parameters).items()
    )
    return f"error {np.mean(last.errors_percent):.2f} % | {words}"
