"""The experiment ``crossvalidate``: other choices of sites fitted, and whole regions left out.

All fits share one emulator, made from simulations at all recorded sites around the answer; the solver then
simulates at some of the fits' optima, which says how far the emulator is off there, and the emulator learns
from those too.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from math import comb
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ...arrays import Array
from ...errors import StudyError
from ...identify.checks.crossvalidation import (
    Choice,
    Fold,
    average_by_site,
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
from ...results.uncertainty import CrossvalidateResult, FoldCheck, FoldEmulator, HeldoutSite, OwnFold
from ...study import Study
from ..engine.context import Context
from ..engine.files import write_result
from ..records.records import load_records
from ..simulation.limb_geometry import LimbGeometry
from ..simulation.simulations import open_experiment_cache
from .answer import correct_to_fine_meshes
from .problem import CalibrationProblem, build_problem
from .search import RecordSimulator

Runs = list[list[SiteResponse]]

_CHECKED = 3  # fits whose optima are simulated in each of two rounds
_MARGIN = 0.02  # of the emulator's box, in the logarithm, that fits may go beyond


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
    simulator = RecordSimulator(
        load_records(context, study.records_at(*recorded), secondary=True),
        open_experiment_cache(context, folder),
        context.executor,
        partial(context.tell, "crossvalidate", 0, 0),
    )
    problem, best = build_problem(study), study.vector(stored.parameters)
    problem = replace(problem, unknowns=problem.unknowns.with_start(best))
    measured = simulator.records.measured
    sites: dict[str, tuple[int, ...]] = {}
    for i, one in enumerate(measured):
        sites[one.site_name] = (*sites.get(one.site_name, ()), i)
    groups = list(sites.values())
    correction = correct_to_fine_meshes(problem, simulator, best)

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
