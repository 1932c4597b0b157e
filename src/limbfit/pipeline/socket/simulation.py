"""The limb of a study as sockets are put on it, and a socket put on and loaded: a job, and what is stored."""

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
from ..engine.context import Context
from ..engine.digests import code_digest, compute_digest, compute_file_digest
from ..engine.store import Made, ResultFiles
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
    def from_context(cls, context: Context, name: str) -> SocketLimb:
        """That of a study whose surfaces are stored; ``name`` is the experiment's, for its progress."""
        study, surfaces = context.study, context.store["surfaces"]
        anatomy, thickness = load_anatomy(surfaces), study.socket.liner.thickness_mm
        outer, depth = anatomy, read_stored_depth(surfaces, anatomy, mesh_settings(study))
        if thickness:
            context.tell(name, 0, 0, f"a liner of {thickness:g} mm around the limb")
            outer, depth = build_liner_surface(anatomy, thickness, depth)
        regions, fibres = build_regions(study, anatomy), find_fibre_directions(context)
        return cls(study, anatomy, outer, depth, regions, fibres)

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

    @property
    def liner(self) -> LinerFacts:
        """What is stored of the liner."""
        table = self.study.socket.liner
        return LinerFacts(thickness_mm=table.thickness_mm, material=table.material, **table.parameters)


@dataclass(frozen=True, eq=False)
class SocketRun:
    """A socket's face that is put on a meshed limb and loaded, and where what comes of it is kept.

    With ``sensitivities`` there are derivatives by the ``parameters`` of the tissues. ``threads`` are by
    default the machine's.
    """

    name: str
    limb: SocketLimb
    mesh: Mesh
    parameters: Parameters
    face: Socket
    kept: ResultFiles | None = None
    sensitivities: bool = False
    threads: int | None = None

    @cached_property
    def fit(self) -> SocketFit:
        """How the socket comes on the limb, and its loads."""
        study, anatomy, socket = self.limb.study, self.limb.anatomy, self.face
        table, known = study.socket, find_directions(anatomy, study.socket.side)
        loads = []
        for load in table.loads:
            force, moment, point = load_of(study, load, anatomy, socket)
            loads.append(Load(load.name, force, moment, point, load.duration_s, load.hold_s))
        depth = float(np.ptp(socket.points @ known.proximal))
        return SocketFit(
            pivot=find_load_point(anatomy, socket.points[socket.brim]),
            proximal=known.proximal,
            anterior=known.anterior,
            friction=table.friction,
            donning_s=table.donning_s,
            hold_s=table.hold_s,
            travel_mm=None if table.donning == "growth" else table.travel_mm or depth,
            loads=tuple(loads),
        )

    def write_face(self, file: Path) -> None:
        """Write the face with its signed distance from the unloaded limb, negative where pressed in."""
        face = self.face.surface.to_pyvista()
        face.point_data["offset_mm"] = -self.face.offset(self.limb.outer.skin)
        face.save(file)

    @cached_property
    def faces(self) -> dict[str, NDArray[np.bool_]]:
        """Which faces (f,) under the socket belong to each region: those whose nearest skin does."""
        limb, middles = self.limb, self.mesh.points[self.mesh.face_sets[OUTER][:, :3]].mean(axis=1)
        return find_covered_regions(middles, limb.anatomy.skin, limb.regions, self.face)

    @property
    def laws(self) -> dict[str, Material]:
        """Of the tissues and the liner."""
        load_extensions(self.limb.study.extensions)  # a worker has not read the study
        table, liner = self.limb.study.material, self.limb.study.socket.liner
        kappa, fibres = table.kappa_ratio, dict(self.limb.fibres)
        laws = build_materials(self.parameters, kappa, table.law, fibres, table.relaxation_span_s)
        return laws | build_materials({LINER: liner.parameters}, kappa) if liner.thickness_mm else laws

    @cached_property
    def key(self) -> str:
        """Of all that decides what the socket does to the limb, whose mesh lies above what is kept."""
        assert self.kept is not None
        study, face, fit = self.limb.study, self.face, self.fit
        table = study.socket.model_dump(mode="json", exclude={"design", "worn_s", "measured"})
        # Regions and loads follow from the names of the bones as well, which no mesh and no table holds.
        loads = [(*load.force, *load.moment, *load.point) for load in fit.loads]
        regions = {name: mask.tolist() for name, mask in self.faces.items()}
        return compute_digest(
            *(table, study.material.model_dump(mode="json"), self.parameters, self.sensitivities),
            *(compute_file_digest(self.kept.folder.parent / MESH), code_digest(solve_run)),
            *(face.points.tolist(), face.clear.tolist(), compute_extensions_digest(study.extensions)),
            *(fit.pivot.tolist(), loads, regions),
        )

    @property
    def partial_key(self) -> str:
        """The key under which it is kept after donning and each load, to go on where it was killed."""
        return f"begun-{self.key}"


def solve_run(run: SocketRun, tell: Callable[[float, float, str], None]) -> DonningResult:
    """Put a socket on and load it; ``tell`` is given the time, the end of all, both s, and words.

    Raises `RunError` where the simulation does not come to its end.
    """
    fit, kept = run.fit, run.kept
    end = fit.ends[-1][2]

    def report_row(row: SocketStep) -> None:
        force = float(np.linalg.norm(row.force))
        words = f"{row.time:.2f} of {end:g} s: {force:.0f} N, {row.whole.peak_kPa:.0f} kPa at most"
        tell(row.time, end, words)

    problem = build_socket_problem(run.mesh, run.laws, run.face, fit)
    before = None if kept is None else kept.find(run.partial_key)
    found = simulate_donning(
        replace(problem, fibres=build_fibre_field(run.limb.fibres, run.mesh)),
        fit,
        run.faces,
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
    fit, names, statistics = run.fit, found.result.parameter_names, found.result.statistics
    spread = None if known is None else SimulationSpread.make(run.limb.study, names, known)
    held = {name: _summarise_state(run, one, spread) for name, one in found.held.items()}
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


def _summarise_state(run: SocketRun, one: LoadedState, spread: SimulationSpread | None) -> dict[str, Any]:
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
        "inside": _summarise_strain(run, one),
    }


def _summarise_strain(run: SocketRun, one: LoadedState) -> list[dict[str, Any]]:
    """Strain of each tissue under the liner, and where most: the place at rest, the region nearest to it."""
    mesh, faces = run.mesh, run.faces
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
