"""The experiment ``socket_design``: from pressures to a socket's shape, beside a uniformly reduced control.

The limb under the target pressure has the shape of the socket.  Control and design are put on and loaded
alike; where regions are named, the depths over them are moved to lower the largest pressures there.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from ...anatomy.frame import Frame, build_limb_frame
from ...anatomy.surfaces.surfaces import Anatomy, write_surface
from ...anatomy.surfaces.triangles import Surface
from ...arrays import Array
from ...donning import build_pressed_problem, extract_outer_surface, press_limb
from ...donning.model import OUTER
from ...donning.relief import Relief, SocketTrial
from ...errors import RunError, SurfaceError
from ...fe import Step
from ...fe.materials import Material
from ...indentation import Parameters, build_fibre_field
from ...mesh import Mesh, write_vtu
from ...results.limb import MeshMeasures
from ...results.socket import SocketDesignResult
from ...socket import Recipe, Socket, rectify_limb
from ...socket.rays import compute_offsets, compute_profile
from ...socket.rectify import reduce_to_volume
from ...socket.targets import Target, build_zone
from ...socket.wall import measure_thickness
from ...study import Study
from ..engine.context import Context
from ..engine.digests import code_digest, compute_digest
from ..engine.partial_results import Made, ResultFiles
from ..engine.storage import write_result, write_table
from ..simulation.limb_geometry import LimbGeometry
from .limb import SocketLimb, SocketRun, run_sockets, simulate_socket
from .shape import (
    build_recipe,
    build_regions,
    build_socket_wall,
    build_target,
    check_at_rest,
    check_regions,
    find_covered_regions,
    load_of,
    place_errors,
)

NAME, PLACE = "socket_design", "socket.design"
CONTROL, DESIGN, OPTIMISED = "control", "design", "optimised"


def check_socket_design(study: Study, limb: LimbGeometry | None, options: Mapping[str, Any]) -> None:
    """Refuse tissues that are not at rest, and a shape, load, region or target that the limb cannot have.

    Raises
    ------
    StudyError
    """
    check_at_rest(study)
    if limb is not None:
        build_undeformed_socket(study, limb.anatomy, limb.anatomy.skin, options["optimise"])


def build_undeformed_socket(
    study: Study, anatomy: Anatomy, outer: Surface, optimise: Sequence[str]
) -> tuple[Recipe, Socket]:
    """The recipe of all designs, and the face on the limb as it is, with whose shape a wall can be made.

    Raises
    ------
    StudyError
        Where loads, regions or the target pressure are not those of this limb, or the wall cannot be made.
    """
    with place_errors(study, PLACE):
        recipe, frame = build_recipe(study, anatomy), build_limb_frame(anatomy.cut_point, anatomy.cut_normal)
        plain = rectify_limb(outer, frame, replace(recipe, reduction_percent=0.0))
        for load in study.socket.loads:
            load_of(study, load, anatomy, plain)
        regions, middles = build_regions(study, anatomy), outer.triangles.mean(axis=1)
        covered = find_covered_regions(middles, anatomy.skin, regions, plain)
        check_regions(study, [one.region for one in study.socket.design.regions], f"{PLACE}.regions", covered)
        check_regions(study, optimise, "--optimise", covered)
        if not build_target(study).at(middles, anatomy, regions, plain).any():
            raise SurfaceError(
                "no pressure is stated anywhere on the limb", remedy="state one below the brim"
            )
        build_socket_wall(study, anatomy, plain)
    return recipe, plain


def run_socket_design(
    context: Context,
    folder: Path,
    *,
    parameters: Parameters,
    parameters_from: str,
    optimise: Sequence[str],
    simulations: int,
) -> dict[str, Any]:
    """Design a socket for the target pressure of the study, and put it and its control on the limb.

    Parameters
    ----------
    optimise : regions whose largest pressures are to be lowered.
    simulations : at most so many for that, beside those of control and design.
    """
    with place_errors(context.study, PLACE):
        bench = _Bench.of(context, folder, parameters, optimise, simulations)
        target = build_target(context.study)
        recipe = bench.designed(target)
        design = bench.made(DESIGN, recipe)
        control_face, reduction = reduce_to_volume(
            design.face.volume_mm3, bench.limb.outer.skin, bench.frame, bench.recipe
        )
        control = _Made(CONTROL, control_face, facts={"reduction_percent": reduction})
        done = {one.name: one for one in bench.put_on(control, design)}
        found: dict[str, Any] = {}
        if optimise:
            best, found = _optimise_depths(bench, recipe, done, optimise, simulations)
            done[OPTIMISED] = best
    last = list(done.values())[-1]
    walled = build_socket_wall(context.study, bench.limb.anatomy, last.face)
    write_surface(folder / "socket.stl", walled)
    content = {
        "target": {"pressure": target.kind, "pressure_kPa": target.pressure_kPa}
        | {"regions": dict(target.regions)},
        "designs": [bench.told(one) for one in done.values()],
        "optimisation": found or None,
        "wall": _build_wall_facts(bench, walled, last),
        "parameters": parameters,
        "parameters_from": parameters_from,
        "liner": bench.limb.liner,
        "balance_percent": max(one.facts["simulation"]["balance_percent"] for one in done.values()),
        "mesh": bench.mesh_facts,
    }
    write_result(folder / f"{NAME}.json", SocketDesignResult(**content))
    for one in done.values():
        bench.write(folder, one)
    _write_tables(folder, content)
    return {}


@dataclass(frozen=True, eq=False)
class _Made:
    """A design: its face, and what is known of it: depths, its simulation, fields at the mesh's nodes."""

    name: str
    face: Socket
    facts: Mapping[str, Any] = field(default_factory=dict)
    fields: Mapping[str, Array] = field(default_factory=dict)


