"""A FEBio input solved by limbfit, with the tables that its own output section asks for."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from io import TextIOBase
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError, ProblemError, RunError
from ..fe import Problem, Result, Step, System, solve
from ..fe.laws import Laws
from ..fe.observables import ElementFields, element_fields
from ..fe.system import Increment
from .model import FebModel, read_feb
from .problem import Body, deformable_body, drive, step_control, to_problem, touching_body
from .requests import Request

Array = NDArray[np.float64]
_CAUCHY = ("sx", "sy", "sz", "sxy", "syz", "sxz")


@dataclass(frozen=True)
class FebRun:
    """What came of a FEBio input: the simulation, the files written, and what was left out."""

    result: Result
    files: tuple[Path, ...]
    notes: tuple[str, ...]


def run_feb(
    path: str | Path,
    output: str | Path,
    on_step: Callable[[Step, float], None] | None = None,
    keep: bool = False,
    **settings: Any,
) -> FebRun:
    """Solve a FEBio input and write its log-file tables into the folder ``output``.

    Parameters
    ----------
    on_step : called with every accepted step and the time of the last one, s.
    keep : refuse to write over files that are there.
    settings : fields of `StepControl` that replace what the input says (``times``, ``threads``, ..).

    Raises
    ------
    ProblemError
        Where the input cannot be read or holds what limbfit does not know; with its line.
    RunError
        Where the tables cannot be written.
    """
    folder, model = Path(output), read_feb(path)
    try:
        problem = to_problem(model)
        control = step_control(model, problem, **settings)
        tables = _Tables(model, problem, folder, Path(path).stem)
    except ProblemError as error:
        raise ProblemError(error.what, file=path, place=error.place, remedy=error.remedy) from None
    assert control.times is not None
    for table in tables.files:
        own = table.exists() and table.samefile(path)
        if own or (keep and table.exists()):
            raise InputError("is there already", file=table, remedy="give another folder with --output")
    last = control.times[-1]

    def accepted(step: Step) -> None:
        tables.add(step)
        if on_step is not None:
            on_step(step, last)

    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tables:
            result = solve(problem, control, on_step=accepted, store="peak")
    except OSError as error:
        raise RunError(f"{folder}: {error.strerror or error}") from error
    return FebRun(result, tables.files, model.notes)


class _Tables:
    """The tables of a model, written step by step, so that what was reached is there when it stops."""

    def __init__(self, model: FebModel, problem: Problem, folder: Path, stem: str) -> None:
        self.model, self.problem = model, problem
        self.body: Body = deformable_body(model)
        self.axis = drive(model).axis
        self.system = System(problem)
        self.laws = Laws.build([problem.materials[name] for name in problem.mesh.region_names])
        self.count = 0
        names = [request.file or f"{stem}.log" for request in model.requests]
        self.paths = [folder / name for name in names]
        self.streams: dict[Path, TextIOBase] = {}

    @property
    def files(self) -> tuple[Path, ...]:
        return tuple(dict.fromkeys(self.paths))

    def __enter__(self) -> _Tables:
        for path in self.files:
            self.streams[path] = path.open("w", encoding="utf-8")
        self._write(0.0, None)
        return self

    def __exit__(self, *_: object) -> None:
        for stream in self.streams.values():
            stream.close()

    def add(self, step: Step) -> None:
        """Write one accepted step."""
        self._write(step.time, step)

    def _write(self, time: float, step: Step | None) -> None:
        needed = any(request.kind == "element_data" for request in self.model.requests)
        fields = element_fields(self.system, self.laws, step.state) if step is not None and needed else None
        for request, path in zip(self.model.requests, self.paths):
            stream = self.streams[path]
            head = f"*Step  = {self.count}\n*Time  = {time:.9g}\n*Data  = {';'.join(request.names)}\n"
            stream.write(head)
            numbers, columns = self._columns(request, step, fields)
            for i in np.flatnonzero([request.wants(int(number)) for number in numbers]):
                values = (f"{column[i]:.12g}" for column in columns)
                stream.write(request.delimiter.join([str(numbers[i]), *values]) + "\n")
            stream.flush()
        self.count += 1

    def _columns(
        self, request: Request, step: Step | None, fields: ElementFields | None
    ) -> tuple[NDArray[np.int64], list[Array]]:
        """FEBio's numbers of the items, and a column per name."""
        mesh = self.body.mesh
        u = np.zeros_like(mesh.points) if step is None else step.state.u
        if request.kind == "node_data":
            found = dict(zip(("x", "y", "z", "ux", "uy", "uz"), np.hstack([mesh.points + u, u]).T))
            numbers = self.model.geometry.node_ids[self.body.nodes]
        elif request.kind == "element_data":
            found = self._of_elements(mesh.points + u, fields)
            numbers = self.body.cell_ids
        else:
            found = self._of_rigid(step)
            numbers = np.array([body.number for body in self.model.rigid.values()])
        return numbers, [found[name] for name in request.names]

    def _of_elements(self, points: Array, fields: ElementFields | None) -> dict[str, Array]:
        cells = self.body.mesh.cells
        stress = np.zeros((len(cells), 6)) if fields is None else fields.cauchy
        found = dict(zip(_CAUCHY, stress.T))
        xx, yy, zz, xy, yz, zx = stress.T
        tensor = np.stack([xx, xy, zx, xy, yy, yz, zx, yz, zz], axis=1).reshape(-1, 3, 3)
        found |= dict(zip(("s3", "s2", "s1"), np.linalg.eigvalsh(tensor).T))
        found |= dict(zip(("x", "y", "z"), points[cells].mean(axis=1).T))
        found["J"] = np.ones(len(cells)) if fields is None else fields.J
        return found

    def _of_rigid(self, step: Step | None) -> dict[str, Array]:
        """Position of the centre of mass, mm, and force on the tissue, N, of every rigid body."""
        moved = np.zeros((len(self.model.rigid), 3))
        force = np.zeros_like(moved)
        touching = touching_body(self.model) if self.model.contact is not None else ""
        for i, (name, body) in enumerate(self.model.rigid.items()):
            if body.centre is not None:
                moved[i] = body.centre
            if name == touching and self.axis is not None:
                advance = float(self.problem.history.at(0.0)) if step is None else step.displacement
                moved[i] += advance * self.axis
                if step is not None:
                    force[i] = self._force(step)
        return dict(zip(("x", "y", "z", "Fx", "Fy", "Fz"), np.hstack([moved, force]).T))

    def _force(self, step: Step) -> Array:
        """Force (3,) of the indenter on the tissue, N."""
        nothing, state = np.zeros(0), step.state
        penalty = state.penalty * self.laws.modulus
        increment = Increment(state.time, state.displacement, nothing, nothing, penalty)
        return -np.asarray(self.system.contact_force(state.u, increment)).sum(axis=0)
