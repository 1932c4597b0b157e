"""Forces at every recorded site from the identified parameters: the stage ``predict``."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from itertools import zip_longest
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...identify.fit.correction import CoarseToFine
from ...identify.fit.objective import SiteResponse
from ...identify.fit.prediction import Known, error_percent, summarise
from ...indentation import (
    Parameters,
    Simulation,
    SimulationJob,
    SiteModel,
    rested_fields,
    to_parameters,
    to_vector,
)
from ..shared.context import Context
from ..shared.simulations import SimulationCache
from ..shared.store import write_json
from .outliers import outlier_record
from .traces import SiteRecord, as_response, site_record, write_curves

Array = NDArray[np.float64]
_MISSING = {
    "force": "no force is predicted",
    "interval": "no 95 % interval and no check against the other sites",
    "one_material": "no force with one material",
}


def run_predict(context: Context, folder: Path) -> dict[str, Any]:
    """Force at every recorded site with all materials and with one, intervals, and the fields at the peak."""
    study = context.study
    calibration = context.stored("calibrate", "calibration.json")
    found = [to_vector(stage["parameters"], study.tissues) for stage in calibration["stages"]]
    one, best = found[0], found[-1]
    known = Known.of(calibration["uncertainty"])
    records = [site_record(context, site) for site in study.sites if site.trace is not None]
    cache = SimulationCache(
        folder / "runs", also=[context.store[stage] / "runs" for stage in ("calibrate", "predict")]
    )
    jobs = _jobs(context, records, best, _one_material(calibration, study.tissues))
    simulations = []
    for simulation in cache.run(jobs, context.executor):
        simulations.append(simulation)
        context.tell("predict", len(simulations), len(jobs) + len(records), f"site {simulation.site}")
    n = len(records)
    ours = own = [as_response(simulation) for simulation in simulations[:n]]
    others = [as_response(simulation) for simulation in simulations[n:]]
    searched, correction = records, None
    if study.mesh.coarse is not None:
        searched = [site_record(context, record.site, coarse=True) for record in records]
        coarse, others = others[:n], others[n:]
        correction = CoarseToFine(coarse, own)
        ours = correction(coarse)
        fine = correction(others) if others else []
        others = [as_is if r.site.fitted else held for r, as_is, held in zip(records, others, fine)]
    sites = [SitePrediction(*parts) for parts in zip_longest(records, simulations[:n], ours, others)]
    _write_fields(context, folder, [site.record for site in sites if site.own.completed], best, len(jobs))
    for site in sites:
        _write_curves(folder, site, best, known)
    rows = [_row(site) for site in sites]
    doubts = outlier_record(context, cache, records, ours, best, one, searched, correction)
    write_json(folder / "predict.json", {"sites": rows, **_means(rows), **doubts})
    return {}


def _one_material(calibration: dict[str, Any], tissues: Sequence[str]) -> tuple[Array, Array | None] | None:
    """The answer with one material, where the calibration started its simulation; None where it is best."""
    stage, *others = calibration["stages"]
    if not others:
        return None
    guess = stage["iterations"][-1]["first_guess"]
    return to_vector(stage["parameters"], tissues), None if guess is None else to_vector(guess, tissues)


def _jobs(
    context: Context,
    records: Sequence[SiteRecord],
    best: Array,
    simple: tuple[Array, Array | None] | None,
) -> list[SimulationJob]:
    """Every record with all materials, then so on coarse meshes where there are, then with one (unless None).

    At the fitted sites the calibration has simulated the one material already. With coarse meshes derivatives
    are theirs, and so is the one material's force at held-out sites. Its simulation there starts from that
    with all materials and derivatives, which has just been done.
    """
    one, guess = (None, None) if simple is None else simple
    if context.study.mesh.coarse is None:
        jobs = [record.job(best) for record in records]
        if one is not None:
            jobs += [
                r.job(one, start=guess) if r.site.fitted else r.job(one, sensitivities=False, start=best)
                for r in records
            ]
        return jobs
    coarse = [site_record(context, record.site, coarse=True) for record in records]
    jobs = [record.job(best, sensitivities=False) for record in records]
    jobs += [record.job(best) for record in coarse]
    if one is not None:
        jobs += [
            fine.job(one, sensitivities=False)
            if fine.site.fitted
            else rough.job(one, sensitivities=False, start=best)
            for fine, rough in zip(records, coarse, strict=True)
        ]
    return jobs


@dataclass(frozen=True)
class SitePrediction:
    """A recorded site at the answer: its own mesh's simulation, the same with derivatives, and with one
    material (None where that is the answer). Force and derivatives at the times of the record."""

    record: SiteRecord
    own: Simulation
    ours: SiteResponse
    one: SiteResponse | None

    @property
    def missing(self) -> dict[str, str]:
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
        doubts = self.ours.doubts if self.ours.completed else self.own.warnings
        return [*doubts, *(f"{_MISSING[what]}: {reason}" for what, reason in self.missing.items())]


@dataclass(frozen=True)
class FieldJob:
    """Fields at the deepest point of a site, to be stored by a worker, of what it has just simulated."""

    model: SiteModel
    parameters: Parameters
    file: Path
    sensitivities: bool


def store_fields(job: FieldJob) -> str:
    rested_fields(job.model, job.parameters, job.file, job.sensitivities)
    return job.model.name


def _write_fields(
    context: Context, folder: Path, records: Sequence[SiteRecord], vector: Array, before: int
) -> None:
    parameters = to_parameters(vector, context.study.tissues)
    with_derivatives = context.study.mesh.coarse is None  # else those are the coarse mesh's
    jobs = [FieldJob(r.model, parameters, folder / f"{r.site.name}.vtu", with_derivatives) for r in records]
    missing = [job for job in jobs if not job.file.is_file()]
    names = [job.model.name for job in missing]
    for i, name in enumerate(context.executor.map(store_fields, missing, keys=names)):
        total = before + len(missing)
        context.tell("predict", before + i + 1, total, f"fields of site {name}")


def _write_curves(folder: Path, site: SitePrediction, best: Array, known: Known) -> None:
    """The record beside its prediction; a column that is not predicted is not there."""
    record, ours, missing = site.record, site.ours, site.missing
    columns = {
        "time_s": record.times_s,
        "displacement_mm": record.displacement_mm,
        "force_measured_N": record.force_N,
    }
    if "force" not in missing:
        columns["force_simulated_N"] = site.own.force_N
    if site.one is not None and "one_material" not in missing:
        columns["force_one_material_N"] = site.one.force_N
    if ours.completed:
        half = known.half_width_95(ours.jacobian, best, float(ours.force_N.max()), record.site.name)
        columns["force_low_N"] = np.maximum(ours.force_N - half, 0.0)
        columns["force_high_N"] = ours.force_N + half
    write_curves(folder / f"{record.site.name}.csv", **columns)


def _row(site: SitePrediction) -> dict[str, Any]:
    record, own = site.record, site.own

    def error(found: Simulation | SiteResponse | None) -> float | None:
        if found is None or not found.completed:
            return None
        return error_percent(found.force_N, record.force_N)

    return {
        "site": record.site.name,
        "region": record.site.region,
        "fitted": record.site.fitted,
        "peak_force_N": float(record.force_N.max()),
        "error_percent": error(own),
        "error_one_material_percent": error(site.one),
        "penetration_mm": own.penetration_mm,
        "completed": own.completed,
        "reason": own.reason,
        "not_predicted": site.missing,
        "warnings": site.warnings,
        "doubts": [asdict(doubt) for doubt in own.doubts],
        "steps": own.facts["steps"],
        "element": own.facts["element"],
    }


def _means(rows: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Mean and standard deviation of the errors of fitted and held-out sites; None where there are none."""
    found: dict[str, Any] = {}
    for kind, fitted in (("fitted", True), ("heldout", False)):
        errors = [
            r["error_percent"] for r in rows if r["fitted"] == fitted and r["error_percent"] is not None
        ]
        summary = asdict(summarise(errors))
        for key in ("mean_percent", "sd_percent"):
            name = f"{key.removesuffix('_percent')}_error_{kind}_percent"
            found[name] = None if np.isnan(summary[key]) else summary[key]
    return found
