"""From the meshes of a search to the study's own, and what those lack beside infinitely fine ones."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

from ...arrays import Array
from ...errors import RunError
from ...identify.fit.correction import MeshCorrection
from ...study import Study
from ...study.meshing import MeshTable
from ...study.tables import SolverTable
from ..engine.context import Context
from ..limb.mesh import mesh_settings
from ..limb.remesh import mesh_in_background, mesh_where_possible, scale_edges
from ..records.records import RecordSet, SiteRecord
from ..simulation.extrapolation import MESH_ORDERS, estimate_fine_error
from .record_simulator import RecordSimulator, Responses

COARSENING_FACTOR = 1.3  # of the edges and the steps: another mesh that tells the error of the study's own
NO_MESH_ERROR = "intervals do not count the error of the site's own mesh"


@dataclass(frozen=True)
class FineMeshCorrection:
    """Responses at an answer, what brings those of a search to the study's own meshes as they were there,
    and one standard deviation (n,) N of what these lack at every site: none where no other mesh tells."""

    responses: Responses
    as_fine: Callable[[Responses], Responses]
    mesh_N: tuple[Array, ...] = ()


def correct_to_fine_meshes(study: Study, simulator: RecordSimulator, parameters: Array) -> FineMeshCorrection:
    """The responses at an answer, and what brings those of the search to the study's own meshes.

    Raises
    ------
    RunError
        Where a site cannot be simulated there.
    """
    searched = simulator.search(parameters)
    correction = FineMeshCorrection(searched, list)
    if simulator.records.is_coarsened:
        as_fine = MeshCorrection(searched, simulator.check(parameters))
        correction = FineMeshCorrection(as_fine(searched), as_fine)
    if study.mesh.coarse is not None:
        errors = _estimate_mesh_errors(study, simulator, parameters, searched, simulator.records.own)
        correction = replace(correction, mesh_N=errors)
    for one in correction.responses:
        if not one.completed:
            raise RunError(f"site {one.site} cannot be simulated at the answer: {one.reason}")
    return correction


def correct_answer(
    context: Context, simulator: RecordSimulator, parameters: Array, responses: Responses, folder: Path
) -> tuple[FineMeshCorrection, int]:
    """The correction at the answer of a search whose ``responses`` are known, and how many simulations of
    coarser meshes it took.

    ``folder`` is for the coarser meshes that tell the error of the study's own, where it has no others.
    """
    study, records = context.study, simulator.records
    correction = FineMeshCorrection(responses, list)
    if records.is_coarsened:
        correction = correct_to_fine_meshes(study, simulator, parameters)
    if study.mesh.coarse is not None:
        return correction, 0
    coarser = _mesh_coarser(context, records, folder, simulator)
    if not any(coarser):
        return correction, 0
    searched = simulator.search(parameters) if records.is_coarsened else responses
    errors = _estimate_mesh_errors(study, simulator, parameters, searched, coarser)
    return replace(correction, mesh_N=errors), records.simulations


@contextmanager
def mesh_coarser_in_background(
    context: Context, records: RecordSet, folder: Path
) -> Iterator[Callable[[], None]]:
    """The coarser meshes that `correct_answer` will want in ``folder``, made beside the block; it is given a
    function that waits for them."""
    if context.study.mesh.coarse is not None:
        yield lambda: None
        return
    models = [record.model for record in records.own]
    coarser = scale_edges(mesh_settings(context.study), COARSENING_FACTOR)
    with mesh_in_background(context, folder, models, coarser) as wait:
        yield wait


def _mesh_coarser(
    context: Context, records: RecordSet, folder: Path, simulator: RecordSimulator
) -> list[SiteRecord | None]:
    """The records on coarser meshes than the study's own, which are made in ``folder``.

    None for a site of which none can be made: a line says so.
    """
    models = [record.model for record in records.own]
    coarser = scale_edges(mesh_settings(context.study), COARSENING_FACTOR)
    meshed = mesh_where_possible(context, folder, models, coarser, simulator.report, NO_MESH_ERROR)
    pairs = zip(records.own, meshed, strict=True)
    return [replace(record, model=model) if model else None for record, model in pairs]


def _estimate_mesh_errors(
    study: Study,
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
    records = simulator.records.own
    errors, share = [0.0 * record.compared for record in records], estimate_own_mesh_error(study.mesh)
    meshed = [(i, other) for i, other in enumerate(others) if other is not None]
    steps = _scale_steps(study.solver)
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


def _scale_steps(table: SolverTable) -> SolverTable:
    """The steps in time `COARSENING_FACTOR` times as long."""
    names = ("load_steps", "unload_steps")
    fewer = {name: max(2, round(getattr(table, name) / COARSENING_FACTOR)) for name in names}
    return table.model_copy(update=fewer)
