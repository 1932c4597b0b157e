"""The records of a study judged before anything is simulated (see `identify.plausibility`)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from ...anatomy.sites.sites import compute_indenter_axis, measure_tissue_under
from ...anatomy.surfaces.surfaces import Anatomy, load_anatomy
from ...identify.checks.plausibility import RecordFacts, RecordWarning, check_plausibility
from ...indentation import compute_contact_radius
from ...results.curves import read_curves
from ...results.limb import PlacedSite
from ...results.records import TraceFacts
from ...study import Record, Study
from ...traces import SurfaceMotion
from ..engine.context import Context
from ..simulation.limb_geometry import LimbGeometry
from .secondary_measurements import ChosenPoints, choose_points


def read_record_warnings(context: Context) -> tuple[RecordWarning, ...]:
    """Flags on all records from the stages ``surfaces``, ``sites`` and ``traces``."""
    study = context.study
    traces = context.results.traces.sites
    rows = {row.site: row for row in context.results.sites.sites}
    raw = {name: read_curves(context.store["traces"] / f"{name}-raw.csv") for name in traces}
    steps = {name: float(np.median(np.diff(curves["time_s"]))) for name, curves in raw.items()}
    return record_flags(study, traces, steps, rows, load_anatomy(context.store["surfaces"]))


def tell_flags(context: Context) -> None:
    """Warn of what is wrong with records before parameters are identified from them."""
    for flag in read_record_warnings(context):
        context.tell("calibrate", 0, 0, f"warning: {flag.text}")


def record_flags(
    study: Study,
    records: Mapping[str, TraceFacts],
    steps_s: Mapping[str, float],
    placed: Mapping[str, PlacedSite],
    anatomy: Anatomy | None,
) -> tuple[RecordWarning, ...]:
    """Flags on the records.

    Parameters
    ----------
    records : what ``traces.json`` says of each.
    steps_s : time between samples of each.
    placed : what ``sites.json`` says of the sites whose place is known (yet).
    anatomy : None while the surfaces are not known.
    """
    recorded = [record for record in study.recorded if record.name in records]
    facts = [
        _collect_facts(
            one,
            records[one.name],
            steps_s[one.name],
            compute_contact_radius(study.indenter_of(one)),
            placed.get(one.site.name),
            anatomy,
        )
        for one in recorded
    ]
    remarks = [(one.name, remark) for one in recorded for remark in records[one.name].remarks]
    of_reading = (RecordWarning((name,), **remark.to_plain()) for name, remark in remarks)
    return (*of_reading, *check_plausibility(facts))


def _collect_facts(
    stated: Record,
    record: TraceFacts,
    step_s: float,
    radius: float,
    row: PlacedSite | None,
    anatomy: Anatomy | None,
) -> RecordFacts:
    facts: dict[str, Any] = {}
    if row is not None and anatomy is not None:
        width = radius * np.sqrt(np.pi)
        axis = np.array(row.axis)
        normal = compute_indenter_axis(anatomy.skin, row.position_mm, width)
        facts = {
            "position_mm": row.position_mm,
            "thickness_mm": measure_tissue_under(anatomy, row.position_mm, normal, width),
            "axis_deg": float(np.degrees(np.arccos(np.clip(axis @ normal, -1, 1)))),
            "off_skin_mm": row.off_skin_mm if row.marker is None else None,
            "hint_mm": None if row.marker is None else row.marker.distance_to_hint_mm,
        }
    return RecordFacts(
        site=stated.name,
        place=stated.site.name,
        peak_N=record.peak_force_N,
        depth_mm=record.depth_mm,
        speed_mm_s=abs(record.speed_load_mm_s),
        step_s=step_s,
        radius_mm=radius,
        **facts,
    )


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
