"""Where a phantom is indented, how deep, and along which axis: 18 places in four regions, as in the paper.

Places are given around the limb (angle from anterior through medial, radians) and along it (millimetres
below the knee joint, or a thigh's proximal cut), so that they keep their anatomical meaning when a seed
changes the limb.

And the record of the indentation robot: a clean force history becomes a noisy 500 Hz record with slack. It
starts clear of the skin, moves at constant speed to its depth, straight back to where it started,
and records a little longer. Its displacement counts from the start, not from touch-down.

The true forces are those of the implicit anatomy, meshed and stepped otherwise than a calibration does. The
mesh comes from the exact surfaces, not from the segmented image, and is finer than the study's where the
indenter presses; the element has twice its quadrature points (FEBio's rule), and like the study's default one
mean dilatation each: with the pressure as it comes, forces of such meshes are 5 to 20 % too large
(docs/convergence.md), which a calibration would put into the moduli.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

import numpy as np

from .. import indentation
from ..anatomy.meshing.meshing import BaseMesh, MeshSettings, build_base_mesh, mesh_site
from ..anatomy.surfaces.surfaces import Anatomy, load_anatomy
from ..arrays import Array
from ..errors import RunError, SiteError
from ..fe import StepControl, solve
from ..mesh import Mesh, find_gauges_along
from ..study import IndenterTable
from .geometry import Limb, Shank
from .mri import SkinMarker

RATE_HZ = 500.0
AFTER_S = 0.4
CLEARANCE_MM = (0.3, 0.6)
FORCE_NOISE_N = (0.03, 0.05)
ULTRASOUND_HZ, ULTRASOUND_NOISE_MM = 20.0, 0.1
SURFACE_HZ, SURFACE_NOISE_MM = 5.0, 0.05
WAVES_HZ, WAVES_NOISE_M_S, WAVES_BIAS_M_S = 1.0, 0.1, 0.1
DISPLACEMENT_NOISE_MM = 0.005
HEADER = "time_s,displacement_mm,force_N"
ELEMENT = "tet10g8p0"
LOAD_STEPS, UNLOAD_STEPS = 12, 16
STIFFEST_PER_MM, PENALTY_TIMES_TISSUE = 400.0, 3200.0
INDENTER_MM, INDENTER_EDGE_MM = 20.0, 2.0
SAFE_SHARE = 0.4  # of the thinnest soft tissue under the indenter
HINT_ERROR_MM = (3.0, 5.0)  # how far off a place is when measured by hand
SPEED_MM_S, SPEED_SPREAD = 0.96, 0.05

PATELLAR, TIBIA, LATERAL, POSTERIOR = "patellar tendon", "tibia", "lateral", "posterior wall"


@dataclass(frozen=True)
class Place:
    """A place on the limb: angle (rad), distance below its shape's datum (mm), wanted depth (mm)."""

    name: str
    region: str
    angle: float
    below: float
    depth: float


def _build_places(region: str, depth: float, first: int, spots: Sequence[tuple[float, float]]) -> list[Place]:
    return [Place(f"{first + i:02d}", region, angle, below, depth) for i, (angle, below) in enumerate(spots)]


SHANK_PLACES = (
    *_build_places(PATELLAR, 5.0, 1, [(0.0, 7.0), (-0.45, 16.0), (0.45, 16.0)]),
    *_build_places(TIBIA, 3.5, 4, [(0.95, 46.0), (0.95, 72.0), (0.95, 98.0), (0.35, 42.0), (1.0, 124.0)]),
    *_build_places(
        LATERAL, 5.0, 9, [(-0.8, 44.0), (-0.85, 72.0), (-0.85, 100.0), (-1.3, 58.0), (-1.3, 86.0)]
    ),
    *_build_places(
        POSTERIOR, 7.0, 14, [(3.14, 38.0), (2.75, 64.0), (-2.7, 64.0), (3.14, 92.0), (3.14, 120.0)]
    ),
)
_COLUMN = ((0.0, 75.0), (0.3, 105.0), (-0.3, 105.0), (0.0, 130.0), (0.0, 160.0))
THIGH_PLACES = (
    *_build_places("anterior", 6.0, 1, [(0.0, 95.0), (-0.45, 125.0), (0.45, 125.0)]),
    *_build_places("medial", 6.0, 4, [(0.5 * np.pi + aside, below) for aside, below in _COLUMN]),
    *_build_places("lateral", 5.0, 9, [(-0.5 * np.pi + aside, below) for aside, below in _COLUMN]),
    *_build_places("posterior", 7.0, 14, [(np.pi + aside, below) for aside, below in _COLUMN]),
)
FITTED = ("01", "05", "10", "15")
DETAIL_SITES = {"coarse": (*FITTED, "13", "17"), "paper": tuple(place.name for place in SHANK_PLACES)}


