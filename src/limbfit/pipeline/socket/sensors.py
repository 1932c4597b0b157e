"""The stage ``sensors``: a model of the limb in its socket, and what sensors in that socket read."""

from functools import partial
from pathlib import Path

from ...results.socket import SensorsResult
from ..engine.context import Context
from ..engine.store import ResultFiles, write_result
from .measured import place_sensors
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
    tables, outer = study.socket.measured, limb.outer.skin
    sensors = [place_sensors(study, table, socket, limb.anatomy, outer) for table in tables]
    for one in sensors:
        context.tell(NAME, 0, 0, f"{one.name}: {one.words}")
    mesh, facts = limb.mesh(folder, socket, partial(context.tell, NAME, 0, 0))
    ResultFiles(folder).put(MODEL, limb.build_model(socket, mesh).pack())
    limb.write_face(socket, folder / "socket-face.vtp")
    content = SensorsResult(edge_mm=mesh_edge_mm(study, socket), mesh=facts, sensors=sensors)
    write_result(folder / f"{NAME}.json", content)
