"""The experiment ``socket_design``: from pressures to a socket's shape, beside a uniformly reduced control.

The limb under the target pressure has the shape of the socket.  Control and design are put on and loaded
alike; where regions are named, the depths over them are moved to lower the largest pressures there.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from ...anatomy.surfaces.surfaces import Anatomy, write_surface
from ...anatomy.surfaces.triangles import Surface
from ...arrays import Array
from ...donning import build_pressed_problem, extract_outer_surface, press_limb
from ...donning.model import OUTER
from ...donning.relief import Relief, SocketTrial
from ...errors import RunError, SurfaceError
from ...execution import Executor
from ...indentation import build_fibre_field
from ...laws import Parameters
from ...mesh import write_vtu
from ...results.socket import SocketDesignResult, SocketSimulation, SocketState
from ...socket import Recipe, Socket, rectify_limb
from ...socket.pressing import Target, build_zone
from ...socket.rays import compute_offsets, compute_profile
from ...socket.rectify import reduce_to_volume
from ...socket.wall import measure_thickness
from ...study import Study
from ..engine.context import NO_PARAMETERS, Context
from ..engine.digests import code_digest, compute_digest
from ..engine.store import RUNS, Made, ResultFiles, write_result, write_table
from ..simulation.limb_geometry import LimbGeometry
from . import shape
from .fabrication import write_shop_package
from .simulation import SocketLimb, SocketRun, run_sockets, simulate_socket

NAME, PLACE = "socket_design", "socket.design"
Tell = Callable[[float, str], None]  # how much is done, and words
CONTROL, DESIGN, OPTIMISED = "control", "design", "optimised"


def check_socket_design(study: Study, limb: LimbGeometry | None, options: Mapping[str, Any]) -> None:
    """Refuse tissues as `check_tissues`, and a shape, load, region or target that the limb cannot have."""
    shape.check_tissues(study)
    if limb is not None:
        build_undeformed_socket(study, limb.anatomy, limb.anatomy.skin, options["optimise"])


def build_undeformed_socket(
    study: Study, anatomy: Anatomy, outer: Surface, optimise: Sequence[str]
) -> tuple[Recipe, Socket]:
    """The recipe of all designs, and the face on the limb as it is, with whose shape a wall can be made.

    Raises `StudyError` where loads, regions or the target pressure are not those of this limb, or the wall
    cannot be made.
    """
    with shape.place_errors(study, PLACE):
        recipe = shape.build_recipe(study, anatomy)
        plain = rectify_limb(outer, anatomy.frame, replace(recipe, reduction_percent=0.0))
        for load in study.socket.loads:
            shape.load_of(study, load, anatomy, plain)
        regions, middles = shape.build_regions(study, anatomy), outer.triangles.mean(axis=1)
        covered = shape.find_covered_regions(middles, anatomy.skin, regions, plain)
        stated = [one.region for one in study.socket.design.regions]
        shape.check_regions(study, stated, f"{PLACE}.regions", covered)
        shape.check_regions(study, optimise, "--optimise", covered)
        if not shape.build_target(study).at(middles, anatomy, regions, plain).any():
            what = "no pressure is stated anywhere on the limb"
            raise SurfaceError(what, remedy="state one below the brim")
        shape.build_socket_wall(study, anatomy, plain)
    return recipe, plain


def run_socket_design(
    context: Context,
    folder: Path,
    *,
    parameters: Parameters = NO_PARAMETERS,
    parameters_from: str = "",
    optimise: Sequence[str] = (),
    simulations: int = 0,
) -> None:
    """Design a socket for the target pressure of the study, and put it and its control on the limb.

    ``optimise``: regions whose largest pressures are to be lowered. ``simulations``: at most so many for
    that, beside those of control and design.
    """
    study, total = context.study, 3 + (simulations if optimise else 0)

    def tell(done: float, words: str) -> None:
        context.tell(NAME, done, total, words)

    with shape.place_errors(study, PLACE):
        report, target = partial(context.tell, NAME, 0, 0), shape.build_target(study)
        limb = SocketLimb.from_store(study, context.store, report)
        plain, face = build_undeformed_socket(study, limb.anatomy, limb.outer.skin, optimise)
        mesh, facts = limb.mesh(folder, face, report)
        kept = ResultFiles(folder / RUNS, also=[context.store[NAME] / RUNS])
        unloaded = SocketRun("", limb.build_model(face, mesh), parameters, kept)
        recipe = _compute_pressed_recipe(limb, unloaded, plain, target, tell)
        designed = _build_face(limb, recipe, {})
        reduced, percent = reduce_to_volume(designed.volume_mm3, limb.outer.skin, limb.anatomy.frame, plain)
        model = limb.build_model(reduced, mesh)
        control = _Design(replace(unloaded, name=CONTROL, model=model), {"reduction_percent": percent})
        model = limb.build_model(designed, mesh)
        design = _Design(replace(unloaded, name=DESIGN, model=model), {"depths_mm": {}})
        designs, found = _solve_designs([control, design], context.executor, tell, 1), None
        if optimise:
            best, found = _optimise_depths(context, limb, recipe, designs, optimise, simulations, tell)
            designs.append(best)
    last = designs[-1].run
    walled = shape.build_socket_wall(study, limb.anatomy, last.model.face)
    write_surface(folder / "socket.stl", walled)
    thickness = measure_thickness(walled, last.model.face)
    content = {
        "target": {"pressure": target.kind, "pressure_kPa": target.pressure_kPa, "regions": target.regions},
        "designs": [_summarise_design(limb, one) for one in designs],
        "optimisation": found,
        "wall": {
            "of": last.name,
            "stated_mm": study.socket.design.wall_mm,
            "least_mm": thickness.min(),
            "median_mm": np.median(thickness),
            "volume_cm3": walled.volume / 1000.0,
        },
        "shop": write_shop_package(folder, limb, last.model.face, walled),
        "parameters": parameters,
        "parameters_from": parameters_from,
        "liner": limb.liner,
        "balance_percent": max(one.simulation.balance_percent for one in designs if one.simulation),
        "mesh": facts,
    }
    result = SocketDesignResult.model_validate(content)
    write_result(folder / f"{NAME}.json", result)
    for one in designs:
        _write_fields(folder, limb, one)
    _write_tables(folder, result)


@dataclass(frozen=True, eq=False)
class _Design:
    """A face on the limb, how it was ``made``, and what happens when it is put on: facts and fields."""

    run: SocketRun
    made: Mapping[str, Any]
    simulation: SocketSimulation | None = None
    fields: Mapping[str, Array] = field(default_factory=dict)

    @property
    def loaded_states(self) -> Sequence[SocketState]:
        """The limb under each load; after donning where there are none."""
        assert self.simulation is not None
        return self.simulation.loads or [self.simulation.donning]

    @property
    def peaks(self) -> dict[str, float]:
        """The largest pressure of each region over all loads, kPa."""
        peaks: dict[str, float] = {}
        for held in self.loaded_states:
            for row in held.regions:
                peaks[row.region] = max(row.peak_kPa, peaks.get(row.region, 0.0))
        return peaks


def _compute_pressed_recipe(
    limb: SocketLimb, unloaded: SocketRun, plain: Recipe, target: Target, tell: Tell
) -> Recipe:
    """How the limb's shape becomes that under the target pressure."""
    model, mesh, kept = unloaded.model, unloaded.model.mesh, unloaded.kept
    assert kept is not None
    table, middles = limb.study.socket, mesh.points[mesh.face_sets[OUTER][:, :3]].mean(axis=1)
    pressure = target.at(middles, limb.anatomy, limb.regions, model.face)
    laws = model.build_laws(unloaded.parameters)
    problem = build_pressed_problem(mesh, laws, pressure, table.donning_s, table.hold_s)
    problem = replace(problem, fibres=build_fibre_field(model.fibres, mesh))
    end = problem.history.times[-1]

    def make() -> Made:
        words = "target pressure: {:.2f} of {:g} s"
        result = press_limb(problem, lambda step: tell(step.time / end, words.format(step.time, end)))
        if not result.completed:
            what = f"the limb could not be put under the target pressure: {result.reason}"
            raise RunError(f"{what}; lower {PLACE}.pressure_kPa, or choose another socket.edge_mm")
        return {"statistics": result.statistics}, {"displacement": result.states[-1].u}

    given = unloaded.key, code_digest(press_limb), pressure.tolist()
    _, fields = kept.get(compute_digest("pressed", *given), make)
    before, after = extract_outer_surface(mesh), extract_outer_surface(mesh, fields["displacement"])
    profile = compute_profile(limb.outer.skin, limb.anatomy.frame)
    return replace(plain, offsets=compute_offsets(profile, before, after, limb.anatomy.frame))


