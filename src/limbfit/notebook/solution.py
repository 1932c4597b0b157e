"""A simulation that shows itself: its curve as a plot, its steps as grids of pyvista."""

import sys
from collections.abc import Callable
from dataclasses import dataclass, fields

import numpy as np
import pyvista as pv
from matplotlib import pyplot
from matplotlib.axes import Axes

from ..errors import ProblemError
from ..fe import Problem, Result, State, Step, StepControl, System
from ..fe import solve as simulate
from ..fe.kernel.assembly import is_compiled
from ..fields import rest, state_fields

COMPILING = "limbfit compiles its kernels: half a minute, once on this machine"


@dataclass(frozen=True, repr=False)
class Solution(Result):
    """A `Result` that shows itself; ``frames`` are rest and every step, stresses included."""

    frames: tuple[State, ...] = ()

    def __repr__(self) -> str:
        ended = "complete" if self.completed else f"incomplete: {self.reason}"
        steps, end = len(self.times) - 1, self.times[-1]
        return f"<Solution: {steps} steps to {end:g} s, {self.peak_force:.3g} N at most, {ended}>"

    def to_pyvista(self, step: int | None = None) -> pv.UnstructuredGrid:
        """The mesh at rest with the fields of a step; ``grid.warp_by_vector("displacement_mm")`` moves it.
        The grid has arrays of its own: what is changed in it changes neither mesh nor solution.

        ``step``: 0 is rest, -1 the last; by default the deepest of the loading. Fields and units are those of
        ``docs/fields.md``: stress, stretch, contact pressure.
        """
        if step is None:
            frame = self.deepest
        else:
            frame = self.frames[step] if -len(self.frames) <= step < len(self.frames) else None
        if frame is None:
            has = f"there are {len(self.frames)}" if self.frames else "it was solved without frames"
            raise ProblemError(f"no step {step}: {has}", remedy="count from 0, which is rest")
        mesh = self.problem.mesh
        grid = pv.UnstructuredGrid({mesh.kind.vtk: mesh.cells}, mesh.points.copy())
        system = self.system or System(self.problem)
        point_data, cell_data = state_fields(system, self.problem, frame)
        for data, arrays in ((grid.point_data, point_data), (grid.cell_data, cell_data)):
            for name, values in arrays.items():
                data[name] = np.array(values)
        grid.cell_data["region"] = mesh.regions.copy()
        grid.field_data["region_names"] = list(mesh.region_names)  # for `read_vtu`, where it is saved
        return grid

    def plot(self, axes: Axes | None = None, label: str = "") -> Axes:
        """Draw force (N) against displacement (mm), on new axes where none are given."""
        axes = axes or new_axes()
        times = np.linspace(0.0, self.times[-1], 400)
        axes.plot(self.displacement_at(times), self.force_at(times), label=label or "simulated")
        axes.plot(self.displacement, self.force, ".", color=axes.lines[-1].get_color())
        axes.set(xlabel="displacement, mm", ylabel="force, N")
        return axes


def solve(
    problem: Problem,
    steps: StepControl | None = None,
    *,
    sensitivities: bool = False,
    frames: bool = True,
    listener: Callable[[Step], None] | None = None,
) -> Solution:
    """Simulate an indentation.

    Parameters
    ----------
    steps : how it steps, and on how many threads; the defaults need no change.
    sensitivities : also the derivative of the force with respect to every material parameter.
    frames : keep every step with its stresses, for `Solution.to_pyvista`; without, the deepest alone.
    listener : called with every step.

    Raises
    ------
    ProblemError
        Before anything is solved, where the problem is impossible as stated. A simulation that cannot go on
        is no error: the solution says ``completed = False`` and why.
    """
    announce_compilation()
    states: list[State] = []

    def keep(step: Step) -> None:
        if frames:
            states.append(step.state)
        if listener is not None:
            listener(step)

    result = simulate(problem, steps or StepControl(), sensitivities=sensitivities, on_step=keep)
    if frames:
        states.insert(0, rest(result.system, problem))
    return Solution(**{f.name: getattr(result, f.name) for f in fields(Result)}, frames=tuple(states))


def new_axes() -> Axes:
    """Axes on a new figure of pyplot: a notebook shows it, ``pyplot.show()`` does so in a script."""
    _, axes = pyplot.subplots(figsize=(5, 4), layout="constrained")
    return axes


def announce_compilation() -> None:
    """Say so on standard error where the kernels are not compiled yet: a first run seems to hang."""
    if not is_compiled():
        sys.stderr.write(COMPILING + "\n")
