"""The record of the indentation robot: a clean force history becomes a noisy 500 Hz record with slack.

The robot starts clear of the skin, moves at constant speed to its depth, straight back to where it started,
and records a little longer. Its displacement counts from the start, not from touch-down.

The true forces are those of the implicit anatomy, meshed and stepped otherwise than a calibration does. The
mesh comes from the exact surfaces, not from the segmented image, and is finer than the study's where the
indenter presses; the element has twice its quadrature points (FEBio's rule), and like the study's default one
mean dilatation each: with the pressure as it comes, forces of such meshes are 5 to 20 % too large
(docs/convergence.md), which a calibration would put into the moduli.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ..anatomy.meshing.meshing import BaseMesh, MeshSettings, build_base_mesh, mesh_site
from ..anatomy.surfaces.surfaces import Anatomy, load_anatomy
from ..arrays import Array
from ..errors import RunError
from ..fe import StepControl, solve
from ..indentation import (
    Parameters,
    SiteModel,
    build_problem,
    choose_points_around,
    cut_neighbourhood,
    observe_result,
    place_waves_under,
    read_indenter,
)
from ..mesh import Mesh, find_gauges_along
from ..study import IndenterTable
from .sites import INDENTER_EDGE_MM, INDENTER_MM, Ramp, TrueSite

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

    Parameters
    ----------
    ramp : depth and speed from touch-down.
    force : force (n,) in N at times (n,) from touch-down, within ``[0, 2 ramp.peak_s]``.
    random : source of clearance and noise.
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
    path: Path,
    made: RobotRecord,
    points: Array,
    moves: Callable[[Array], Array],
    random: np.random.Generator,
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
    path: Path,
    made: RobotRecord,
    speeds: Mapping[str, Callable[[Array], Array]],
    random: np.random.Generator,
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
    parameters: Parameters
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
    return mesh if within_mm is None else cut_neighbourhood(mesh, site.position, within_mm).mesh


def simulate_true_force(job: ForceJob) -> TrueForce:
    """Solve one site. Raises `RunError` when the simulation does not complete."""
    site = job.site
    knots_s, knots_mm = site.ramp.knots
    model = SiteModel(
        name=site.name,
        mesh=Path(),
        mesh_digest="",
        position=tuple(site.position.tolist()),
        axis=tuple(site.axis.tolist()),
        knots_s=knots_s,
        knots_mm=knots_mm,
        indenter=IndenterTable(width_mm=INDENTER_MM, edge_radius_mm=INDENTER_EDGE_MM),
    )
    problem = replace(build_problem(model, job.mesh, job.parameters), element=ELEMENT)
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
    indenter = read_indenter(model.indenter, model.position, model.axis, model.edge)
    around = choose_points_around(job.mesh, indenter) if job.measurements.surface else np.zeros((0, 3))
    waves = place_waves_under(model, job.mesh) if job.measurements.shear_waves else ()
    layers = tuple(gauge.region for gauge in gauges)
    model = replace(model, layers=layers, skin_points=tuple(map(tuple, around)), waves=waves)
    values, _ = observe_result(result, model, times)
    of_layers, of_skin, of_waves = np.split(values, [len(layers), len(values) - len(waves)])
    return replace(
        found,
        layers={one.region: (one.thickness_mm, row) for one, row in zip(gauges, of_layers)},
        skin_points=around,
        skin_moves=of_skin.reshape(len(around), 3, len(times)),
        speeds={one.tissue: row for one, row in zip(waves, of_waves)},
    )