def _build_face(limb: SocketLimb, recipe: Recipe, depths: Mapping[str, float]) -> Socket:
    """The face of a recipe with depths (mm) over regions; it can be given its wall."""
    zones = [build_zone(region, limb.anatomy, limb.regions, depth) for region, depth in depths.items()]
    face = rectify_limb(limb.outer.skin, limb.anatomy.frame, replace(recipe, areas=zones))
    shape.build_socket_wall(limb.study, limb.anatomy, face)
    return face


def _solve_designs(designs: Sequence[_Design], executor: Executor, tell: Tell, before: int) -> list[_Design]:
    """With what happens when each is put on and loaded: several side by side on the study's workers.

    Simulations done ``before`` them count as progress.
    """
    runs = [one.run for one in designs]
    reasons = run_sockets(runs, executor, lambda done, words: tell(before + done, words))
    for reason in filter(None, reasons):
        raise RunError(reason)
    solved = []
    for one in designs:
        facts, fields = simulate_socket(one.run)
        one = replace(one, simulation=SocketSimulation(**facts), fields=fields)
        peak = max(held.peak_kPa for held in one.loaded_states)
        tell(before + len(designs), f"{one.run.name}: {peak:.0f} kPa at most")
        solved.append(one)
    return solved


def _summarise_design(limb: SocketLimb, one: _Design) -> dict[str, Any]:
    face = one.run.model.face
    offset = -face.offset(limb.outer.skin)
    return {
        "name": one.run.name,
        "volume_cm3": face.volume_mm3 / 1000.0,
        "offset_mm": [offset.min(), offset.max()],
        "peaks_kPa": one.peaks,
        **one.made,
        "simulation": one.simulation,
    }


