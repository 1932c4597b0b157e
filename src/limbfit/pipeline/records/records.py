"""Stored records with their sites' models: what is simulated, and what that is compared with."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from ...arrays import Array
from ...fe import list_texts
from ...identify.fit.objective import MeasuredCurve, SiteResponse
from ...identify.uncertainty.noise import compute_depth_slope
from ...indentation import Simulation, SimulationJob, SiteModel
from ...study import Record, Site, Study
from ...traces import SurfaceMotion, Thinning, WaveMeans
from ..engine.context import Context
from ..engine.storage import read_curves
from ..limb.files import LAYERS, SMOOTHING, WAVES
from ..simulation.simulations import build_recorded_model, find_surface_points
from ..simulation.surface_points import ChosenPoints, read_motion
from .secondary_measurements import LayerMeasurement, SecondaryValues, SurfaceMeasurement, WaveMeasurement


def is_moved(study: Study) -> bool:
    """Whether the answer is what is most probable, and not the least squares.

    As the study states; else where a fitted site has more than one record of force. What the records' own
    doubts weigh decides then: errors of touch-down and site that one fit to everything would take for tissue.
    """
    table, records = study.calibration, study.records_at(*study.fitted)
    if table.answer is not None:
        return table.answer == "most probable"
    more = len(records) > len(study.fitted) or any(record.observed for record in records)
    return more and not table.is_papers


@dataclass(frozen=True)
class SiteRecord:
    """A record at its site: what a simulation needs, and the forces, or depths, it is compared with.

    ``smoothing`` (n, n) is what regularising did to the record, which is done to the simulated force as well
    before parameters are judged by their difference (``respond``): else the corner at the peak, which it
    blunts, would be taken for an error of the model. ``nested_mm``: parameters are searched on as much of the
    same mesh. With ``seen`` it is what was seen beside the force that is compared, of the same simulation.
    ``touch_down_sd_mm`` is how far the touch-down may be off, ``error_share`` how far forces may be beside
    that.
    """

    record: Record
    tissues: tuple[str, ...]
    model: SiteModel
    times_s: Array
    displacement_mm: Array
    force_N: Array
    smoothing: Array
    nested_mm: float | None = None
    seen: SecondaryValues | None = None
    touch_down_sd_mm: float = 0.0
    error_share: float = 0.01

    @property
    def name(self) -> str:
        """The record's; with what was seen beside it."""
        return self.record.name if self.seen is None else f"{self.record.name}+{self.seen.what}"

    @property
    def unit(self) -> str:
        """Of what is compared."""
        return self.record.unit if self.seen is None else self.seen.unit

    @property
    def site(self) -> Site:
        return self.record.site

    @property
    def measured(self) -> MeasuredCurve:
        """What the calibration compares with."""
        weight = self.record.weight * (1.0 if self.seen is None else self.seen.weight(self.error_share))
        doubt = self.touch_down_sd_mm * self._by_depth if self.seen is None else None
        return MeasuredCurve(
            self.name, self.compared, weight, self.site.name, self.unit, doubt, self.error_share
        )

    @property
    def _by_depth(self) -> Array:
        """How the record (n,) changes with the place of its touch-down, N/mm, or mm/mm."""
        if self.record.forced:
            return np.ones_like(self.times_s)
        return self.smoothing @ compute_depth_slope(self.times_s, self.displacement_mm, self.force_N)

    @property
    def compared(self) -> Array:
        """What is compared: force (n,) N; displacement, mm, under a stated force; what is seen beside."""
        if self.seen is not None:
            return self.seen.value
        return self.displacement_mm if self.record.forced else self.force_N

    def respond(self, simulation: Simulation) -> SiteResponse:
        """What this record would show of a simulation."""
        plain = to_response(simulation)
        if self.seen is not None:
            values, slopes = self.seen.of(simulation)
            return replace(plain, force_N=values, jacobian=slopes)
        force_N, jacobian = (self.smoothing @ values for values in (plain.force_N, plain.jacobian))
        return replace(plain, force_N=force_N, jacobian=jacobian)

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


def to_response(simulation: Simulation) -> SiteResponse:
    """A simulation as it is; derivatives (n, 0) where it has none."""
    jacobian = np.zeros((simulation.force_N.size, 0)) if simulation.jacobian is None else simulation.jacobian
    ended = simulation.completed, simulation.reason
    kinds = list_texts(simulation.doubts, "slipped", "folded")
    return SiteResponse(simulation.force_N, jacobian, *ended, simulation.site, simulation.warnings, *kinds)


def load_site_record(context: Context, record: Record) -> SiteRecord:
    """A stored record and its site's model, on the whole of its own mesh."""
    curves = read_curves(context.store["traces"] / f"{record.name}.csv")
    facts = context.stored("traces", "traces.json")["sites"][record.name]
    return SiteRecord(
        record=record,
        tissues=context.study.tissues,
        model=build_recorded_model(context, record),
        times_s=curves["time_s"],
        displacement_mm=curves["displacement_mm"],
        force_N=curves["force_N"],
        smoothing=np.load(context.store["traces"] / SMOOTHING.format(record.name)),
        nested_mm=context.study.within_mm if context.study.mesh.coarse is None else None,
        touch_down_sd_mm=facts["touch_down_uncertainty_mm"],
        error_share=context.study.calibration.force_error_percent / 100.0,
    )


