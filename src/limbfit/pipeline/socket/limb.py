"""The limb of a study as sockets are put on it: meshed whole under its liner, with loads and regions."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...anatomy.meshing.layers import LayerSpec
from ...anatomy.meshing.liner import build_liner_surface
from ...anatomy.meshing.meshing import MeshSettings, mesh_limb
from ...anatomy.surfaces.surfaces import Anatomy, load_anatomy
from ...arrays import Array
from ...donning import (
    SETTLING,
    DonningResult,
    Load,
    LoadedState,
    Patch,
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
from ...fe import SimulationWarning
from ...fe.materials import Material
from ...indentation import Direction, Parameters, build_fibre_field, build_materials
from ...mesh import Mesh, read_vtu
from ...results.limb import MeshMeasures
from ...socket import Socket
from ...socket.landmarks import SkinRegion, find_directions, find_load_point
from ...study import Study
from ..engine.context import Context
from ..engine.digests import code_digest, compute_digest, compute_file_digest
from ..engine.partial_results import Begun, Made, ResultFiles
from ..limb.mesh import is_meshed, keep_mesh, mesh_settings, read_mesh_facts, read_stored_depth
from ..simulation.limb_geometry import find_fibre_directions
from .intervals import ParameterSpread, SimulationSpread, spread_to_facts
from .shape import build_regions, find_covered_regions, load_of, mesh_edge_mm

Mask = NDArray[np.bool_]

LINER, MESH = "liner", "limb.vtu"
BELOW_BRIM_MM = 15.0  # edges are short from so far above the brim on
FAR, GROWTH, FLATNESS = 3.5, 0.5, 1.6  # edges near the proximal cut over those below, and how elements grow


@dataclass(frozen=True, eq=False)
class SocketLimb:
    """What sockets are put on.

    Attributes
    ----------
    anatomy : skin and bones; ``outer`` has what the socket touches for its skin.
    depth : of the fat below that, where it is mapped.
    regions : of the skin, by name.
    fibres : their direction in each tissue that has some.
    """

    study: Study
    anatomy: Anatomy
    outer: Anatomy
    depth: Array | None
    regions: Mapping[str, SkinRegion]
    fibres: tuple[tuple[str, Direction], ...]

    @classmethod
    def of(cls, context: Context, name: str) -> SocketLimb:
        """That of a study whose surfaces are stored; ``name`` is the experiment's, for its progress."""
        study, surfaces = context.study, context.store["surfaces"]
        anatomy, thickness = load_anatomy(surfaces), study.socket.liner.thickness_mm
        outer, depth = anatomy, read_stored_depth(surfaces, anatomy, mesh_settings(study))
        if thickness:
            context.tell(name, 0, 0, f"a liner of {thickness:g} mm around the limb")
            outer, depth = build_liner_surface(anatomy, thickness, depth)
        return cls(
            study, anatomy, outer, depth, build_regions(study, anatomy), find_fibre_directions(context)
        )

    def materials(self, parameters: Parameters) -> dict[str, Material]:
        """Of the tissues and the liner."""
        table, liner = self.study.material, self.study.socket.liner
        kappa = table.kappa_ratio
        laws = build_materials(parameters, kappa, table.law, dict(self.fibres), table.relaxation_span_s)
        return laws | build_materials({LINER: liner.parameters}, kappa) if liner.thickness_mm else laws

    def mesh(self, context: Context, name: str, folder: Path, brim: Socket) -> tuple[Mesh, MeshMeasures]:
        """The whole limb's mesh and its facts; that of an interrupted run is kept."""
        self.fit(brim)  # a load that is not known is refused before anything is meshed
        file = folder / MESH
        if not is_meshed(file):
            context.tell(name, 0, 0, "a mesh of the whole limb")
            fine = BELOW_BRIM_MM - float(self.outer.height(brim.points).max())
            settings = self._settings(mesh_edge_mm(self.study, brim))
            mesh, facts = mesh_limb(self.outer, settings, max(fine, 0.0), self.depth)
            keep_mesh(mesh, facts, file)
        return read_vtu(file), read_mesh_facts(file)

    def _settings(self, edge_mm: float) -> MeshSettings:
        table, settings = self.study.socket, mesh_settings(self.study)
        layers = settings.layers
        if table.liner.thickness_mm:
            layers = (LayerSpec(LINER, table.liner.thickness_mm), *layers)
        return replace(
            settings,
            element="tet10",
            layers=layers,
            edge_near_mm=edge_mm,
            edge_far_mm=max(FAR * edge_mm, settings.edge_far_mm),
            growth=GROWTH,
            flatness=FLATNESS,
        )

    def fit(self, socket: Socket) -> SocketFit:
        """How a socket comes on this limb, and its loads."""
        table, known = self.study.socket, find_directions(self.anatomy, self.study.socket.side)
        loads = []
        for load in table.loads:
            force, moment, point = load_of(self.study, load, self.anatomy, socket)
            loads.append(Load(load.name, force, moment, point, load.duration_s, load.hold_s))
        depth = float(np.ptp(socket.points @ known.proximal))
        return SocketFit(
            pivot=find_load_point(self.anatomy, socket.points[socket.brim]),
            proximal=known.proximal,
            anterior=known.anterior,
            friction=table.friction,
            donning_s=table.donning_s,
            hold_s=table.hold_s,
            travel_mm=None if table.donning == "growth" else table.travel_mm or depth,
            loads=tuple(loads),
        )

    def faces(self, mesh: Mesh, socket: Socket) -> dict[str, Mask]:
        """Which faces (f,) under a socket belong to each region: those whose nearest skin does."""
        middles = mesh.points[mesh.face_sets[OUTER][:, :3]].mean(axis=1)
        return find_covered_regions(middles, self.anatomy.skin, self.regions, socket)

    def key(self, folder: Path, parameters: Parameters, socket: Socket, sensitivities: bool = False) -> str:
        """Of all that decides what a socket does to this limb, whose `mesh` is kept in the folder."""
        table = self.study.socket.model_dump(mode="json", exclude={"design", "worn_s"})
        return compute_digest(
            *(table, self.study.material.model_dump(mode="json"), parameters, sensitivities),
            *(compute_file_digest(folder / MESH), code_digest(SocketLimb.of), code_digest(simulate_donning)),
            *(socket.points.tolist(), socket.clear.tolist()),
        )

    def don(
        self,
        mesh: Mesh,
        laws: Mapping[str, Material],
        socket: Socket,
        told: Callable[[float, float, str], None],
        sensitivities: bool = False,
        threads: int | None = None,
        begun: Begun | None = None,
    ) -> DonningResult:
        """Put a socket on and load it.

        Parameters
        ----------
        told : is given the time, the end of all, both s, and words.
        threads : by default the machine's.
        begun : where it is kept after donning and each load, and goes on where it was killed.

        Raises
        ------
        RunError
            Where the simulation does not come to its end.
        """
        fit = self.fit(socket)
        end = fit.ends[-1][2]

        def on_row(row: SocketStep) -> None:
            force = float(np.linalg.norm(row.force))
            words = f"{row.time:.2f} of {end:g} s: {force:.0f} N, {row.whole.peak_kPa:.0f} kPa at most"
            told(row.time, end, words)

        problem = replace(
            build_socket_problem(mesh, laws, socket, fit), fibres=build_fibre_field(self.fibres, mesh)
        )
        before = None if begun is None else begun.latest()
        found = simulate_donning(
            problem,
            fit,
            self.faces(mesh, socket),
            sensitivities=sensitivities,
            on_row=on_row,
            threads=threads,
            keep=None if begun is None else lambda part: begun.put(pack(part)),
            begin=None if before is None else unpack(*before),
        )
        if not found.result.completed:
            raise RunError(_describe_stop(found, fit))
        return found

    def facts(
        self, found: DonningResult, socket: Socket, known: ParameterSpread | None = None
    ) -> dict[str, Any]:
        """What is stored of a simulation, with intervals where parameters are ``known`` so well."""
        fit = self.fit(socket)
        spread = (
            None if known is None else SimulationSpread.of(self.study, found.result.parameter_names, known)
        )
        mesh = found.result.problem.mesh
        faces = self.faces(mesh, socket)
        held = {
            name: _loaded_to_dict(one, spread) | {"inside": _summarise_strain(mesh, one, faces)}
            for name, one in found.held.items()
        }
        donned, base = held.pop("donning"), found.held["donning"].row
        loads = []
        for load in fit.loads:
            here = found.held[load.name]
            depth = float(here.row.move[2] - base.move[2])
            settled = {"settling_mm": depth}
            settled |= spread_to_facts(spread, "settling_", "mm", depth, here.slopes.get(SETTLING))
            stated = {"name": load.name, "force_N": load.force, "moment_Nmm": load.moment}
            loads.append({**stated, **settled, **held[load.name]})
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
            "warnings": [format_warning(doubt) for doubt in found.result.doubts if doubt.kind != "sunk"],
            "statistics": {
                key: statistics[key] for key in ("steps", "cuts", "newton_iterations", "unknowns")
            },
        }

    @property
    def liner(self) -> dict[str, Any]:
        """What is stored of the liner."""
        table = self.study.socket.liner
        return {"thickness_mm": table.thickness_mm, "material": table.material} | table.parameters


