"""The stage ``sensors``: a model of the limb in its socket, and what sensors in that socket read."""

from functools import partial
from pathlib import Path

import numpy as np

from ...results.socket import PlacedCell, PlacedSensor, SensorsResult
from ...socket.sensors import COMPARED
from ..engine.context import Context
from ..engine.store import ResultFiles, write_result
from .measured import OFF, place_sensors
from .shape import build_loadable_socket, mesh_edge_mm
from .simulation import SocketLimb

NAME = "sensors"
MODEL = "model"  # of the file with a packed `SocketModel`


def run_sensors(context: Context, folder: Path) -> None:
    """Draw the socket around the limb, place the cells of its sensors on it, and mesh the limb in it.

    The mesh of an interrupted run is kept. Errors as `build_loadable_socket` and `place_sensors`.
    """
    study, limb = context.study, SocketLimb.from_context(context, NAME)
    socket = build_loadable_socket(study, limb.anatomy, limb.outer.skin)
    sensors = []
    for table in study.socket.measured:
        recording, states, stretch = place_sensors(study, table, socket, limb.anatomy, limb.outer.skin)
        means = recording.frames.mean(axis=0)
        columns = {
            "cell": recording.names,
            "state": states,
            "position_mm": recording.position,
            "area_mm2": recording.area_mm2,
            "measured_kPa": [value if np.isfinite(value) else None for value in means.tolist()],
        }
        cells = [PlacedCell(**dict(zip(columns, values))) for values in zip(*columns.values(), strict=True)]
        stated = table.model_dump(include={"name", "load", "error_kPa", "error_percent"})
        sensors.append(PlacedSensor(**stated, stretch_percent=stretch, cells=cells))
        count = states.count(COMPARED)
        words = f"{table.name}: {count} of {len(cells)} cells count, {states.count(OFF)} are {OFF}"
        context.tell(NAME, 0, 0, words)
    mesh, facts = limb.mesh(folder, socket, partial(context.tell, NAME, 0, 0))
    ResultFiles(folder).put(MODEL, limb.build_model(socket, mesh).pack())
    limb.write_face(socket, folder / "socket-face.vtp")
    content = SensorsResult(edge_mm=mesh_edge_mm(study, socket), mesh=facts, sensors=sensors)
    write_result(folder / f"{NAME}.json", content)