@dataclass(eq=False)
class _Bench:
    """The limb on which designs are tried, and what is kept of them."""

    context: Context
    limb: SocketLimb
    mesh: Mesh
    mesh_facts: MeshMeasures
    laws: Mapping[str, Material]
    recipe: Recipe
    plain: Socket
    kept: ResultFiles
    parameters: Parameters
    total: int
    count: int = 0

    @classmethod
    def of(
        cls, context: Context, folder: Path, parameters: Parameters, optimise: Sequence[str], count: int
    ) -> _Bench:
        limb = SocketLimb.of(context, NAME)
        recipe, plain = build_undeformed_socket(context.study, limb.anatomy, limb.outer.skin, optimise)
        mesh, facts = limb.mesh(context, NAME, folder, plain)
        kept = ResultFiles(folder, also=[context.store[NAME]])
        laws = limb.materials(parameters)
        total = 3 + (count if optimise else 0)
        return cls(context, limb, mesh, facts, laws, recipe, plain, kept, parameters, total)

    @property
    def frame(self) -> Frame:
        return build_limb_frame(self.limb.anatomy.cut_point, self.limb.anatomy.cut_normal)

    def tell(self, share: float, words: str) -> None:
        self.context.tell(NAME, self.count + share, self.total, words)

    def designed(self, target: Target) -> Recipe:
        """How the limb's shape becomes that under the target pressure."""
        table, faces = self.limb.study.socket, self.mesh.face_sets[OUTER]
        middles = self.mesh.points[faces[:, :3]].mean(axis=1)
        pressure = target.at(middles, self.limb.anatomy, self.limb.regions, self.plain)
        problem = build_pressed_problem(self.mesh, self.laws, pressure, table.donning_s, table.hold_s)
        problem = replace(problem, fibres=build_fibre_field(self.limb.fibres, self.mesh))
        end = problem.history.times[-1]

        def on_step(step: Step) -> None:
            self.tell(step.time / end, f"target pressure: {step.time:.2f} of {end:g} s")

        def make() -> Made:
            result = press_limb(problem, on_step)
            if not result.completed:
                raise RunError(
                    f"the limb could not be put under the target pressure: {result.reason}; lower "
                    f"{PLACE}.pressure_kPa, or choose another socket.edge_mm"
                )
            return {"statistics": result.statistics}, {"displacement": result.states[-1].u}

        given = self._key(self.plain), code_digest(press_limb), pressure.tolist()
        _, fields = self.kept.get(compute_digest("pressed", *given), make)
        self.count += 1
        limb = compute_profile(self.limb.outer.skin, self.frame)
        before, after = (
            extract_outer_surface(self.mesh),
            extract_outer_surface(self.mesh, fields["displacement"]),
        )
        return replace(self.recipe, offsets=compute_offsets(limb, before, after, self.frame))

    def made(self, name: str, recipe: Recipe, depths: Mapping[str, float] | None = None) -> _Made:
        """The face of a recipe with depths (mm) over regions; it can be given its wall."""
        zones = [
            build_zone(region, self.limb.anatomy, self.limb.regions, depth)
            for region, depth in (depths or {}).items()
        ]
        face = rectify_limb(self.limb.outer.skin, self.frame, replace(recipe, areas=zones))
        build_socket_wall(self.limb.study, self.limb.anatomy, face)
        return _Made(name, face, {"depths_mm": dict(depths or {})})

    def put_on(self, *made: _Made) -> list[_Made]:
        """With what happens when each is put on and loaded: several side by side on the study's workers."""
        jobs = [self._job(one) for one in made]
        for reason in filter(None, run_sockets(jobs, self.context.executor, self.tell)):
            raise RunError(reason)
        self.count += len(jobs)
        done = []
        for one, job in zip(made, jobs, strict=True):
            facts, fields = simulate_socket(job)
            self.tell(0.0, f"{one.name}: {_find_peak(facts):.0f} kPa at most")
            done.append(replace(one, facts={**one.facts, "simulation": facts}, fields=fields))
        return done

    def _job(self, one: _Made) -> SocketRun:
        key = self._key(one.face)
        return SocketRun(one.name, self.limb, self.mesh, self.laws, one.face, self.kept, key)

    def _key(self, face: Socket) -> str:
        return self.limb.key(self.kept.folder.parent, self.parameters, face)

    def told(self, one: _Made) -> dict[str, Any]:
        """What is stored of a design."""
        offset = -one.face.offset(self.limb.outer.skin)
        shape = {"volume_cm3": one.face.volume_mm3 / 1000.0, "offset_mm": [offset.min(), offset.max()]}
        return {"name": one.name, **shape, "peaks_kPa": _collect_peaks(one.facts["simulation"]), **one.facts}

    def write(self, folder: Path, one: _Made) -> None:
        """The face with its offset from the unloaded limb, and the fields after donning and each load."""
        face = one.face.surface.to_pyvista()
        face.point_data["offset_mm"] = -one.face.offset(self.limb.outer.skin)
        face.save(folder / f"{one.name}-face.vtp")
        names = dict.fromkeys(key.rpartition(".")[0] for key in one.fields)
        for i, name in enumerate(names):
            data = {"pressure_kPa": one.fields[f"{name}.pressure"], "shear_kPa": one.fields[f"{name}.shear"]}
            data["displacement_mm"] = one.fields[f"{name}.displacement"]
            write_vtu(self.mesh, folder / f"{one.name}-{i}.vtu", point_data=data)


