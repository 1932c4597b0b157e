"""The experiment ``regions``: parameters of each region of the limb beside those of the whole (table 3)."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from ...arrays import Array
from ...errors import InputError, StudyError
from ...identify.checks.crossvalidation import RegionFit, RegionRecords, average_errors, fit_regions
from ...identify.fit.calibration import Calibration
from ...identify.fit.objective import SiteResponse
from ...identify.fit.parameters import Unknowns
from ...results.uncertainty import RegionFitted, RegionsResult, WholeLimbFit
from ...study import Site, Study
from ..engine.context import Context
from ..engine.storage import write_result, write_table
from ..identification.calibrate import group_intervals
from ..identification.fine_meshes import correct_answer, plan_coarser_meshes
from ..identification.intervals import sample_intervals
from ..identification.problem import CalibrationProblem, build_problem
from ..identification.record_simulator import RecordSimulator
from ..identification.search import search_parameters
from ..records.records import load_records, load_site_record, to_response
from ..simulation.limb_geometry import LimbGeometry
from ..simulation.simulations import open_experiment_cache

CHOICES = ("all", "fitted")


def run_regions(context: Context, folder: Path, *, sites: str = "all") -> None:
    """Each region's own parameters, started from the whole limb's, and the errors of both.

    ``sites``: ``all`` fits every recorded site of a region, as table 3 lists them; ``fitted`` those that the
    study fits, and the others of the region are predicted.
    """
    study = context.study
    recorded = [site for site in study.sites if study.records_at(site)]
    # By region: the sites that it is fitted on, and all that have a record.
    members: dict[str, tuple[list[Site], list[Site]]] = {}
    for name in dict.fromkeys(site.region for site in recorded if site.region):
        mine = [site for site in recorded if site.region == name]
        used = mine if sites == "all" else [site for site in mine if site.fitted]
        if used:
            members[name] = (used, mine)
    stages = context.results.calibration.stages
    whole = study.vector(stages[-1].parameters)
    cache = open_experiment_cache(context, folder)
    report, problem = partial(context.tell, "regions", 0, 0), build_problem(study)
    simulators = {}
    for name, (fitted, _) in members.items():
        records = load_records(context, study.records_at(*fitted), secondary=True)
        simulators[name] = RecordSimulator(records, cache, context.executor, report)
    regions = {
        name: _build_region(context, problem, simulators[name], mine) for name, (_, mine) in members.items()
    }
    found = fit_regions(regions, problem.unknowns, whole)
    rows = [
        _summarise_region(context, problem, simulators[name], name, members[name], fit, folder)
        for name, fit in found.items()
    ]
    without = [site.name for site in recorded if not site.region]
    unfitted = dict.fromkeys(site.region for site in recorded if site.region and site.region not in members)
    left_out = [f"region {name}: none of its sites is fitted" for name in unfitted]
    left_out += [f"sites without a region: {', '.join(without)}"] if without else []
    content = RegionsResult(
        sites_used=sites,
        left_out=left_out,
        whole=WholeLimbFit(
            name=stages[-1].name,
            start=stages[0].start,
            parameters=stages[-1].parameters,
            fitted_sites=[site.name for site in study.fitted],
        ),
        regions=rows,
        mean_own_error_percent=_average_sites(row.own_error_percent_by_site for row in rows),
        mean_whole_error_percent=_average_sites(row.whole_error_percent_by_site for row in rows),
    )
    write_result(folder / "regions.json", content)
    _write_tables(folder, content)


def check_regions(study: Study, limb: LimbGeometry | None, options: Mapping[str, Any]) -> None:
    """Refuse a study whose recorded sites have no region, and an unknown choice of sites."""
    if (sites := options["sites"]) not in CHOICES:
        raise InputError(f"{sites!r} is not a choice of sites", place="sites", remedy="use all or fitted")
    if not any(record.site.region for record in study.recorded):
        raise StudyError(
            "no site has a region",
            file=study.file,
            place="sites",
            remedy='give each a region, such as region = "tibia"',
        )


def _build_region(
    context: Context, problem: CalibrationProblem, simulator: RecordSimulator, mine: Sequence[Site]
) -> RegionRecords:
    records = [load_site_record(context, record) for record in context.study.records_at(*mine)]

    def identify(start: Unknowns) -> Calibration:
        return search_parameters(problem, simulator, start, problem.stages[-1:])[0]

    def simulate(parameters: Array) -> list[SiteResponse]:
        """On the study's own meshes; with derivatives where the study's prediction has made them so."""
        apart = context.study.is_searched_apart
        jobs = [record.own_job(parameters) if apart else record.job(parameters) for record in records]
        return [to_response(one) for one in simulator.cache.run(jobs, context.executor)]

    return RegionRecords(identify, simulate, tuple(record.measured for record in records))


def _summarise_region(
    context: Context,
    problem: CalibrationProblem,
    simulator: RecordSimulator,
    name: str,
    chosen: tuple[list[Site], list[Site]],
    fit: RegionFit,
    folder: Path,
) -> RegionFitted:
    """What ``regions.json`` holds of a region."""
    study, found = context.study, fit.calibration
    fitted, mine = chosen
    responses = list(found.responses)
    coarser = plan_coarser_meshes(context, simulator.records, folder / "coarser")
    correction, spent = correct_answer(problem, simulator, found.parameters, responses, coarser)
    _, known = sample_intervals(problem, simulator, found, correction, spent, moves=False)
    return RegionFitted(
        region=name,
        sites=[site.name for site in mine],
        fitted_sites=[site.name for site in fitted],
        parameters=study.by_tissue(found.parameters),
        intervals_95=group_intervals(known, study),
        verdict=dict(zip(known.names, known.verdicts, strict=True)),
        evaluations=found.evaluations,
        converged=found.converged,
        reason=found.reason,
        own_error_percent=average_errors(fit.own_percent),
        whole_error_percent=average_errors(fit.whole_percent),
        own_error_percent_by_site=fit.own_percent,
        whole_error_percent_by_site=fit.whole_percent,
    )


def _average_sites(errors: Iterable[Mapping[str, float | None]]) -> float | None:
    """Mean error over the sites of all regions."""
    return average_errors({site: error for of_region in errors for site, error in of_region.items()})


def _write_tables(folder: Path, content: RegionsResult) -> None:
    """Table 3 as CSV: parameters by region, and errors by site."""
    whole, rows = content.whole, content.regions
    heads = ["tissue", "parameter", "start", "whole_limb"]
    lines = []
    for tissue, values in whole.parameters.items():
        for key, value in values.items():
            cells = [tissue, key, whole.start[tissue][key], value]
            lines.append([*cells, *(row.parameters[tissue][key] for row in rows)])
    write_table(folder / "parameters.csv", [*heads, *(row.region for row in rows)], lines)
    errors = [
        [row.region, site, site in row.fitted_sites, own, row.whole_error_percent_by_site[site]]
        for row in rows
        for site, own in row.own_error_percent_by_site.items()
    ]
    heads = ["region", "site", "fitted", "own_error_percent", "whole_limb_error_percent"]
    write_table(folder / "errors.csv", heads, errors)
