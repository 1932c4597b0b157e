"""The experiment ``socket``: the limb in its socket, donned, held and loaded."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import igl
import numpy as np
from numpy.typing import NDArray

from ...anatomy.meshing.layers import LayerSpec
from ...anatomy.meshing.liner import under_liner
from ...anatomy.meshing.meshing import MeshSettings, mesh_limb
from ...anatomy.surfaces.surfaces import Anatomy, load_anatomy, write_surface
from ...anatomy.surfaces.thickness import read_thickness
from ...donning import SETTLING, Donned, Fit, Held, Load, Patch, Row, don, socket_problem
from ...donning.model import OUTER
from ...errors import RunError
from ...indentation import Parameters, materials
from ...mesh import Mesh, read_vtu, write_vtu
from ...socket import Socket
from ...socket.landmarks import directions, knee_centre
from ...socket.regions import Region
from ...study import Study
from ..shared.context import Context
from ..shared.socket_shape import load_of, regions_of, socket_of
from ..shared.store import read_json, write_json
from ..shared.tabular import write_table
from ..stages.files import THICKNESS
from ..stages.mesh import mesh_settings

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

LINER = "liner"
BELOW_BRIM_MM = 15.0  # edges are short from so far above the brim on
FAR, GROWTH, FLATNESS = 3.5, 0.5, 1.6  # edges near the proximal cut over those below, and how elements grow
Z95 = 1.96


def run_socket(
    context: Context, folder: Path, *, parameters: Parameters, parameters_from: str
) -> dict[str, Any]:
    """Pressure, shear and settling in the study's socket at the ``parameters`` of the tissues."""
    study, table = context.study, context.study.socket
    anatomy = load_anatomy(context.store["surfaces"])
    outer, depth = _outer(context, anatomy)
    socket = socket_of(study, anatomy, outer.skin)
    write_surface(folder / "socket.stl", socket.surface)
    mesh = _mesh(context, folder, outer, depth, socket)
    fit = _fit(study, anatomy, socket)
    laws = materials(parameters, study.material.kappa_ratio, study.material.law)
    if table.liner.thickness_mm:
        laws |= materials({LINER: table.liner.parameters}, study.material.kappa_ratio)
    problem = socket_problem(mesh, laws, socket, fit)
    regions = _regions(regions_of(study, anatomy), anatomy, mesh, socket)
    covariance = _covariance(context, parameters_from)
    end = fit.ends[-1][2]

    def told(row: Row) -> None:
        force = float(np.linalg.norm(row.force))
        words = f"{row.time:.2f} of {end:g} s: {force:.0f} N, {row.whole.peak_kPa:.0f} kPa at most"
        context.tell("socket", row.time, end, words)

    found = don(problem, fit, regions, sensitivities=covariance is not None, on_row=told)
    if not found.result.completed:
        raise RunError(
            f"the socket could not be simulated to the end: {found.result.reason}; lower "
            "socket.reduction_percent or the areas' depths, or choose another socket.edge_mm"
        )
    content = _content(study, found, fit, covariance) | {
        "parameters": parameters,
        "parameters_from": parameters_from,
        "socket": _shape(study, socket, outer),
        "mesh": read_json(folder / "limb.json"),
    }
    write_json(folder / "socket.json", content)
    _write_fields(folder, mesh, found)
    _write_tables(folder, content)
    return {}


def _outer(context: Context, anatomy: Anatomy) -> tuple[Anatomy, Array | None]:
    """The anatomy whose skin is what the socket touches, and the depth of the fat below it."""
    table, surfaces = context.study.socket.liner, context.store["surfaces"]
    mapped = any(layer.thickness_mm is None for layer in context.study.geometry.model_layers)
    depth = read_thickness(surfaces / THICKNESS, anatomy.skin) if mapped else None
    if not table.thickness_mm:
        return anatomy, depth
    context.tell("socket", 0, 0, f"a liner of {table.thickness_mm:g} mm around the limb")
    return under_liner(anatomy, table.thickness_mm, depth)


def _settings(study: Study) -> MeshSettings:
    """How the whole limb is meshed."""
    table, settings = study.socket, mesh_settings(study)
    layers = settings.layers
    if table.liner.thickness_mm:
        layers = (LayerSpec(LINER, table.liner.thickness_mm), *layers)
    return replace(
        settings,
        element="tet10",
        layers=layers,
        edge_near_mm=table.edge_mm,
        edge_far_mm=max(FAR * table.edge_mm, settings.edge_far_mm),
        growth=GROWTH,
        flatness=FLATNESS,
    )


