"""Records to regularised curves (the stage ``traces``), and a record with its model for what stands on it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...errors import TraceError
from ...identify.fit.objective import Measured, SiteResponse
from ...identify.uncertainty.noise import depth_slope
from ...indentation import Simulation, SimulationJob, SiteModel
from ...phases import MotionPhase, in_words
from ...study import Record, Site, Study
from ...traces import (
    Creep,
    Regularised,
    Thinning,
    TouchDown,
    Trace,
    read_trace,
    regularise,
    regularise_creep,
    understand,
)
from ..shared.context import Context
from ..shared.simulations import CURVE_POINTS, recorded_model
from ..shared.store import write_json
from ..shared.tabular import read_curves, write_curves
from .layers import load_thinnings, read_thinnings, store_thinnings, weight_of

Array = NDArray[np.float64]
SMOOTHING = "{}-smoothing.npy"  # of a record, as a matrix


def read_record(study: Study, record: Record) -> tuple[Trace, Regularised, dict[str, Any]]:
    """A record as it is used, its regularised curves and the facts that ``traces.json`` holds."""
    table = study.traces
    file = study.path(record.trace)
    trace = read_trace(file, (table.time_s, table.displacement_mm, table.force_N))
    try:
        known = understand(trace, record.touch_down_s, forced=record.forced)
        trace, touch = known.trace, known.touch_down
        made = regularise_creep if record.forced else regularise
        smooth = made(trace, touch, table.smoothing, record.peak_s)
    except TraceError as error:
        raise TraceError(error.what, file=file, place=error.place, remedy=error.remedy) from None
    facts = {
        "site": record.site.name,
        "control": record.control,
        "touch_down_s": touch.time_s,
        "touch_down_mm": touch.displacement_mm,
        "touch_down_uncertainty_mm": touch.uncertainty_mm,
        "peak_s": touch.time_s + smooth.peak_s,
        "peak_force_N": smooth.peak_force_N,
        "depth_mm": smooth.depth_mm,
        "noise_N": smooth.noise_N,
        "speed_load_mm_s": smooth.speed_load_mm_s,
        "speed_unload_mm_s": None if np.isnan(smooth.speed_unload_mm_s) else smooth.speed_unload_mm_s,
        "phases": _phase_rows(trace, smooth, touch),
        "phases_in_words": in_words(smooth.phases),
        "knots_s": smooth.knots_s.tolist(),
        "knots_mm": smooth.knots_mm.tolist(),
        "knots_N": smooth.knots_N.tolist() if isinstance(smooth, Creep) else None,
        "remarks": [asdict(remark) for remark in known.remarks],
    }
    return trace, smooth, facts


def _phase_rows(trace: Trace, smooth: Regularised, touch: TouchDown) -> list[dict[str, Any]]:
    """What the indenter does, in times of the record and in mm from touch-down."""
    first_s, first_mm = float(trace.time_s[0]), float(trace.displacement_mm[0]) - touch.displacement_mm
    phases = [phase.later(touch.time_s) for phase in smooth.phases]
    if touch.time_s > first_s:
        phases.insert(0, MotionPhase("approach", first_s, touch.time_s, first_mm, 0.0))
    return [{**asdict(phase), "rate_mm_s": phase.rate_mm_s} for phase in phases]


def run_traces(context: Context, folder: Path) -> dict[str, Any]:
    """Records to regularised curves, counted from touch-down."""
    recorded = context.study.recorded
    facts = {}
    for i, record in enumerate(recorded):
        context.tell("traces", i, len(recorded), f"site {record.name}")
        trace, smooth, told = read_record(context.study, record)
        facts[record.name] = told
        write_curves(
            folder / f"{record.name}-raw.csv",
            time_s=trace.time_s,
            displacement_mm=trace.displacement_mm,
            force_N=trace.force_N,
        )
        even = smooth.resample(CURVE_POINTS)
        write_curves(
            folder / f"{record.name}.csv",
            time_s=even.time_s,
            displacement_mm=even.displacement_mm,
            force_N=even.force_N,
        )
        np.save(folder / SMOOTHING.format(record.name), smooth.curve.response(even.time_s))
        if record.ultrasound is not None:
            seen = read_thinnings(context.study, record, told["touch_down_s"], smooth)
            told["layers"] = store_thinnings(folder, record, seen)
            for one in seen:
                if not one.is_seen:
                    words = f"ultrasound of {record.name}: {one.tissue} hardly gives way, and is not compared"
                    context.tell("traces", i, len(recorded), words)
    write_json(folder / "traces.json", {"sites": facts})
    return {}


@dataclass(frozen=True)
class SiteRecord:
    """A record at its site: what a simulation needs, and the forces, or depths, it is compared with.

    ``smoothing`` (n, n) is what regularising did to the record, which is done to the simulated force as well
    before parameters are judged by their difference (``respond``): else the corner at the peak, which it
    blunts, would be taken for an error of the model. ``nested_mm``: parameters are searched on as much of the
    same mesh. With ``seen`` it is what ultrasound saw of one tissue meanwhile that is compared, of the same
    simulation; ``weight`` is how much that counts beside a force. ``touch_down_sd_mm`` is how far the
    touch-down may be off, ``error_share`` how far forces may be beside that.
    """

    record: Record
    tissues: tuple[str, ...]
    model: SiteModel
    times_s: Array
    displacement_mm: Array
    force_N: Array
    smoothing: Array
    nested_mm: float | None = None
    seen: Thinning | None = None
    weight: float = 1.0
    touch_down_sd_mm: float = 0.0
    error_share: float = 0.01

    @property
    def name(self) -> str:
        """The record's; with the tissue that ultrasound saw."""
        return self.record.name if self.seen is None else f"{self.record.name}+{self.seen.tissue}"

    @property
    def unit(self) -> str:
        """Of what is compared."""
        return self.record.unit if self.seen is None else "mm"

    @property
    def site(self) -> Site:
        return self.record.site

    @property
    def measured(self) -> Measured:
        """What the calibration compares with."""
        weight = self.weight * self.record.weight
        doubt = self.touch_down_sd_mm * self._by_depth if self.seen is None else None
        return Measured(self.name, self.compared, weight, self.site.name, self.unit, doubt, self.error_share)

    @property
    def _by_depth(self) -> Array:
        """How the record (n,) changes with the place of its touch-down, N/mm, or mm/mm."""
        if self.record.forced:
            return np.ones_like(self.times_s)
        return self.smoothing @ depth_slope(self.times_s, self.displacement_mm, self.force_N)

    @property
    def compared(self) -> Array:
        """What is compared: force (n,) N; displacement, mm, under a stated force; compression of a tissue."""
        if self.seen is not None:
            return self.seen.compression_mm
        return self.displacement_mm if self.record.forced else self.force_N

    @property
    def compared_at_s(self) -> Array:
        """At which times (n,) s from touch-down."""
        return self.times_s if self.seen is None else self.seen.time_s

    def respond(self, simulation: Simulation) -> SiteResponse:
        """What this record would show of a simulation."""
        plain = as_response(simulation)
        if self.seen is not None:
            plain = self._compression(plain, simulation)
        force_N, jacobian = (self.smoothing @ values for values in (plain.force_N, plain.jacobian))
        return replace(plain, force_N=force_N, jacobian=jacobian)

    def _compression(self, plain: SiteResponse, simulation: Simulation) -> SiteResponse:
        """The response with the compression of its tissue in place of the force."""
        assert self.seen is not None
        row, slopes = self.model.layers.index(self.seen.tissue), simulation.compression_jacobian
        jacobian = np.zeros_like(plain.jacobian) if slopes is None else slopes[row]
        return replace(plain, force_N=simulation.compression_mm[row], jacobian=jacobian)

    def job(
        self, parameters: Array, sensitivities: bool = True, starts: Sequence[Array] = ()
    ) -> SimulationJob:
        """The simulation with these parameters; ``starts``: those whose simulations give first guesses."""
        values, times = tuple(map(float, parameters)), tuple(map(float, self.times_s))
        first = tuple(tuple(map(float, start)) for start in starts)
        return SimulationJob(self.model, self.tissues, values, times, sensitivities, first)

    def own_job(self, parameters: Array, starts: Sequence[Array] = ()) -> SimulationJob:
        """The force on the whole of the study's own mesh, without derivatives.

        Where parameters are searched on a part of that mesh, its simulation gives the first guesses, and
        ``starts`` are that one's; otherwise they are nothing.
        """
        if self.nested_mm is None:
            return self.job(parameters, sensitivities=False)
        return replace(self.job(parameters, sensitivities=False, starts=starts), nested_mm=self.nested_mm)


