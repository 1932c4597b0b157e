"""The experiment ``crossvalidate``: other choices of sites fitted, and whole regions left out.

All fits share one emulator, made from simulations at all recorded sites around the answer; the solver then
simulates at some of the fits' optima, which says how far the emulator is off there, and the emulator learns
from those too.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from math import comb
from pathlib import Path
from typing import Any

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
from ...identify.fit.calibration import CalibrationSettings
from ...identify.fit.objective import SiteResponse
from ...identify.fit.parameters import Unknowns
from ...identify.fit.prediction import compute_error_percent
from ...identify.uncertainty.emulator import Emulator
from ...results.uncertainty import CrossvalidateResult, FoldCheck, FoldEmulator, HeldoutSite, OwnFold
from ...study import Study
from ..engine.context import Context
from ..engine.storage import write_result, write_rows, write_table
from ..records.records import load_records
from ..simulation.limb_geometry import LimbGeometry
from ..simulation.simulations import open_experiment_cache
from .fine_meshes import correct_to_fine_meshes
from .problem import build_problem
from .record_simulator import RecordSimulator

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
    context: Context, folder: Path, *, fit: int, choices: int, seed: int, runs: int
) -> None:
    """Held-out errors over choices of ``fit`` sites, with all their records (0: as many as the study fits).

    At most ``choices`` of them are drawn with ``seed``; ``runs`` more simulations of all sites make the
    emulator.
    """
    study = context.study
    recorded = [site for site in study.sites if study.records_at(site)]
    size = fit or len(study.fitted)
    simulator = RecordSimulator(
        load_records(context, study.records_at(*recorded), secondary=True),
        open_experiment_cache(context, folder),
        context.executor,
        partial(context.tell, "crossvalidate", 0, 0),
    )
    bench = _Bench(context, simulator, seed, runs)
    own_choice = tuple(i for i, site in enumerate(recorded) if site.fitted)
    chosen = list_choices(len(recorded), size, choices, seed)
    regions = list_choices_without_regions([site.region for site in recorded])
    first = bench.validate(own_choice, chosen, {})
    checks = bench.check(first.spread(_CHECKED), 1)
    found = bench.validate(own_choice, chosen, regions)
    checks += bench.check(found.spread(_CHECKED), 2)
    content = _build_result(context, bench, found, size, comb(len(recorded), size), checks)
    write_result(folder / "crossvalidate.json", content)
    _write_tables(folder, content)


class _Found:
    """The fits of one emulator: the study's own choice, others, and those without a region."""

    def __init__(self, own: Fold, folds: tuple[Fold, ...], regions: tuple[Fold, ...]) -> None:
        self.own, self.folds, self.regions = own, folds, regions

    def spread(self, count: int) -> list[Fold]:
        """Some fits from the best to the worst, the study's own first."""
        ranked = sorted(self.folds, key=lambda fold: fold.mean_heldout)
        places = np.linspace(0, len(ranked) - 1, min(count - 1, len(ranked))).astype(int)
        return [self.own, *(ranked[i] for i in places)]


