"""A FEBio input solved by limbfit, with the log-file tables that its own output section asks for."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from io import TextIOBase
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from ..arrays import Array, Indices
from ..errors import InputError, RunError, add_location
from ..fe import Result, Step, System, solve
from ..fe.observables import ElementFields, compute_element_fields, compute_nodal_forces
from .parts import build_tissue
from .penalty import FacePenalties
from .problem import build_step_control, find_drive, group_contacts, has_penalty, to_problem
from .reading.model import KNOWN_DATA, FebModel, Request, read_feb

_CAUCHY = ("sx", "sy", "sz", "sxy", "syz", "sxz")


@dataclass(frozen=True)
class FebRun:
    """The result of a FEBio input: the simulation, the files written, and notes on what was left out."""

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

    Raises `ProblemError` if the input cannot be read or holds what limbfit does not support, with its line,
    and `RunError` if the tables cannot be written.

    ``on_step``: called with every accepted step and the time of the last one, s; ``keep``: refuse to write
    over existing files; ``settings``: fields of `StepControl` that replace what the input says (``times``,
    ``threads``, ..).
    """
    folder = Path(output)
    with add_location(file=path):
        model = read_feb(path)
        problem = to_problem(model)
        control = build_step_control(model, problem, **settings)
        system = System(problem, control.threads)
        tables = LogTables(model, system, folder, Path(path).stem)
        weights = None
        if has_penalty(model) and "penalty" not in settings:
            laws = [contacts[0] for contacts in group_contacts(model).values()]
            weights = FacePenalties(system, laws, np.asarray(control.times))
    assert control.times is not None
    for table in tables.files:
        own = table.exists() and table.samefile(path)
        if own or (keep and table.exists()):
            raise InputError("is there already", file=table, remedy="give another folder with --output")
    last = control.times[-1]

    def accept_step(step: Step) -> None:
        tables.write(step)
        if weights is not None:
            weights.update_after(step)
        if on_step is not None:
            on_step(step, last)

    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tables:
            result = solve(problem, control, on_step=accept_step, store="peak", system=system)
    except OSError as error:
        raise RunError(f"{folder}: {error.strerror or error}") from error
    return FebRun(result, tables.files, model.notes)