def as_response(simulation: Simulation) -> SiteResponse:
    """A simulation as it is; derivatives (n, 0) where it has none."""
    jacobian = np.zeros((simulation.force_N.size, 0)) if simulation.jacobian is None else simulation.jacobian
    ended = simulation.completed, simulation.reason
    doubts: dict[str, str] = {doubt.kind: doubt.text for doubt in simulation.doubts}
    return SiteResponse.with_doubts(simulation.force_N, jacobian, *ended, simulation.site, doubts)


def site_record(context: Context, record: Record) -> SiteRecord:
    """A stored record and its site's model, on the whole of its own mesh."""
    curves = read_curves(context.store["traces"] / f"{record.name}.csv")
    facts = context.stored("traces", "traces.json")["sites"][record.name]
    return SiteRecord(
        record=record,
        tissues=context.study.tissues,
        model=recorded_model(context, record),
        times_s=curves["time_s"],
        displacement_mm=curves["displacement_mm"],
        force_N=curves["force_N"],
        smoothing=np.load(context.store["traces"] / SMOOTHING.format(record.name)),
        nested_mm=context.study.within_mm if context.study.mesh.coarse is None else None,
        touch_down_sd_mm=facts["touch_down_uncertainty_mm"],
        error_share=context.study.calibration.force_error_percent / 100.0,
    )


def all_compared(context: Context, records: Sequence[SiteRecord]) -> list[SiteRecord]:
    """The records, each followed by one for every tissue that ultrasound saw beside it."""
    facts = context.stored("traces", "traces.json")["sites"]
    found = []
    for one in records:
        found.append(one)
        for seen in load_thinnings(context.store["traces"], one.record, facts[one.record.name]):
            weight = weight_of(seen, context.study.calibration.force_error_percent)
            at = np.array([np.interp(seen.time_s, one.times_s, row) for row in np.eye(len(one.times_s))]).T
            found.append(replace(one, seen=seen, weight=weight, smoothing=at))
    return found


def as_searched(context: Context, records: Sequence[SiteRecord]) -> Sequence[SiteRecord]:
    """The records as parameters are searched (`site_model`); ``records`` itself where that is the same."""
    if not context.study.is_searched_apart:
        return records
    return [replace(one, model=recorded_model(context, one.record, searched=True)) for one in records]
