"""Simulations that also tell how far the tissue's volume changes at the deepest point."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from ...arrays import Array
from ...fe import Result, solve
from ...fe.kernel.laws import Laws
from ...fe.observables import compute_element_fields
from ...indentation import Simulation, SimulationJob, SiteModel, build_problem, build_steps, to_parameters
from ...mesh import read_vtu
from ..shared.simulations import SimulationCache

NO_VOLUME = dict.fromkeys(("J_min", "J_low", "J_high", "J_max", "beyond_percent"))
ALLOWED = 0.01  # departure of J from one that the paper's bulk modulus is to keep to


def open_volume_cache(folder: Path) -> SimulationCache:
    """Kept apart from simulations without volumes, which have the same key."""
    return SimulationCache(folder / "volumes", work=simulate_with_volumes)


def simulate_with_volumes(job: SimulationJob) -> Simulation:
    """As `indentation.simulate`, without derivatives; ``facts["volume"]`` says what became of the volumes.

    Of the elements within one width of the indenter from the site: ``J_min`` and ``J_max`` are means of
    single elements, ``J_low`` and ``J_high`` bound the middle 98 % of the volume, ``beyond_percent`` is the
    share of the volume whose J is more than 1 % from one.
    """
    model = job.model
    parameters = to_parameters(job.parameters, job.tissues, job.model.law)
    problem = build_problem(model, read_vtu(model.mesh), parameters)
    result = solve(problem, steps=build_steps(model), store="peak")
    return Simulation(
        site=model.name,
        force_N=result.force_at(np.array(job.times_s) + model.waits_s),
        jacobian=None,
        completed=result.completed,
        reason=result.reason,
        penetration_mm=float(result.penetration.max(initial=0.0)),
        facts=dict(result.statistics) | {"volume": _compute_volume_ratio(result, model)},
        doubts=result.doubts,
    )


def _compute_volume_ratio(result: Result, model: SiteModel) -> dict[str, Any]:
    if not result.states:
        return dict(NO_VOLUME)
    problem = result.problem
    laws = Laws.build([problem.materials[name] for name in problem.mesh.region_names])
    J = compute_element_fields(result.system, laws, result.states[-1]).J
    centres = problem.mesh.points[problem.mesh.corners].mean(axis=1)
    near = np.linalg.norm(centres - np.array(model.position), axis=1) < model.indenter.width_mm
    return summarise_volumes(J[near], result.system.weights.sum(axis=1)[near])


def summarise_volumes(J: Array, volumes: Array) -> dict[str, float]:
    """What is told of ratios of volumes J (m,) of elements of ``volumes`` (m,)."""
    order = np.argsort(J)
    share = np.cumsum(volumes[order]) / volumes.sum()
    low, high = np.interp([0.01, 0.99], share, J[order]).tolist()
    beyond = float(volumes[np.abs(J - 1.0) > ALLOWED].sum() / volumes.sum())
    return {
        "J_min": float(J.min()),
        "J_low": low,
        "J_high": high,
        "J_max": float(J.max()),
        "beyond_percent": 100.0 * beyond,
    }