@dataclass(frozen=True)
class Ramp:
    """A constant-speed indentation: ``depth`` mm under touch-down at ``speed`` mm/s, and back."""

    depth: float
    speed: float

    def __post_init__(self) -> None:
        if not (self.depth > 0 and self.speed > 0):
            what = f"cannot indent {self.depth:g} mm at {self.speed:g} mm/s"
            raise SiteError(what, remedy="give positive numbers")

    @property
    def peak_s(self) -> float:
        """Seconds from touch-down to the peak."""
        return self.depth / self.speed

    @property
    def knots(self) -> tuple[tuple[float, float, float], tuple[float, float, float]]:
        """Times (s) and displacements (mm) from touch-down: start, peak, back."""
        return (0.0, self.peak_s, 2 * self.peak_s), (0.0, self.depth, 0.0)


@dataclass(frozen=True)
class TrueSite:
    """A site as it is: position on the skin, unit axis into the limb (LPS mm), depth (mm), speed (mm/s).

    ``hint`` is the position as measured by hand, ``thickness`` the thinnest soft tissue under the indenter.
    """

    name: str
    region: str
    fitted: bool
    position: Array
    axis: Array
    depth: float
    speed: float
    thickness: float
    hint: Array

    @property
    def ramp(self) -> Ramp:
        """The indentation that the robot makes there."""
        return Ramp(self.depth, self.speed)


def build_true_sites(limb: Limb, seed: int) -> tuple[TrueSite, ...]:
    """Build all 18 sites of a limb."""
    places = SHANK_PLACES if isinstance(limb.shape, Shank) else THIGH_PLACES
    return tuple(
        _build_true_site(limb, place, np.random.default_rng([seed, 6, i])) for i, place in enumerate(places)
    )


def select_sites(sites: Sequence[TrueSite], names: Sequence[str]) -> tuple[TrueSite, ...]:
    """Select the named sites, in the order of the limb's list; all are fitted where none would be. Raises
    `SiteError` when a name is not among them.
    """
    available = {site.name for site in sites}
    unknown = [name for name in names if name not in available]
    if unknown:
        what = f"the phantom has no site {unknown[0]!r}"
        raise SiteError(what, remedy=f"choose from {', '.join(sorted(available))}")
    found = [site for site in sites if site.name in set(names)]
    unfitted = not any(site.fitted for site in found)
    return tuple(replace(site, fitted=site.fitted or unfitted) for site in found)


def build_markers(sites: Sequence[TrueSite]) -> tuple[SkinMarker, ...]:
    """Put a skin marker on every site."""
    return tuple(SkinMarker(site.position, -site.axis) for site in sites)


def _build_true_site(limb: Limb, place: Place, random: np.random.Generator) -> TrueSite:
    position = limb.skin_point(place.angle, limb.shape.datum - place.below)
    footprint = _sample_footprint(limb, position)
    axis = limb.inward(footprint).mean(axis=0)
    axis /= np.linalg.norm(axis)
    thickness = min(limb.tissue_thickness(point, axis) for point in footprint)
    error = random.normal(size=3)
    error *= random.uniform(*HINT_ERROR_MM) / np.linalg.norm(error)
    return TrueSite(
        name=place.name,
        region=place.region,
        fitted=place.name in FITTED,
        position=position,
        axis=axis,
        depth=round(min(place.depth, SAFE_SHARE * thickness), 2),
        speed=SPEED_MM_S * (1 + SPEED_SPREAD * random.uniform(-1, 1)),
        thickness=thickness,
        hint=position + error,
    )


