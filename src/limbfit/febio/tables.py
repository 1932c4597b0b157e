"""The log-file tables that a FEBio input asks for, written as limbfit solves it."""

from __future__ import annotations

from io import TextIOBase
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from ..fe import Step, System
from ..fe.kernel.laws import Laws
from ..fe.observables import ElementFields, element_fields, nodal_forces
from .driving import contacts_of_bodies, drive
from .reading.model import FebModel
from .reading.requests import Request
from .tissue import tissue_of

Array = NDArray[np.float64]
_CAUCHY = ("sx", "sy", "sz", "sxy", "syz", "sxz")


class Tables:
    """The tables of a model, written step by step, so that what was reached is there when it stops.

    Nodes and elements stand in the order of the file, those of rigid bodies among them: they move with their
    body, and are free of stress.
    """

    def __init__(self, model: FebModel, system: System, folder: Path, stem: str) -> None:
        problem = system.problem
        self.model, self.problem, self.system = model, problem, system
        self.tissue = tissue_of(model)
        self.laws = Laws.build([problem.materials[name] for name in problem.mesh.region_names])
        self.travel = drive(model).travel
        # The bodies of the problem by FEBio's name, in the problem's order.
        self.bodies = dict(zip(contacts_of_bodies(model), problem.rigid_bodies))
        self.count = 0
        names = [request.file or f"{stem}.log" for request in model.requests]
        self.paths = [folder / name for name in names]
        self.streams: dict[Path, TextIOBase] = {}

    @property
    def files(self) -> tuple[Path, ...]:
        """Every file once."""
        return tuple(dict.fromkeys(self.paths))

    def __enter__(self) -> Tables:
        for path in self.files:
            self.streams[path] = path.open("w", encoding="utf-8")
        self._write(0.0, None)
        return self

    def __exit__(self, *_: object) -> None:
        for stream in self.streams.values():
            stream.close()

    def add(self, step: Step) -> None:
        """Write one accepted step."""
        self._write(self.model.settled_s + step.time, step)

    def _write(self, time: float, step: Step | None) -> None:
        needed = any(request.kind == "element_data" for request in self.model.requests)
        fields = element_fields(self.system, self.laws, step.state) if step is not None and needed else None
        u = self._displacement(step)
        for request, path in zip(self.model.requests, self.paths):
            stream = self.streams[path]
            head = f"*Step  = {self.count}\n*Time  = {time:.9g}\n*Data  = {';'.join(request.names)}\n"
            stream.write(head)
            numbers, columns = self._columns(request, step, u, fields)
            for i in np.flatnonzero([request.wants(int(number)) for number in numbers]):
                values = (f"{column[i]:.12g}" for column in columns)
                stream.write(request.delimiter.join([str(numbers[i]), *values]) + "\n")
            stream.flush()
        self.count += 1

    def _pose(self, name: str, step: Step | None) -> tuple[Array, Array]:
        """Move (3,) of a rigid body's centre of mass, mm, and its rotation vector (3,), rad, in space."""
        if name in self.bodies and self.problem.indenter is None:
            i, body = list(self.bodies).index(name), self.bodies[name]
            coordinates = body.motion.at(0.0)[0] if step is None else step.coordinates[i]
            return coordinates[:3] @ body.shape.frame, coordinates[3:] @ body.shape.frame
        gone = float(self.problem.history.at(0.0)) if step is None else step.displacement
        return gone * self.travel[name], np.zeros(3)

    def _displacement(self, step: Step | None) -> Array:
        """Displacement (n, 3) of all nodes of the file, mm; nodes of no element stay."""
        u = np.zeros_like(self.model.geometry.points)
        for part in self.model.parts_of(self.model.rigid).values():
            move, turn = self._pose(part.material, step)
            nodes, centre = np.unique(part.cells), self.model.rigid[part.material].centre
            arms = self.model.geometry.points[nodes] - centre
            u[nodes] = move + Rotation.from_rotvec(turn).apply(arms) - arms
        if step is not None:
            u[self.tissue.nodes] = step.state.u
        return u

    def _columns(
        self, request: Request, step: Step | None, u: Array, fields: ElementFields | None
    ) -> tuple[NDArray[np.int64], list[Array]]:
        """FEBio's numbers of the items, and a column per name."""
        geometry = self.model.geometry
        if request.kind == "node_data":
            found = dict(zip(("x", "y", "z", "ux", "uy", "uz"), np.hstack([geometry.points + u, u]).T))
            numbers = geometry.node_ids
        elif request.kind == "element_data":
            found = self._of_elements(geometry.points + u, fields)
            numbers = np.concatenate([part.ids for part in geometry.parts.values()])
        else:
            found = self._of_rigid(step)
            numbers = np.array([body.number for body in self.model.rigid.values()])
        return numbers, [found[name] for name in request.names]

    def _of_elements(self, points: Array, fields: ElementFields | None) -> dict[str, Array]:
        parts = self.model.geometry.parts.values()
        stress, J = (np.zeros((sum(len(part.ids) for part in parts), 6)), [])
        middle, at, tissue = [], 0, 0
        for part in parts:
            count = len(part.ids)
            middle.append(points[part.cells].mean(axis=1))
            J.append(np.ones(count))
            if part.material in self.model.materials:
                if fields is not None:
                    stress[at : at + count] = fields.cauchy[tissue : tissue + count]
                    J[-1] = fields.J[tissue : tissue + count]
                tissue += count
            at += count
        found = dict(zip(_CAUCHY, stress.T))
        xx, yy, zz, xy, yz, zx = stress.T
        tensor = np.stack([xx, xy, zx, xy, yy, yz, zx, yz, zz], axis=1).reshape(-1, 3, 3)
        found |= dict(zip(("s3", "s2", "s1"), np.linalg.eigvalsh(tensor).T))
        found |= dict(zip(("x", "y", "z"), np.vstack(middle).T))
        found["J"] = np.concatenate(J)
        return found

    def _of_rigid(self, step: Step | None) -> dict[str, Array]:
        """Place of the centre of mass, mm, rotation vector, rad, force, N, and moment about that place, N mm,
        of every rigid body."""
        names = ("x", "y", "z", "thx", "thy", "thz", "Fx", "Fy", "Fz", "Mx", "My", "Mz")
        rows = np.zeros((len(self.model.rigid), len(names)))
        for i, (name, body) in enumerate(self.model.rigid.items()):
            move, turn = self._pose(name, step)
            rows[i, :3], rows[i, 3:6] = body.centre + move, turn
            if step is not None:
                rows[i, 6:] = self._force(name, body.centre + move, turn, step)
        return dict(zip(names, rows.T))

    def _force(self, name: str, at: Array, turn: Array, step: Step) -> Array:
        """Force and moment (6,) about ``at`` of a rigid body on the tissue that it touches and carries."""
        total = np.zeros(6)
        if name in self.bodies:
            assert self.system.bodies is not None
            i = list(self.bodies).index(name)
            body = self.system.bodies.all[i]
            force, conjugate = step.reactions[i].reshape(2, 3) @ body.frame
            pivot = body.pivot + step.coordinates[i, :3] @ body.frame
            moment = np.linalg.solve(_turning(turn).T, conjugate)
            total += [*force, *(moment + np.cross(pivot - at, force))]
        if name in self.model.carried:
            nodes = self.tissue.number[self.model.carried[name]]
            forces = nodal_forces(self.system, self.laws, step.state)[nodes]
            arms = self.tissue.mesh.points[nodes] + step.state.u[nodes] - at
            total += [*forces.sum(axis=0), *np.cross(arms, forces).sum(axis=0)]
        return total


def _turning(w: Array) -> Array:
    """(3, 3) the spin of a body in space per unit of its rotation vector ``w``: Rodrigues' left Jacobian."""
    angle, skew = float(np.linalg.norm(w)), np.cross(np.eye(3), w)
    if angle < 1e-6:
        return np.asarray(np.eye(3) + 0.5 * skew)
    a, b = (1.0 - np.cos(angle)) / angle**2, (angle - np.sin(angle)) / angle**3
    return np.asarray(np.eye(3) + a * skew + b * skew @ skew)
