"""How far a record may be off: by its noise, and by its site as a whole, before residuals are seen.

The image places skin and bone to a share of its voxels, and tissue that is thinner by so much is stiffer: by
what a flat punch on a bonded incompressible layer says (Hayes et al. 1972).  How much more tissue differs
from site to site the residuals themselves must tell (`limbfit.identify.uncertainty.discrepancy`).
"""

from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...arrays import Array
from ...identify.checks.plausibility import compute_layer_factor
from ...identify.fit.objective import SiteResponse
from ...identify.uncertainty.noise import SiteNoise, estimate_record_noise
from ...indentation import SiteModel, compute_contact_radius
from ...mesh import read_vtu
from ...study import Study
from ...traces.numerics import estimate_noise
from .records import SiteRecord
from .traces import read_record

LEAST_SHARE = 0.01  # of the force: what is left on the true surfaces of those patients
_STEP = 1.1
_PRESSED_SHARE = 0.03  # of the peak: below it the force has a corner, where the skin lets go


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
    return estimate_record_noise(
        record.name,
        record.times_s,
        residual,
        force_N,
        None if record.record.forced else record.displacement_mm,
        record.touch_down_sd_mm,
        record.smoothing,
        scatter,
    )


def estimate_site_deviation(
    study: Study, record: SiteRecord, response: SiteResponse, parameters: Array
) -> Array:
    """One standard deviation (n,) of what a record would be off by, as its site's tissue were stiffer.

    In N, or mm where the record compares depths, from the derivatives at ``parameters`` (p,). What thinner
    tissue is strained more by shows in what is seen of it (`SecondaryValues.by_strain`), not in its moduli.
    """
    stiffer = np.asarray(response.jacobian @ (parameters * is_modulus(study)))
    surface_mm, thickness_mm = record.surface_error_mm, measure_bone_distance_mm(record.model)
    strained = None if record.seen is None else record.seen.by_strain(response.force_N)
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
    ratio = radius_mm / thickness_mm
    return float(
        np.log(compute_layer_factor(ratio * _STEP) / compute_layer_factor(ratio / _STEP)) / np.log(_STEP**2)
    )


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