def _mesh(context: Context, folder: Path, outer: Anatomy, depth: Array | None, socket: Socket) -> Mesh:
    """The whole limb's mesh; that of an interrupted run is kept."""
    file = folder / "limb.vtu"
    if not (file.is_file() and file.with_suffix(".json").is_file()):
        context.tell("socket", 0, 0, "a mesh of the whole limb")
        fine = BELOW_BRIM_MM - float(outer.height(socket.points).max())
        mesh, report = mesh_limb(outer, _settings(context.study), max(fine, 0.0), depth)
        write_vtu(mesh, file)
        facts = {**asdict(report), "repairs": [repair.text for repair in report.repairs]}
        write_json(file.with_suffix(".json"), facts)
    return read_vtu(file)


def _fit(study: Study, anatomy: Anatomy, socket: Socket) -> Fit:
    table, known = study.socket, directions(anatomy, study.socket.side)
    knee = knee_centre(anatomy)
    loads = []
    for load in table.loads:
        force, moment, point = load_of(study, load, anatomy)
        loads.append(Load(load.name, force, moment, point, load.duration_s, load.hold_s))
    return Fit(
        pivot=anatomy.cut_point if knee is None else knee,
        proximal=known.proximal,
        anterior=known.anterior,
        friction=table.friction,
        donning_s=table.donning_s,
        hold_s=table.hold_s,
        travel_mm=None if table.donning == "growth" else table.travel_mm or _depth(socket, known.proximal),
        loads=tuple(loads),
    )


def _depth(socket: Socket, proximal: Array) -> float:
    """From the brim to the distal end, mm."""
    return float(np.ptp(socket.points @ proximal))


def _regions(regions: Mapping[str, Region], anatomy: Anatomy, mesh: Mesh, socket: Socket) -> dict[str, Mask]:
    """Which faces (f,) under the socket belong to each region: those whose nearest skin does."""
    middles = mesh.points[mesh.face_sets[OUTER][:, :3]].mean(axis=1)
    skin = igl.point_mesh_squared_distance(middles, anatomy.skin.points, anatomy.skin.faces)[1]
    nearest = igl.point_mesh_squared_distance(middles, socket.points, socket.faces)[1]
    covered = ~np.isin(socket.faces[nearest], socket.brim).any(axis=1)
    masks = {name: region.faces[skin] & covered for name, region in regions.items()}
    return {name: mask for name, mask in masks.items() if mask.any()}


def _covariance(context: Context, parameters_from: str) -> Array | None:
    """Of the logarithms of the tissues' parameters, where they were identified."""
    if parameters_from != "identified":
        return None
    return np.array(context.stored("calibrate", "calibration.json")["uncertainty"]["covariance_log"])


def _content(study: Study, found: Donned, fit: Fit, covariance: Array | None) -> dict[str, Any]:
    """What ``socket.json`` says of the simulation."""
    names = [f"{region}.{name}" for region, name in found.result.parameter_names]
    held = {name: _held(one, fit, _spread(study, names, covariance)) for name, one in found.held.items()}
    donned, base = held.pop("donning"), found.held["donning"].row
    loads = []
    for load in fit.loads:
        here = found.held[load.name].row
        settled = {"settling_mm": float(here.move[2] - base.move[2])}
        loads.append(
            {
                "name": load.name,
                "force_N": load.force,
                "moment_Nmm": load.moment,
                **settled,
                **held[load.name],
            }
        )
    statistics = found.result.statistics
    return {
        "seconds": statistics["seconds"]["total"],
        "penetration_mm": max((row.penetration_mm for row in found.rows), default=0.0),
        "balance_percent": 100.0 * max((row.imbalance for row in found.rows), default=0.0),
        "friction": fit.friction,
        "donning": donned,
        "loads": loads,
        "steps": [_step(row, fit) for row in found.rows],
        # How far it sinks in is told by itself: the wall's stiffness is stated, and no study's.
        "warnings": [doubt.text for doubt in found.result.doubts if doubt.kind != "sunk"],
        "statistics": {key: statistics[key] for key in ("steps", "cuts", "newton_iterations", "unknowns")},
    }


