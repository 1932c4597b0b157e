"""Forces at every recorded site from the identified parameters: the stage ``predict``."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from itertools import zip_longest
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...identify.fidelity import Anchor, corrected
from ...identify.objective import SiteResponse
from ...identify.prediction import Known, error_percent, summarise
from ...indentation import (
    Parameters,
    Simulation,
    SimulationJob,
    SiteModel,
    rested_fields,
    to_parameters,
    to_vector,
)
from ..context import Context
from ..simulations import SimulationCache
from ..store import write_json
from .outliers import outlier_record
from .traces import SiteRecord, site_record, write_curves

Array = NDArray[np.float64]


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
    ours, others = simulations[:n], simulations[n:]
    coarse, simple = ([], others) if study.mesh.coarse is None else (others[:n], others[n:])
    if coarse:
        simple = [
            s if record.site.fitted else _fine_force(s, fine, rough)
            for record, s, fine, rough in zip(records, simple, ours, coarse)
        ]
        ours = [_with_derivatives(*parts) for parts in zip(ours, coarse)]
    _write_fields(context, folder, records, best, len(jobs))
    rows = []
    for record, with_all, with_one in zip_longest(records, ours, simple):
        _write_prediction(folder, record, with_all, with_one, best, known)
        rows.append(_row(record, with_all, with_one))
    searched = records
    if study.mesh.coarse is not None:
        searched = [site_record(context, record.site, coarse=True) for record in records]
    doubts = outlier_record(context, cache, records, ours, best, one, searched)
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


def _with_derivatives(fine: Simulation, coarse: Simulation) -> Simulation:
    """The fine force with the coarse mesh's derivatives, scaled as the forces are."""
    assert coarse.jacobian is not None
    scale = Anchor(np.zeros(0), (coarse.force_N,), (fine.force_N,)).scales[0]
    return replace(fine, jacobian=scale * coarse.jacobian)


def _fine_force(simple: Simulation, fine: Simulation, coarse: Simulation) -> Simulation:
    """The one material's force on a coarse mesh, corrected by what is known with all materials."""
    anchor = Anchor(np.zeros(0), (coarse.force_N,), (fine.force_N,))
    rough = SiteResponse(simple.force_N, np.zeros((simple.force_N.size, 0)))
    return replace(simple, force_N=corrected(rough, coarse.force_N, fine.force_N, anchor.scales[0]).force_N)


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


def _write_prediction(
    folder: Path, record: SiteRecord, ours: Simulation, one: Simulation | None, best: Array, known: Known
) -> None:
    assert ours.jacobian is not None
    half = known.half_width_95(ours.jacobian, best, float(ours.force_N.max()), record.site.name)
    write_curves(
        folder / f"{record.site.name}.csv",
        time_s=record.times_s,
        displacement_mm=record.displacement_mm,
        force_measured_N=record.force_N,
        force_simulated_N=ours.force_N,
        **({} if one is None else {"force_one_material_N": one.force_N}),
        force_low_N=np.maximum(ours.force_N - half, 0.0),
        force_high_N=ours.force_N + half,
    )


def _row(record: SiteRecord, ours: Simulation, one: Simulation | None) -> dict[str, Any]:
    def error(simulation: Simulation | None) -> float | None:
        if simulation is None or not simulation.completed:
            return None
        return error_percent(simulation.force_N, record.force_N)

    return {
        "site": record.site.name,
        "region": record.site.region,
        "fitted": record.site.fitted,
        "peak_force_N": float(record.force_N.max()),
        "error_percent": error(ours),
        "error_one_material_percent": error(one),
        "penetration_mm": ours.penetration_mm,
        "completed": ours.completed,
        "reason": ours.reason,
        "warnings": list(ours.warnings),
        "steps": ours.facts["steps"],
        "element": ours.facts["element"],
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
