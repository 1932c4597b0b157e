"""The experiment ``uncertainty``: what the records determine, and what else would change the answer."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import cycle
from pathlib import Path
from typing import Any

import numpy as np

from ...arrays import Array
from ...identify.fit.correction import MeshCorrection
from ...identify.fit.objective import SiteResponse
from ...identify.fit.parameters import build_space, group_by_kind
from ...identify.uncertainty.discrepancy import ResidualModel
from ...identify.uncertainty.estimator import FitSensitivity
from ...identify.uncertainty.exploration import Exploration, ExplorationSettings, explore_posterior
from ...identify.uncertainty.likelihood import Likelihood
from ...identify.uncertainty.model_comparison import ModelComparison, compare_models, fit_alternative
from ..engine.context import Context
from ..identification.predict import Answer, build_answer_jobs
from ..identification.record_simulator import (
    RecordSimulator,
    build_groupings,
    build_unknowns,
    estimate_linearised,
    list_stage_titles,
)
from ..records.deviations import estimate_site_noise
from ..records.records import coarsen_records, load_site_record, to_response
from ..simulation.simulations import open_experiment_cache
from .result import Found, Predicted, write_results
from .sources import Change, build_variants, simulate_changes

_NEAR = 4.0  # runs of the calibration whose error is at most this many times the least, plus 3 %, are used
NAME = "uncertainty"


class FittedSites(RecordSimulator):
    """The fitted sites, simulated with derivatives; brought to the fine meshes' forces where those exist."""

    def __init__(
        self,
        context: Context,
        folder: Path,
        best: Array,
        earlier: Mapping[tuple[float, ...], Sequence[Array]],
    ) -> None:
        """``earlier``: parameters that the calibration simulated, and where it started them from."""
        records = context.study.records_at(*context.study.fitted)
        super().__init__(context, open_experiment_cache(context, folder), records, NAME)
        self.best, self.earlier = best, earlier
        self.at_best = self.anchored(best)

    def simulate(self, points: Sequence[Array]) -> list[list[SiteResponse]]:
        """Responses of all sites at several parameters (p,)."""
        jobs = [
            record.job(point, starts=self._starts_of(point)) for point in points for record in self.searched
        ]
        found: list[SiteResponse] = []
        done = self.cache.run(jobs, self.context.executor)
        for record, simulation in zip(cycle(self.records), done):
            found.append(record.respond(simulation))
            self.context.tell(NAME, len(found), len(jobs), f"site {simulation.site}")
        n = len(self.searched)
        return [self.at_best.as_fine(found[i : i + n]) for i in range(0, len(found), n)]

    def _starts_of(self, point: Array) -> Sequence[Array]:
        """Where a simulation starts from: as in the calibration, or from the answer, itself from rest."""
        if np.array_equal(point, self.best):
            return ()
        return self.earlier.get(tuple(point.tolist()), (self.best,))


def run_uncertainty(context: Context, folder: Path) -> dict[str, Any]:
    """Posterior, profiles, evidence, further sources and prediction intervals (see docs/uncertainty.md)."""
    study = context.study
    calibration = context.stored("calibrate", "calibration.json")
    best = study.vector(calibration["stages"][-1]["parameters"])
    earlier = _select_earlier_points(context, calibration)
    sites = FittedSites(context, folder, best, earlier)
    known = estimate_linearised(context, sites.records, best, sites.at_best)
    table, grouping = study.uncertainty, build_groupings(study)[-1]
    space = build_space(build_unknowns(study), grouping)
    settings = ExplorationSettings(
        table.runs, max(4, table.runs // 4), checked=table.checked, seed=table.seed
    )
    explored = explore_posterior(
        sites.simulate,
        sites.measured,
        build_unknowns(study),
        space,
        known,
        [np.array(point) for point in sorted(earlier)],
        settings,
        report=lambda text: context.tell(NAME, 0, 0, text),
    )
    evidence = _compare_groupings(context, explored, known.residual_model) if len(study.tissues) > 1 else None
    gain = FitSensitivity.linearise(
        best, sites.at_best.responses, known.residual_model, build_unknowns(study), space
    )
    found: list[Change] = []
    if table.sources:
        wanted = build_variants(context, folder, sites.searched, best)
        found = simulate_changes(context, sites.cache, wanted, sites.records)
    result = Found(known, explored, evidence, gain, tuple(found), build_unknowns(study))
    write_results(folder, result, _predict_sites(context, sites))
    return {"runs": explored.rounds[-1].runs}


def _select_earlier_points(
    context: Context, calibration: dict[str, Any]
) -> dict[tuple[float, ...], Sequence[Array]]:
    """Parameters of the calibration's iterates that came near the records, and where it started them from."""
    study = context.study
    iterates = [iterate for stage in calibration["stages"] for iterate in stage["iterations"]]
    least = min(iterate["error_percent"] for iterate in iterates)
    return {
        tuple(study.vector(one["parameters"]).tolist()): [study.vector(s) for s in one["starts"]]
        for one in iterates
        if one["error_percent"] <= _NEAR * least + 3.0
    }


def _compare_groupings(context: Context, explored: Exploration, model: ResidualModel) -> ModelComparison:
    """One material against the study's own, on one emulator and covariance, and where nothing was fitted."""
    study, likelihood = context.study, explored.likelihood
    space = build_space(build_unknowns(study), group_by_kind(build_unknowns(study).names))
    single = Likelihood(explored.emulator, likelihood.measured, model, build_unknowns(study), space)
    titles = list_stage_titles(study.tissues)
    calibration = context.stored("calibrate", "calibration.json")
    start = study.vector(calibration["stages"][0]["parameters"])
    one, _ = fit_alternative(titles[0], single, space.reduce(np.log(start)))
    several, _ = fit_alternative(titles[1], likelihood, explored.best.z)
    rows = [row for row in context.stored("predict", "predict.json")["sites"] if not row["fitted"]]
    columns = ("error_one_material_percent", "error_percent")
    held = [row for row in rows if all(row[column] is not None for column in columns)]
    return compare_models(one, several, *([row[column] for row in held] for column in columns))


def _predict_sites(context: Context, sites: FittedSites) -> list[Predicted]:
    """Every recorded site at the identified parameters, from what the stage ``predict`` has simulated."""
    study = context.study
    records = [load_site_record(context, record) for record in study.recorded]
    searched = coarsen_records(context, records)
    answer = Answer.of(context.stored("calibrate", "calibration.json")["stages"][-1], study)
    jobs = build_answer_jobs(records, searched, answer)
    ends = [to_response(end) for end in sites.cache.run(jobs, context.executor)]
    n = len(records)
    responses = ends if searched is records else MeshCorrection(ends[n:], ends[:n])(ends[n:])
    return [
        Predicted(r, end, estimate_site_noise(study, r, end.force_N) if end.completed else None)
        for r, end in zip(searched, responses)
    ]
