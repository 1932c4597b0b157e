"""Pressures that sensors in a socket measured, as part of the identification.

The socket is simulated at the answer with derivatives, and what is most probable is found with the pressures
as they are to first order about it. That is repeated until it no longer moves what is compared.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from scipy.linalg import block_diag

from ...arrays import Array
from ...donning import DonningResult
from ...identify.fit.calibration import Calibration
from ...identify.fit.prediction import NORMAL_95
from ...identify.fit.readings import LinearisedReadings, add_scatter
from ...identify.uncertainty.uncertainty import Uncertainty
from ...mesh import read_vtu
from ...results.identification import PressureRound, SocketPressures
from ...results.socket import PlacedSensor
from ...socket.sensors import COMPARED
from ...study import Study
from ..engine.digests import code_digest, compute_digest
from ..engine.store import RUNS, Made, ResultFiles, Store
from ..socket.measured import NAME as SENSORS
from ..socket.measured import sample_pressure, stack_cells
from ..socket.shape import build_loadable_socket
from ..socket.simulation import MESH, SocketLimb, SocketModel, SocketRun, solve_run
from .answer import FineMeshCorrection, sample_intervals
from .search import RecordSimulator, Report

FOLDER = "socket"
MAX_ROUNDS = 4
TOLERANCE_SD = 0.3  # of what all pressures together tell: it is enough that they move by less
NOT_SETTLED = "the parameters still moved when the socket had been simulated as often as it may be"
_STEP = 1e-4  # of a parameter's logarithm, for derivatives


@dataclass(frozen=True, eq=False)
class CellReadings:
    """All cells of a study that can be compared with a simulation, whatever their recording.

    ``position`` (n, 3) mm, ``off`` (n,) kPa: measured less simulated, the ``derivatives`` (n, p) of the
    simulated ones with respect to the logarithms of the study's parameters, and the sensors' ``covariance``
    (n, n). The stated percentage counts twice: for each cell, and for the gain of its whole recording.
    """

    position: Array
    off: Array
    derivatives: Array
    covariance: Array


@dataclass(frozen=True, eq=False)
class PressureSimulator:
    """Simulates the socket of a ``study`` on the mesh of the stage ``sensors``, and compares its pressures.

    What was simulated is kept in the calibration's ``folder``; what the one before has kept counts as well.
    ``report`` is given lines of progress.
    """

    study: Study
    store: Store
    folder: Path
    report: Report

    @cached_property
    def model(self) -> SocketModel:
        """The limb in the socket."""
        limb = SocketLimb.from_store(self.study, self.store, self.report)
        socket = build_loadable_socket(self.study, limb.anatomy, limb.outer.skin)
        return limb.build_model(socket, read_vtu(self.store[SENSORS] / MESH))

    def read_cells(self, parameters: Array, title: str) -> CellReadings:
        """Simulate the socket with these parameters (p,), and compare; what was kept is not done again."""
        kept = ResultFiles(self.folder / RUNS, also=[self.store["calibrate"] / FOLDER / RUNS])
        run = SocketRun("calibrate", self.model, self.study.by_tissue(parameters), kept, sensitivities=True)
        sensors = self.store.results.sensors.sensors

        def make() -> Made:
            found = solve_run(run, lambda time, end, words: self.report(f"{title}: {words}"))
            return {}, vars(compare_cells(self.model, sensors, found))

        cells = [one.to_plain() for one in sensors]
        _, arrays = kept.get(compute_digest(run.key, cells, code_digest(compare_cells)), make)
        kept.drop(run.partial_key)
        return CellReadings(**arrays)


def compare_cells(model: SocketModel, sensors: Sequence[PlacedSensor], found: DonningResult) -> CellReadings:
    """Compare sensors with a simulation that has sensitivities."""
    study, names, parts = model.study, list(found.result.parameter_names), []
    own = [(tissue, parameter.name) for tissue in study.tissues for parameter in study.law.parameters]
    for sensor in sensors:
        held, cells = found.held[sensor.load], [cell for cell in sensor.cells if cell.state == COMPARED]
        points, areas, measured = stack_cells(cells)
        simulated, below = sample_pressure(model, held, points, areas)
        derivatives = np.zeros((len(points), len(own)))
        for i, name in enumerate(own):
            if name in names:  # fibres that a tissue has not change nothing
                step = _STEP * np.eye(len(names))[names.index(name)]
                near = [held.extrapolate(by) for by in (step, -step)]
                ends = [sample_pressure(model, one, points, areas, below)[0] for one in near]
                derivatives[:, i] = (ends[0] - ends[1]) / (2.0 * _STEP)
        share, own_sd = 0.01 * sensor.error_percent / NORMAL_95, sensor.error_kPa / NORMAL_95
        # Of simulated pressures: a gain over measured ones would draw the answer to small pressures.
        gain, alone = share * simulated, own_sd**2 + (share * measured) ** 2
        parts.append((points, measured - simulated, derivatives, np.diag(alone) + np.outer(gain, gain)))
    positions, offs, slopes, covariances = zip(*parts, strict=True)
    together = np.concatenate(positions), np.concatenate(offs), np.concatenate(slopes)
    return CellReadings(*together, block_diag(*covariances))


def count_pressures(
    pressures: PressureSimulator,
    simulator: RecordSimulator,
    answer: Calibration,
    correction: FineMeshCorrection,
) -> tuple[Calibration, Uncertainty, SocketPressures]:
    """Find what is most probable by records and pressures, from the ``answer`` to the records alone.

    Returned are that, what is known of it, and what the pressures told. The simulator's problem counts the
    pressures from then on. Raises `RunError` where the socket cannot be simulated.
    """
    now, rounds, edge_mm = answer.parameters, list[PressureRound](), pressures.store.results.sensors.edge_mm
    while True:
        title = f"socket, simulation {len(rounds) + 1}"
        cells = pressures.read_cells(now, title)
        covariance, scatter_kPa = add_scatter(cells.covariance, cells.off, cells.position, edge_mm)
        readings = LinearisedReadings.weigh(cells.off, cells.derivatives, covariance, np.log(now))
        simulator.count_readings(readings)
        found, known = sample_intervals(simulator, answer, correction)
        moved = float(np.linalg.norm(readings.rows @ np.log(found.parameters / now)))
        rounds.append(
            PressureRound(
                parameters=pressures.study.by_tissue(now),
                rms_kPa=float(np.sqrt(np.mean(cells.off**2))),
                bias_kPa=-float(cells.off.mean()),
                scatter_kPa=scatter_kPa,
                moved_sd=moved,
            )
        )
        words = f"{len(cells.off)} cells off by {rounds[-1].rms_kPa:.1f} kPa (RMS)"
        pressures.report(f"{title}: {words}, then parameters that move them by {moved:.2f} deviations")
        now, settled = found.parameters, moved < TOLERANCE_SD
        if settled or len(rounds) == MAX_ROUNDS:
            break
    if not settled:
        pressures.report(f"warning: {NOT_SETTLED}")
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
