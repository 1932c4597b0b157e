"""The phantom's true forces: its implicit anatomy, meshed and stepped otherwise than a calibration does.

The mesh comes from the exact surfaces, not from the segmented image, and is finer than the study's; the
element has twice its quadrature points (FEBio's rule), and like the study's default one mean dilatation
each: with the pressure as it comes, forces of such meshes are 5 to 20 % too large (docs/convergence.md),
which a calibration would put into the moduli.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..anatomy.meshing.meshing import BaseMesh, MeshSettings, base_mesh, mesh_site
from ..anatomy.surfaces.surfaces import Anatomy, load_anatomy
from ..errors import RunError
from ..fe import StepControl, solve
from ..indentation import Parameters, SiteModel, build_problem
from ..study import IndenterTable
from .record import Ramp
from .sites import INDENTER_EDGE_MM, INDENTER_MM

ELEMENT = "tet10g8p0"
PENALTY_PER_MM = 400.0  # the indenter sinks in by less than a hundredth of the depth everywhere
STEPS = StepControl(load_steps=12, unload_steps=16, penalty=PENALTY_PER_MM, hold_penalty=True)
MESHES = {
    "coarse": MeshSettings(edge_near_mm=2.8, edge_far_mm=28.0, near_radius_mm=14.0, growth=0.8, flatness=1.6),
    "paper": MeshSettings(edge_near_mm=2.8, edge_far_mm=14.0, near_radius_mm=16.0),
}


@dataclass(frozen=True)
class ForceJob:
    """One indentation to be simulated: where the anatomy is stored, place, ramp, the tissues' parameters."""

    site: str
    anatomy: Path
    position: tuple[float, float, float]
    axis: tuple[float, float, float]
    ramp: Ramp
    parameters: Parameters
    mesh: MeshSettings


@dataclass(frozen=True)
class TrueForce:
    """What came back: force (n,) N at times (n,) s from touch-down, and facts for ``truth.json``."""

    site: str
    times: NDArray[np.float64]
    force: NDArray[np.float64]
    facts: dict[str, float | int | str]


@lru_cache(maxsize=1)
def _base(folder: Path, settings: MeshSettings) -> tuple[Anatomy, BaseMesh]:
    """What all sites of a phantom share; a worker makes it once."""
    anatomy = load_anatomy(folder)
    return anatomy, base_mesh(anatomy, settings)


def site_force(job: ForceJob) -> TrueForce:
    """Mesh and solve one site.

    Raises
    ------
    RunError
        When the simulation does not complete.
    """
    anatomy, base = _base(job.anatomy, job.mesh)
    mesh, _ = mesh_site(anatomy, np.array(job.position), np.array(job.axis), job.mesh, base)
    knots_s, knots_mm = job.ramp.knots
    model = SiteModel(
        name=job.site,
        mesh=Path(),
        mesh_digest="",
        position=job.position,
        axis=job.axis,
        knots_s=knots_s,
        knots_mm=knots_mm,
        indenter=IndenterTable(width_mm=INDENTER_MM, edge_radius_mm=INDENTER_EDGE_MM),
    )
    problem = build_problem(model, mesh, job.parameters)
    result = solve(replace(problem, element=ELEMENT), steps=STEPS)
    if not result.completed:
        raise RunError(f"the phantom's site {job.site} could not be simulated: {result.reason}")
    times = np.linspace(0.0, knots_s[-1], 401)
    facts: dict[str, float | int | str] = {
        "element": ELEMENT,
        "nodes": len(mesh.points),
        "cells": len(mesh.cells),
    }
    return TrueForce(job.site, times, result.force_at(times), facts)