def _sample_footprint(limb: Limb, position: Array) -> Array:
    """Find skin points (25, 3) under a square indenter at a position, along its normal."""
    normal = -limb.inward(position[None])[0]
    proximal = limb.proximal_normal - normal * (limb.proximal_normal @ normal)
    proximal /= np.linalg.norm(proximal)
    across = np.cross(normal, proximal)
    ticks = np.linspace(-INDENTER_MM / 2, INDENTER_MM / 2, 5)
    u, v = np.meshgrid(ticks, ticks)
    points = position + u.reshape(-1, 1) * across + v.reshape(-1, 1) * proximal
    for _ in range(8):  # Newton along the normal; the field is close to a distance
        points = points - limb.skin(points)[:, None] * normal
    return points


class SecondaryMeasurements(NamedTuple):
    """What is measured of an indentation beside its force."""

    ultrasound: bool = False
    surface: bool = False
    shear_waves: bool = False


NOTHING = SecondaryMeasurements()


@dataclass(frozen=True)
class RobotRecord:
    """A record: ``time`` (n,) s, ``displacement`` (n,) mm, ``force`` (n,) N, and what it was made with."""

    time: Array
    displacement: Array
    force: Array
    clearance: float
    touch_s: float
    force_noise: float

    def write(self, path: Path) -> None:
        """Write the CSV as the robot does."""
        table = np.column_stack([self.time, self.displacement, self.force])
        np.savetxt(path, table, fmt=("%.3f", "%.4f", "%.4f"), delimiter=",", header=HEADER, comments="")


def record(ramp: Ramp, force: Callable[[Array], Array], random: np.random.Generator) -> RobotRecord:
    """Record an indentation.

    ``ramp``: depth and speed from touch-down; ``force``: force (n,) in N at times (n,) from touch-down,
    within ``[0, 2 ramp.peak_s]``; ``random``: source of clearance and noise.
    """
    clearance = random.uniform(*CLEARANCE_MM)
    sd = random.uniform(*FORCE_NOISE_N)
    touch = clearance / ramp.speed
    half = touch + ramp.peak_s
    time = np.arange(0.0, 2 * half + AFTER_S, 1 / RATE_HZ)
    displacement = np.interp(time, [0, half, 2 * half], [0, clearance + ramp.depth, 0])
    since = time - touch
    touching = (since > 0) & (since < 2 * ramp.peak_s)
    clean = np.zeros_like(time)
    clean[touching] = force(since[touching])
    return RobotRecord(
        time=time,
        displacement=displacement + DISPLACEMENT_NOISE_MM * random.standard_normal(time.size),
        force=clean + sd * random.standard_normal(time.size),
        clearance=clearance,
        touch_s=touch,
        force_noise=sd,
    )


def write_ultrasound(
    path: Path,
    made: RobotRecord,
    layers: Mapping[str, tuple[float, Callable[[Array], Array]]],
    random: np.random.Generator,
) -> None:
    """Write what ultrasound through the indenter saw of a record: thickness of tissues, mm, at 20 Hz.

    ``layers``: by tissue its thickness at rest, mm, and its compression, mm, at times (n,) from touch-down.
    """
    time = np.arange(0.0, made.time[-1], 1 / ULTRASOUND_HZ)
    since = time - made.touch_s
    columns = {"time_s": time}
    for tissue, (thickness, compression) in layers.items():
        clean = thickness - np.where(since > 0.0, compression(np.maximum(since, 0.0)), 0.0)
        columns[f"{tissue}_mm"] = clean + ULTRASOUND_NOISE_MM * random.standard_normal(time.size)
    _write_table(path, columns)


