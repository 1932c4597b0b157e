"""Other choices of sites: the experiments ``crossvalidate`` and ``regions``.

``crossvalidate`` fits other choices of sites, and leaves whole regions out. All fits share one emulator, made
from simulations at all recorded sites around the answer; the solver then simulates at some of the optima,
which says how far the emulator is off there, and the emulator learns from those too.

``regions`` finds parameters of each region of the limb beside those of the whole (table 3).
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from math import comb
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ...arrays import Array
from ...errors import InputError, StudyError
from ...identify.checks.crossvalidation import (
    Choice,
    Fold,
    average_by_site,
    average_errors,
    compute_site_errors,
    cross_validate,
    expand_to_records,
    list_choices,
    list_choices_without_regions,
    rank_fold,
    spread_points,
    summarise_errors_by_site,
)
from ...identify.fit.objective import MeasuredCurve, SiteResponse
from ...identify.fit.prediction import compute_error_percent
from ...identify.uncertainty.emulator import Emulator
from ...results.uncertainty import (
    CrossvalidateResult,
    FoldCheck,
    FoldEmulator,
    HeldoutSite,
    OwnFold,
    RegionFitted,
    RegionsResult,
    WholeLimbFit,
)
from ...study import Site, Study
from ..engine.context import Context
from ..engine.store import write_result, write_table
from ..records.records import load_records, load_site_record, to_response
from ..simulation.limb_geometry import LimbGeometry
from ..simulation.simulations import SimulationCache, open_experiment_cache
from .answer import correct_answer, correct_to_fine_meshes, plan_coarser_meshes, sample_intervals
from .calibrate import group_intervals
from .search import CalibrationProblem, RecordSimulator, build_problem, search_parameters

Runs = list[list[SiteResponse]]

_CHECKED = 3  # fits whose optima are simulated in each of two rounds
_MARGIN = 0.02  # of the emulator's box, in the logarithm, that fits may go beyond
CHOICES = ("all", "fitted")


def check_crossvalidate(study: Study, limb: LimbGeometry | None, options: Mapping[str, Any]) -> None:
    """Refuse a study whose recorded sites are all fitted; see `run_crossvalidate`."""
    recorded = [site for site in study.sites if study.records_at(site)]
    size = options["fit"] or len(study.fitted)
    if not 0 < size < len(recorded):
        raise StudyError(
            f"{size} of {len(recorded)} recorded sites fitted leave none to be predicted",
            file=study.file,
            place="sites",
            remedy="record more sites, or fit fewer (--fit)",
        )


def run_crossvalidate(
    context: Context, folder: Path, *, fit: int = 0, choices: int = 200, seed: int = 0, runs: int = 12
) -> None:
    """Held-out errors over choices of ``fit`` sites, with all their records (0: as many as the study fits).

    At most ``choices`` of them are drawn with ``seed``; ``runs`` more simulations of all sites make the
    emulator.
    """
    study, stored = context.study, context.results.calibration
    recorded = [site for site in study.sites if study.records_at(site)]
    size = fit or len(study.fitted)
    problem, best = build_problem(study, stored), study.vector(stored.parameters)
    problem = replace(problem, unknowns=problem.unknowns.with_start(best))
    records = load_records(context, study.records_at(*recorded), secondary=True)
    cache, report = open_experiment_cache(context, folder), partial(context.tell, "crossvalidate", 0, 0)
    simulator, measured = RecordSimulator(problem, records, cache, context.executor, report), records.curves
    sites: dict[str, tuple[int, ...]] = {}
    for i, one in enumerate(measured):
        sites[one.site_name] = (*sites.get(one.site_name, ()), i)
    groups = list(sites.values())
    correction = correct_to_fine_meshes(simulator, best)

    def simulate(points: Sequence[Array]) -> Runs:
        found = []
        for i, point in enumerate(points):
            context.tell("crossvalidate", i, len(points), f"simulation {i + 1} of {len(points)}")
            found.append(correction.as_fine(simulator.search(point)))
            if failed := _describe_failed(found[-1]):
                told = f"warning: a simulation failed at site {failed}: the emulator does without it"
                context.tell("crossvalidate", 0, 0, told)
        return found

    # Where nothing is known, fits go anywhere; the emulator must not.
    covariance = np.array(stored.uncertainty.covariance_log)
    drawn = list(spread_points(best, covariance, problem.space, runs, seed))
    points, known = [best, *drawn], [correction.responses, *simulate(drawn)]
    own = tuple(i for i, site in enumerate(recorded) if site.fitted)
    chosen = list_choices(len(recorded), size, choices, seed)
    regions, checks = list_choices_without_regions([site.region for site in recorded]), []
    for number, without in ((1, {}), (2, regions)):
        emulator = Emulator(np.array(points), known)
        fits = _fit_choices(context, emulator, problem, measured, groups, (own, chosen, without))
        # The study's own where it leaves a site out, and some from the best to the worst.
        ranked = sorted(fits.folds, key=lambda fold: fold.mean_heldout)
        places = np.linspace(0, len(ranked) - 1, min(_CHECKED - 1, len(ranked))).astype(int)
        checked = [*([fits.own] if fits.own.heldout else []), *(ranked[i] for i in places)]
        optima = [fold.parameters for fold in checked]
        solved = simulate(optima)
        checks += _check_folds(number, checked, solved, emulator, measured, sites)
        points, known = points + optima, known + solved
    last = Emulator(np.array(points), known)
    loo_percent = float(np.median(last.loo_percent))
    summary = FoldEmulator(runs=len(last.points), loo_percent=loo_percent, checks=checks)
    possible = comb(len(recorded), size)
    content = _build_result(study, problem.unknowns.names, tuple(sites), fits, size, possible, summary)
    write_result(folder / "crossvalidate.json", content)


class _Fits(NamedTuple):
    """The fits of one emulator: the study's own choice, others, and those without a region."""

    own: Fold
    folds: tuple[Fold, ...]
    regions: tuple[Fold, ...]


