"""Simulations of a site as jobs for any process, and what a process keeps of a site between them.

`simulate` is the one function that every stage, executor and phantom calls.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import psutil

from ..arrays import Array
from ..execution import count_usable_cores
from ..extensions import compute_extensions_digest
from ..fe import Problem, Result, SimulationWarning, StepControl, System, solve
from ..fields import Animation, write_fields
from ..laws import LAWS, OGDEN, to_parameters
from ..mesh import read_vtu
from .neighbourhood import Extension, cut_neighbourhood
from .observing import observe_result
from .sites import Parameters, SiteModel, build_problem, build_site_materials, build_steps


@dataclass(frozen=True)
class SimulationJob:
    """A simulation to be done: parameters (flat over ``tissues``, kPa), and the times of the force.

    ``starts``: other parameters, whose simulation gives the first guesses, and those that gave them theirs,
    the first from rest; several times quicker where they are near. Forces then differ within the solver's
    tolerance, and by nothing else. ``nested_mm``: first guesses are those of the same job, with derivatives,
    on no more of the mesh than this distance from the site; ``starts`` are then that one's.
    """

    model: SiteModel
    tissues: tuple[str, ...]
    parameters: tuple[float, ...]
    times_s: tuple[float, ...]
    sensitivities: bool = True
    starts: tuple[tuple[float, ...], ...] = ()
    nested_mm: float | None = None

    @property
    def nested_job(self) -> SimulationJob | None:
        """The job on a part of the mesh whose simulation gives the first guesses, where there is one."""
        if self.nested_mm is None:
            return None
        model = replace(self.model, within_mm=self.nested_mm)
        return replace(self, model=model, sensitivities=True, nested_mm=None)


@dataclass(frozen=True)
class Simulation:
    """The result of a job: force (n,) N and its derivatives (n, p) at the job's times.

    Where a force drives the indenter, ``force_N`` is what answers to it: the displacement, mm.

    Derivatives are in flat order, per kPa, -, -, s.  ``doubts``: the warnings about it, by kind. ``observed``
    (g, n) holds what else is observed, in rows: the thickness that each of the model's layers has lost, then
    the moves of each of its points of the skin along the model's axes, mm, and the speeds of its shear waves,
    m/s. ``observed_jacobian`` (g, n, p) are its derivatives.
    """

    site: str
    force_N: Array
    jacobian: Array | None
    completed: bool
    reason: str
    penetration_mm: float
    facts: dict[str, Any]
    doubts: tuple[SimulationWarning, ...] = ()
    observed: Array = field(default_factory=lambda: np.zeros((0, 0)))
    observed_jacobian: Array | None = None

    @property
    def warnings(self) -> tuple[str, ...]:
        """The texts of the warnings about it."""
        return tuple(doubt.text for doubt in self.doubts)


# Nodes of the sites that a process keeps, four of the largest usual ones, and the bytes that each costs;
# processes on all cores keep no more than a share of the machine's memory.
_MAX_NODES, _BYTES_PER_NODE, _MEMORY_SHARE = 200_000, 25_000, 0.5
# The tissue that sets a site's contact penalty, whatever law the site's own have.
_REFERENCE_TISSUE = {"c_kPa": 5.0, "m": 5.0, "gamma": 1.0, "tau_s": 1.0}
# To the deepest point; from the indenter's edge.  With 4 steps and 20 mm more the penalty of the demo's six
# sites is the same within 0.3 %, for twice the time.
_REFERENCE_STEPS, _REFERENCE_RADIUS_MM = 3, 35.0
# Of the penetration that is allowed: three of 24 tissues drawn over the bounds then go beyond it.
_PENETRATION_MARGIN = 0.5


@dataclass
class PreparedSite:
    """What a process keeps of a site for its next simulations.

    ``problem``, ``system`` and ``penalty`` (of contact, 1/mm; None: the solver's first) follow from the site
    alone. ``kept``: the newest simulations with their jobs: from rest with sensitivities and without, from
    first guesses, and of those that gave such to others; with all states where they have sensitivities or
    more than the force is read from them, else the deepest. ``extension``: from a neighbourhood of that
    radius to the whole.
    """

    problem: Problem
    system: System
    penalty: float | None
    kept: dict[str, tuple[SimulationJob, Result]] = field(default_factory=dict)
    extension: tuple[float, Extension] | None = None


# By model, tissues and what the files of its extensions hold: a session may change those between two calls.
_prepared: OrderedDict[tuple[SiteModel, tuple[str, ...], str], PreparedSite] = OrderedDict()


def _prepare(model: SiteModel, tissues: tuple[str, ...]) -> PreparedSite:
    """The site's discretisation and contact penalty; sites not used for longest are forgotten."""
    key = model, tissues, compute_extensions_digest(model.extensions)
    known = _prepared.get(key)
    if known is None:
        problem = _build_reference_problem(model, tissues)
        control = build_steps(model)
        penalty, system = control.penalty, System(problem, control.threads)
        if penalty is None:
            within = _REFERENCE_RADIUS_MM + model.indenter.width_mm / 2.0
            if model.within_mm is not None:
                within = min(within, model.within_mm)
            # Under a stated force too it is driven by its displacement; nothing else moves the limb.
            near = replace(model, clamps=None, course=(), prestretch=(), knots_N=(), within_mm=within)
            allowed = _PENETRATION_MARGIN * control.penetration
            yielding = _estimate_yielding(near, tissues, key[-1])
            penalty = max(yielding / allowed, 2000.0 / model.indenter.width_mm)
        known = _prepared[key] = PreparedSite(problem, system, penalty)
    _prepared.move_to_end(key)
    most = count_stored_nodes(psutil.virtual_memory().total, count_usable_cores())
    while len(_prepared) > 1 and sum(len(one.problem.mesh.points) for one in _prepared.values()) > most:
        _prepared.popitem(last=False)
    return known


def _build_reference_problem(model: SiteModel, tissues: tuple[str, ...]) -> Problem:
    parameters = dict.fromkeys(tissues, _REFERENCE_TISSUE)
    return build_problem(replace(model, law=OGDEN), read_vtu(model.mesh), parameters)


def count_stored_nodes(memory: float, cores: int) -> int:
    """Nodes of the sites that a process keeps on a machine with so many bytes and cores."""
    return min(_MAX_NODES, int(_MEMORY_SHARE * memory / (cores * _BYTES_PER_NODE)))


@lru_cache(maxsize=64)
def _estimate_yielding(model: SiteModel, tissues: tuple[str, ...], extensions_digest: str) -> float:
    """Penetration of the indenter into reference tissue over its travel, times the contact penalty (1/mm).

    Over the penetration that is allowed it is the penalty, which all simulations of a site hold.  One that
    each found for itself would change in steps with the parameters, and the force by a percent with it; one
    taken over from the simulation before makes the answer depend on what that was.  Where other tissue lets
    the indenter sink in farther, the result says so.  Zero where the reference goes nowhere.
    """
    problem = _build_reference_problem(model, tissues)
    times = tuple(problem.history.loading_s * np.arange(1, _REFERENCE_STEPS + 1) / _REFERENCE_STEPS)
    found = solve(problem, steps=replace(build_steps(model), times=times), store="peak")
    if not found.states:
        return 0.0
    return float(found.penetration[-1] / found.displacement[-1]) * found.states[-1].penalty


def _solve(model: SiteModel, parameters: Parameters, **how: Any) -> Result:
    """Simulate a site with what is prepared for it: the same answer, whatever was simulated before."""
    known = _prepare(model, tuple(parameters))
    return solve(
        known.problem.with_materials(build_site_materials(model, parameters)),
        steps=build_first_steps(model, tuple(parameters)),
        system=known.system,
        **how,
    )


def _solve_job(job: SimulationJob) -> Result:
    """A job's simulation, from the first guesses that it states; not done again where that is kept."""
    model, known, wanted = job.model, _prepare(job.model, job.tissues), replace(job, times_s=())
    for one, kept in known.kept.values():
        if one == wanted:
            return kept
    from_rest = not job.starts and job.nested_mm is None
    found = _solve(
        model,
        to_parameters(np.array(job.parameters), job.tissues, model.law),
        sensitivities=job.sensitivities,
        warm_start=None if from_rest else _prepare_guesses(job, known),
        store="all" if job.sensitivities or model.gauges else "peak",
    )
    # Sensitivities are most of a state's memory; a first guess needs few digits of them.
    single = [None if s.sensitivity is None else s.sensitivity.astype(np.float32) for s in found.states]
    pairs = zip(found.states, single, strict=True)
    states = (replace(state, sensitivity=d) for state, d in pairs)  # type: ignore[arg-type]
    found = replace(found, states=tuple(states))
    known.kept[f"from rest, {job.sensitivities}" if from_rest else "from guesses"] = wanted, found
    return found


def _prepare_guesses(job: SimulationJob, known: PreparedSite) -> Result:
    """The simulation that gives a job's first guesses, on its own mesh or carried on into it."""
    if job.nested_job is None:
        guess = replace(job, parameters=job.starts[-1], starts=job.starts[:-1], sensitivities=True)
        found = _solve_job(guess)
        if guess.starts:
            known.kept["of guesses"] = replace(guess, times_s=()), found
        return found
    near = _solve_job(job.nested_job)
    radius, centre = job.nested_mm, np.array(job.model.position)
    if known.extension is None or known.extension[0] != radius:
        assert radius is not None
        part = cut_neighbourhood(known.problem.mesh, centre, radius)
        known.extension = radius, Extension(known.system, part, centre, radius)
    return known.extension[1].guesses(near)


def build_first_steps(model: SiteModel, tissues: Sequence[str]) -> StepControl:
    """`build_steps`, with the contact penalty that every simulation of the site holds."""
    return replace(build_steps(model), penalty=_prepare(model, tuple(tissues)).penalty, hold_penalty=True)


def simulate(job: SimulationJob) -> Simulation:
    """Simulate a job; a failure is a result with a reason, never an exception.

    The answer depends on the job alone: not on the process, nor on what it simulated before. The simulation
    that a job starts from is done again where this process has not kept it.
    """
    model, result = job.model, _solve_job(job)
    times = np.array(job.times_s) + model.waits_s
    seen, slopes = observe_result(result, model, times) if model.gauges else (np.zeros((0, 0)), None)
    return Simulation(
        site=model.name,
        force_N=result.response_at(times),
        jacobian=_to_user_units(result, job, result.response_sensitivity_at(times))
        if job.sensitivities
        else None,
        completed=result.completed,
        reason=result.reason,
        penetration_mm=float(result.penetration.max(initial=0.0)),
        facts=dict(result.statistics),
        doubts=result.doubts,
        observed=seen,
        observed_jacobian=None if slopes is None else _to_user_units(result, job, slopes),
    )


def simulate_fields(
    model: SiteModel, parameters: Parameters, file: Path, animation: Path | None = None
) -> Result:
    """Simulate an indentation and store its fields at the deepest point as VTU (see `fields`).

    With ``animation`` (a ``.pvd``) the fields of every step are stored too.  A simulation that fails in its
    first step has no fields at its deepest point, and ``file`` is not written.
    """
    frames = None
    if animation is not None:
        prepared = _prepare(model, tuple(parameters)).problem
        frames = Animation(prepared.with_materials(build_site_materials(model, parameters)), animation)
    result = _solve(model, parameters, on_step=None if frames is None else frames.add, store="peak")
    _write_deepest(result, file)
    return result


def store_job_fields(job: SimulationJob, file: Path) -> None:
    """Fields of a job's simulation as `simulate_fields` stores them; it is done where this process has not
    just done it."""
    _write_deepest(_solve_job(job), file)


def _write_deepest(result: Result, file: Path) -> None:
    if result.deepest is not None:
        write_fields(result.system, result.problem, result.deepest, file)


def _to_user_units(result: Result, job: SimulationJob, slopes: Array) -> Array:
    """Derivatives (..., p) of the solver in flat order, per kPa where the parameter is a modulus.

    A tissue that does not reach the site is no region of its mesh: nothing depends on it.
    """
    order = {name: i for i, name in enumerate(result.parameter_names)}
    wanted = [(tissue, p) for tissue in job.tissues for p in LAWS[job.model.law].parameters]
    columns = np.zeros((*slopes.shape[:-1], len(wanted)))
    for i, (tissue, parameter) in enumerate(wanted):
        j = order.get((tissue, parameter.name))
        if j is not None:
            columns[..., i] = slopes[..., j] * parameter.scale
    return columns
