"""From records and meshes to identified parameters: the stage ``calibrate``."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from ...errors import RunError, StudyError
from ...identify.calibration import Calibration, CalibrationSettings, State, calibrate
from ...identify.correction import CoarseToFine
from ...identify.fidelity import FidelitySettings, Round, calibrate_corrected
from ...identify.intervals import Kept, sampled_uncertainty
from ...identify.multistart import Multistart, describe, multistart
from ...identify.objective import Measured, SiteResponse
from ...identify.parameters import Grouping, Prior, Unknowns, constrained, search_space, two_stages
from ...identify.uncertainty import LINEARISED, Uncertainty, estimate_uncertainty
from ...indentation import (
    Parameters,
    Simulation,
    SimulationJob,
    flat_names,
    to_parameters,
    to_vector,
)
from ...study import Site, Study
from ..context import Context
from ..simulations import SimulationCache
from ..store import write_json
from .doubted import Doubted, contact_record, doubts_record
from .plausible import stored_flags
from .record_noise import site_noise
from .traces import SiteRecord, site_record

Array = NDArray[np.float64]
Responses = list[SiteResponse]
NEAR = 1.5  # in logarithms of parameters: as far as another simulation's states save work as first guesses
ONLY_LINEARISED = "too few simulations completed near the answer: its intervals are linearised, too sure"
COUNTS = ("no", "one", "two", "three", "four", "five", "six")


def stage_titles(tissues: Sequence[str]) -> tuple[str, ...]:
    """Names of the stages of the identification; a single tissue has one."""
    n = len(tissues)
    return ("one material", f"{COUNTS[n] if n < len(COUNTS) else n} materials")[: min(n, 2)]


class Laboratory:
    """Simulates some sites: with derivatives on one mesh, without on the other where there are two.

    ``title`` is the stage or experiment that is told of progress.
    """

    def __init__(
        self, context: Context, cache: SimulationCache, sites: Sequence[Site], title: str = "calibrate"
    ) -> None:
        study = context.study
        self.context, self.cache, self.title = context, cache, title
        self.records = [site_record(context, site) for site in sites]
        self.searched = self.records
        if study.mesh.coarse is not None:
            self.searched = [site_record(context, site, coarse=True) for site in sites]
        self.evaluations = self.corrections = 0
        self.warnings: dict[str, list[str]] = {}
        self.latest: dict[str, Simulation] = {}
        self.penalties: dict[str, float | None] = {}
        self.doubts: list[Doubted] = []
        self.kept = Kept()
        self._rested: Array | None = None
        self._starts: dict[bytes, Array | None] = {}

    @property
    def measured(self) -> list[Measured]:
        return [record.measured for record in self.records]

    def search(self, parameters: Array) -> Responses:
        """Force and derivatives where parameters are searched."""
        self.evaluations += 1
        start = self.first_guess(parameters)
        jobs = [record.job(parameters, start=start) for record in self.searched]
        found = self._run(jobs, f"evaluation {self.evaluations}", searched=parameters)
        self.kept.add(parameters, found)
        return found

    def first_guess(self, parameters: Array) -> Array | None:
        """Parameters simulated from rest near these; None where these are to be simulated so themselves.

        It follows from the parameters asked for before: a run taken up again asks for the same ones.
        """
        key = parameters.tobytes()
        if key not in self._starts:
            rested = self._rested
            if rested is not None and np.max(np.abs(np.log(parameters / rested))) > NEAR:
                rested = None
            if rested is None:
                self._rested = parameters
            self._starts[key] = rested
        return self._starts[key]

    def answer(self, parameters: Array) -> Responses:
        """The forces of an answer, from rest as all that follows takes them; ``warnings`` are then theirs."""
        if self.searched is not self.records:
            return self.check(parameters)
        return self._run([record.job(parameters) for record in self.records], "the answer, from rest")

    def check(self, parameters: Array) -> Responses:
        """Force on the study's own meshes; what failed before is tried again."""
        self.corrections += 1
        jobs = [record.job(parameters, sensitivities=False) for record in self.records]
        return self._run(jobs, f"correction {self.corrections}", again=True)

    def correction(self, parameters: Array) -> tuple[Responses, Callable[[Responses], Responses]]:
        """The responses at an answer, and what brings those of `search` to the study's own meshes.

        Raises
        ------
        RunError
            Where a site cannot be simulated there.
        """
        found = self.search(parameters)
        correct: Callable[[Responses], Responses] = list
        if self.searched is not self.records:
            correct = CoarseToFine(found, self.check(parameters))
        found = correct(found)
        for one in found:
            if not one.completed:
                raise RunError(f"site {one.site} cannot be simulated at the answer: {one.reason}")
        return found, correct

    def uncertainty(self, found: Calibration, grouping: Grouping) -> Uncertainty:
        """What the records tell about an answer, sampled on what was simulated near it and a little more.

        Where that cannot be, for simulations that fail, it is linearised and a line says so.
        """
        study = self.context.study
        known = linearised(study, self.records, found.parameters, found.responses)
        fine = self.searched is self.records
        as_fine: Callable[[Responses], Responses] = list if fine else self.correction(found.parameters)[1]
        kept = Kept()
        for point, run in zip(self.kept.points, self.kept.responses, strict=True):
            kept.add(point, as_fine(list(run)))

        def simulate(parameters: Array) -> Responses:
            self.context.tell(self.title, 0, 0, "a further evaluation, for the intervals")
            return as_fine(self.search(parameters))

        bounds = unknowns(study)
        space = search_space(bounds, grouping)
        sampled = sampled_uncertainty(known, self.measured, bounds, space, kept, simulate)
        if sampled.method == LINEARISED:
            self.context.tell(self.title, 0, 0, f"warning: {ONLY_LINEARISED}")
        return sampled

    def _facts(self, state: State) -> dict[str, Any]:
        """The newest iterate in numbers: error in percent of the largest force, parameters, cost."""
        last = state.history[-1]
        return {
            "iterate": len(state.history) - 1,
            "evaluations": self.evaluations,
            "cost": last.cost,
            "error_percent": float(np.mean(last.errors_percent)),
            "error_percent_by_site": dict(
                zip(
                    (record.site.name for record in self.records),
                    map(float, last.errors_percent),
                    strict=True,
                )
            ),
            "parameters": to_parameters(np.array(last.parameters), self.context.study.tissues),
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
            self.latest[simulation.site] = simulation
            if simulation.warnings:
                self.warnings[simulation.site] = list(simulation.warnings)
            if searched is not None:
                self.penalties[simulation.site] = simulation.facts.get("penalty_per_mm")
                self.doubts += [
                    Doubted(self.evaluations, simulation.site, tuple(searched.tolist()), doubt)
                    for doubt in simulation.doubts
                ]
            self.context.tell(self.title, 0, 0, f"{what}, site {simulation.site}")
        return found

    def identify(self, start: Unknowns, stages: Sequence[Grouping]) -> tuple[Calibration, tuple[Round, ...]]:
        """The parameters of the sites' records as the study wants them found, and the corrections made."""
        study, table = self.context.study, self.context.study.calibration

        titles = stage_titles(study.tissues)[-len(stages) :]

        def tell(state: State) -> None:
            name = titles[state.history[-1].stage]
            facts = {"of": name, **self._facts(state)}
            words = f"{name}: {_describe(state, study.tissues)}"
            self.context.tell(self.title, 0, 0, words, fit=True, facts=facts)

        if study.mesh.coarse is None:
            found = calibrate(
                self.search, self.measured, start, settings(study), stages=stages, on_iterate=tell
            )
            return found, ()
        corrected = calibrate_corrected(
            self.search, self.check, self.measured, start, settings(study),
            FidelitySettings(table.corrections, table.correction_tolerance_percent),
            stages=stages, on_iterate=tell,
        )  # fmt: skip
        return corrected.calibration, corrected.rounds


def run_calibrate(context: Context, folder: Path) -> dict[str, Any]:
    """One material, then each tissue its own, on the fitted sites; simulations are kept.

    A run taken up again repeats the interrupted one from its kept simulations.
    """
    study, table = context.study, context.study.calibration
    if not study.fitted:
        raise StudyError("no site is fitted", file=study.file, place="sites", remedy="set fitted = true")
    for flag in stored_flags(context):
        context.tell("calibrate", 0, 0, f"warning: {flag.text}")
    cache = SimulationCache(folder / "runs", also=[context.store["calibrate"] / "runs"])
    laboratory = Laboratory(context, cache, study.fitted)
    stages = groupings(study)
    rounds_of: dict[int, tuple[Round, ...]] = {}

    def run(number: int, start: Unknowns) -> Calibration:
        if number:
            context.tell("calibrate", 0, 0, f"start {number + 1} of {table.starts}")
        found, rounds_of[number] = laboratory.identify(start, stages)
        return found

    tried = multistart(run, unknowns(study), table.starts, table.seed)
    found = tried.best
    known = laboratory.uncertainty(found, stages[-1])
    rounds = rounds_of[tried.number]
    answers = laboratory.answer(found.parameters)
    for site, texts in laboratory.warnings.items():
        context.tell("calibrate", 0, 0, f"warning: site {site}, at the answer: {'; '.join(texts)}")
    content = _calibration_record(context, found, known, laboratory)
    content |= {
        "corrections": [_round_record(one, found.sites, study.tissues) for one in rounds],
        "multistart": _multistart_record(tried, study.tissues) if table.starts > 1 else None,
        "warnings": laboratory.warnings,
        "contact": contact_record(laboratory.latest, laboratory.penalties, answers, found.responses),
        "doubts": doubts_record(
            laboratory.doubts, laboratory.latest, laboratory.evaluations * len(laboratory.records), found
        ),
    }
    write_json(folder / "calibration.json", content)
    return {}


def linearised(
    study: Study, records: Sequence[SiteRecord], parameters: Array, responses: Sequence[SiteResponse]
) -> Uncertainty:
    """What fitted records tell about ``parameters`` (p,), whose responses are given."""
    pairs = zip(records, responses, strict=True)
    noise = [site_noise(study, record, response.force_N) for record, response in pairs]
    measured = [record.measured for record in records]
    return estimate_uncertainty(
        parameters, responses, measured, unknowns(study), noise, groupings(study)[-1], settings(study)
    )


def settings(study: Study) -> CalibrationSettings:
    """How the study wants its parameters found."""
    table = study.calibration
    return CalibrationSettings(
        objective=table.objective,
        relative_tolerance=table.relative_tolerance,
        max_iterations=table.max_iterations,
        stopping=table.stopping,
        force_error_percent=table.force_error_percent,
    )


def groupings(study: Study) -> tuple[Grouping, ...]:
    """Which parameters move together in each stage, as far as the study lets them move."""
    names, table = unknowns(study).names, study.calibration
    made = [constrained(one, names, table.fixed, table.tied) for one in two_stages(names)]
    return tuple(dict.fromkeys(made))


def unknowns(study: Study) -> Unknowns:
    """The four parameters of each tissue with the study's start and bounds."""
    material, tissues = study.material, study.tissues

    def flat(which: Literal["start", "lower", "upper"]) -> Array:
        return to_vector({tissue: material.of(tissue, which) for tissue in tissues}, tissues)

    names = tuple(f"{tissue}.{name}" for tissue, name in flat_names(tissues))
    priors = tuple(Prior(name, p.median, p.factor) for name, p in study.calibration.prior.items())
    return Unknowns(names, flat("start"), flat("lower"), flat("upper"), priors)


def _describe(state: State, tissues: Sequence[str]) -> str:
    last = state.history[-1]
    values = to_parameters(np.array(last.parameters), tissues)
    words = " | ".join(
        f"{tissue} c {v['c_kPa']:.3g} kPa, m {v['m']:.3g}, gamma {v['gamma']:.3g}, tau {v['tau_s']:.3g} s"
        for tissue, v in values.items()
    )
    return f"error {np.mean(last.errors_percent):.2f} % | {words}"


def _calibration_record(
    context: Context, found: Calibration, known: Uncertainty, laboratory: Laboratory
) -> dict[str, Any]:
    """What ``calibration.json`` holds."""
    study, tissues, cache = context.study, context.study.tissues, laboratory.cache
    bounds = unknowns(study)
    example = cache.example()
    return {
        "stages": [
            _stage_record(found, i, bounds.start, tissues, laboratory) for i in range(len(found.stages))
        ],
        "bounds": {
            "lower": to_parameters(bounds.lower, tissues),
            "upper": to_parameters(bounds.upper, tissues),
        },
        "objective": study.calibration.objective,
        "uncertainty": _uncertainty_record(known, tissues),
        "forward_runs": len(cache),
        "forward_runs_with_sensitivities": cache.with_sensitivities(),
        "linear_solver": example.facts["linear_solver"] if example else None,
        "element": example.facts["element"] if example else None,
    }


def _stage_record(
    found: Calibration, number: int, start: Array, tissues: Sequence[str], laboratory: Laboratory
) -> dict[str, Any]:
    """One stage: from ``start`` (the first) or the end of the stage before to its own end."""
    stage = found.stages[number]
    before = np.array(found.stages[number - 1].parameters) if number else start
    iterates = [iterate for iterate in found.history if iterate.stage == number]

    def first_guess(parameters: Sequence[float]) -> Parameters | None:
        rested = laboratory.first_guess(np.array(parameters))
        return None if rested is None else to_parameters(rested, tissues)

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
                "first_guess": first_guess(iterate.parameters),
                "cost": iterate.cost,
                "error_percent": float(np.mean(iterate.errors_percent)),
                "error_percent_by_site": dict(zip(found.sites, iterate.errors_percent, strict=True)),
            }
            for i, iterate in enumerate(iterates)
        ],
    }


