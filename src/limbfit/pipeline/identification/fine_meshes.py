"""From the meshes of a search to the study's own, and what those lack beside infinitely fine ones."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from ...arrays import Array
from ...errors import RunError
from ...identify.fit.calibration import Calibration
from ...identify.fit.multifidelity import MeshCorrection
from ...study.meshing import MeshTable
from ..engine.context import Context
from ..limb.mesh import MeshJob, mesh_settings, plan_meshes, scale_edges
from ..limb.remesh import mesh_where_possible
from ..records.records import RecordSet, SiteRecord
from ..simulation.extrapolation import MESH_ORDERS, estimate_fine_error
from .problem import CalibrationProblem
from .record_simulator import RecordSimulator, Responses

COARSENING_FACTOR = 1.3  # of the edges and the steps: another mesh that tells the error of the study's own
NO_MESH_ERROR = "intervals do not count the error of the site's own mesh"


@dataclass(frozen=True)
class FineMeshCorrection:
    """Responses at an answer, what brings those of a search to the study's own meshes as they were there,
    and one standard deviation (n,) N of what these lack at every site: none where no other mesh tells.

    ``simulations``: how many of meshes made for it alone it took.
    """

    responses: Responses
    as_fine: Callable[[Responses], Responses]
    mesh_N: tuple[Array, ...] = ()
    simulations: int = 0


def correct_to_fine_meshes(
    problem: CalibrationProblem, simulator: RecordSimulator, parameters: Array
) -> FineMeshCorrection:
    """The responses at an answer, and what brings those of the search to the study's own meshes.

    Raises `RunError` where a site cannot be simulated there.
    """
    searched = simulator.search(parameters)
    correction = FineMeshCorrection(searched, list)
    if simulator.records.is_coarsened:
        as_fine = MeshCorrection(searched, simulator.check(parameters))
        correction = FineMeshCorrection(as_fine(searched), as_fine)
    if problem.study.mesh.coarse is not None:
        errors = _estimate_mesh_errors(problem, simulator, parameters, searched, simulator.records.own)
        correction = replace(correction, mesh_N=errors)
    for one in correction.responses:
        if not one.completed:
            raise RunError(f"site {one.site} cannot be simulated at the answer: {one.reason}")
    return correction


def plan_coarser_meshes(context: Context, records: RecordSet, folder: Path) -> list[MeshJob]:
    """Coarser meshes that tell the error of the study's own, in ``folder``; none where it has coarse ones."""
    if context.study.mesh.coarse is not None:
        return []
    coarser = scale_edges(mesh_settings(context.study), COARSENING_FACTOR)
    folder.mkdir(exist_ok=True)
    models = (record.model for record in records.own)
    return plan_meshes(context, folder, ((one.site, one.position, one.axis) for one in models), coarser)


def correct_answer(
    problem: CalibrationProblem,
    simulator: RecordSimulator,
    answer: Calibration,
    coarser: Sequence[MeshJob],
) -> FineMeshCorrection:
    """The correction at the answer of a search; the planned ``coarser`` meshes tell the mesh error."""
    records, parameters, responses = simulator.records, answer.parameters, list(answer.responses)
    correction = FineMeshCorrection(responses, list)
    if records.is_coarsened:
        correction = correct_to_fine_meshes(problem, simulator, parameters)
    if not coarser:
        return correction
    models = [record.model for record in records.own]
    found = mesh_where_possible(coarser, models, simulator.executor, simulator.report, NO_MESH_ERROR)
    pairs = zip(records.own, found, strict=True)
    others = [replace(record, model=model) if model else None for record, model in pairs]
    if not any(others):
        return correction
    searched = simulator.search(parameters) if records.is_coarsened else responses
    errors = _estimate_mesh_errors(problem, simulator, parameters, searched, others)
    return replace(correction, mesh_N=errors, simulations=records.simulations)


def _estimate_mesh_errors(
    problem: CalibrationProblem,
    simulator: RecordSimulator,
    parameters: Array,
    searched: Responses,
    others: Sequence[SiteRecord | None],
) -> tuple[Array, ...]:
    """One standard deviation (n,) N of what the study's meshes lack at every site.

    It follows from the difference of what is ``searched`` and of the same on ``others``, meshes of other
    edges, with fewer steps: in unloading these change the force as much as the mesh does. Zero where there
    are none, or these cannot be simulated: a line says so.
    """
    study, records = problem.study, simulator.records.own
    errors, share = [0.0 * record.compared for record in records], estimate_own_mesh_error(study.mesh)
    meshed = [(i, other) for i, other in enumerate(others) if other is not None]
    fewer = {
        name: max(2, round(getattr(study.solver, name) / COARSENING_FACTOR))
        for name in ("load_steps", "unload_steps")
    }
    steps = study.solver.model_copy(update=fewer)
    near = [
        replace(one, model=replace(one.model, within_mm=study.within_mm, steps=steps)) for _, one in meshed
    ]
    jobs = [other.job(parameters, sensitivities=False) for other in near]
    done = simulator.cache.run(jobs, simulator.executor, again=True)
    for (i, _), simulation in zip(meshed, done, strict=True):
        response, known = records[i].respond(simulation), searched[i]
        words = f"another mesh, site {simulation.site}"
        if not response.completed:
            words = f"warning: site {simulation.site}: the error of its mesh is not known: {response.reason}"
        simulator.report(words)
        if response.completed and known.completed:
            errors[i] = share * (known.force_N - response.force_N)
    return tuple(errors)


def estimate_own_mesh_error(table: MeshTable) -> float:
    """One standard deviation of what the study's own mesh lacks, over its difference from the coarser one."""
    ratio = COARSENING_FACTOR if table.coarse is None else table.coarse.edge_near_mm / table.edge_near_mm
    return estimate_fine_error(MESH_ORDERS[table.element], ratio)
