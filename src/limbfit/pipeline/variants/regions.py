"""The experiment ``regions``: parameters of each region of the limb beside those of the whole (table 3)."""

from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from ...arrays import Array
from ...errors import InputError, StudyError
from ...identify.checks.crossvalidation import average_errors, fit_region
from ...identify.fit.calibration import Calibration
from ...identify.fit.objective import SiteResponse
from ...identify.fit.parameters import Unknowns
from ...results.uncertainty import RegionFitted, RegionsResult, WholeLimbFit
from ...study import Site, Study
from ..engine.context import Context
from ..engine.files import write_result, write_table
from ..identification.answer import correct_answer, plan_coarser_meshes, sample_intervals
from ..identification.calibrate import group_intervals
from ..identification.problem import CalibrationProblem, build_problem
from ..identification.search import RecordSimulator, search_parameters
from ..records.records import load_records, load_site_record, to_response
from ..simulation.limb_geometry import LimbGeometry
from ..simulation.simulations import SimulationCache, open_experiment_cache

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
    stages, problem = context.results.calibration.stages, build_problem(study)
    whole, cache = study.vector(stages[-1].parameters), open_experiment_cache(context, folder)
    rows = [
        _fit_region(context, folder, problem, cache, whole, name, *chosen) for name, chosen in members.items()
    ]
    sites_of = {record.name: record.site.name for record in study.recorded}
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
        mean_own_error_percent=average_errors(
            {name: one for row in rows for name, one in row.own_error_percent_by_site.items()}, sites_of
        ),
        mean_whole_error_percent=average_errors(
            {name: one for row in rows for name, one in row.whole_error_percent_by_site.items()}, sites_of
        ),
    )
    write_result(folder / "regions.json", content)
    _write_tables(folder, content, sites_of)


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


def _fit_region(
    context: Context,
    folder: Path,
    problem: CalibrationProblem,
    cache: SimulationCache,
    whole: Array,
    name: str,
    fitted: Sequence[Site],
    mine: Sequence[Site],
) -> RegionFitted:
    """Fit a region on some of its sites, and judge it and the ``whole`` limb's parameters (p,) at all.

    What is compared is simulated on the study's own meshes; with derivatives where the study's prediction
    has made them so.
    """
    study, report = context.study, partial(context.tell, "regions", 0, 0)
    records = load_records(context, study.records_at(*fitted), secondary=True)
    simulator = RecordSimulator(records, cache, context.executor, report)
    judged = [load_site_record(context, record) for record in study.records_at(*mine)]
    sites = {record.name: record.site.name for record in judged}

    def identify(start: Unknowns) -> Calibration:
        return search_parameters(problem, simulator, start, problem.stages[-1:]).calibration

    def simulate(parameters: Array) -> list[SiteResponse]:
        apart = study.is_searched_apart
        jobs = [record.own_job(parameters) if apart else record.job(parameters) for record in judged]
        return [to_response(one) for one in cache.run(jobs, context.executor)]

    measured = [record.measured for record in judged]
    found, own, of_whole = fit_region(identify, simulate, measured, problem.unknowns, whole)
    coarser = plan_coarser_meshes(context, records, folder / "coarser")
    correction = correct_answer(problem, simulator, found, coarser)
    _, known = sample_intervals(problem, simulator, found, correction, moves=False)
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
        own_error_percent=average_errors(own, sites),
        whole_error_percent=average_errors(of_whole, sites),
        own_error_percent_by_site=own,
        whole_error_percent_by_site=of_whole,
    )


def _write_tables(folder: Path, content: RegionsResult, sites: Mapping[str, str]) -> None:
    """Table 3 as CSV: parameters by region, and errors by record, whose ``sites`` are given by name."""
    whole, rows = content.whole, content.regions
    heads = ["tissue", "parameter", "start", "whole_limb"]
    lines = []
    for tissue, values in whole.parameters.items():
        for key, value in values.items():
            cells = [tissue, key, whole.start[tissue][key], value]
            lines.append([*cells, *(row.parameters[tissue][key] for row in rows)])
    write_table(folder / "parameters.csv", [*heads, *(row.region for row in rows)], lines)
    errors = [
        [row.region, name, sites[name] in row.fitted_sites, own, row.whole_error_percent_by_site[name]]
        for row in rows
        for name, own in row.own_error_percent_by_site.items()
    ]
    heads = ["region", "site", "fitted", "own_error_percent", "whole_limb_error_percent"]
    write_table(folder / "errors.csv", heads, errors)
