"""Pressures that sensors in the socket measured, beside those of the model at the same places.

The stage ``sensors`` stores where they are, and the mesh of the limb in its socket, for the calibration.

Cells move and turn with the socket, and the limb slides under them. The model's pressure is the mean over a
cell's area; its interval is that of the smallest region around the cell, in proportion to the pressures.
Agreement is that of Bland and Altman (Lancet 1986, 327:307): the mean of model minus measured, and limits
between which 95 % of such differences lie.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from ...anatomy.meshing.layers import build_liner_surface
from ...anatomy.sites.markups import read_markups
from ...anatomy.surfaces.surfaces import Anatomy
from ...anatomy.surfaces.thickness import interpolate_values
from ...anatomy.surfaces.triangles import Surface
from ...arrays import Array, Indices
from ...donning import DonningResult, LoadedState, extract_outer_surface
from ...donning.model import OUTER
from ...errors import StudyError, add_location
from ...identify.fit.prediction import NORMAL_95
from ...results.socket import (
    MeasuredCell,
    PlacedCell,
    PlacedSensor,
    PressureAgreement,
    SensorComparison,
    SensorsResult,
)
from ...socket import Socket
from ...socket.rays import compute_profile
from ...socket.sensors import COMPARED, SensorFrames, SheetLayout, read_recording
from ...socket.wrapping import wrap_sheet
from ...study import Study
from ...study.socket import MeasuredTable
from ..engine.context import Context
from ..engine.store import write_result
from ..simulation.loading import LimbAxis
from .shape import build_loadable_socket, build_socket, mesh_edge_mm, place_errors
from .simulation import SocketLimb, SocketModel, SocketRun

NAME = "sensors"
OFF, ALL = "off the socket", "all"  # a cell that the face does not reach, and cells of any region
# Points of a disc of radius 1, and their weights: exact to the fifth order (Abramowitz and Stegun, 25.4.61).
_TURNS = np.radians(60.0 * np.arange(6))
DISC = np.vstack([[0.0, 0.0], np.sqrt(2.0 / 3.0) * np.column_stack([np.cos(_TURNS), np.sin(_TURNS)])])
WEIGHTS = np.array([1 / 4, *[1 / 8] * 6])
_READ = ("area_mm2", "measured_kPa")  # of a cell


def read_sensors(study: Study, table: MeasuredTable) -> SensorFrames:
    """Read a recording; what the study states wins over its file. Raises `InputError` with the remedy."""
    layout = None
    if table.rows and table.columns and table.spacing_mm:
        layout = SheetLayout((table.rows, table.columns), table.spacing_mm)
    keys = {"from_s": "start_s", "to_s": "end_s"} | {key: key for key in ("noise_kPa", "saturation_kPa")}
    stated = {keys[key]: value for key, value in table if key in keys and value is not None}
    return read_recording(study.path(table.file), layout, table.format, **stated)


def place_sensors(
    study: Study, table: MeasuredTable, socket: Socket, anatomy: Anatomy, outer: Surface
) -> PlacedSensor:
    """Place what a table of ``socket.measured`` states on a socket around the ``outer`` surface of a limb.

    A cell that the socket does not reach is `OFF` it. Raises `InputError` for what cannot be right, with the
    remedy.
    """
    recording, place = read_sensors(study, table), f"socket.measured.{table.name}"
    points, layout, stretch = recording.position, recording.layout, None
    with add_location(study.file, place), place_errors(study, place):
        known = {} if table.markups is None else read_markups(study.path(table.markups))
        for one in table.landmarks:
            if one.marker is not None and one.marker not in known:
                raise StudyError(f"no marker is named {one.marker!r}", remedy=f"there are {', '.join(known)}")
            if layout and (one.row > layout.shape[0] or one.column > layout.shape[1]):
                remedy = f"there are {layout.shape[0]} rows of {layout.shape[1]} cells"
                raise StudyError(f"no cell {one.row}-{one.column} for a landmark", remedy=remedy)
        if points is None:
            points = np.array([known[one.marker] if one.marker else one.position for one in table.landmarks])
        far = np.sqrt(socket.surface.find_nearest(points)[0])
        if far.max() > table.within_mm:
            what = "landmark" if layout else "cell"
            what += f" {far.argmax() + 1} lies {far.max():.0f} mm from the socket's face"
            raise StudyError(what, remedy="correct its position (LPS, mm), or state a larger within_mm")
        if layout is not None and recording.place is not None:
            marked = np.array([(one.row - 1, one.column - 1) for one in table.landmarks])
            rays = compute_profile(outer, anatomy.frame).rays
            whole, stretch = wrap_sheet(layout, marked, points, socket, rays, anatomy.frame)
            points = whole[tuple(recording.place.T)]
    covers, means = socket.find_covered(points), recording.frames.mean(axis=0)
    columns = {
        "cell": recording.names,
        "state": [state if there else OFF for state, there in zip(recording.states, covers, strict=True)],
        "position_mm": points,
        "area_mm2": recording.area_mm2,
        "measured_kPa": [mean if np.isfinite(mean) else None for mean in means.tolist()],
    }
    cells = [PlacedCell(**dict(zip(columns, values))) for values in zip(*columns.values(), strict=True)]
    stated = table.model_dump(include={"name", "load", "error_kPa", "error_percent"})
    return PlacedSensor(**stated, stretch_percent=stretch, cells=cells)


def run_sensors(context: Context, folder: Path) -> None:
    """Draw the socket around the limb, place the cells of its sensors on it, and mesh the limb in it.

    The mesh of an interrupted run is kept. Raises `StudyError` where no cell can be compared, and errors as
    `build_loadable_socket` and `place_sensors`.
    """
    study, tell = context.study, partial(context.tell, NAME, 0, 0)
    limb = SocketLimb.from_store(study, context.store, tell)
    socket = build_loadable_socket(study, limb.anatomy, limb.outer.skin)
    tables, outer = study.socket.measured, limb.outer.skin
    sensors = [place_sensors(study, table, socket, limb.anatomy, outer) for table in tables]
    for one in sensors:
        tell(f"{one.name}: {one.words}")
    if not any(COMPARED in one.counts for one in sensors):
        raise StudyError("no cell can be compared", file=study.file, place="socket.measured")
    _, facts = limb.mesh(folder, socket, tell)
    limb.write_face(socket, folder / "socket-face.vtp")
    content = SensorsResult(edge_mm=mesh_edge_mm(study, socket), mesh=facts, sensors=sensors)
    write_result(folder / f"{NAME}.json", content)


def stack_cells(cells: Sequence[PlacedCell]) -> tuple[Array, Array, Array]:
    """Positions (n, 3) mm, areas (n,) mm2 and mean readings (n,) kPa of cells; nan where there is none."""
    positions = np.array([cell.position_mm for cell in cells]).reshape(-1, 3)
    areas, measured = (np.array([getattr(cell, key) for cell in cells], float) for key in _READ)
    return positions, areas, measured


def describe_measured(study: Study, anatomy: Anatomy | None) -> list[str]:
    """Say what is known of the recordings of ``socket.measured``; they are placed where the limb is known.

    The socket is drawn around the liner, or a sheet would be too long for it. Errors as `place_sensors`.
    """
    tables, said = study.socket.measured, []
    if anatomy is None or not tables:
        return [f"socket.measured.{one.name}: {len(read_sensors(study, one).names)} cells" for one in tables]
    thickness = study.socket.liner.thickness_mm
    outer = _build_outer_surface(anatomy, thickness) if thickness else anatomy.skin
    socket = build_socket(study, anatomy, outer)
    for one in tables:
        said.append(f"socket.measured.{one.name}: {place_sensors(study, one, socket, anatomy, outer).words}")
    return said


@lru_cache(maxsize=1)  # a check asks twice
def _build_outer_surface(anatomy: Anatomy, liner_mm: float) -> Surface:
    return build_liner_surface(anatomy, liner_mm)[0].skin


def compare_measured(
    limb: SocketLimb, run: SocketRun, found: DonningResult, content: Mapping[str, Any]
) -> tuple[list[SensorComparison], list[PressureAgreement]]:
    """Compare every recording of a study with a simulation, whose intervals are those of its ``content``."""
    axis, model, sensors = LimbAxis(limb.anatomy), run.model, []
    held = {one["name"]: one for one in content["loads"]} | {"donning": content["donning"]}
    sizes = {name: mask.sum() for name, mask in model.faces.items()}
    for table in limb.study.socket.measured:
        placed = place_sensors(limb.study, table, model.face, limb.anatomy, limb.outer.skin)
        points, areas, measured = stack_cells(placed.cells)
        simulated, below = sample_pressure(model, found.held[table.load], points, areas)
        rows = {row["region"]: row for row in held[table.load]["regions"]}
        faces = below[:, 0] % len(model.mesh.face_sets[OUTER])  # its parts come one after another
        around = [sorted((n for n in sizes if model.faces[n][face]), key=sizes.__getitem__) for face in faces]
        pairs = zip(simulated, around, strict=True)
        columns = {
            "regions": around,
            "level_mm": axis.measure_level(points),
            "angle_deg": axis.measure_angle(points),
            "error_kPa": np.hypot(table.error_kPa, 0.01 * table.error_percent * np.nan_to_num(measured)),
            "model_kPa": simulated,
            "interval_kPa": [_scale_interval(p, [rows[name] for name in names]) for p, names in pairs],
        }
        beside = [dict(zip(columns, values)) for values in zip(*columns.values(), strict=True)]
        of_cells = zip(placed.cells, beside, strict=True)
        cells = [MeasuredCell(**cell.model_dump(), **more) for cell, more in of_cells]
        named = placed.model_dump(include={"name", "load", "stretch_percent"})
        sensors.append(SensorComparison(**named, counts=placed.counts, cells=cells))
    return sensors, summarise_agreement(sensors)


def _scale_interval(value: float, rows: Sequence[Mapping[str, Any]]) -> list[float] | None:
    """The interval of the first region that has one, in proportion to a value; None where none has."""
    known = (row for row in rows if row["interval_kPa"] is not None and row["mean_kPa"] > 0.0)
    return next(([value * end / row["mean_kPa"] for end in row["interval_kPa"]] for row in known), None)


def sample_pressure(
    model: SocketModel, held: LoadedState, points: Array, area_mm2: Array, onto: Indices | None = None
) -> tuple[Array, Indices]:
    """Mean pressure (n,) kPa over discs on the socket, and the limb's triangles (n, d) below their points.

    ``points`` (n, 3) are their middles where the socket is donned, with areas (n,). ``onto``: triangles of an
    earlier call, which the pressure is taken from again as if each went on beyond its edges. So pressures of
    nearly the same state can be differentiated: the nearest triangle may change in between, and they jump.
    """
    fit, row, wall = model.fit, held.row, model.face.surface
    normal = wall.face_normals[wall.find_nearest(points)[1]]
    along = np.cross(normal, np.eye(3)[np.abs(normal).argmin(axis=1)])
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    across = DISC @ np.stack([along, np.cross(normal, along)], axis=1)
    over = points[:, None] + np.sqrt(area_mm2 / np.pi)[:, None, None] * across
    turn = Rotation.from_rotvec(np.radians(row.turn) @ fit.frame)
    moved = fit.pivot + row.move @ fit.frame + turn.apply(over.reshape(-1, 3) - fit.pivot)
    surface = extract_outer_surface(model.mesh, held.displacement)
    if onto is None:
        _, face, moved = surface.find_nearest(moved)
    else:
        face = onto.reshape(-1)
    outer = np.unique(model.mesh.face_sets[OUTER])
    values = interpolate_values(surface, held.pressure[outer][None], face, moved)[0]
    return values.reshape(-1, len(DISC)) @ WEIGHTS, face.reshape(-1, len(DISC))


def summarise_agreement(sensors: Sequence[SensorComparison]) -> list[PressureAgreement]:
    """How model and measured pressures agree, by load and by region: all cells first, then each region."""
    inside: dict[tuple[str, str], list[MeasuredCell]] = {}
    for one in sensors:
        for cell in (cell for cell in one.cells if cell.state == COMPARED):
            for region in (ALL, *cell.regions):
                inside.setdefault((one.load, region), []).append(cell)
    return [_compute_agreement(load, region, cells) for (load, region), cells in inside.items()]


def _compute_agreement(load: str, region: str, cells: Sequence[MeasuredCell]) -> PressureAgreement:
    measured, error, model = np.array([(c.measured_kPa, c.error_kPa, c.model_kPa) for c in cells], float).T
    ends = np.array([cell.interval_kPa or (cell.model_kPa, cell.model_kPa) for cell in cells])
    off = model - measured
    half = np.abs(np.where(off > 0.0, ends[:, 0], ends[:, 1]) - model)  # on the side of the reading
    bias, spread = float(off.mean()), NORMAL_95 * float(np.std(off, ddof=1)) if len(off) > 1 else None
    return PressureAgreement(
        load=load,
        region=region,
        cells=len(cells),
        measured_kPa=float(measured.mean()),
        model_kPa=float(model.mean()),
        bias_kPa=bias,
        limits_kPa=None if spread is None else (bias - spread, bias + spread),
        within_percent=100.0 * float(np.mean(np.abs(off) <= np.hypot(error, half))),
    )
