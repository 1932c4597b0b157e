"""What looks wrong in records: before anything is simulated, and beside the identified model.

See `identify.plausibility` and `identify.outliers`.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from ...anatomy.sites.sites import compute_indenter_axis, measure_tissue_under
from ...anatomy.surfaces.surfaces import Anatomy
from ...arrays import Array
from ...identify.checks.outliers import find_outliers
from ...identify.checks.plausibility import RecordFacts, RecordWarning, check_plausibility, explain_warnings
from ...identify.fit.multifidelity import MeshCorrection
from ...identify.fit.objective import SiteResponse
from ...indentation import SimulationJob, compute_contact_radius
from ...results.base import read_curves
from ...results.limb import PlacedSite, RecordFlag, TraceFacts
from ...study import Study
from ...traces import SurfaceMotion
from ..engine.context import Context
from ..engine.store import Store
from ..simulation.limb_geometry import LimbGeometry
from .records import RecordSet, SiteRecord
from .secondary_measurements import ChosenPoints, choose_points


def read_record_warnings(study: Study, store: Store, limb: LimbGeometry) -> tuple[RecordWarning, ...]:
    """Flags on all records of the stage ``traces``, on the stored limb."""
    traces = store.results.traces.sites
    raw = {name: read_curves(store["traces"] / f"{name}-raw.csv") for name in traces}
    steps = {name: float(np.median(np.diff(curves["time_s"]))) for name, curves in raw.items()}
    return record_flags(study, traces, steps, limb.places, limb.anatomy)


def tell_flags(context: Context) -> None:
    """Warn of what is wrong with records before parameters are identified from them."""
    limb = LimbGeometry.from_store(context.store)
    for flag in read_record_warnings(context.study, context.store, limb):
        context.tell("calibrate", 0, 0, f"warning: {flag.text}")


def record_flags(
    study: Study,
    records: Mapping[str, TraceFacts],
    steps_s: Mapping[str, float],
    placed: Mapping[str, PlacedSite],
    anatomy: Anatomy | None,
) -> tuple[RecordWarning, ...]:
    """Flags on the ``records``, of each of which ``traces.json`` says this.

    ``steps_s``: time between samples of each. ``placed``: what ``sites.json`` says of the sites whose place
    is known (yet). ``anatomy``: None while the surfaces are not known.
    """
    recorded, facts = [record for record in study.recorded if record.name in records], list[RecordFacts]()
    for one in recorded:
        record, row = records[one.name], placed.get(one.site.name)
        radius, of_place = compute_contact_radius(study.indenter_of(one)), dict[str, Any]()
        if row is not None and anatomy is not None:
            width = radius * np.sqrt(np.pi)
            normal = compute_indenter_axis(anatomy.open_skin, row.position_mm, width, one.site.edge)
            of_place = {
                "position_mm": row.position_mm,
                "thickness_mm": measure_tissue_under(anatomy, row.position_mm, normal, width),
                "axis_deg": float(np.degrees(np.arccos(np.clip(np.array(row.axis) @ normal, -1, 1)))),
                "off_skin_mm": row.off_skin_mm if row.marker is None else None,
                "hint_mm": None if row.marker is None else row.marker.distance_to_hint_mm,
            }
        own = RecordFacts(
            record=one.name,
            site=one.site.name,
            peak_N=record.peak_force_N,
            depth_mm=record.depth_mm,
            speed_mm_s=abs(record.speed_load_mm_s),
            step_s=steps_s[one.name],
            radius_mm=radius,
            **of_place,
        )
        facts.append(own)
    remarks = [(one.name, remark) for one in recorded for remark in records[one.name].remarks]
    of_reading = (RecordWarning((name,), **remark.to_plain()) for name, remark in remarks)
    return (*of_reading, *check_plausibility(facts))


def choose_surface_points(
    limb: LimbGeometry, study: Study, motions: Mapping[str, SurfaceMotion | None]
) -> dict[str, ChosenPoints]:
    """By record the points of its surface that can be compared; ``motions``: of records, by name.

    Raises `TraceError` where a record has none.
    """
    skin, found = (limb.anatomy.skin.points, limb.anatomy.skin.faces), {}
    for record in study.recorded:
        motion = motions.get(record.name)
        if motion is not None:
            found[record.name] = choose_points(study, record, limb.place(record.site), skin, motion)
    return found


def check_records(
    plain: Sequence[RecordWarning],
    run: Callable[[Sequence[SimulationJob]], list[SiteResponse]],
    given: RecordSet,
    ours: Sequence[SiteResponse],
    best: Array,
    one: Array,
    correction: MeshCorrection | None,
    tie: Array,
) -> dict[str, Any]:
    """Warnings about the records themselves, and about those that the model misses.

    By the keys that ``predict.json`` has them under.

    Parameters
    ----------
    plain : warnings of `read_record_warnings`.
    run : simulates jobs, in order.
    ours : the ``given`` records with the identified parameters ``best``, with derivatives; those that failed
        are not looked at.
    one : the answer with one material.
    correction : brings responses on the meshes of the search to those of the study's own meshes; None where
        they are the same.
    tie : (p, k) which parameters the study lets move, and which of them together.
    """
    whole = [i for i, response in enumerate(ours) if response.completed]
    records, searched = [given.own[i] for i in whole], [given.searched[i] for i in whole]
    known, failed = [ours[i] for i in whole], list[str]()

    def simulate(parameters: Array) -> list[SiteResponse]:
        if np.array_equal(parameters, best):
            return known
        found = run([record.job(parameters, starts=[best]) for record in searched])
        found = found if correction is None else correction.select(whole)(found)
        failed.extend(f"site {r.site}, one material: {r.reason}" for r in found if not r.completed)
        return found

    def simulate_exchange(parameters: Array, i: int, j: int) -> tuple[SiteResponse, SiteResponse]:
        jobs = [_build_driven_job(searched[a], searched[b], parameters) for a, b in ((i, j), (j, i))]
        one, two = run(jobs)
        pairs = ((one, two), (two, one))
        failed.extend(f"site {a.site}, record of {b.site}: {a.reason}" for a, b in pairs if not a.completed)
        return one, two

    left_out, warnings = find_outliers(
        simulate,
        [replace(record.curve, weight=1.0 / record.record.of_site) for record in records],
        best,
        [(record.times_s, record.displacement_mm) for record in records],
        simulate_exchange,
        one,
        tie,
    )
    against = explain_warnings(warnings, plain)
    flags = [RecordFlag(**flag.to_dict(), found="in the record") for flag in plain]
    flags += [RecordFlag(**flag.to_dict(), found="against the model") for flag in against]
    return {"flags": flags, "left_out": left_out, "failed": list(dict.fromkeys(failed))}


def _build_driven_job(site: SiteRecord, other: SiteRecord, parameters: Array) -> SimulationJob:
    """The site driven by the record of another one, and indented by what made that."""
    keys = ("knots_s", "knots_mm", "knots_N", "indenter", "indenter_digest")
    driven = {key: getattr(other.model, key) for key in keys}
    model = replace(site.model, **driven, layers=(), skin_points=())
    return replace(site, model=model, times_s=other.times_s).job(parameters)
