"""The answer of a search on the study's own meshes, with intervals; limits of finer meshes.

What the meshes of the search lack beside the study's own, and these beside infinitely fine ones, follows from
simulations at the answer. What the records tell of the parameters then has intervals, and the answer may move
to what is most probable.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.optimize import brentq

from ...arrays import Array
from ...errors import RunError
from ...identify.fit.calibration import Calibration, move_answer
from ...identify.fit.multifidelity import MeshCorrection
from ...identify.uncertainty.intervals import EvaluationStore, count_further_evaluations, sample_uncertainty
from ...identify.uncertainty.uncertainty import LINEARISED, Uncertainty, estimate_uncertainty
from ...study.meshing import MeshTable
from ..engine.context import Context
from ..limb.mesh import MeshJob, mesh_settings, plan_meshes, scale_edges
from ..limb.remesh import mesh_where_possible
from ..records.records import RecordSet, SiteRecord, estimate_site_deviation, estimate_site_noise
from .search import RecordSimulator, Responses

# Of the force of an indenter on a limb, against the edge (docs/convergence.md); None: it does not change in
# one direction there, so a difference tells how large the error may be and nothing can be extrapolated.
MESH_ORDERS: Mapping[str, float | None] = {"tet4": 1.3, "tet10": 1.0, "tet10p0": None}
MEASURED_ORDERS = (0.3, 6.0)  # in which an order that three meshes show is believed
_MAX_ERROR_FACTOR = 5.0  # times a difference: two edges that are nearly the same tell no limit
COARSENING_FACTOR = 1.3  # of the edges and the steps: another mesh that tells the error of the study's own
NO_MESH_ERROR = "intervals do not count the error of the site's own mesh"
ONLY_LINEARISED = "too few simulations completed near the answer: its intervals are linearised, too narrow"
NOT_MOVED = "what is most probable cannot be simulated, and the least squares are the answer"


def estimate_coarse_error(order: float | None, ratio: float) -> float:
    """Error of the coarser of two over their difference (Richardson), where edges or steps have this ratio.

    ``limit - coarser`` is this times ``finer - coarser``; where there is no order, the difference itself.
    """
    return 1.0 if order is None else min(1.0 / (1.0 - ratio**-order), _MAX_ERROR_FACTOR)


@dataclass(frozen=True)
class Extrapolation:
    """What a quantity tends to as meshes get finer, and the order at which it does.

    ``measured``: the order follows from three meshes; otherwise it is assumed and the limit rests on the two
    finest ones. ``order`` is None where nothing is extrapolated: the limit is then the finest mesh's value.
    """

    limit: float
    order: float | None
    measured: bool

    def error_percent(self, value: float) -> float:
        """How far a value is from the limit, in percent of it."""
        return 100.0 * (value / self.limit - 1.0)


def extrapolate_richardson(
    edges: Sequence[float], values: Sequence[float], assumed: float | None
) -> Extrapolation:
    """``value = limit + a edge^order`` through the three finest meshes (Richardson; Roache 1998).

    Where the values do not change in one direction, or at no order of `MEASURED_ORDERS`, it is ``assumed``.

    Parameters
    ----------
    edges : (k,) edge lengths of two or more meshes, in any order.
    values : (k,) what was computed on them.
    assumed : the element's own of `MESH_ORDERS`; with None nothing is extrapolated.
    """
    if len(edges) < 2:
        raise ValueError("two meshes or more are needed")
    order = np.argsort(edges)
    h, f = np.asarray(edges, dtype=float)[order][:3], np.asarray(values, dtype=float)[order][:3]
    if assumed is None:
        return Extrapolation(float(f[0]), None, False)

    def mismatch(p: float) -> float:
        return float((f[2] - f[1]) * (h[1] ** p - h[0] ** p) - (f[1] - f[0]) * (h[2] ** p - h[1] ** p))

    low, high = MEASURED_ORDERS
    measured = len(h) == 3 and (f[2] - f[1]) * (f[1] - f[0]) > 0.0 and mismatch(low) * mismatch(high) < 0.0
    p = float(brentq(mismatch, low, high)) if measured else assumed
    share = h[0] ** p / (h[1] ** p - h[0] ** p)
    return Extrapolation(float(f[0] - share * (f[1] - f[0])), p, bool(measured))


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


def correct_to_fine_meshes(simulator: RecordSimulator, parameters: Array) -> FineMeshCorrection:
    """The responses at an answer, and what brings those of the search to the study's own meshes.

    Raises `RunError` where a site cannot be simulated there.
    """
    searched = simulator.search(parameters)
    correction = FineMeshCorrection(searched, list)
    if simulator.records.is_coarsened:
        as_fine = MeshCorrection(searched, simulator.check(parameters))
        correction = FineMeshCorrection(as_fine(searched), as_fine)
    if simulator.problem.study.mesh.coarse is not None:
        errors = _estimate_mesh_errors(simulator, parameters, searched, simulator.records.own)
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
    simulator: RecordSimulator, answer: Calibration, coarser: Sequence[MeshJob]
) -> FineMeshCorrection:
    """The correction at the answer of a search; the planned ``coarser`` meshes tell the mesh error."""
    records, parameters, responses = simulator.records, answer.parameters, list(answer.responses)
    correction = FineMeshCorrection(responses, list)
    if records.is_coarsened:
        correction = correct_to_fine_meshes(simulator, parameters)
    if not coarser:
        return correction
    models = [record.model for record in records.own]
    found = mesh_where_possible(coarser, models, simulator.executor, simulator.report, NO_MESH_ERROR)
    pairs = zip(records.own, found, strict=True)
    others = [replace(record, model=model) if model else None for record, model in pairs]
    if not any(others):
        return correction
    searched = simulator.search(parameters) if records.is_coarsened else responses
    errors = _estimate_mesh_errors(simulator, parameters, searched, others)
    return replace(correction, mesh_N=errors, simulations=records.simulations)


def _estimate_mesh_errors(
    simulator: RecordSimulator, parameters: Array, searched: Responses, others: Sequence[SiteRecord | None]
) -> tuple[Array, ...]:
    """One standard deviation (n,) N of what the study's meshes lack at every site.

    It follows from the difference of what is ``searched`` and of the same on ``others``, meshes of other
    edges, with fewer steps: in unloading these change the force as much as the mesh does. Zero where there
    are none, or these cannot be simulated: a line says so.
    """
    study, records = simulator.problem.study, simulator.records.own
    errors, share = [0.0 * record.compared for record in records], estimate_own_mesh_error(study.mesh)
    meshed = [(i, other) for i, other in enumerate(others) if other is not None]
    fewer = {
        name: max(2, round(getattr(study.solver, name) / COARSENING_FACTOR))
        for name in ("load_steps", "unload_steps")
    }
    steps = study.solver.model_copy(update=fewer)
    models = [replace(other.model, within_mm=study.within_mm, steps=steps) for _, other in meshed]
    near = [replace(other, model=model) for (_, other), model in zip(meshed, models)]
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
    order = MESH_ORDERS[table.element]
    return 1.0 if order is None else min(1.0 / max(ratio**order - 1.0, 1e-9), _MAX_ERROR_FACTOR)


def estimate_linearised(
    simulator: RecordSimulator, parameters: Array, correction: FineMeshCorrection
) -> Uncertainty:
    """What fitted records tell about ``parameters`` (p,), at which the correction was made."""
    problem, responses, study = simulator.problem, correction.responses, simulator.problem.study
    pairs = list(zip(simulator.records.own, responses, strict=True))
    noise = [estimate_site_noise(study, record, response.force_N) for record, response in pairs]
    off = [estimate_site_deviation(study, record, response, parameters) for record, response in pairs]
    return estimate_uncertainty(
        parameters,
        responses,
        simulator.records.curves,
        problem.unknowns,
        noise,
        problem.stages[-1],
        problem.settings,
        correction.mesh_N,
        off,
    )


def sample_intervals(
    simulator: RecordSimulator, found: Calibration, correction: FineMeshCorrection, moves: bool = True
) -> tuple[Calibration, Uncertainty]:
    """The answer, which ``moves`` to what is most probable where that is wanted, and what is known of it.

    Sampled on what was simulated near it and a little more, less what the correction took;
    linearised, and the answer stays, where that cannot be for simulations that fail.
    """
    problem, records = simulator.problem, simulator.records
    known = estimate_linearised(simulator, found.parameters, correction)
    evaluations = EvaluationStore()
    for point, run in zip(simulator.store.points, simulator.store.responses, strict=True):
        evaluations.add(point, correction.as_fine(list(run)))

    def simulate(parameters: Array) -> Responses:
        simulator.report("a further evaluation, for the intervals")
        return correction.as_fine(simulator.search(parameters))

    further = count_further_evaluations(records.simulations, correction.simulations)
    about = known, evaluations, simulate, further
    moves = moves and problem.is_moved
    sampled = sample_uncertainty(*about, move_answer=moves)
    if sampled.method == LINEARISED:
        simulator.report(f"warning: {ONLY_LINEARISED}")
    if not moves or sampled.method == LINEARISED:
        return found, sampled
    responses = simulate(sampled.parameters)
    answer = move_answer(found, sampled.parameters, records.curves, responses, problem.unknowns)
    if isinstance(answer, Calibration):
        return answer, sampled
    simulator.report(f"warning: {NOT_MOVED}: {answer}")
    return found, sample_uncertainty(*about, move_answer=False)
