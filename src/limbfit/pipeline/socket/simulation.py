"""The limb of a study, a model of it in a socket, and the simulation of that as a job with stored results."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...anatomy.meshing.layers import LayerSpec, build_liner_surface
from ...anatomy.meshing.meshing import mesh_limb
from ...anatomy.surfaces.surfaces import Anatomy, load_anatomy
from ...arrays import Array
from ...donning import (
    SETTLING,
    DonningResult,
    Load,
    LoadedState,
    SocketFit,
    SocketStep,
    build_socket_problem,
    pack,
    simulate_donning,
    unpack,
)
from ...donning.model import OUTER
from ...errors import RunError
from ...execution import Executor, SerialExecutor, report_progress
from ...extensions import compute_extensions_digest, load_extensions
from ...fe import SimulationWarning
from ...fe.materials import Material
from ...indentation import Direction, Parameters, build_fibre_field, build_materials
from ...mesh import Mesh, read_vtu
from ...results.limb import MeshMeasures
from ...results.socket import LinerFacts
from ...socket import Socket
from ...socket.landmarks import SkinRegion, find_directions, find_load_point
from ...study import Study
from ..engine.digests import code_digest, compute_digest
from ..engine.store import Made, ResultFiles, Store
from ..limb.mesh import is_meshed, keep_mesh, mesh_settings, read_mesh_facts, read_stored_depth
from ..simulation.limb_geometry import find_fibre_directions
from .intervals import ParameterSpread, SimulationSpread, spread_to_facts
from .shape import LINER, build_regions, find_covered_regions, load_of, mesh_edge_mm

MESH = "limb.vtu"
BELOW_BRIM_MM = 15.0  # edges are short from so far above the brim on
FAR, GROWTH, FLATNESS = 3.5, 0.5, 1.6  # edges near the proximal cut over those below, and how elements grow


@dataclass(frozen=True, eq=False)
class SocketLimb:
    """What sockets are put on: its ``anatomy``, and ``outer``, which has what a socket touches for its skin.

    ``depth`` is that of the fat below, where it is mapped, ``regions`` are those of the skin, by name, and
    ``fibres`` their direction in each tissue that has some.
    """

    study: Study
    anatomy: Anatomy
    outer: Anatomy
    depth: Array | None
    regions: Mapping[str, SkinRegion]
    fibres: tuple[tuple[str, Direction], ...]

    @classmethod
    def from_store(cls, study: Study, store: Store, report: Callable[..., None]) -> SocketLimb:
        """That of a study whose surfaces are stored; ``report`` is given a line where a liner is made."""
        surfaces, thickness = store["surfaces"], study.socket.liner.thickness_mm
        outer = anatomy = load_anatomy(surfaces)
        depth = read_stored_depth(surfaces, anatomy, mesh_settings(study))
        if thickness:
            report(f"a liner of {thickness:g} mm around the limb")
            outer, depth = build_liner_surface(anatomy, thickness, depth)
        fibres = find_fibre_directions(study, store.results)
        return cls(study, anatomy, outer, depth, build_regions(study, anatomy), fibres)

    def mesh(self, folder: Path, brim: Socket, report: Callable[[str], None]) -> tuple[Mesh, MeshMeasures]:
        """The whole limb's mesh and its facts; that of an interrupted run is kept."""
        file = folder / MESH
        if not is_meshed(file):
            report("a mesh of the whole limb")
            fine = BELOW_BRIM_MM - float(self.outer.height(brim.points).max())
            edge_mm, liner_mm = mesh_edge_mm(self.study, brim), self.study.socket.liner.thickness_mm
            settings, liner = mesh_settings(self.study), (LayerSpec(LINER, liner_mm),) if liner_mm else ()
            settings = replace(
                settings,
                element="tet10",
                layers=(*liner, *settings.layers),
                edge_near_mm=edge_mm,
                edge_far_mm=max(FAR * edge_mm, self.study.mesh.edge_far_mm),  # no pins press there
                growth=GROWTH,
                flatness=FLATNESS,
            )
            mesh, facts = mesh_limb(self.outer, settings, max(fine, 0.0), self.depth)
            keep_mesh(mesh, facts, file)
        return read_vtu(file), read_mesh_facts(file)

    def build_model(self, face: Socket, mesh: Mesh) -> SocketModel:
        """The model of the limb with this ``mesh`` in a socket with this ``face``."""
        study, anatomy = self.study, self.anatomy
        table, known = study.socket, find_directions(anatomy, study.socket.side)
        loads = []
        for load in table.loads:
            force, moment, point = load_of(study, load, anatomy, face)
            loads.append(Load(load.name, force, moment, point, load.duration_s, load.hold_s))
        depth = float(np.ptp(face.points @ known.proximal))
        fit = SocketFit(
            pivot=find_load_point(anatomy, face.points[face.brim]),
            proximal=known.proximal,
            anterior=known.anterior,
            friction=table.friction,
            donning_s=table.donning_s,
            hold_s=table.hold_s,
            travel_mm=None if table.donning == "growth" else table.travel_mm or depth,
            loads=tuple(loads),
        )
        middles = mesh.points[mesh.face_sets[OUTER][:, :3]].mean(axis=1)
        faces = find_covered_regions(middles, anatomy.skin, self.regions, face)
        return SocketModel(study, mesh, face, fit, faces, self.fibres)

    def write_face(self, face: Socket, file: Path) -> None:
        """Write a face with its signed distance from the unloaded limb, negative where pressed in."""
        drawn = face.surface.to_pyvista()
        drawn.point_data["offset_mm"] = -face.offset(self.outer.skin)
        drawn.save(file)

    @property
    def liner(self) -> LinerFacts:
        """What is stored of the liner."""
        table = self.study.socket.liner
        return LinerFacts(thickness_mm=table.thickness_mm, material=table.material, **table.parameters)