def select_compared_records(context: Context, records: Sequence[SiteRecord]) -> list[SiteRecord]:
    """The records, each followed by one for everything that was seen beside it."""
    facts, folder = context.stored("traces", "traces.json")["sites"], context.store["traces"]
    found = []
    for one in records:
        found.append(one)
        own, points = facts[one.record.name], find_surface_points(context, one.record)
        observed = _load_observed(folder, one.record, own, one.times_s, points)
        found += [replace(one, seen=seen) for seen in observed]
    return found


def coarsen_records(context: Context, records: Sequence[SiteRecord]) -> Sequence[SiteRecord]:
    """The records as parameters are searched (`build_site_model`); ``records`` where that is the same."""
    if not context.study.is_searched_apart:
        return records
    return [replace(one, model=build_recorded_model(context, one.record, searched=True)) for one in records]


def _load_observed(
    folder: Path,
    record: Record,
    facts: dict[str, Any],
    times_s: Array,
    points: ChosenPoints | None,
) -> tuple[SecondaryValues, ...]:
    """What is compared beside a record, in the order of a simulation's gauges.

    ``times_s`` (t,) are those of the record's simulation, ``points`` those of its surface.
    """
    stated = facts.get("layers", {})
    tissues = [tissue for tissue, one in stated.items() if one["compared"]]
    found: list[SecondaryValues] = []
    if tissues:
        curves = read_curves(folder / LAYERS.format(record.name))
        for number, tissue in enumerate(tissues):
            found.append(_build_layer_measurement(tissue, stated[tissue], curves, number, times_s))
    if points is not None:
        motion = read_motion(folder, record)
        found.append(_build_surface_measurement(record, points, motion, len(tissues), times_s))
    first = len(tissues) + (0 if points is None else 3 * len(points.points))
    if places := facts.get("waves", []):
        curves = read_curves(folder / WAVES.format(record.name))
        for number, place in enumerate(places):
            own = {name: values[curves["place"] == number] for name, values in curves.items()}
            found.append(_build_wave_measurement(record, place["name"], own, first + number, times_s))
    return tuple(found)


def _build_layer_measurement(
    tissue: str, stated: dict[str, Any], curves: dict[str, Array], number: int, times_s: Array
) -> LayerMeasurement:
    thinning = Thinning(
        tissue,
        stated["thickness_mm"],
        curves["time_s"],
        curves[f"{tissue}_mm"],
        curves["samples"],
        stated["before"],
        stated["sd_mm"],
    )
    n = len(thinning.time_s)
    return LayerMeasurement(
        tissue,
        thinning.compression_mm,
        thinning.time_s,
        np.full(n, number),
        _build_interpolation(times_s, thinning.time_s),
        thinning.covariance,
        {"sd": stated["sd_mm"], "thickness_mm": stated["thickness_mm"], "compared": f"{n} times"},
    )


def _build_surface_measurement(
    record: Record, points: ChosenPoints, motion: SurfaceMotion, first: int, times_s: Array
) -> SurfaceMeasurement:
    means = motion.means(points.which)
    sd, words = record.surface_sd_mm, ("x", "y", "z")
    if record.surface_frame == "site":
        words = ("along the edge", "across it", "along the axis")
    facts = {
        "sd": sd,
        "left_out": dict(points.left_out),
        "components": list(words),
        "compared": f"{len(points.points)} points, {len(means.moved_mm)} values",
    }
    return SurfaceMeasurement(
        "surface",
        means.moved_mm,
        means.time_s,
        first + 3 * means.point + means.component,
        means.frames @ _build_interpolation(times_s, motion.time_s),
        np.diag(sd**2 / means.samples),
        facts,
        np.array(points.points)[means.point],
        means.component,
    )


def _build_wave_measurement(
    record: Record, name: str, curves: dict[str, Array], gauge: int, times_s: Array
) -> WaveMeasurement:
    means, n = WaveMeans(curves["time_s"], curves["speed_m_s"], curves["samples"]), len(curves["time_s"])
    sd, bias = record.shear_waves_sd_m_s, record.shear_waves_bias_m_s
    return WaveMeasurement(
        f"{name}-waves",
        means.speed_m_s,
        means.time_s,
        np.full(n, gauge),
        _build_interpolation(times_s, means.time_s),
        means.covariance(sd, bias),
        {"sd": sd, "bias": bias, "compared": f"{n} times"},
    )


def _build_interpolation(from_s: Array, to_s: Array) -> Array:
    """Matrix (n, t) of linear interpolation from times (t,) to times (n,)."""
    return np.array([np.interp(to_s, from_s, row) for row in np.eye(len(from_s))]).T