def _fit_choices(
    context: Context,
    emulator: Emulator,
    problem: CalibrationProblem,
    measured: Sequence[MeasuredCurve],
    groups: Sequence[Choice],
    choices: tuple[Choice, Sequence[Choice], Mapping[str, Choice]],
) -> _Fits:
    """Fit the study's own choice, others, and those without a region, within the emulator's box.

    ``groups`` are the numbers of each site's records.
    """
    (own, chosen, regions), bounds = choices, problem.unknowns
    settings = replace(problem.settings, relative_tolerance=1e-3, max_iterations=40, stopping="relative")
    low = np.maximum(emulator.lower * np.exp(-_MARGIN), bounds.lower)
    high = np.minimum(emulator.upper * np.exp(_MARGIN), bounds.upper)
    unknowns = replace(bounds, lower=low, upper=high)

    def tell(done: int, total: int) -> None:
        context.tell("crossvalidate", done, total, f"{done} of {total} choices fitted")

    def fit(
        choices: Sequence[Choice], progress: Callable[[int, int], None] = lambda done, total: None
    ) -> tuple[Fold, ...]:
        records = [expand_to_records(choice, groups) for choice in choices]
        folds = cross_validate(emulator, measured, unknowns, records, settings, progress, problem.stages[-1])
        pairs = zip(folds, choices, strict=True)
        return tuple(average_by_site(fold, choice, groups) for fold, choice in pairs)

    (alone,), others = fit([own]), fit(chosen, tell)
    without = zip(regions, fit(list(regions.values())), strict=True)
    return _Fits(alone, others, tuple(replace(fold, label=region) for region, fold in without))


def _check_folds(
    number: int,
    folds: Sequence[Fold],
    solved: Runs,
    emulator: Emulator,
    measured: Sequence[MeasuredCurve],
    sites: Mapping[str, Choice],
) -> list[FoldCheck]:
    """The solver's errors at the optima of some fits beside the emulator's."""
    names, rows = list(sites), []
    for fold, run in zip(folds, solved, strict=True):
        if _describe_failed(run):
            continue
        held = [
            np.mean([compute_error_percent(run[i].force_N, measured[i].force_N) for i in sites[names[site]]])
            for site in fold.heldout
        ]
        pairs = zip(emulator(fold.parameters), run, strict=True)
        away = [compute_error_percent(cheap.force_N, one.force_N) for cheap, one in pairs]
        rows.append(
            FoldCheck(
                round=number,
                fitted=[names[i] for i in fold.fitted],
                heldout_emulated_percent=fold.mean_heldout,
                heldout_solved_percent=float(np.mean(held)),
                emulator_error_percent=float(np.mean(away)),
                emulator_error_largest_percent=float(np.max(away)),
            )
        )
    return rows


def _describe_failed(run: Sequence[SiteResponse]) -> str:
    """The sites whose simulation did not complete, in words; empty where all did."""
    return ", ".join(response.site for response in run if not response.completed)


def _build_result(
    study: Study,
    names: Sequence[str],
    sites: Sequence[str],
    found: _Fits,
    size: int,
    possible: int,
    emulator: FoldEmulator,
) -> CrossvalidateResult:
    regions = {site.name: site.region for site in study.sites}
    by_site = summarise_errors_by_site(found.folds, len(sites))
    return CrossvalidateResult(
        fitted_sites=size,
        choices=len(found.folds),
        choices_possible=possible,
        own=OwnFold(**{**dict(found.own.summarise(sites, names)), **rank_fold(found.own, found.folds)}),
        sites=[
            HeldoutSite(
                site=name,
                region=regions[name],
                fitted=i in found.own.fitted,
                left_out_of=count,
                mean_percent=mean,
                sd_percent=sd,
                own_percent=found.own.errors_percent[i],
            )
            for i, (name, (count, mean, sd)) in enumerate(zip(sites, by_site))
        ],
        regions=[fold.summarise(sites, names) for fold in found.regions],
        folds=[fold.summarise(sites, names) for fold in found.folds],
        at_limit_share=float(np.mean([bool(fold.at_limit) for fold in found.folds])),
        emulator=emulator,
    )


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
    simulator = RecordSimulator(problem, records, cache, context.executor, report)
    judged = [load_site_record(context, record) for record in study.records_at(*mine)]
    sites = {record.name: record.site.name for record in judged}

    def simulate(parameters: Array) -> list[SiteResponse]:
        apart = study.is_searched_apart
        jobs = [record.own_job(parameters) if apart else record.job(parameters) for record in judged]
        return [to_response(one) for one in cache.run(jobs, context.executor)]

    measured = [record.curve for record in judged]
    of_whole, start = compute_site_errors(simulate, whole, measured), problem.unknowns.with_start(whole)
    found = search_parameters(simulator, start, problem.stages[-1:]).calibration
    own = compute_site_errors(simulate, found.parameters, measured)
    coarser = plan_coarser_meshes(context, records, folder / "coarser")
    correction = correct_answer(simulator, found, coarser)
    _, known = sample_intervals(simulator, found, correction, moves=False)
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