@dataclass(frozen=True, eq=False)
class SocketRun:
    """A job: a socket's face that is put on a limb and loaded, and where what comes of it is kept."""

    name: str
    limb: SocketLimb
    mesh: Mesh
    laws: Mapping[str, Material]
    face: Socket
    kept: ResultFiles
    key: str
    threads: int | None = None


def run_sockets(
    jobs: Sequence[SocketRun], executor: Executor, tell: Callable[[float, str], None]
) -> list[str]:
    """Do the jobs side by side; why each could not be done, in words, nothing where it was.

    ``tell`` is given how many are done, with parts, and words. What was kept before is not done again.
    """
    left = [job for job in jobs if job.kept.find(job.key) is None]
    beside: Executor = executor if len(left) > 1 else SerialExecutor()
    shares, before = dict.fromkeys((job.name for job in left), 0.0), len(jobs) - len(left)

    def told(job: SocketRun, message: tuple[float, str]) -> None:
        shares[job.name], words = message
        tell(before + sum(shares.values()), f"{job.name}: {words}")

    threads = beside.threads_for(len(left))
    reasons = beside.map(_run_socket, [replace(job, threads=threads) for job in left], on_report=told)
    found = dict(zip(shares, reasons, strict=True))
    return [found.get(job.name, "") for job in jobs]