def _write_fields(folder: Path, limb: SocketLimb, one: _Design) -> None:
    """The face, and the fields after donning and each load."""
    run = one.run
    limb.write_face(run.model.face, folder / f"{run.name}-face.vtp")
    names = dict.fromkeys(key.rpartition(".")[0] for key in one.fields)
    for i, name in enumerate(names):
        data = {"pressure_kPa": one.fields[f"{name}.pressure"], "shear_kPa": one.fields[f"{name}.shear"]}
        data["displacement_mm"] = one.fields[f"{name}.displacement"]
        write_vtu(run.model.mesh, folder / f"{run.name}-{i}.vtu", point_data=data)


def _optimise_depths(
    context: Context,
    limb: SocketLimb,
    recipe: Recipe,
    designs: Sequence[_Design],
    optimise: Sequence[str],
    count: int,
    tell: Tell,
) -> tuple[_Design, dict[str, Any]]:
    """The best of the designs that depths over the named regions give, and how it was found.

    ``designs`` are control and design; at most ``count`` others are tried.
    """
    best, (control, start) = designs[1], (one.peaks for one in designs)
    regions = [name for name in start if name in control]
    # As stated; else no region is to bear more than the control's most loaded one.
    stated = {one.region: one.limit_kPa for one in context.study.socket.design.regions if one.limit_kPa}
    limits = {name: stated.get(name, max(control.values())) for name in regions}

    def vector(peaks: Mapping[str, float]) -> Array:
        return np.array([peaks.get(name, 0.0) for name in regions])

    order = [regions.index(name) for name in optimise]
    search = Relief(order, vector(control), vector(limits), vector(start))
    rows = [_to_row(search.trials[0], optimise, start)]
    for number in range(1, count + 1):
        proposed = search.propose()
        if proposed is None:
            break
        depths = dict(zip(optimise, map(float, proposed), strict=True))
        name, before = f"{OPTIMISED}, {number}", 2 + number
        try:
            model = limb.build_model(_build_face(limb, recipe, depths), best.run.model.mesh)
            tried = _Design(replace(best.run, name=name, model=model), {"depths_mm": depths})
            (made,) = _solve_designs([tried], context.executor, tell, before)
        except (SurfaceError, RunError) as error:
            tell(before + 1.0, f"{name}: {error}")
            rows.append(_to_row(search.tell(proposed, None), optimise, None, str(error)))
            continue
        trial = search.tell(proposed, vector(made.peaks))
        rows.append(_to_row(trial, optimise, made.peaks))
        if trial is search.best:
            best = made
    peaks = best.peaks
    gains = [
        {
            "region": name,
            "control_kPa": control[name],
            "design_kPa": start[name],
            "optimised_kPa": peaks[name],
            "change_percent": 100.0 * (peaks[name] / control[name] - 1.0) if control[name] else None,
        }
        for name in optimise
    ]
    beyond = [name for name in regions if name not in optimise and peaks[name] > limits[name]]
    found = {"regions": list(optimise), "gains": gains, "limits_kPa": limits, "beyond_limits": beyond}
    best = replace(best, run=replace(best.run, name=OPTIMISED))
    return best, found | {"simulations": count, "trials": rows}


def _to_row(
    trial: SocketTrial, optimise: Sequence[str], peaks: Mapping[str, float] | None, reason: str = ""
) -> dict[str, Any]:
    return {
        "depths_mm": dict(zip(optimise, trial.depths, strict=True)),
        "peaks_kPa": None if peaks is None else {name: peaks[name] for name in optimise},
        "merit": trial.merit if np.isfinite(trial.merit) else None,
        "reason": reason,
    }


def _write_tables(folder: Path, result: SocketDesignResult) -> None:
    columns = ("mean_kPa", "peak_kPa", "shear_kPa", "shear_peak_kPa")
    rows = [
        [design.name, name, region.region, *(getattr(region, key) for key in columns)]
        for design in result.designs
        for name, held in design.simulation.states.items()
        for region in held.regions
    ]
    write_table(folder / "regions.csv", ["design", "load", "region", *columns], rows)
    if (found := result.optimisation) is None:
        return
    heads = [*(f"{name}_{unit}" for unit in ("depth_mm", "peak_kPa") for name in found.regions), "reason"]
    lines = []
    for trial in found.trials:
        depths, peaks = trial.depths_mm, trial.peaks_kPa or {}
        values = (of_region.get(name) for of_region in (depths, peaks) for name in found.regions)
        lines.append([*values, trial.reason])
    write_table(folder / "trials.csv", heads, lines)