def write_surface(
    path: Path, made: RobotRecord, points: Array, moves: Callable[[Array], Array], random: np.random.Generator
) -> None:
    """Write what cameras saw of the skin around the indenter: positions at rest and displacements, at 5 Hz.

    ``points`` (k, 3) mm are at rest; ``moves`` are of all points (k, 3, n), mm, at times (n,) from
    touch-down.
    """
    time = np.arange(0.0, made.time[-1], 1 / SURFACE_HZ)
    since = time - made.touch_s
    moved = np.where(since > 0.0, moves(np.maximum(since, 0.0)), 0.0)
    moved = moved + SURFACE_NOISE_MM * random.standard_normal(moved.shape)
    columns = {"time_s": np.repeat(time, len(points))}
    columns |= dict(zip(("x_mm", "y_mm", "z_mm"), np.tile(points, (len(time), 1)).T))
    columns |= dict(zip(("ux_mm", "uy_mm", "uz_mm"), moved.transpose(1, 2, 0).reshape(3, -1)))
    _write_table(path, columns)


def write_waves(
    path: Path, made: RobotRecord, speeds: Mapping[str, Callable[[Array], Array]], random: np.random.Generator
) -> None:
    """Write what elastography through the indenter read of a record: speeds of shear waves, m/s, at 1 Hz.

    All of a tissue's readings are off together, and each by itself. ``speeds``: by tissue the speed, m/s, at
    times (n,) from touch-down.
    """
    time = np.arange(0.0, made.time[-1], 1 / WAVES_HZ)
    since = np.maximum(time - made.touch_s, 0.0)
    columns = {"time_s": time}
    for tissue, speed in speeds.items():
        off = WAVES_BIAS_M_S * random.standard_normal() + WAVES_NOISE_M_S * random.standard_normal(time.size)
        columns[f"{tissue}_m_s"] = speed(since) + off
    _write_table(path, columns)


def _write_table(path: Path, columns: Mapping[str, Array]) -> None:
    table = np.column_stack(list(columns.values()))
    np.savetxt(path, table, fmt="%.3f", delimiter=",", header=",".join(columns), comments="")


@dataclass(frozen=True)
class Discretisation:
    """How true forces are made.

    ``within_mm``: tissue farther than that from the site is left out, and what is cut is free: the bones of a
    shank hold it. In a thigh forces would be 6 % too small.
    ``softest_per_mm`` (1/mm): contact is `STIFFEST_PER_MM` stiff over thin tissue, and softer over thick
    tissue, but no softer than that: the indenter sinks in by less than a hundredth of the depth everywhere.
    """

    mesh: MeshSettings
    within_mm: float | None
    softest_per_mm: float

    def steps(self, tissue_mm: float) -> StepControl:
        """Steps and contact over so much tissue."""
        penalty = float(np.clip(PENALTY_TIMES_TISSUE / tissue_mm, self.softest_per_mm, STIFFEST_PER_MM))
        return StepControl(
            load_steps=LOAD_STEPS, unload_steps=UNLOAD_STEPS, penalty=penalty, hold_penalty=True
        )


DISCRETISATIONS = {
    "coarse": Discretisation(
        MeshSettings(edge_near_mm=3.0, edge_far_mm=28.0, near_radius_mm=14.0, growth=1.0, flatness=1.9),
        within_mm=100.0,
        softest_per_mm=100.0,
    ),
    "paper": Discretisation(
        MeshSettings(edge_near_mm=2.8, edge_far_mm=14.0, near_radius_mm=16.0),
        within_mm=None,
        softest_per_mm=STIFFEST_PER_MM,
    ),
}


def choose_discretisation(detail: str, kind: str) -> Discretisation:
    """Choose how the true forces of a kind of limb are made, for images of a detail."""
    made = DISCRETISATIONS[detail]
    return made if kind == "transtibial" else replace(made, within_mm=None)


@dataclass(frozen=True)
class ForceJob:
    """One indentation to be simulated: its site, mesh, steps, and the tissues' parameters."""

    site: TrueSite
    mesh: Mesh
    steps: StepControl
    parameters: indentation.Parameters
    measurements: SecondaryMeasurements = NOTHING