def _optimise_depths(
    bench: _Bench, recipe: Recipe, done: Mapping[str, _Made], optimise: Sequence[str], count: int
) -> tuple[_Made, dict[str, Any]]:
    """The best of the designs that depths over the named regions give, and how it was found."""
    control, start = (_collect_peaks(done[name].facts["simulation"]) for name in (CONTROL, DESIGN))
    regions = [name for name in start if name in control]
    limits = _find_limits(bench, control, regions)
    order = [regions.index(name) for name in optimise]

    def vector(peaks: Mapping[str, float]) -> Array:
        return np.array([peaks.get(name, 0.0) for name in regions])

    search = Relief(order, vector(control), vector(limits), vector(start))
    best, rows = done[DESIGN], [_to_row(search.trials[0], optimise, start)]
    for number in range(1, count + 1):
        depths = search.propose()
        if depths is None:
            break
        made = _try_design(bench, recipe, dict(zip(optimise, map(float, depths), strict=True)), number)
        peaks = _collect_peaks(made.facts["simulation"]) if isinstance(made, _Made) else None
        trial = search.tell(depths, None if peaks is None else vector(peaks))
        rows.append(_to_row(trial, optimise, peaks, "" if isinstance(made, _Made) else made))
        if isinstance(made, _Made) and trial is search.best:
            best = made
    peaks = _collect_peaks(best.facts["simulation"])
    gains = [
        {
            "region": name,
            "control_kPa": control[name],
            "design_kPa": start[name],
            "optimised_kPa": peaks[name],
            "change_percent": 100.0 * (peaks[name] / control[name] - 1.0),
        }
        for name in optimise
    ]
    beyond = [name for name in regions if name not in optimise and peaks[name] > limits[name]]
    found = {"regions": list(optimise), "gains": gains, "limits_kPa": limits, "beyond_limits": beyond}
    return replace(best, name=OPTIMISED), found | {"simulations": count, "trials": rows}


