"""Records to regularised curves, and what was seen beside them: the stage ``traces``."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ...errors import TraceError
from ...phases import MotionPhase, describe_phases
from ...results import limb as stored
from ...study import Record, Study, TracesTable
from ...traces import (
    Creep,
    LayerThinning,
    RegularisedCurve,
    SurfaceMotion,
    Trace,
    TraceWarning,
    WaveMeans,
    WaveSpeeds,
    compute_thinnings,
    interpret_record,
    read_layers,
    read_surface_motion,
    read_trace,
    read_wave_speeds,
    regularise,
    regularise_creep,
    select_frames_in_contact,
)
from ..engine.context import Context, name_file_in_errors
from ..engine.store import LAYERS, SMOOTHING, WAVES, write_curves, write_result
from ..simulation.simulations import CURVE_POINTS
from .secondary_measurements import write_motion

END_SHARE = 0.05  # of the largest force: an indenter that hardly pushes does not hold the tissue
SEEN = 3.0  # standard deviations that the skin must move by to be compared


class SecondaryMeasurement(NamedTuple):
    """What was seen beside a record's force: layers, the skin, shear waves at places under the indenter."""

    layers: tuple[LayerThinning, ...]
    motion: SurfaceMotion | None
    waves: tuple[tuple[WaveSpeeds, WaveMeans], ...]


def read_record(study: Study, record: Record) -> tuple[Trace, RegularisedCurve, stored.TraceFacts]:
    """A record as it is used, its regularised curves and the facts that ``traces.json`` holds."""
    return read_trace_file(study.path(record.trace), study.traces, record)


def read_trace_file(
    file: Path, table: TracesTable, record: Record | None = None
) -> tuple[Trace, RegularisedCurve, stored.TraceFacts]:
    """What `read_record` returns, of any file; without a ``record`` the displacement was stated.

    Raises `TraceError` for a file that is no record, or one that cannot be used.
    """
    trace = read_trace(file, (table.time_s, table.displacement_mm, table.force_N))
    forced = record is not None and record.forced
    with name_file_in_errors(file):
        known = interpret_record(trace, None if record is None else record.touch_down_s, forced=forced)
        trace, touch = known.trace, known.touch_down
        made = regularise_creep if forced else regularise
        smooth = made(trace, touch, table.smoothing, None if record is None else record.peak_s)
    phases = [phase.later(touch.time_s) for phase in smooth.phases]
    first_s, first_mm = float(trace.time_s[0]), float(trace.displacement_mm[0]) - touch.displacement_mm
    if touch.time_s > first_s:
        phases.insert(0, MotionPhase("approach", first_s, touch.time_s, first_mm, 0.0))
    remarks = list(known.warnings)
    if trace.notes:
        cause, remedy = "the format of the rig's export", "compare the phases with what the rig did"
        remarks.insert(0, TraceWarning("reading", "; ".join(trace.notes), cause, remedy, {}))
    facts = stored.TraceFacts(
        site=file.stem if record is None else record.site.name,
        control="displacement" if record is None else record.control,
        touch_down_s=touch.time_s,
        touch_down_mm=touch.displacement_mm,
        touch_down_uncertainty_mm=touch.uncertainty_mm,
        peak_s=touch.time_s + smooth.peak_s,
        peak_force_N=smooth.peak_force_N,
        depth_mm=smooth.depth_mm,
        noise_N=smooth.noise_N,
        speed_load_mm_s=smooth.speed_load_mm_s,
        speed_unload_mm_s=None if np.isnan(smooth.speed_unload_mm_s) else smooth.speed_unload_mm_s,
        phases=[stored.RecordPhase.model_validate(phase) for phase in phases],
        phases_in_words=describe_phases(smooth.phases),
        knots_s=smooth.knots_s.tolist(),
        knots_mm=smooth.knots_mm.tolist(),
        knots_N=smooth.knots_N.tolist() if isinstance(smooth, Creep) else None,
        remarks=[stored.RecordRemark.model_validate(remark) for remark in remarks],
    )
    return trace, smooth, facts


def describe_record(record: stored.TraceFacts) -> str:
    """A record in a line: force, depth, touch-down and phases."""
    return (
        f"peak force {record.peak_force_N:.2f} N at {record.depth_mm:.2f} mm, "
        f"touch-down after {record.touch_down_mm:.2f} +- {record.touch_down_uncertainty_mm:.2f} "
        f"mm; {record.phases_in_words}"
        + ("" if record.speed_unload_mm_s is not None else "; loading only, no unloading")
    )


