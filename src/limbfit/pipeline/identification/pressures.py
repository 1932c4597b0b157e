"""Pressures that sensors in a socket measured, as part of the identification.

The socket is simulated at the answer with derivatives, and what is most probable is found with the pressures
as they are to first order about it. That is repeated until it no longer moves what is compared.
"""

from functools import partial
from pathlib import Path

import numpy as np

from ...identify.fit.calibration import Calibration
from ...identify.fit.readings import LinearisedReadings, add_scatter
from ...identify.uncertainty.uncertainty import Uncertainty
from ...results.identification import PressureRound, SocketPressures
from ..engine.context import Context
from ..engine.digests import code_digest, compute_digest, compute_file_digest
from ..engine.store import RUNS, Made, ResultFiles
from ..socket.measured import CellReadings, read_cells
from ..socket.shape import build_loadable_socket, mesh_edge_mm
from ..socket.simulation import SocketLimb, SocketRun, solve_run
from .answer import FineMeshCorrection, sample_intervals
from .search import RecordSimulator

FOLDER = "socket"
MAX_ROUNDS = 4
TOLERANCE_SD = 0.3  # of what all pressures together tell: it is enough that they move by less
NOT_SETTLED = "the parameters still moved when the socket had been simulated as often as it may be"


def count_pressures(
    context: Context,
    folder: Path,
    simulator: RecordSimulator,
    answer: Calibration,
    correction: FineMeshCorrection,
) -> tuple[Calibration, Uncertainty, SocketPressures]:
    """Find what is most probable by records and pressures, from the ``answer`` to the records alone.

    Returned are that, what is known of it, and what the pressures told. ``folder`` is the stage's own. The
    simulator's problem counts the pressures from then on. Raises `RunError` where the socket cannot be
    simulated.
    """
    study, tell = context.study, partial(context.tell, "calibrate", 0, 0)
    limb = SocketLimb.from_context(context, "calibrate")
    socket = build_loadable_socket(study, limb.anatomy, limb.outer.skin)
    own, edge_mm = folder / FOLDER, mesh_edge_mm(study, socket)
    kept = ResultFiles(own / RUNS, also=[context.store["calibrate"] / FOLDER / RUNS])
    mesh, _ = limb.mesh(own, socket, tell)
    now, rounds = answer.parameters, list[PressureRound]()
    while True:
        title = f"socket, simulation {len(rounds) + 1}"
        run = SocketRun("calibrate", limb, mesh, study.by_tissue(now), socket, kept, sensitivities=True)
        cells = _simulate_cells(context, run, title)
        covariance, scatter_kPa = add_scatter(cells.covariance, cells.off, cells.position, edge_mm)
        readings = LinearisedReadings.weigh(cells.off, cells.derivatives, covariance, np.log(now))
        simulator.count_readings(readings)
        found, known = sample_intervals(simulator, answer, correction)
        moved = float(np.linalg.norm(readings.rows @ np.log(found.parameters / now)))
        rounds.append(
            PressureRound(
                parameters=run.parameters,
                rms_kPa=float(np.sqrt(np.mean(cells.off**2))),
                bias_kPa=-float(cells.off.mean()),
                scatter_kPa=scatter_kPa,
                moved_sd=moved,
            )
        )
        words = f"{len(cells.off)} cells off by {rounds[-1].rms_kPa:.1f} kPa (RMS)"
        tell(f"{title}: {words}, then parameters that move them by {moved:.2f} deviations")
        now, settled = found.parameters, moved < TOLERANCE_SD
        if settled or len(rounds) == MAX_ROUNDS:
            break
    if not settled:
        tell(f"warning: {NOT_SETTLED}")
    content = SocketPressures(
        cells=len(cells.off),
        settled=settled,
        rounds=rounds,
        rows=readings.rows.tolist(),
        target=readings.target.tolist(),
        share=dict(zip(known.names, known.prior_share.tolist(), strict=True)),
        wider_without=dict(zip(known.names, known.wider_without.tolist(), strict=True)),
    )
    return found, known, content


def _simulate_cells(context: Context, run: SocketRun, title: str) -> CellReadings:
    """Simulate the socket and compare; what was kept is not done again."""
    assert run.kept is not None
    study = run.limb.study

    def make() -> Made:
        found = solve_run(run, lambda time, end, words: context.tell("calibrate", 0, 0, f"{title}: {words}"))
        return {}, vars(read_cells(run, found))

    tables = [one.model_dump(mode="json") for one in study.socket.measured]
    files = [path for one in study.socket.measured for path in (one.file, one.markups) if path is not None]
    digests = [compute_file_digest(study.path(file)) for file in files]
    _, arrays = run.kept.get(compute_digest(run.key, tables, digests, code_digest(read_cells)), make)
    run.kept.drop(run.partial_key)
    return CellReadings(**arrays)
