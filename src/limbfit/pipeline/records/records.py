"""Stored records with their sites' models: what is simulated, what it is compared with, and its errors.

A record may be off by its noise, and by its site as a whole, before residuals are seen. The image places skin
and bone to a share of its voxels, and tissue that is thinner by so much is stiffer: by what a flat punch on a
bonded incompressible layer says (Hayes et al. 1972). How much more tissue differs from site to site the
residuals themselves must tell (`limbfit.identify.uncertainty.discrepancy`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import TypeVar

import numpy as np
import SimpleITK as sitk  # noqa: N813
from numpy.typing import NDArray

from ...arrays import Array
from ...fe import list_texts
from ...identify.checks.plausibility import compute_layer_factor
from ...identify.fit.objective import MeasuredCurve, SiteResponse
from ...identify.uncertainty.noise import SiteNoise, compute_depth_slope, estimate_record_noise
from ...indentation import Simulation, SimulationJob, SiteModel, compute_contact_radius
from ...mesh import read_vtu
from ...results.base import read_curves
from ...study import Indentation, Record, Site, Study
from ...traces.numerics import estimate_noise
from ..engine.context import Context
from ..engine.store import SMOOTHING, Store
from ..simulation.limb_geometry import build_site_model, coarsen_model
from .secondary_measurements import (
    SecondaryValues,
    choose_points,
    list_compared_tissues,
    place_waves,
    read_motion,
    read_secondary_values,
)
from .traces import read_record

T = TypeVar("T")
# Root mean square error of a tibia's surface near a site, over the edge of the image's voxels: 0.16 to 0.19
# for synthetic patients (docs/uncertainty.md).
OF_A_VOXEL = 0.17
GIVEN_MM = 0.3  # of surfaces that come as files
LEAST_SHARE = 0.01  # of the force: what is left on the true surfaces of those patients
_STEP = 1.1
_PRESSED_SHARE = 0.03  # of the peak: below it the force has a corner, where the skin lets go


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
    def curve(self) -> MeasuredCurve:
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
            values, slopes = self.seen.observe(simulation)
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
    def curves(self) -> list[MeasuredCurve]:
        """What the calibration compares with."""
        return [record.curve for record in self.own]

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
    surface_error_mm = estimate_surface_error_mm(study, context.store)
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
        surface_error_mm=surface_error_mm,
    )


def build_model(context: Context, one: Indentation) -> SiteModel:
    """An indentation as it was recorded, from touch-down on, or as the study plans it."""
    if isinstance(one, Record):
        return load_site_record(context, one).model
    return build_site_model(context, one, *one.planned_knots)


def estimate_surface_error_mm(study: Study, store: Store) -> float:
    """Standard deviation of where the study's surfaces are: as stated, by the voxels, or of files."""
    if study.calibration.surface_error_mm is not None:
        return study.calibration.surface_error_mm
    if study.image is None:  # labels may be there of one that it had before
        return GIVEN_MM
    reader = sitk.ImageFileReader()
    reader.SetFileName(str(store["segment"] / "labels.seg.nrrd"))
    reader.ReadImageInformation()
    return OF_A_VOXEL * float(np.prod(reader.GetSpacing()[:3])) ** (1 / 3)


def estimate_site_noise(study: Study, record: SiteRecord, force_N: Array) -> SiteNoise:
    """Noise of a record at the times of comparison, its touch-down included.

    ``force_N`` (n,) is the simulated one: what a wrong touch-down does is told by its slope, which is smooth.
    Under a stated force it is the depth, mm, and so is the noise; and so it is with what is seen beside it.
    """
    if record.seen is None:
        found = _estimate_curve_noise(study, record, force_N)
    else:
        depth = None if record.record.forced else record.displacement_mm
        found = record.seen.noise(record.name, force_N, depth, record.touch_down_sd_mm)
    return replace(found, site=record.site.name)


def _estimate_curve_noise(study: Study, record: SiteRecord, force_N: Array) -> SiteNoise:
    """Of a record, by its scatter about smooth curves of its phases, while the indenter presses.

    A stated force has corners of its own: there it is by what regularising took away.
    """
    trace, smooth, facts = read_record(study, record.record)
    since = trace.time_s - facts.touch_down_s
    inside = (since >= 0) & (since <= smooth.time_s[-1])
    force = np.interp(since, smooth.time_s, smooth.force_N)
    residual, scatter = (trace.force_N - force)[inside], None
    if record.record.forced:
        moved = trace.displacement_mm[inside] - facts.touch_down_mm
        residual = moved - np.interp(since[inside], smooth.time_s, smooth.displacement_mm)
    else:
        pressed = inside & (force > _PRESSED_SHARE * smooth.peak_force_N)
        parts = [pressed & (since >= phase.start_s) & (since <= phase.end_s) for phase in smooth.phases]
        found = estimate_noise(*(trace.force_N[part] for part in parts))
        scatter = found.sd_N, found.lag
    curves = record.times_s, residual, force_N, None if record.record.forced else record.displacement_mm
    return estimate_record_noise(record.name, *curves, record.touch_down_sd_mm, record.smoothing, scatter)


def estimate_site_deviation(
    study: Study, record: SiteRecord, response: SiteResponse, parameters: Array
) -> Array:
    """One standard deviation (n,) of what a record would be off by, as its site's tissue were stiffer.

    In N, or mm where the record compares depths, from the derivatives at ``parameters`` (p,). What thinner
    tissue is strained more by shows in what is seen of it (`SecondaryValues.strain_slope`), not in moduli.
    """
    stiffer = np.asarray(response.jacobian @ (parameters * is_modulus(study)))
    surface_mm, thickness_mm = record.surface_error_mm, measure_bone_distance_mm(record.model)
    strained = None if record.seen is None else record.seen.strain_slope(response.force_N)
    if strained is None or thickness_mm is None:
        return stiffer * compute_expected_share(record.model, surface_mm)
    return stiffer * LEAST_SHARE + strained * surface_mm / thickness_mm


def compute_expected_share(model: SiteModel, surface_mm: float) -> float:
    """Standard deviation of the force at a site over the force itself, where surfaces are off by as much."""
    radius = compute_contact_radius(model.indenter)
    thickness = measure_bone_distance_mm(model)
    if thickness is None:  # a half-space has no thickness to be wrong
        return LEAST_SHARE
    return float(np.hypot(LEAST_SHARE, compute_thickness_slope(radius, thickness) * surface_mm / thickness))


def compute_thickness_slope(radius_mm: float, thickness_mm: float) -> float:
    """``-d log F / d log h`` of a flat punch on a bonded layer."""
    above, below = (compute_layer_factor(radius_mm / thickness_mm * step) for step in (_STEP, 1.0 / _STEP))
    return float(np.log(above / below) / np.log(_STEP**2))


def measure_bone_distance_mm(model: SiteModel) -> float | None:
    """From a site to the nearest point of a bone in its mesh; None where the mesh has none."""
    return _measure_distance(model.mesh, model.mesh_digest, model.position)


@lru_cache(maxsize=64)
def _measure_distance(file: Path, digest: str, position: tuple[float, float, float]) -> float | None:
    """All records of a site share its mesh, which is read once."""
    mesh = read_vtu(file)
    bone = mesh.node_sets.get("fixed_bone", np.zeros(0, dtype=int))
    if not len(bone):
        return None
    return float(np.linalg.norm(mesh.points[bone] - np.array(position), axis=1).min())


def is_modulus(study: Study) -> NDArray[np.bool_]:
    """Which of the study's parameters are moduli, in flat order."""
    return np.array([name in study.law.moduli for _, name in study.parameters])
