"""Forces at every recorded site from the identified parameters: the stage ``predict``."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ...arrays import Array
from ...identify.checks.domain import Extent, RecordedRange, describe_outside
from ...identify.checks.fit_quality import assess_fit, refit_residuals, summarise_fit
from ...identify.fit.multifidelity import MeshCorrection
from ...identify.fit.objective import SiteResponse, find_largest_magnitude
from ...identify.fit.prediction import PredictionModel, compute_error_percent, summarise_errors
from ...identify.uncertainty.discrepancy import compute_mesh_covariance
from ...indentation import Simulation, SimulationJob, store_job_fields
from ...results import identification as stored
from ...study import Study
from ..engine.context import Context
from ..engine.store import write_curves, write_result
from ..records.record_checks import check_records, read_record_warnings
from ..records.records import (
    RecordSet,
    SiteRecord,
    estimate_site_deviation,
    estimate_site_noise,
    load_records,
    to_response,
)
from ..simulation.limb_geometry import LimbGeometry
from ..simulation.loading import LimbAxis, LoadHistory, describe_indentation, read_strain_extents
from ..simulation.simulations import SimulationCache
from .search import build_problem

Loading = tuple[Sequence[Extent], Sequence[stored.OutsideRecords]]
_MISSING = {
    "force": "no force is predicted",
    "interval": "no 95 % interval and no check against the other sites",
    "one_material": "no force with one material",
}


def run_predict(context: Context, folder: Path) -> None:
    """Force at every recorded site with all materials and with one, intervals, and the fields at the peak."""
    study, calibration = context.study, context.results.calibration
    answers = [Answer.from_stage(stage, study) for stage in calibration.stages]
    one, best = answers[0].parameters, answers[-1].parameters
    known = PredictionModel.from_stored(calibration.uncertainty)
    records, limb = load_records(context, study.recorded), LimbGeometry.from_store(context.store)
    earlier = [context.store[stage] / "runs" for stage in ("calibrate", "predict")]
    cache = SimulationCache(folder / "runs", also=earlier)
    jobs = build_answer_jobs(records, answers[-1])
    if len(answers) > 1:
        jobs += _build_one_material_jobs(records, answers[0], best)
    sites, correction = _simulate_records(context, cache, records, jobs)
    strains = _write_fields(context, folder, sites, len(jobs))
    bands = [_compute_band(study, site, best, known) if site.ours.completed else None for site in sites]
    tested, loadings = _compare_with_records(limb, sites, strains)
    rows = []
    for site, band, loading in zip(sites, bands, loadings, strict=True):
        _write_curves(folder, site, band)
        rows.append(_summarise_site(site, _write_observed(folder, study, site, best, known), loading))

    def run_check(jobs: Sequence[SimulationJob]) -> list[SiteResponse]:
        responses = []
        for simulation in cache.run(jobs, context.executor):
            context.tell("predict", 0, 0, f"looking at site {simulation.site} for what is wrong")
            responses.append(to_response(simulation))
        return responses

    plain, ours = read_record_warnings(study, context.store, limb), [site.ours for site in sites]
    tie = build_problem(study).space.tie
    warnings = check_records(plain, run_check, records, ours, best, one, correction, tie)
    judged = [(site, band) for site, band in zip(sites, bands, strict=True) if band is not None]
    of_mesh = calibration.uncertainty.residuals.mesh_misfit
    quality = _assess_fits(study, judged, best, known, of_mesh)
    content = stored.PredictResult(
        sites=rows,
        recorded_range=stored.RecordedExtents.model_validate(tested),
        outside_text=describe_outside({f"site {r.record}": r.outside_records for r in rows if not r.fitted}),
        fit_quality=stored.FitSummary(verdict=summarise_fit(quality), records=quality),
        **warnings | _compute_means(rows),
    )
    write_result(folder / "predict.json", content)


@dataclass(frozen=True)
class Answer:
    """Identified ``parameters`` (p,), and those from which its simulation in the calibration ``starts``."""

    parameters: Array
    starts: tuple[Array, ...]

    @classmethod
    def from_stage(cls, stage: stored.SearchStage, study: Study) -> Answer:
        """The answer of a stage as ``calibration.json`` holds it."""
        starts = stage.iterations[-1].starts
        return cls(study.vector(stage.parameters), tuple(study.vector(one) for one in starts))


def build_answer_jobs(records: RecordSet, answer: Answer) -> list[SimulationJob]:
    """Every record at the answer, then so with derivatives as it is searched, if that is another model.

    At the fitted sites the calibration has simulated all of them already; elsewhere they start from rest.
    """
    best = answer.parameters
    if not records.is_coarsened:
        return [record.job(best) for record in records.own]
    starts = [answer.starts if record.site.fitted else () for record in records.own]
    own = [record.own_job(best, before) for record, before in zip(records.own, starts)]
    return own + [record.job(best, starts=before) for record, before in zip(records.searched, starts)]


def _build_one_material_jobs(records: RecordSet, one: Answer, best: Array) -> list[SimulationJob]:
    """Every record with one material: at the fitted sites as the calibration has simulated it already.

    Elsewhere it is of where parameters are searched, and starts from that with all materials and derivatives,
    which has just been done.
    """

    def job(record: SiteRecord, near: SiteRecord) -> SimulationJob:
        if not record.site.fitted:
            return near.job(one.parameters, sensitivities=False, starts=[best])
        simulated = record.job if near is record else record.own_job
        return simulated(one.parameters, starts=one.starts)

    return [job(*pair) for pair in zip(records.own, records.searched)]


@dataclass(frozen=True)
class SitePrediction:
    """A record at the answer, by the ``job`` of its own mesh.

    ``near`` is the simulation with derivatives where that is another than the ``own`` one. ``ours`` is with
    derivatives, ``one`` with one material (None where that is the answer), at the times of the record.
    """

    record: SiteRecord
    job: SimulationJob
    own: Simulation
    near: Simulation | None
    ours: SiteResponse
    one: SiteResponse | None

    @property
    def missing_reasons(self) -> dict[str, str]:
        """What is not predicted, and why."""
        found = {} if self.ours.completed else {"interval": self.ours.reason}
        if not self.own.completed:
            found = {"force": self.own.reason}
        if self.one is not None and not self.one.completed:
            found["one_material"] = self.one.reason
        return found

    @property
    def warnings(self) -> list[str]:
        """What is doubtful or missing."""
        doubts = self.ours.warnings if self.ours.completed else self.own.warnings
        return [*doubts, *(f"{_MISSING[what]}: {reason}" for what, reason in self.missing_reasons.items())]


def _simulate_records(
    context: Context, cache: SimulationCache, records: RecordSet, jobs: Sequence[SimulationJob]
) -> tuple[list[SitePrediction], MeshCorrection | None]:
    """Every record by the ``jobs`` of the answer, which those with one material follow if that is another.

    Beside them is what brings simulations of the search to the records' own meshes, if these differ.
    """
    n, simulations = len(records.own), list[Simulation]()
    for simulation in cache.run(jobs, context.executor):
        simulations.append(simulation)
        context.tell("predict", len(simulations), len(jobs) + n, f"site {simulation.site}")
    responses = [to_response(simulation) for simulation in simulations]
    ours, others, correction = responses[:n], responses[n:], None
    near: Sequence[Simulation | None] = [None] * n
    if records.is_coarsened:
        near = simulations[n : 2 * n]
        coarse, others = others[:n], others[n:]
        correction = MeshCorrection(coarse, ours)
        ours, fine = correction(coarse), correction(others) if others else []
        others = [as_is if r.site.fitted else held for r, as_is, held in zip(records.own, others, fine)]
    single: Sequence[SiteResponse | None] = others or [None] * n
    parts = zip(records.own, jobs, simulations, near, ours, single)
    return [SitePrediction(*of_site) for of_site in parts], correction


def store_fields(wanted: tuple[SimulationJob, Path]) -> list[Extent]:
    """Store the fields of a job at its deepest point, if not done yet; the strains near the indenter.

    It is done by the worker that has just simulated the job.
    """
    job, file = wanted
    if not file.is_file():
        store_job_fields(job, file)
    return read_strain_extents(file) if file.is_file() else []


def _write_fields(
    context: Context, folder: Path, sites: Sequence[SitePrediction], before: int
) -> dict[str, list[Extent]]:
    """Store the fields of what came to its end; return the strains near the indenter of each record."""
    whole, found = [site for site in sites if site.own.completed], {}
    names = [site.record.name for site in whole]
    wanted = [(site.job, folder / f"{name}.vtu") for site, name in zip(whole, names, strict=True)]
    for name, strains in zip(names, context.executor.map(store_fields, wanted, keys=names), strict=True):
        found[name] = strains
        context.tell("predict", before + len(found), before + len(wanted), f"fields of site {name}")
    return found


def _compare_with_records(
    limb: LimbGeometry, sites: Sequence[SitePrediction], strains: Mapping[str, Sequence[Extent]]
) -> tuple[RecordedRange, list[Loading]]:
    """What the fitted records did to the tissue; what each site does, and what of it none of them did."""
    axis = LimbAxis(limb.anatomy)

    def describe(site: SitePrediction, tested: RecordedRange | None = None) -> list[Extent]:
        record, model = site.record.record, site.record.model
        return describe_indentation(
            LoadHistory.from_knots(model.knots_s, model.knots_N or model.knots_mm),
            max(model.knots_mm),
            model.indenter,
            limb.place(record.site),
            axis,
            force_N=float(site.record.force_N.max()),
            strains=strains.get(record.name, ()),
            tested=tested,
        )

    fitted = [site for site in sites if site.record.site.fitted]
    loading = {site.record.name: describe(site) for site in fitted}
    places = np.array([limb.place(site.record.site)[0] for site in fitted]).reshape(-1, 3)
    tested = RecordedRange.from_records(loading.values(), map(float, axis.measure_angle(places)))
    found: list[Loading] = []
    for site in sites:
        own = loading.get(site.record.name) or describe(site, tested)
        found.append((own, () if site.record.site.fitted else tested.find_outside(own)))
    return tested, found


class _Band(NamedTuple):
    """The 95 % band of a record (n,), and one standard deviation (n,) of what its site may be off by."""

    deviation: Array
    low: Array
    high: Array


def _compute_band(study: Study, site: SitePrediction, best: Array, known: PredictionModel) -> _Band:
    record, ours = site.record, site.ours
    deviation = estimate_site_deviation(study, record, ours, best)
    of_site, unit = 0.0 if record.site.fitted else deviation, record.record.unit
    low, high = known.compute_interval_95(ours, best, record.name, unit, of_site, record.times_s)
    return _Band(deviation, np.maximum(low, 0.0), high)


def _write_curves(folder: Path, site: SitePrediction, band: _Band | None) -> None:
    """The record beside its prediction; a column that is not predicted is not there."""
    record, missing = site.record, site.missing_reasons
    name, driven, driving = "force", "displacement_mm", record.displacement_mm
    if record.record.forced:
        name, driven, driving = "displacement", "force_N", record.force_N
    unit = record.record.unit
    columns = {"time_s": record.times_s, driven: driving, f"{name}_measured_{unit}": record.compared}
    if "force" not in missing:
        columns[f"{name}_simulated_{unit}"] = site.own.force_N
    if site.one is not None and "one_material" not in missing:
        columns[f"{name}_one_material_{unit}"] = site.one.force_N
    if band is not None:
        columns |= {f"{name}_low_{unit}": band.low, f"{name}_high_{unit}": band.high}
    write_curves(folder / f"{record.name}.csv", **columns)


def _assess_fits(
    study: Study,
    judged: Sequence[tuple[SitePrediction, _Band]],
    best: Array,
    known: PredictionModel,
    of_mesh: stored.MeshMisfitSummary | None,
) -> list[stored.RecordFit]:
    """How well the model follows each record, beside its noise and the errors of its mesh and site.

    Forces are smoothed as the record is: else the corner at its peak would be taken for an error of the
    model.
    """
    allowed, residuals = [], []
    for site, band in judged:
        force = site.record.smoothing @ site.ours.force_N
        residuals.append(force - site.record.compared)
        noise = estimate_site_noise(study, site.record, force).covariance
        errors = [band.deviation, known.find_mesh_error(site.record.name, force)]
        covariance = noise + sum(np.outer(error, error) for error in errors)
        if of_mesh is not None:
            covariance += compute_mesh_covariance(of_mesh, site.record.times_s, find_largest_magnitude(force))
        allowed.append(covariance)
    fitted = {i: site for i, (site, _) in enumerate(judged) if site.record.site.fitted}
    refitted = refit_residuals(
        [residuals[i] for i in fitted],
        [site.record.smoothing @ site.ours.jacobian * best for site in fitted.values()],
        [allowed[i] for i in fitted],
    )
    left = dict(zip(fitted, refitted, strict=True))
    found = []
    for i, (site, band) in enumerate(judged):
        record = site.record
        found.append(
            assess_fit(
                record.name,
                record.site.fitted,
                record.times_s,
                record.force_N if record.record.forced else record.displacement_mm,
                residuals[i],
                find_largest_magnitude(record.compared),
                allowed[i],
                (record.compared >= band.low) & (record.compared <= band.high),
                left.get(i),
                "displacement" if record.record.forced else "force",
            )
        )
    return found


def _write_observed(
    folder: Path, study: Study, site: SitePrediction, best: Array, known: PredictionModel
) -> list[stored.ObservedError]:
    """Everything that was seen beside a record's force with its prediction, as files and rows."""
    rows = []
    for one in site.record.split()[1:]:
        assert one.seen is not None
        ours = whole = one.respond(site.own)
        if site.near is not None:
            searched = one.respond(site.near)
            ours = MeshCorrection([searched], [whole])([searched])[0]
        seen, what, unit = one.seen, one.seen.quantity, one.seen.unit.replace("/", "_")
        columns = seen.columns | {f"{what}_measured_{unit}": one.compared}
        if whole.completed:
            columns[f"{what}_simulated_{unit}"] = whole.force_N
        if ours.completed:
            of_site = 0.0 if one.site.fitted else estimate_site_deviation(study, one, ours, best)
            about = ours, best, one.name, one.unit, of_site
            low, high = known.compute_interval_95(*about, noise_N=seen.noise_sd)
            columns |= {f"{what}_low_{unit}": low, f"{what}_high_{unit}": high}
        write_curves(folder / f"{one.name}.csv", **columns)
        rows.append(
            stored.ObservedError(
                kind=seen.kind,
                what=seen.what,
                name=one.name,
                unit=seen.unit,
                largest=find_largest_magnitude(one.compared),
                noise=seen.noise_sd,
                **seen.facts,
                error_percent=compute_error_percent(whole.force_N, one.compared) if whole.completed else None,
            )
        )
    return rows