@dataclass(frozen=True, eq=False)
class SocketModel:
    """A limb in a socket, ready to be simulated: what a `SiteModel` is for an indentation.

    ``fit`` is how the socket of this ``face`` comes on the limb of this ``mesh``, and its loads. ``faces``
    are masks (f,) by region: the limb's outer faces under the socket whose nearest skin belongs to it.
    ``fibres`` have a direction in each tissue that has some. Laws and the liner are the study's.
    """

    study: Study
    mesh: Mesh
    face: Socket
    fit: SocketFit
    faces: Mapping[str, NDArray[np.bool_]]
    fibres: tuple[tuple[str, Direction], ...]

    def build_laws(self, parameters: Parameters) -> dict[str, Material]:
        """Those of the tissues with their ``parameters``, and of the liner."""
        load_extensions(self.study.extensions)  # a worker has not read the study
        table, liner = self.study.material, self.study.socket.liner
        kappa, fibres = table.kappa_ratio, dict(self.fibres)
        laws = build_materials(parameters, kappa, table.law, fibres, table.relaxation_span_s)
        return laws | build_materials({LINER: liner.parameters}, kappa) if liner.thickness_mm else laws

    @cached_property
    def digest(self) -> str:
        """Of all that decides what the socket does to the limb, but for the parameters of its tissues."""
        study, mesh, face = self.study, self.mesh, self.face
        return compute_digest(
            *(study.material.model_dump(mode="json"), study.socket.liner.model_dump(mode="json")),
            *(mesh.points, mesh.cells, mesh.regions, mesh.region_names, mesh.held, mesh.face_sets[OUTER]),
            *(face.points, face.faces, face.clear, asdict(self.fit), self.faces, self.fibres),
            *(compute_extensions_digest(study.extensions), code_digest(solve_run)),
        )