class LogTables:
    """The tables of a model, written step by step, so that they hold what was reached when it stops.

    Nodes and elements stand in the order of the file, those of rigid bodies among them: they move with their
    body, and are free of stress.
    """

    def __init__(self, model: FebModel, system: System, folder: Path, stem: str) -> None:
        problem = system.problem
        self.model, self.problem, self.system = model, problem, system
        self.tissue = build_tissue(model)
        self.laws = problem.build_laws()
        self.travel = find_drive(model).travel
        # The bodies of the problem by FEBio's name, in the problem's order.
        self.bodies = dict(zip(group_contacts(model), problem.rigid_bodies))
        self.count = 0
        names = [request.file or f"{stem}.log" for request in model.requests]
        self.paths = [folder / name for name in names]
        self.streams: dict[Path, TextIOBase] = {}

    @property
    def files(self) -> tuple[Path, ...]:
        """Every file once."""
        return tuple(dict.fromkeys(self.paths))

    def __enter__(self) -> LogTables:
        for path in self.files:
            self.streams[path] = path.open("w", encoding="utf-8")
        self.write(None)
        return self

    def __exit__(self, *_: object) -> None:
        for stream in self.streams.values():
            stream.close()

    def write(self, step: Step | None) -> None:
        """Write one accepted step; None: the beginning."""
        time, fields = 0.0 if step is None else self.model.settling_time_s + step.time, None
        if step is not None and any(request.kind == "element_data" for request in self.model.requests):
            fields = compute_element_fields(self.system, self.laws, step.state)
        u = self._compute_displacement(step)
        for request, path in zip(self.model.requests, self.paths):
            stream = self.streams[path]
            head = f"*Step  = {self.count}\n*Time  = {time:.9g}\n*Data  = {';'.join(request.names)}\n"
            stream.write(head)
            numbers, columns = self._compute_columns(request, step, u, fields)
            for i in np.flatnonzero([request.includes(int(number)) for number in numbers]):
                values = (f"{column[i]:.12g}" for column in columns)
                stream.write(request.delimiter.join([str(numbers[i]), *values]) + "\n")
            stream.flush()
        self.count += 1

    def _compute_pose(self, name: str, step: Step | None) -> tuple[Array, Array]:
        """Return move (3,), mm, and rotation vector (3,), rad, of a rigid body's centre of mass in space."""
        if name in self.bodies and self.problem.indenter is None:
            i, body = list(self.bodies).index(name), self.bodies[name]
            coordinates = body.motion.at(0.0)[0] if step is None else step.coordinates[i]
            return coordinates[:3] @ body.shape.frame, coordinates[3:] @ body.shape.frame
        gone = float(self.problem.history.at(0.0)) if step is None else step.displacement
        return gone * self.travel[name], np.zeros(3)

    def _compute_displacement(self, step: Step | None) -> Array:
        """Return the displacement (n, 3) of all nodes of the file, mm; nodes of no element stay."""
        u = np.zeros_like(self.model.geometry.points)
        for part in self.model.geometry.select_parts(self.model.rigid).values():
            move, turn = self._compute_pose(part.material, step)
            nodes, centre = np.unique(part.cells), self.model.rigid[part.material].centre
            arms = self.model.geometry.points[nodes] - centre
            u[nodes] = move + Rotation.from_rotvec(turn).apply(arms) - arms
        if step is not None:
            u[self.tissue.nodes] = step.state.u
        return u

    def _compute_columns(
        self, request: Request, step: Step | None, u: Array, fields: ElementFields | None
    ) -> tuple[Indices, list[Array]]:
        """Return FEBio's numbers of the items, and a column per name."""
        geometry = self.model.geometry
        if request.kind == "node_data":
            found = dict(zip(KNOWN_DATA["node_data"], np.hstack([geometry.points + u, u]).T))
            numbers = geometry.node_ids
        elif request.kind == "element_data":
            found = self._compute_element_columns(geometry.points + u, fields)
            numbers = np.concatenate([part.ids for part in geometry.parts.values()])
        else:
            found = self._compute_rigid_columns(step)
            numbers = np.array([body.number for body in self.model.rigid.values()])
        return numbers, [found[name] for name in request.names]

    def _compute_element_columns(self, points: Array, fields: ElementFields | None) -> dict[str, Array]:
        parts = self.model.geometry.parts.values()
        is_soft = np.repeat(
            [part.material in self.model.materials for part in parts], [len(part.ids) for part in parts]
        )
        stress, J = np.zeros((len(is_soft), 6)), np.ones(len(is_soft))
        if fields is not None:
            stress[is_soft], J[is_soft] = fields.cauchy, fields.J
        middle = np.vstack([points[part.cells].mean(axis=1) for part in parts])
        found = dict(zip(_CAUCHY, stress.T))
        xx, yy, zz, xy, yz, zx = stress.T
        tensor = np.stack([xx, xy, zx, xy, yy, yz, zx, yz, zz], axis=1).reshape(-1, 3, 3)
        found |= dict(zip(("s3", "s2", "s1"), np.linalg.eigvalsh(tensor).T))
        return found | dict(zip(("x", "y", "z"), middle.T)) | {"J": J}

    def _compute_rigid_columns(self, step: Step | None) -> dict[str, Array]:
        """Return columns of every rigid body.

        They are the place of its centre of mass, mm, its rotation vector, rad, the force, N, and the moment
        about that place, N mm.
        """
        names = KNOWN_DATA["rigid_body_data"]
        rows = np.zeros((len(self.model.rigid), len(names)))
        for i, (name, body) in enumerate(self.model.rigid.items()):
            move, turn = self._compute_pose(name, step)
            rows[i, :3], rows[i, 3:6] = body.centre + move, turn
            if step is not None:
                rows[i, 6:] = self._compute_force(name, body.centre + move, turn, step)
        return dict(zip(names, rows.T))

    def _compute_force(self, name: str, pivot_point: Array, turn: Array, step: Step) -> Array:
        """Return force and moment (6,) about a point of a rigid body on tissue that it touches or carries."""
        total = np.zeros(6)
        if name in self.bodies:
            i = list(self.bodies).index(name)
            body = self.system.bodies.all[i]
            force, conjugate = step.reactions[i].reshape(2, 3) @ body.frame
            pivot = body.pivot + step.coordinates[i, :3] @ body.frame
            moment = np.linalg.solve(_compute_spin(turn).T, conjugate)
            total += [*force, *(moment + np.cross(pivot - pivot_point, force))]
        if name in self.model.carried_nodes:
            nodes = self.tissue.node_index[self.model.carried_nodes[name]]
            forces = compute_nodal_forces(self.system, self.laws, step.state)[nodes]
            arms = self.tissue.mesh.points[nodes] + step.state.u[nodes] - pivot_point
            total += [*forces.sum(axis=0), *np.cross(arms, forces).sum(axis=0)]
        return total


def _compute_spin(w: Array) -> Array:
    """Return the spin (3, 3) in space per unit of the rotation vector ``w``: Rodrigues' left Jacobian."""
    angle, skew = float(np.linalg.norm(w)), np.cross(np.eye(3), w)
    if angle < 1e-6:
        return np.asarray(np.eye(3) + 0.5 * skew)
    a, b = (1.0 - np.cos(angle)) / angle**2, (angle - np.sin(angle)) / angle**3
    return np.asarray(np.eye(3) + a * skew + b * skew @ skew)