def run_traces(context: Context, folder: Path) -> None:
    """Records to regularised curves, counted from touch-down."""
    recorded = context.study.recorded
    facts = {}
    for i, record in enumerate(recorded):
        context.tell("traces", i, len(recorded), f"site {record.name}")
        trace, smooth, told = read_record(context.study, record)
        even = smooth.resample(CURVE_POINTS)
        for name, curves in ((f"{record.name}-raw", trace), (record.name, even)):
            columns = {key: getattr(curves, key) for key in ("time_s", "displacement_mm", "force_N")}
            write_curves(folder / f"{name}.csv", **columns)
        np.save(folder / SMOOTHING.format(record.name), smooth.curve.compute_response(even.time_s))
        seen = read_observed(context.study, record, trace, told.touch_down_s, smooth)
        facts[record.name] = told = told.model_copy(update=_store_observed(folder, record, seen))
        still = [f"ultrasound: {name}" for name, one in told.layers.items() if not one.compared]
        if told.surface is not None and not told.surface.compared:
            still.append("surface: the skin")
        for what in still:
            words = f"site {record.name}, {what} hardly gives way, and is not compared"
            context.tell("traces", i, len(recorded), words)
    write_result(folder / "traces.json", stored.TracesResult(sites=facts))


def read_observed(
    study: Study, record: Record, trace: Trace, touch_down_s: float, smooth: RegularisedCurve
) -> SecondaryMeasurement:
    """What was seen while the record's force is 5 % of its largest or more.

    Raises `TraceError` for a file that cannot be that, with the file, the place and the remedy.
    """
    pressed = smooth.time_s[smooth.force_N >= END_SHARE * smooth.force_N.max()]
    end_s = touch_down_s + float(pressed[-1])
    time = study.traces.time_s
    layers: tuple[LayerThinning, ...] = ()
    waves: tuple[tuple[WaveSpeeds, WaveMeans], ...] = ()
    motion: SurfaceMotion | None = None
    if record.ultrasound is not None:
        file = study.path(record.ultrasound)
        with name_file_in_errors(file):
            read = read_layers(file, time)
            layers = compute_thinnings(read, touch_down_s, end_s, record.ultrasound_sd_mm)
        _check_tissues(study, file, "mm", [one.tissue for one in layers])
    if record.shear_waves is not None:
        file = study.path(record.shear_waves)
        speeds = read_wave_speeds(file, time)
        _check_tissues(study, file, "m_s", [one.tissue for one in speeds])
        with name_file_in_errors(file):
            waves = tuple((one, one.average(touch_down_s, end_s)) for one in speeds)
    if record.surface is not None:
        file = study.path(record.surface)
        whole = read_surface_motion(file, time)
        times = float(trace.time_s[0]), float(trace.time_s[-1])
        with name_file_in_errors(file, time):
            motion = select_frames_in_contact(whole, times, touch_down_s, end_s)
    return SecondaryMeasurement(layers, motion, waves)


def _check_tissues(study: Study, file: Path, unit: str, named: Sequence[str]) -> None:
    """Refuse columns of a file that name tissues which the model has not."""
    for tissue in named:
        if tissue not in study.tissues:
            known = ", ".join(f"{one}_{unit}" for one in study.tissues)
            what, remedy = f"the model has no tissue {tissue!r}", f"name columns among {known}"
            raise TraceError(what, file=file, place="header", remedy=remedy)


def _store_observed(folder: Path, record: Record, seen: SecondaryMeasurement) -> dict[str, Any]:
    """Write the curves of a record's tissues, the moves of its surface and the speeds of its shear waves.

    Returns what ``traces.json`` says of them.
    """
    facts: dict[str, Any] = {}
    if layers := seen.layers:
        columns = {f"{one.tissue}_mm": one.compression_mm for one in layers}
        file = folder / LAYERS.format(record.name)
        write_curves(file, time_s=layers[0].time_s, samples=layers[0].samples, **columns)
        facts["layers"] = {
            one.tissue: stored.LayerRecord(
                thickness_mm=one.thickness_mm,
                compression_mm=float(one.compression_mm.max()),
                before=one.before,
                sd_mm=one.sd_mm,
                compared=one.is_detectable,
            )
            for one in layers
        }
    if (motion := seen.motion) is not None:
        write_motion(folder, record, motion)
        frames, points, _ = motion.moved_mm.shape
        facts["surface"] = stored.SurfaceRecord(
            points=points,
            frames=frames,
            displacement_mm=motion.max_motion_mm,
            sd_mm=record.surface_sd_mm,
            compared=motion.max_motion_mm > SEEN * record.surface_sd_mm,
        )
    if seen.waves:
        means = [one for _, one in seen.waves]
        number = np.repeat(np.arange(len(means)), [len(one.time_s) for one in means])
        keys = ("time_s", "speed_m_s", "samples")
        columns = {key: np.concatenate([getattr(one, key) for one in means]) for key in keys}
        write_curves(folder / WAVES.format(record.name), place=number.astype(np.float64), **columns)
        facts["waves"] = [
            stored.WaveRecord(
                name=place.name,
                tissue=place.tissue,
                depth_mm=place.depth_mm,
                readings=int(one.samples.sum()),
                from_m_s=float(one.speed_m_s.min()),
                to_m_s=float(one.speed_m_s.max()),
            )
            for place, one in seen.waves
        ]
    return facts