def _spread(study: Study, names: list[str], covariance: Array | None) -> Any:
    """Standard deviation of a value from its slopes (p,), by the identified parameters' covariance."""
    if covariance is None:
        return None
    short = {f"{tissue}.{key}": i for i, (tissue, key) in enumerate(study.parameters)}
    order = [names.index(name) for name in _solver_names(study)]
    assert len(order) == len(short)

    def deviation(slopes: Array) -> float:
        chosen = slopes[order]
        return float(np.sqrt(chosen @ covariance @ chosen))

    return deviation


def _solver_names(study: Study) -> list[str]:
    """The study's parameters by the names that the solver's materials give them."""
    return [f"{tissue}.{parameter.name}" for tissue in study.tissues for parameter in study.law.parameters]


def _held(one: Held, fit: Fit, deviation: Any) -> dict[str, Any]:
    def interval(name: str, value: float) -> list[float] | None:
        if deviation is None:
            return None
        sd = deviation(one.slopes[name])
        return [max(value - Z95 * sd, 0.0), value + Z95 * sd]

    def told(name: str, patch: Patch) -> dict[str, Any]:
        return {"region": name, **asdict(patch), "interval_kPa": interval(name, patch.mean_kPa)}

    row = one.row
    spread = None if deviation is None else Z95 * deviation(one.slopes[SETTLING])
    return {
        "time_s": row.time,
        "contact_area_mm2": row.contact_area_mm2,
        "peak_kPa": row.whole.peak_kPa,
        "mean_kPa": row.whole.mean_kPa,
        "shear_peak_kPa": row.whole.shear_peak_kPa,
        "settling_interval_mm": None if spread is None else [-spread, spread],
        "regions": [told(name, patch) for name, patch in row.regions.items()],
    }


def _step(row: Row, fit: Fit) -> dict[str, Any]:
    return {
        "time_s": row.time,
        "force_N": fit.frame.T @ row.force,
        "moment_Nmm": fit.frame.T @ row.moment,
        "move_mm": row.move,
        "turn_deg": row.turn,
        "contact_area_mm2": row.contact_area_mm2,
        "peak_kPa": row.whole.peak_kPa,
        "mean_kPa": row.whole.mean_kPa,
        "imbalance_percent": 100.0 * row.imbalance,
    }


def _shape(study: Study, socket: Socket, outer: Anatomy) -> dict[str, Any]:
    """What is told of the socket's shape."""
    table, depth = study.socket, socket.offset(outer.skin)
    return {
        "source": "rectified" if table.file is None else table.file.name,
        "reduction_percent": table.reduction_percent if table.file is None else None,
        "areas": [area.name for area in table.areas],
        "volume_cm3": socket.volume_mm3 / 1000.0,
        "deepest_mm": float(depth.max()),
        "notes": list(socket.notes),
        "liner": {"thickness_mm": table.liner.thickness_mm, "material": table.liner.material}
        | table.liner.parameters,
    }


def _write_fields(folder: Path, mesh: Mesh, found: Donned) -> None:
    """One VTU for donning and each load: pressure, shear and displacement at the nodes."""
    for i, one in enumerate(found.held.values()):
        fields = {"pressure_kPa": one.pressure, "shear_kPa": one.shear, "displacement_mm": one.displacement}
        write_vtu(mesh, folder / f"held-{i}.vtu", point_data=fields)


def _write_tables(folder: Path, content: Mapping[str, Any]) -> None:
    """Regions and steps as CSV."""
    columns = ("mean_kPa", "peak_kPa", "shear_kPa", "shear_peak_kPa")
    rows = [
        [name, region["region"], *(region[key] for key in columns), *(region["interval_kPa"] or ("", ""))]
        for name, held in (("donning", content["donning"]), *((one["name"], one) for one in content["loads"]))
        for region in held["regions"]
    ]
    write_table(folder / "regions.csv", ["load", "region", *columns, "low_kPa", "high_kPa"], rows)
    keys = ("time_s", "peak_kPa", "mean_kPa", "contact_area_mm2", "imbalance_percent")
    heads = [*keys, *(f"force_{axis}_N" for axis in "xyz"), "settling_mm"]
    lines = [[*(row[key] for key in keys), *row["force_N"], row["move_mm"][2]] for row in content["steps"]]
    write_table(folder / "steps.csv", heads, lines)
