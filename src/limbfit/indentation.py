"""A study's site as a mechanical problem, and what is observed in it.

``SiteModel`` is everything about one indentation but the parameters; it travels to worker processes as paths
and numbers. ``simulate`` is the one function that every stage, executor and phantom calls.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from vtkmodules.util.numpy_support import vtk_to_numpy
from vtkmodules.vtkCommonCore import vtkCommand
from vtkmodules.vtkIOGeometry import vtkSTLReader

from .errors import ProblemError, SurfaceError
from .fe import (
    Doubt,
    History,
    Indenter,
    OgdenQLV,
    Problem,
    Result,
    RigidSurface,
    State,
    StepControl,
    System,
    solve,
)
from .fields import Animation, write_fields
from .mesh import Mesh, read_vtu
from .phases import spread
from .study import PARAMETERS, IndenterTable, SolverTable, Vector

Parameters = dict[str, dict[str, float]]
Array = NDArray[np.float64]

KPA = 1e-3  # MPa
_FE_NAME = {"c_kPa": "c", "m": "m", "gamma": "gamma", "tau_s": "tau"}


def flat_names(tissues: Sequence[str]) -> tuple[tuple[str, str], ...]:
    """(tissue, parameter) in the order of every flat vector: the first tissue's four, then the next one's."""
    return tuple((tissue, name) for tissue in tissues for name in PARAMETERS)


def to_vector(parameters: Parameters, tissues: Sequence[str]) -> Array:
    """The 4 numbers of each tissue in flat order (c in kPa)."""
    return np.array([parameters[tissue][name] for tissue, name in flat_names(tissues)])


def to_parameters(vector: Array, tissues: Sequence[str]) -> Parameters:
    """The flat vector as ``{tissue: {name: value}}``, tissues in their order."""
    result: Parameters = {tissue: {} for tissue in tissues}
    for (tissue, name), value in zip(flat_names(tissues), vector, strict=True):
        result[tissue][name] = float(value)
    return result


@dataclass(frozen=True)
class SiteModel:
    """One indentation but for the material: mesh file, indenter and displacement history.

    ``position``, ``axis`` and ``edge`` in LPS mm; ``knots_s`` and ``knots_mm`` are the piecewise linear
    displacement since touch-down; ``indenter_digest`` is that of the indenter's file, where it has one.
    """

    name: str
    mesh: Path
    mesh_digest: str
    position: tuple[float, float, float]
    axis: tuple[float, float, float]
    knots_s: tuple[float, ...]
    knots_mm: tuple[float, ...]
    edge: tuple[float, float, float] | None = None
    indenter: IndenterTable = field(default_factory=IndenterTable)
    indenter_digest: str = ""
    kappa_ratio: float = 100.0
    steps: SolverTable = field(default_factory=SolverTable)
    element: str = ""  # row of the element table; by default that of the mesh's cell type

    @property
    def history(self) -> History:
        """The advance of the indenter."""
        return History(np.array(self.knots_s), np.array(self.knots_mm))

    def curve_times(self, points: int) -> Array:
        """About ``points`` times (k,) s that show the force, all phases and corners among them."""
        return spread(self.history.phases, points, self.history.times)


@dataclass(frozen=True)
class SimulationJob:
    """A simulation to be done: parameters (flat over ``tissues``, kPa), the times of the wanted force.

    ``start``: other parameters, whose simulation from rest gives the first guesses; several times quicker
    where they are near. Forces then differ within the solver's tolerance, and by nothing else.
    """

    model: SiteModel
    tissues: tuple[str, ...]
    parameters: tuple[float, ...]
    times_s: tuple[float, ...]
    sensitivities: bool = True
    start: tuple[float, ...] | None = None


@dataclass(frozen=True)
class Simulation:
    """What came back: force (n,) N and its derivatives (n, 4 x tissues) at the job's times.

    Derivatives are in flat order, per kPa, -, -, s.  ``doubts``: what is doubtful about it, by kind.
    """

    site: str
    force_N: Array
    jacobian: Array | None
    completed: bool
    reason: str
    penetration_mm: float
    facts: dict[str, Any]
    doubts: tuple[Doubt, ...] = ()

    @property
    def warnings(self) -> tuple[str, ...]:
        """What is doubtful about it, in words."""
        return tuple(doubt.text for doubt in self.doubts)


def materials(parameters: Parameters, kappa_ratio: float) -> dict[str, OgdenQLV]:
    """The tissues for the solver, in MPa."""
    return {
        tissue: OgdenQLV(
            c=values["c_kPa"] * KPA,
            m=values["m"],
            gamma=values["gamma"],
            tau=values["tau_s"],
            kappa_ratio=kappa_ratio,
        )
        for tissue, values in parameters.items()
    }


def build_problem(model: SiteModel, mesh: Mesh, parameters: Parameters) -> Problem:
    """The site's boundary-value problem: node sets ``fixed_*`` held, skin in contact with the indenter.

    Only skin near the indenter enters the contact: what it cannot reach costs time for nothing.
    """
    indenter = read_indenter(model.indenter, model.position, model.axis, model.edge)
    faces = mesh.face_sets["skin"]
    reach = indenter.width * 0.71 + max(model.knots_mm) + 8.0
    near = np.linalg.norm(mesh.points[faces[:, :3]].mean(axis=1) - model.position, axis=1) < reach
    return Problem(
        mesh=mesh,
        materials=materials(parameters, model.kappa_ratio),
        fixed=np.unique(np.concatenate([n for s, n in mesh.node_sets.items() if s.startswith("fixed_")])),
        contact_faces=faces[near],
        indenter=indenter,
        history=model.history,
        friction=model.indenter.friction,
        element=model.element,
    )


def read_indenter(table: IndenterTable, position: Vector, axis: Vector, edge: Vector | None) -> Indenter:
    """The indenter at a site; reads the surface of shape ``stl``, whose path must be one of this machine.

    Raises
    ------
    InputError
        For a surface that cannot be read, or that is no indenter.
    """
    file, surface = table.file, None
    if file is not None:
        points, faces = _read_stl(file)
        try:
            surface = RigidSurface(points, faces)
        except ProblemError as error:
            raise ProblemError(error.what, file=file, remedy=error.remedy) from None
    return Indenter(
        shape=table.shape,
        width=table.width_mm,
        edge_radius=table.edge_radius_mm,
        centre=np.array(position),
        axis=np.array(axis),
        edge=None if edge is None else np.array(edge),
        surface=surface,
    )


def _read_stl(file: Path) -> tuple[Array, NDArray[np.int64]]:
    """Points (n, 3) and faces (m, 3) of an STL file, coincident points merged.

    The reader of `anatomy` would load images and graphics into every worker that only solves.
    """
    reader = vtkSTLReader()
    reader.SetFileName(str(file))
    reader.AddObserver(vtkCommand.ErrorEvent, lambda *_: None)  # the error below says it
    reader.Update()
    found = reader.GetOutput()
    if not found.GetNumberOfPolys():
        raise SurfaceError("holds no triangles", file=file, remedy="export the surface as STL again")
    faces = vtk_to_numpy(found.GetPolys().GetConnectivityArray()).reshape(-1, 3).astype(np.int64)
    a, b, c = faces.T
    return vtk_to_numpy(found.GetPoints().GetData()), faces[(a != b) & (b != c) & (c != a)]


_KEPT_NODES = 200_000  # of the sites that a worker keeps: four of the largest usual ones, some 5 GB in all
_REFERENCE = {"c_kPa": 5.0, "m": 5.0, "gamma": 1.0, "tau_s": 1.0}  # tissue that sets a site's contact penalty
_REFERENCE_STEPS = 4  # to the deepest point
# Of the penetration that is allowed: two of 24 tissues drawn over the bounds then go 1.3 times beyond it.
_MARGIN = 0.3


@dataclass
class Prepared:
    """What a process keeps of a site for its next simulations.

    ``problem``, ``system`` and ``penalty`` (of contact, 1/mm; None: the solver's first) follow from the site
    alone. ``rested``: the newest simulation from rest with its parameters; one with sensitivities (True) with
    all of its states, one without (False) with the deepest.
    """

    problem: Problem
    system: System
    penalty: float | None
    rested: dict[bool, tuple[tuple[float, ...], Result]] = field(default_factory=dict)


_prepared: OrderedDict[tuple[SiteModel, tuple[str, ...]], Prepared] = OrderedDict()


def _prepare(model: SiteModel, tissues: tuple[str, ...]) -> Prepared:
    """The site's discretisation and contact penalty; sites not used for longest are forgotten."""
    known = _prepared.get((model, tissues))
    if known is None:
        problem = build_problem(model, read_vtu(model.mesh), dict.fromkeys(tissues, _REFERENCE))
        control = steps_of(model)
        system = System(problem, control.threads)
        penalty = control.penalty
        if penalty is None:
            penalty = _reference_penalty(problem, control, system)
        known = _prepared[model, tissues] = Prepared(problem, system, penalty)
    _prepared.move_to_end((model, tissues))
    while (
        len(_prepared) > 1 and sum(len(one.problem.mesh.points) for one in _prepared.values()) > _KEPT_NODES
    ):
        _prepared.popitem(last=False)
    return known


def _reference_penalty(problem: Problem, control: StepControl, system: System) -> float | None:
    """The contact penalty that reference tissue needs at the deepest point it reaches; None where at none.

    All simulations of a site hold it.  One that each found for itself would change in steps with the
    parameters, and the force by a percent with it; one taken over from the simulation before makes the answer
    depend on what that was.  Where other tissue lets the indenter sink in farther, the result says so.
    """
    deepest = problem.history.peak or float(problem.history.times[-1])
    times = tuple(deepest * np.arange(1, _REFERENCE_STEPS + 1) / _REFERENCE_STEPS)
    control = replace(control, times=times, penetration=_MARGIN * control.penetration)
    found = solve(problem, steps=control, store="peak", system=system)
    return found.states[0].penalty if found.states else None


def _solve(model: SiteModel, parameters: Parameters, **how: Any) -> Result:
    """Simulate a site with what is prepared for it: the same answer, whatever was simulated before."""
    known = _prepare(model, tuple(parameters))
    return solve(
        known.problem.with_materials(materials(parameters, model.kappa_ratio)),
        steps=first_steps(model, tuple(parameters)),
        system=known.system,
        **how,
    )


def _solve_from_rest(
    model: SiteModel, tissues: tuple[str, ...], parameters: tuple[float, ...], sensitivities: bool = True
) -> Result:
    """Simulate a site and keep that (see `Prepared`), unless this was the newest such simulation."""
    known = _prepare(model, tissues)
    kept = known.rested.get(sensitivities)
    if kept is None or kept[0] != parameters:
        values, store = to_parameters(np.array(parameters), tissues), "all" if sensitivities else "peak"
        found = _solve(model, values, sensitivities=sensitivities, store=store)
        kept = parameters, replace(found, states=tuple(map(_lightened, found.states)))
        known.rested[sensitivities] = kept
    return kept[1]


def _lightened(state: State) -> State:
    """Sensitivities are most of a state's memory; a first guess needs few digits of them."""
    single = None if state.sensitivity is None else state.sensitivity.astype(np.float32)
    return replace(state, sensitivity=single)  # type: ignore[arg-type]


def first_steps(model: SiteModel, tissues: Sequence[str]) -> StepControl:
    """`steps_of`, with the contact penalty that every simulation of the site holds."""
    return replace(steps_of(model), penalty=_prepare(model, tuple(tissues)).penalty, hold_penalty=True)


def steps_of(model: SiteModel) -> StepControl:
    """How the solver steps through a site's history, before it adapts."""
    table = model.steps
    control = StepControl(load_steps=table.load_steps, unload_steps=table.unload_steps)
    if table.penalty_per_mm is None:
        return control
    return replace(control, penalty=table.penalty_per_mm, hold_penalty=True)


def simulate(job: SimulationJob) -> Simulation:
    """Simulate a job; a failure is a result with a reason, never an exception.

    The answer depends on the job alone: not on the process, nor on what it simulated before. The simulation
    that a job starts from is done again where this process has not kept it.
    """
    model = job.model
    if job.start is None:
        result = _solve_from_rest(model, job.tissues, job.parameters, job.sensitivities)
    else:
        parameters = to_parameters(np.array(job.parameters), job.tissues)
        warm = _solve_from_rest(model, job.tissues, job.start)
        result = _solve(model, parameters, sensitivities=job.sensitivities, warm_start=warm, store="peak")
    times = np.array(job.times_s)
    return Simulation(
        site=model.name,
        force_N=result.force_at(times),
        jacobian=_in_user_units(result, job.tissues, times) if job.sensitivities else None,
        completed=result.completed,
        reason=result.reason,
        penetration_mm=float(result.penetration.max(initial=0.0)),
        facts=dict(result.statistics),
        doubts=result.doubts,
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
        frames = Animation(prepared.with_materials(materials(parameters, model.kappa_ratio)), animation)
    result = _solve(model, parameters, on_step=None if frames is None else frames.add, store="peak")
    _write_deepest(result, file)
    return result


def rested_fields(model: SiteModel, parameters: Parameters, file: Path, sensitivities: bool) -> None:
    """Fields as `simulate_fields` stores them, of a simulation from rest that `simulate` keeps.

    Which of the two, with or without sensitivities, is to be stated: they differ within the solver's
    tolerance. It is done where this process has not just done it.
    """
    tissues = tuple(parameters)
    vector = tuple(map(float, to_vector(parameters, tissues)))
    _write_deepest(_solve_from_rest(model, tissues, vector, sensitivities), file)


def _write_deepest(result: Result, file: Path) -> None:
    if result.deepest is not None:
        write_fields(result.system, result.problem, result.deepest, file)


def _in_user_units(result: Result, tissues: Sequence[str], times: Array) -> Array:
    """Sensitivities in flat order, per kPa where the parameter is a modulus.

    A tissue that does not reach the site is no region of its mesh: the force does not depend on it.
    """
    order = {name: i for i, name in enumerate(result.parameter_names)}
    found = result.sensitivity_at(times)
    columns = np.zeros((len(times), len(PARAMETERS) * len(tissues)))
    for i, (tissue, name) in enumerate(flat_names(tissues)):
        j = order.get((tissue, _FE_NAME[name]))
        if j is not None:
            columns[:, i] = found[:, j] * (KPA if name == "c_kPa" else 1.0)
    return columns