@dataclass(frozen=True, eq=False)
class SocketRun:
    """A model that is simulated with the ``parameters`` of its tissues, and where what comes of it is kept.

    With ``sensitivities`` there are derivatives by these. ``threads`` are by default the machine's.
    """

    name: str
    model: SocketModel
    parameters: Parameters
    kept: ResultFiles | None = None
    sensitivities: bool = False
    threads: int | None = None

    @cached_property
    def key(self) -> str:
        """Of all that decides what comes of it."""
        return compute_digest(self.model.digest, self.parameters, self.sensitivities)

    @property
    def partial_key(self) -> str:
        """The key under which it is kept after donning and each load, to go on where it was killed."""
        return f"begun-{self.key}"


def solve_run(run: SocketRun, tell: Callable[[float, float, str], None]) -> DonningResult:
    """Put a socket on and load it; ``tell`` is given the time, the end of all, both s, and words.

    Raises `RunError` where the simulation does not come to its end.
    """
    model, kept = run.model, run.kept
    fit = model.fit
    end = fit.ends[-1][2]

    def report_row(row: SocketStep) -> None:
        force = float(np.linalg.norm(row.force))
        words = f"{row.time:.2f} of {end:g} s: {force:.0f} N, {row.whole.peak_kPa:.0f} kPa at most"
        tell(row.time, end, words)

    problem = build_socket_problem(model.mesh, model.build_laws(run.parameters), model.face, fit)
    before = None if kept is None else kept.find(run.partial_key)
    found = simulate_donning(
        replace(problem, fibres=build_fibre_field(model.fibres, model.mesh)),
        fit,
        model.faces,
        sensitivities=run.sensitivities,
        on_row=report_row,
        threads=run.threads,
        keep=None if kept is None else lambda part: kept.put(run.partial_key, pack(part)),
        begin=None if before is None else unpack(*before),
    )
    if not found.result.completed:
        raise RunError(_describe_stop(found, fit))
    return found


def run_sockets(
    runs: Sequence[SocketRun], executor: Executor, tell: Callable[[float, str], None]
) -> list[str]:
    """Do them side by side; why each could not be done, in words, nothing where it was.

    ``tell`` is given how many are done, with parts, and words. What was kept before is not done again.
    """
    left = [run for run in runs if run.kept is not None and run.kept.find(run.key) is None]
    beside: Executor = executor if len(left) > 1 else SerialExecutor()
    shares, before = dict.fromkeys((run.name for run in left), 0.0), len(runs) - len(left)

    def tell_share(run: SocketRun, message: tuple[float, str]) -> None:
        shares[run.name], words = message
        tell(before + sum(shares.values()), f"{run.name}: {words}")

    threads = beside.threads_for(len(left))
    reasons = beside.map(_run_socket, [replace(run, threads=threads) for run in left], on_report=tell_share)
    found = dict(zip(shares, reasons, strict=True))
    return [found.get(run.name, "") for run in runs]


def _run_socket(run: SocketRun) -> str:
    """Do it, and report how far it is, from 0 to 1, in words; why it does not come to its end."""
    try:
        simulate_socket(run)
    except RunError as error:
        return str(error)
    return ""


def simulate_socket(run: SocketRun) -> Made:
    """Facts, and pressure, shear and displacement at the mesh's nodes after donning and each load; kept."""
    assert run.kept is not None

    def make() -> Made:
        found = solve_run(run, lambda time, end, words: report_progress([time / end, words]))
        fields = {
            f"{name}.{part}": getattr(held, part)
            for name, held in found.held.items()
            for part in ("pressure", "shear", "displacement")
        }
        return summarise_run(run, found), fields

    made = run.kept.get(run.key, make)
    run.kept.drop(run.partial_key)
    return made


def format_warning(doubt: SimulationWarning) -> str:
    """A doubt about a simulation in the words of a socket: that of folded elements names an indenter."""
    if doubt.kind != "folded":
        return doubt.text
    return (
        f"{doubt.count} elements of the limb are inside out at a node, and pressures near them may be too "
        "small: choose a smaller socket.edge_mm"
    )