class _Bench:
    """Simulations of all recorded sites, the emulator made of them, and the fits on it."""

    def __init__(self, context: Context, simulator: RecordSimulator, seed: int, runs: int) -> None:
        self.context, self.simulator = context, simulator
        study = context.study
        stored = context.results.calibration
        self.best = study.vector(stored.parameters)
        problem = build_problem(study)
        self.bounds = problem.unknowns.with_start(self.best)
        self.measured = simulator.records.measured
        of_site: dict[str, list[int]] = {}
        for i, one in enumerate(self.measured):
            of_site.setdefault(one.site_name, []).append(i)
        self.sites, self.groups = tuple(of_site), tuple(map(tuple, of_site.values()))
        covariance = np.array(stored.uncertainty.covariance_log)
        # Where nothing is known, fits go anywhere; the emulator must not.
        drawn = spread_points(self.best, covariance, self.bounds, runs, seed)
        correction = correct_to_fine_meshes(problem, simulator, self.best)
        self.as_fine = correction.as_fine
        self.points, self.runs = [self.best], [correction.responses]
        self.learn(list(drawn))

    def learn(self, points: Sequence[Array]) -> Runs:
        """Simulate at some points and make the emulator anew; the runs."""
        runs = []
        for i, point in enumerate(points):
            self.context.tell("crossvalidate", i, len(points), f"simulation {i + 1} of {len(points)}")
            runs.append(self.as_fine(self.simulator.search(point)))
        for point, run in zip(points, runs, strict=True):
            if failed := _describe_failed(run):
                told = f"warning: a simulation failed at site {failed}: the emulator does without it"
                self.context.tell("crossvalidate", 0, 0, told)
            else:
                self.points, self.runs = [*self.points, point], [*self.runs, run]
        self.emulator = Emulator.fit(self.bounds.names, np.array(self.points), self.runs)
        return runs

    @property
    def unknowns(self) -> Unknowns:
        """The study's, within the emulator's region."""
        low = np.maximum(self.emulator.lower * np.exp(-_MARGIN), self.bounds.lower)
        high = np.minimum(self.emulator.upper * np.exp(_MARGIN), self.bounds.upper)
        return Unknowns(self.bounds.names, self.best, low, high, self.bounds.priors)

    def validate(self, own: Choice, chosen: Sequence[Choice], regions: dict[str, Choice]) -> _Found:
        table = self.context.study.calibration
        settings = CalibrationSettings(objective=table.objective, relative_tolerance=1e-3, max_iterations=40)
        given = (self.emulator, self.measured, self.unknowns)

        def tell(done: int, total: int) -> None:
            self.context.tell("crossvalidate", done, total, f"{done} of {total} choices fitted")

        def fitted(
            choices: dict[str, Choice], told: Callable[[int, int], None] = lambda done, total: None
        ) -> tuple[Fold, ...]:
            records = {label: expand_to_records(choice, self.groups) for label, choice in choices.items()}
            folds = cross_validate(*given, records, settings, told)
            pairs = zip(folds, choices.values(), strict=True)
            return tuple(average_by_site(fold, choice, self.groups) for fold, choice in pairs)

        (alone,) = fitted({"": own})
        numbered = fitted({str(i): choice for i, choice in enumerate(chosen)}, tell)
        return _Found(alone, tuple(replace(fold, label="") for fold in numbered), fitted(regions))

    def check(self, folds: Sequence[Fold], number: int) -> list[FoldCheck]:
        """The solver's errors at the optima of some fits beside the emulator's, which then learns them."""
        emulated = [self.emulator(fold.parameters) for fold in folds]
        runs = self.learn([fold.parameters for fold in folds])
        rows = []
        for fold, cheap, run in zip(folds, emulated, runs):
            if _describe_failed(run):
                continue
            held = [self.groups[site] for site in fold.heldout]
            solved = [
                np.mean([compute_error_percent(run[i].force_N, self.measured[i].force_N) for i in of_site])
                for of_site in held
            ]
            away = [compute_error_percent(cheap[i].force_N, run[i].force_N) for i in range(len(run))]
            rows.append(
                FoldCheck(
                    round=number,
                    fitted=[self.sites[i] for i in fold.fitted],
                    heldout_emulated_percent=fold.mean_heldout,
                    heldout_solved_percent=float(np.mean(solved)),
                    emulator_error_percent=float(np.mean(away)),
                    emulator_error_largest_percent=float(np.max(away)),
                )
            )
        return rows


def _describe_failed(run: Sequence[SiteResponse]) -> str:
    """The sites whose simulation did not complete, in words; empty where all did."""
    return ", ".join(response.site for response in run if not response.completed)


def _build_result(
    context: Context, bench: _Bench, found: _Found, size: int, possible: int, checks: Sequence[FoldCheck]
) -> CrossvalidateResult:
    """What ``crossvalidate.json`` holds."""
    names, sites = bench.bounds.names, bench.sites
    regions = {site.name: site.region for site in context.study.sites}
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
                left_out_of=summary.sites,
                mean_percent=_to_plain(summary.mean_percent),
                sd_percent=_to_plain(summary.sd_percent),
                own_percent=found.own.errors_percent[i],
            )
            for i, (name, summary) in enumerate(zip(sites, by_site))
        ],
        regions=[fold.summarise(sites, names) for fold in found.regions],
        folds=[fold.summarise(sites, names) for fold in found.folds],
        at_limit_share=float(np.mean([bool(fold.at_limit) for fold in found.folds])),
        emulator=FoldEmulator(
            runs=len(bench.points), loo_percent=float(np.median(bench.emulator.loo_percent)), checks=checks
        ),
    )


def _to_plain(value: float) -> float | None:
    return None if np.isnan(value) else value


def _write_tables(folder: Path, content: CrossvalidateResult) -> None:
    """Every fit and its errors, and errors by site, as CSV."""
    sites = [row.site for row in content.sites]
    names = list(content.own.parameters)
    heads = ["fitted", "mean_error_fitted_percent", "mean_error_heldout_percent", *names]
    heads += [f"error_{site}_percent" for site in sites]
    rows = [
        [
            " ".join(fold.fitted),
            fold.mean_error_fitted_percent,
            fold.mean_error_heldout_percent,
            *(fold.parameters[name] for name in names),
            *(fold.errors_percent[site] for site in sites),
        ]
        for fold in (content.own, *content.folds, *content.regions)
    ]
    write_table(folder / "fits.csv", heads, rows)
    write_rows(folder / "sites.csv", content.sites)