def _summarise_site(
    site: SitePrediction, observed: Sequence[stored.ObservedError], loading: Loading
) -> stored.RecordPrediction:
    record, own = site.record, site.own

    def error(found: Simulation | SiteResponse | None) -> float | None:
        if found is None or not found.completed:
            return None
        return compute_error_percent(found.force_N, record.compared)

    return stored.RecordPrediction(
        site=record.site.name,
        record=record.name,
        control=record.record.control,
        region=record.site.region,
        fitted=record.site.fitted,
        peak_force_N=float(record.force_N.max()),
        error_percent=error(own),
        error_one_material_percent=error(site.one),
        penetration_mm=own.penetration_mm,
        completed=own.completed,
        reason=own.reason,
        not_predicted=site.missing_reasons,
        warnings=site.warnings,
        doubts=[stored.SimulationDoubt.model_validate(doubt) for doubt in own.doubts],
        steps=own.facts["steps"],
        element=own.facts["element"],
        observed=observed,
        loading=[stored.QuantityRange.model_validate(one) for one in loading[0]],
        outside_records=loading[1],
    )


def _compute_means(rows: Sequence[stored.RecordPrediction]) -> dict[str, float | None]:
    """Mean and standard deviation of the errors of fitted and held-out sites; None where there are none.

    A site's is the mean of its records'.
    """
    found: dict[str, float | None] = {}
    for kind, fitted in (("fitted", True), ("heldout", False)):
        chosen = [(row.site, row.error_percent) for row in rows if row.fitted == fitted]
        _, mean, sd = summarise_errors(stored.average_records(chosen))
        found |= {f"mean_error_{kind}_percent": mean, f"sd_error_{kind}_percent": sd}
    return found