def _try_design(bench: _Bench, recipe: Recipe, depths: Mapping[str, float], number: int) -> _Made | str:
    """A design put on the limb; words where it cannot be."""
    try:
        return bench.put_on(bench.made(f"{OPTIMISED}, {number}", recipe, depths))[0]
    except (SurfaceError, RunError) as error:
        bench.count += 1
        bench.tell(0.0, f"{OPTIMISED}, {number}: {error}")
        return str(error)


def _find_limits(bench: _Bench, control: Mapping[str, float], regions: Sequence[str]) -> dict[str, float]:
    """As stated; else no region is to bear more than the control's most loaded one."""
    stated = {one.region: one.limit_kPa for one in bench.limb.study.socket.design.regions if one.limit_kPa}
    return {name: stated.get(name, max(control.values())) for name in regions}


def _to_row(
    trial: SocketTrial, optimise: Sequence[str], peaks: Mapping[str, float] | None, reason: str = ""
) -> dict[str, Any]:
    return {
        "depths_mm": dict(zip(optimise, trial.depths, strict=True)),
        "peaks_kPa": None if peaks is None else {name: peaks[name] for name in optimise},
        "merit": trial.merit if np.isfinite(trial.merit) else None,
        "reason": reason,
    }


def _collect_peaks(simulation: Mapping[str, Any]) -> dict[str, float]:
    """The largest pressure of each region over all loads, kPa; after donning where there are none."""
    peaks: dict[str, float] = {}
    for held in simulation["loads"] or [simulation["donning"]]:
        for row in held["regions"]:
            peaks[row["region"]] = max(row["peak_kPa"], peaks.get(row["region"], 0.0))
    return peaks


def _find_peak(simulation: Mapping[str, Any]) -> float:
    return float(max(held["peak_kPa"] for held in simulation["loads"] or [simulation["donning"]]))


def _build_wall_facts(bench: _Bench, body: Surface, one: _Made) -> dict[str, Any]:
    measured = measure_thickness(body, one.face)
    return {
        "of": one.name,
        "stated_mm": bench.limb.study.socket.design.wall_mm,
        "least_mm": measured.min(),
        "median_mm": np.median(measured),
        "volume_cm3": body.volume / 1000.0,
    }


def _write_tables(folder: Path, content: Mapping[str, Any]) -> None:
    columns = ("mean_kPa", "peak_kPa", "shear_kPa", "shear_peak_kPa")
    rows = [
        [design["name"], name, region["region"], *(region[key] for key in columns)]
        for design in content["designs"]
        for name, held in (
            ("donning", design["simulation"]["donning"]),
            *((one["name"], one) for one in design["simulation"]["loads"]),
        )
        for region in held["regions"]
    ]
    write_table(folder / "regions.csv", ["design", "load", "region", *columns], rows)
    found = content["optimisation"]
    if found is None:
        return
    names = found["regions"]
    heads = [*(f"{name}_{unit}" for unit in ("depth_mm", "peak_kPa") for name in names), "reason"]
    lines = [
        [
            *(trial["depths_mm"][name] for name in names),
            *((trial["peaks_kPa"] or {}).get(name) for name in names),
            trial["reason"],
        ]
        for trial in found["trials"]
    ]
    write_table(folder / "trials.csv", heads, lines)