def _describe_stop(found: DonningResult, fit: SocketFit) -> str:
    """Why a simulation did not come to its end, and what may be done about it."""
    last = found.rows[-1] if found.rows else None
    time = 0.0 if last is None else last.time
    during = next((name for name, _, off in fit.ends if time < off - 1e-9), fit.ends[-1][0])
    if during == "donning" or last is None:
        return (
            f"the socket could not be put on: {found.result.reason}; lower socket.reduction_percent or the "
            "areas' depths, or choose another socket.edge_mm"
        )
    reached, moved = np.linalg.norm(last.force), np.linalg.norm(last.move)
    return (
        f"the load {during!r} could not be carried beyond {reached:.0f} N, with the socket {moved:.0f} mm "
        f"from where it was put on: {found.result.reason}; see whether the "
        "force presses the socket onto the limb (socket.loads.force_N, LPS), and whether anything holds it: "
        "socket.friction, an end that bears (socket.distal)"
    )


def summarise_run(
    run: SocketRun, found: DonningResult, known: ParameterSpread | None = None
) -> dict[str, Any]:
    """What is stored of a simulation, with intervals where parameters are ``known`` so well."""
    model, names, statistics = run.model, found.result.parameter_names, found.result.statistics
    fit, spread = model.fit, None if known is None else SimulationSpread.make(model.study, names, known)
    held = {name: _summarise_state(model, one, spread) for name, one in found.held.items()}
    base, loads = found.held["donning"].row, []
    for load in fit.loads:
        here = found.held[load.name]
        depth = float(here.row.move[2] - base.move[2])
        settled = spread_to_facts(spread, "settling_", "mm", depth, here.slopes.get(SETTLING))
        stated = {"name": load.name, "force_N": load.force, "moment_Nmm": load.moment, "settling_mm": depth}
        loads.append({**stated, **settled, **held[load.name]})
    return {
        "seconds": statistics["seconds"]["total"],
        "penetration_mm": max((row.penetration_mm for row in found.rows), default=0.0),
        "balance_percent": 100.0 * max((row.imbalance for row in found.rows), default=0.0),
        "friction": fit.friction,
        "donning": held["donning"],
        "loads": loads,
        "steps": [_step(row, fit) for row in found.rows],
        # How far it sinks in is told by itself: the wall's stiffness is stated, and no study's.
        "warnings": [format_warning(doubt) for doubt in found.result.doubts if doubt.kind != "sunk"],
        "statistics": {key: statistics[key] for key in ("steps", "cuts", "newton_iterations", "unknowns")},
    }


def _summarise_state(model: SocketModel, one: LoadedState, spread: SimulationSpread | None) -> dict[str, Any]:
    row = one.row
    return {
        "time_s": row.time,
        "contact_area_mm2": row.contact_area_mm2,
        "peak_kPa": row.whole.peak_kPa,
        "mean_kPa": row.whole.mean_kPa,
        "shear_peak_kPa": row.whole.shear_peak_kPa,
        "regions": [
            {"region": name, **asdict(patch)}
            | spread_to_facts(spread, "", "kPa", patch.mean_kPa, one.slopes.get(name))
            for name, patch in row.regions.items()
        ],
        "inside": _summarise_strain(model, one),
    }


def _summarise_strain(model: SocketModel, one: LoadedState) -> list[dict[str, Any]]:
    """Strain of each tissue under the liner, and where most: the place at rest, the region nearest to it."""
    mesh, faces = model.mesh, model.faces
    middles = mesh.points[mesh.face_sets[OUTER][:, :3]].mean(axis=1)
    rows = []
    for number, tissue in enumerate(mesh.region_names):
        if tissue == LINER:
            continue
        found, most_sheared = one.strains.summarise_cells(mesh.regions == number)
        place = mesh.points[mesh.cells[most_sheared, :4]].mean(axis=0)
        far = np.linalg.norm(middles - place, axis=1)
        near = min(faces, key=lambda name: float(far[faces[name]].min()), default=None)
        rows.append({"tissue": tissue, **found, "place_mm": place, "near": near})
    return rows


def _step(row: SocketStep, fit: SocketFit) -> dict[str, Any]:
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
