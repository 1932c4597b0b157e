"""Stored records with their sites' models: what is simulated, and what that is compared with."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np
import SimpleITK as sitk  # noqa: N813

from ...arrays import Array
from ...fe import list_texts
from ...identify.fit.objective import MeasuredCurve, SiteResponse
from ...identify.uncertainty.noise import compute_depth_slope
from ...indentation import Simulation, SimulationJob, SiteModel
from ...mesh import read_vtu
from ...results.base import read_curves
from ...study import Indentation, Record, Site, Study
from ..engine.context import Context
from ..engine.files import SMOOTHING
from ..engine.store import Store
from ..simulation.limb_geometry import build_site_model, coarsen_model
from .secondary_measurements import (
    SecondaryValues,
    choose_points,
    list_compared_tissues,
    place_waves,
    read_motion,
    read_secondary_values,
)

T = TypeVar("T")
# Root mean square error of a tibia's surface near a site, over the edge of the image's voxels: 0.16 to 0.19
# for synthetic patients (docs/uncertainty.md).
OF_A_VOXEL = 0.17
GIVEN_MM = 0.3  # of surfaces that come as files


@dataclass(frozen=True)
class SiteRecord:
    """A record at its site: what a simulation needs, and the forces, or depths, it is compared with.

    ``smoothing`` (n, n) is what regularising did to the record, which is done to the simulated force as well
    before parameters are judged by their difference (``respond``): else the corner at the peak, which it
    blunts, would be taken for an error of the model. ``nested_mm``: parameters are searched on as much of the
    same mesh. ``secondary`` is what was seen beside the force; with ``seen`` it is that which is compared, of
    the same simulation. ``touch_down_sd_mm`` is how far the touch-down may be off, ``error_share`` how far
    forces may be beside that, ``surface_error_mm`` how far the limb's surfaces (`estimate_surface_error_mm`).
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
    secondary: tuple[SecondaryValues, ...] = ()
    touch_down_sd_mm: float = 0.0
    error_share: float = 0.01
    surface_error_mm: float = GIVEN_MM

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
        doubt = None
        if self.seen is None:
            # By how it changes with the place of its touch-down, N/mm, or mm/mm.
            slope = np.ones_like(self.times_s)
            if not self.record.forced:
                driven = self.times_s, self.displacement_mm, self.force_N
                slope = self.smoothing @ compute_depth_slope(*driven)
            doubt = self.touch_down_sd_mm * slope
        return MeasuredCurve(
            self.name, self.compared, weight, self.site.name, self.unit, doubt, self.error_share
        )

    @property
    def compared(self) -> Array:
        """What is compared: force (n,) N; displacement, mm, under a stated force; what is seen beside."""
        if self.seen is not None:
            return self.seen.value
        return self.displacement_mm if self.record.forced else self.force_N

    def split(self) -> list[SiteRecord]:
        """The record, followed by one for everything that was seen beside it."""
        return [self, *(replace(self, seen=seen) for seen in self.secondary)]

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


@dataclass(frozen=True)
class RecordSet:
    """Records on the study's own meshes, and the same records as parameters are searched.

    ``searched`` is ``own`` itself where the search takes those meshes whole. What was seen beside a record
    follows it as one more record (`SiteRecord.seen`).
    """

    own: tuple[SiteRecord, ...]
    searched: tuple[SiteRecord, ...]

    @property
    def is_coarsened(self) -> bool:
        """True if parameters are searched on something smaller than the sites' own meshes."""
        return self.searched is not self.own

    @property
    def measured(self) -> list[MeasuredCurve]:
        """What the calibration compares with."""
        return [record.measured for record in self.own]

    @property
    def simulations(self) -> int:
        """How many simulations an evaluation takes: one of each record."""
        return sum(record.seen is None for record in self.own)

    def select_forces(self, items: Sequence[T]) -> list[T]:
        """Of one item a record those of the records themselves, not of what was seen beside them."""
        return [item for record, item in zip(self.own, items, strict=True) if record.seen is None]


def load_records(context: Context, records: Sequence[Record], secondary: bool = False) -> RecordSet:
    """Stored records and their sites' models; with ``secondary`` what was seen beside each follows it."""
    loaded = [load_site_record(context, record) for record in records]
    own = tuple(one for record in loaded for one in (record.split() if secondary else [record]))
    if not context.study.is_searched_apart:
        return RecordSet(own, own)
    models = {record.name: coarsen_model(context, record.model) for record in loaded}
    return RecordSet(own, tuple(replace(one, model=models[one.record.name]) for one in own))


def load_site_record(context: Context, record: Record) -> SiteRecord:
    """A stored record and its site's model, on the whole of its own mesh.

    Raises `TraceError` where nothing of its surface can be compared, or the limb has no place of its shear
    waves.
    """
    study, folder = context.study, context.store["traces"]
    facts, points = context.results.traces.sites[record.name], None
    force = (facts.knots_N or ()) if record.forced else ()
    tissues = list_compared_tissues(facts)
    model = build_site_model(context, record, facts.knots_s, facts.knots_mm, force, tissues)
    if facts.surface is not None and facts.surface.compared:
        mesh = read_vtu(model.mesh)
        place, skin = (model.position, model.axis), (mesh.points, mesh.face_sets["skin"])
        points = choose_points(study, record, place, skin, read_motion(folder, record))
        model = replace(model, skin_points=points.points, skin_axes=points.axes)
    if facts.waves:
        model = replace(model, waves=place_waves(study, record, model, facts.waves))
    curves = read_curves(folder / f"{record.name}.csv")
    return SiteRecord(
        record=record,
        tissues=study.tissues,
        model=model,
        times_s=curves["time_s"],
        displacement_mm=curves["displacement_mm"],
        force_N=curves["force_N"],
        smoothing=np.load(folder / SMOOTHING.format(record.name)),
        nested_mm=study.within_mm if study.mesh.coarse is None else None,
        secondary=read_secondary_values(folder, record, facts, points, curves["time_s"]),
        touch_down_sd_mm=facts.touch_down_uncertainty_mm,
        error_share=study.calibration.force_error_percent / 100.0,
        surface_error_mm=estimate_surface_error_mm(study, context.store),
    )


def build_model(context: Context, one: Indentation) -> SiteModel:
    """An indentation as it was recorded, from touch-down on, or as the study plans it."""
    if isinstance(one, Record):
        return load_site_record(context, one).model
    return build_site_model(context, one, *one.planned_knots)


def estimate_surface_error_mm(study: Study, store: Store) -> float:
    """Standard deviation of where the study's surfaces are: as stated, by the voxels, or of files."""
    stated = study.calibration.surface_error_mm
    labels = store["segment"] / "labels.seg.nrrd"
    if stated is not None:
        return stated
    if study.image is None:  # labels may be there of one that it had before
        return GIVEN_MM
    reader = sitk.ImageFileReader()
    reader.SetFileName(str(labels))
    reader.ReadImageInformation()
    return OF_A_VOXEL * float(np.prod(reader.GetSpacing()[:3])) ** (1 / 3)