def _run_socket(job: SocketRun) -> str:
    """Do a job, which reports how far it is, from 0 to 1, in words; why it does not come to its end."""
    try:
        simulate_socket(job)
    except RunError as error:
        return str(error)
    return ""


def simulate_socket(job: SocketRun) -> Made:
    """Facts, and pressure, shear and displacement at the mesh's nodes after donning and each load."""

    begun = Begun(job.kept, job.key)

    def told(time: float, end: float, words: str) -> None:
        report_progress([time / end, words])

    def make() -> Made:
        found = job.limb.don(job.mesh, job.laws, job.face, told, threads=job.threads, begun=begun)
        fields = {
            f"{name}.{part}": getattr(held, part)
            for name, held in found.held.items()
            for part in ("pressure", "shear", "displacement")
        }
        return job.limb.facts(found, job.face), fields

    made = job.kept.get(job.key, make)
    begun.drop()
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


def _loaded_to_dict(one: LoadedState, spread: SimulationSpread | None) -> dict[str, Any]:
    def of(name: str, patch: Patch) -> dict[str, Any]:
        known = spread_to_facts(spread, "", "kPa", patch.mean_kPa, one.slopes.get(name))
        return {"region": name, **asdict(patch), **known}

    row = one.row
    return {
        "time_s": row.time,
        "contact_area_mm2": row.contact_area_mm2,
        "peak_kPa": row.whole.peak_kPa,
        "mean_kPa": row.whole.mean_kPa,
        "shear_peak_kPa": row.whole.shear_peak_kPa,
        "regions": [of(name, patch) for name, patch in row.regions.items()],
    }


def _summarise_strain(mesh: Mesh, one: LoadedState, faces: Mapping[str, Mask]) -> list[dict[str, Any]]:
    """Strain of each tissue under the liner, and where most: the place at rest, the region nearest to it."""
    middles = mesh.points[mesh.face_sets[OUTER][:, :3]].mean(axis=1)
    rows = []
    for number, tissue in enumerate(mesh.region_names):
        if tissue == LINER:
            continue
        found = asdict(one.strains.within(mesh.regions == number))
        place = mesh.points[mesh.cells[found.pop("cell"), :4]].mean(axis=0)
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
