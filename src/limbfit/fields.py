"""Fields of a simulation as files for ParaView: one step as VTU, all steps as a PVD collection.

Names and units are those of docs/fields.md; stress is Cauchy stress in the order xx, yy, zz, xy, yz, zx,
which is also VTK's order of symmetric tensors.
"""

from pathlib import Path

import numpy as np

from .arrays import Array
from .fe import Problem, State, Step, System
from .fe.memory import Memory
from .fe.observables import (
    average_at_nodes,
    compute_contact_pressure,
    compute_element_fields,
    compute_von_mises,
)
from .mesh import write_pvd, write_vtu

KPA = 1e-3  # MPa


def write_fields(system: System, problem: Problem, state: State, file: Path) -> None:
    """Write the fields of a state as VTU (see `state_fields`); points are at rest."""
    point_data, cell_data = state_fields(system, problem, state)
    write_vtu(problem.mesh, file, point_data=point_data, cell_data=cell_data)


def state_fields(system: System, problem: Problem, state: State) -> tuple[dict[str, Array], dict[str, Array]]:
    """Fields at points (n, ..) and of cells (m, ..) of a state that kept its memory, by name and unit.

    ``displacement_mm`` moves the points from rest.  The state is one of a `Step` that `iterate` yields, or
    the one kept with ``store="peak"``.
    """
    laws = problem.build_laws()
    fields = compute_element_fields(system, laws, state)
    cauchy = fields.cauchy / KPA
    point_data = {
        "displacement_mm": state.u,
        "contact_pressure_kPa": compute_contact_pressure(system, laws, state) / KPA,
        "cauchy_nodal_kPa": average_at_nodes(system, cauchy),
    }
    cell_data = {
        "cauchy_kPa": cauchy,
        "von_mises_kPa": compute_von_mises(cauchy),
        "largest_stretch": fields.stretches[:, 0],
        "middle_stretch": fields.stretches[:, 1],
        "smallest_stretch": fields.stretches[:, 2],
        "J": fields.J,
        "energy_density_kPa": fields.energy / KPA,
    }
    return point_data, cell_data


def rest(system: System, problem: Problem) -> State:
    """The state before the first step."""
    memory = Memory.rest(system, problem.build_laws())
    return State(
        0.0, problem.history.displacement_at(0.0), np.zeros_like(problem.mesh.points), 0.0, memory=memory
    )


class Animation:
    """Fields of every step: ``<name>.pvd`` and, in a folder of the same name, ``step-0000.vtu`` (rest), ..

    The collection is written anew after every step, so that what was reached can be played when a simulation
    stops early.
    """

    def __init__(self, problem: Problem, file: Path) -> None:
        self.problem, self.file = problem, file
        self.system = System(problem)
        self.folder = file.with_suffix("")
        self.folder.mkdir(parents=True, exist_ok=True)
        for old in self.folder.glob("step-*.vtu"):
            old.unlink()
        self.frames: list[tuple[float, Path]] = []
        self._write(rest(self.system, problem))

    def add(self, step: Step) -> None:
        """Write one step; give it to `solve` as ``on_step``."""
        self._write(step.state)

    def _write(self, state: State) -> None:
        frame = self.folder / f"step-{len(self.frames):04d}.vtu"
        write_fields(self.system, self.problem, state, frame)
        self.frames.append((state.time, frame))
        write_pvd(self.file, self.frames)
