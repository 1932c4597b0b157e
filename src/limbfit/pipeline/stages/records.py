"""Stored records with their sites' models: what is simulated, and what that is compared with."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ...fe import texts_of
from ...identify.fit.objective import Measured, SiteResponse
from ...identify.uncertainty.noise import depth_slope
from ...indentation import Simulation, SimulationJob, SiteModel
from ...study import Record, Site
from ..shared.artefacts import read_curves
from ..shared.context import Context
from ..shared.simulations import recorded_model, surface_points
from .files import SMOOTHING
from .observed import Observed, load_observed

Array = NDArray[np.float64]


@dataclass(frozen=True)
class SiteRecord:
    """A record at its site: what a simulation needs, and the forces, or depths, it is compared with.

    ``smoothing`` (n, n) is what regularising did to the record, which is done to the simulated force as well
    before parameters are judged by their difference (``respond``): else the corner at the peak, which it
    blunts, would be taken for an error of the model. ``nested_mm``: parameters are searched on as much of the
    same mesh. With ``seen`` it is what was seen beside the force that is compared, of the same simulation;
    ``weight`` is how much that counts beside a force. ``touch_down_sd_mm`` is how far the touch-down may be
    off, ``error_share`` how far forces may be beside that.
    """

    record: Record
    tissues: tuple[str, ...]
    model: SiteModel
    times_s: Array
    displacement_mm: Array
    force_N: Array
    smoothing: Array
    nested_mm: float | None = None
    seen: Observed | None = None
    weight: float = 1.0
    touch_down_sd_mm: float = 0.0
    error_share: float = 0.01

    @property
    def name(self) -> str:
        """The record's; with what was seen beside it."""
        return self.record.name if self.seen is None else f"{self.record.name}+{self.seen.what}"

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
        """What is compared: force (n,) N; displacement, mm, under a stated force; what is seen beside."""
        if self.seen is not None:
            return self.seen.value_mm
        return self.displacement_mm if self.record.forced else self.force_N

    def respond(self, simulation: Simulation) -> SiteResponse:
        """What this record would show of a simulation."""
        plain = as_response(simulation)
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


def as_response(simulation: Simulation) -> SiteResponse:
    """A simulation as it is; derivatives (n, 0) where it has none."""
    jacobian = np.zeros((simulation.force_N.size, 0)) if simulation.jacobian is None else simulation.jacobian
    ended = simulation.completed, simulation.reason
    kinds = texts_of(simulation.doubts, "slipped", "folded")
    return SiteResponse(simulation.force_N, jacobian, *ended, simulation.site, simulation.warnings, *kinds)


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
    """The records, each followed by one for everything that was seen beside it."""
    facts, folder = context.stored("traces", "traces.json")["sites"], context.store["traces"]
    found = []
    for one in records:
        found.append(one)
        own, points = facts[one.record.name], surface_points(context, one.record)
        for seen in load_observed(folder, one.record, own, one.times_s, points):
            weight = seen.weight(context.study.calibration.force_error_percent)
            found.append(replace(one, seen=seen, weight=weight))
    return found


def as_searched(context: Context, records: Sequence[SiteRecord]) -> Sequence[SiteRecord]:
    """The records as parameters are searched (`site_model`); ``records`` itself where that is the same."""
    if not context.study.is_searched_apart:
        return records
    return [replace(one, model=recorded_model(context, one.record, searched=True)) for one in records]