@dataclass(frozen=True)
class TrueForce:
    """The simulated force (n,) N at times (n,) s from touch-down, and facts for ``truth.json``.

    ``layers``: of each tissue on the axis its thickness at rest, mm, and its compression (n,) mm, where
    ultrasound was wanted. ``skin_points`` (k, 3) mm around the indenter and their ``skin_moves`` (k, 3, n),
    mm, where cameras were. ``speeds`` (n,) m/s of shear waves in each tissue on the axis.
    """

    times: Array
    force: Array
    facts: dict[str, float | int | str]
    layers: dict[str, tuple[float, Array]] = field(default_factory=dict)
    skin_points: Array = field(default_factory=lambda: np.zeros((0, 3)))
    skin_moves: Array = field(default_factory=lambda: np.zeros((0, 3, 0)))
    speeds: dict[str, Array] = field(default_factory=dict)


@lru_cache(maxsize=1)
def _build_base(folder: Path, settings: MeshSettings) -> tuple[Anatomy, BaseMesh]:
    """Build what all sites of a phantom share; a worker does so once."""
    anatomy = load_anatomy(folder)
    return anatomy, build_base_mesh(anatomy, settings)


def mesh_true_site(site: TrueSite, folder: Path, settings: MeshSettings, within_mm: float | None) -> Mesh:
    """Mesh one site of the anatomy in ``folder``, and keep the tissue that its force depends on."""
    anatomy, base = _build_base(folder, settings)
    mesh, _ = mesh_site(anatomy, site.position, site.axis, settings, base)
    return mesh if within_mm is None else indentation.cut_neighbourhood(mesh, site.position, within_mm).mesh


def simulate_true_force(job: ForceJob) -> TrueForce:
    """Solve one site. Raises `RunError` when the simulation does not complete."""
    site = job.site
    knots_s, knots_mm = site.ramp.knots
    model = indentation.SiteModel(
        name=site.name,
        mesh=Path(),
        mesh_digest="",
        position=tuple(site.position.tolist()),
        axis=tuple(site.axis.tolist()),
        knots_s=knots_s,
        knots_mm=knots_mm,
        indenter=IndenterTable(width_mm=INDENTER_MM, edge_radius_mm=INDENTER_EDGE_MM),
    )
    problem = replace(indentation.build_problem(model, job.mesh, job.parameters), element=ELEMENT)
    result = solve(problem, steps=job.steps, store="all" if any(job.measurements) else "peak")
    if not result.completed:
        raise RunError(f"the phantom's site {site.name} could not be simulated: {result.reason}")
    times = np.linspace(0.0, knots_s[-1], 401)
    facts: dict[str, float | int | str] = {
        "element": ELEMENT,
        "nodes": len(job.mesh.points),
        "cells": len(job.mesh.cells),
        "steps": int(result.statistics["steps"]),
        "penalty_per_mm": float(result.statistics["penalty_per_mm"]),
    }
    found = TrueForce(times, result.force_at(times), facts)
    if not any(job.measurements):
        return found
    gauges = find_gauges_along(job.mesh, site.position, site.axis) if job.measurements.ultrasound else ()
    indenter = indentation.read_indenter(model.indenter, model.position, model.axis, model.edge)
    around = np.zeros((0, 3))
    if job.measurements.surface:
        around = indentation.choose_points_around(job.mesh, indenter)
    waves = indentation.place_waves_under(model, job.mesh) if job.measurements.shear_waves else ()
    layers = tuple(gauge.region for gauge in gauges)
    model = replace(model, layers=layers, skin_points=tuple(map(tuple, around)), waves=waves)
    values, _ = indentation.observe_result(result, model, times)
    of_layers, of_skin, of_waves = np.split(values, [len(layers), len(values) - len(waves)])
    return replace(
        found,
        layers={one.region: (one.thickness_mm, row) for one, row in zip(gauges, of_layers)},
        skin_points=around,
        skin_moves=of_skin.reshape(len(around), 3, len(times)),
        speeds={one.tissue: row for one, row in zip(waves, of_waves)},
    )