def _round_record(one: Round, sites: Sequence[str], tissues: Sequence[str]) -> dict[str, Any]:
    """One correction of the coarse meshes' forces; percentages are of each site's largest force."""
    return {
        "stage": stage_titles(tissues)[one.stage] if one.stage >= 0 else "start",
        "parameters": to_parameters(np.array(one.parameters), tissues),
        "scale_by_site": dict(zip(sites, one.scales, strict=True)),
        "difference_percent_by_site": dict(zip(sites, one.difference_percent, strict=True)),
        "change_percent_by_site": dict(zip(sites, one.expected_percent, strict=True)),
        "reason": one.reason,
    }


def _multistart_record(tried: Multistart, tissues: Sequence[str]) -> dict[str, Any]:
    """What came of every start."""
    names = [f"{tissue}.{name}" for tissue, name in flat_names(tissues)]
    return {
        "summary": describe(tried, names),
        "reached": tried.reached,
        "starts": [
            {
                "start": to_parameters(np.array(one.start), tissues),
                "parameters": None
                if one.parameters is None
                else to_parameters(np.array(one.parameters), tissues),
                **{
                    key: getattr(one, key)
                    for key in ("cost", "evaluations", "converged", "reason", "same", "apart")
                },
            }
            for one in tried.starts
        ],
    }


def _uncertainty_record(known: Uncertainty, tissues: Sequence[str]) -> dict[str, Any]:
    """What is stored of the uncertainty; intervals by tissue and name, like the parameters."""
    intervals: dict[str, dict[str, list[float]]] = {tissue: {} for tissue in tissues}
    for (tissue, name), interval in zip(flat_names(tissues), known.intervals_95.tolist(), strict=True):
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
        "most_probable": to_parameters(known.centre, tissues),
        "residuals": known.residual_model.to_dict(),
    }
