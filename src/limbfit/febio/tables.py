"""The log-file tables that a FEBio input asks for, written as limbfit solves it."""

from __future__ import annotations

from io import TextIOBase
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..fe import Step, System
from ..fe.kernel.laws import Laws
from ..fe.observables import ElementFields, element_fields, nodal_forces
from .model import FebModel
from .problem import Body, deformable_body, drive, touching_body
from .requests import Request

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
        self.body: Body = deformable_body(model)
        self.laws = Laws.build([problem.materials[name] for name in problem.mesh.region_names])
        self.travel = drive(model).travel
        self.touching = "" if model.contact is None else touching_body(model)
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
        self._write(step.time, step)

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

    def _advance(self, body: str, step: Step | None) -> Array:
        """How far a rigid body has gone (3,), mm."""
        gone = float(self.problem.history.at(0.0)) if step is None else step.displacement
        return gone * self.travel[body]

    def _displacement(self, step: Step | None) -> Array:
        """Displacement (n, 3) of all nodes of the file, mm; nodes of no element stay."""
        u = np.zeros_like(self.model.geometry.points)
        for part in self.model.parts_of(self.model.rigid).values():
            u[part.cells] = self._advance(part.material, step)
        if step is not None:
            u[self.body.nodes] = step.state.u
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
        """Position of the centre of mass, mm, and force on the tissue, N, of every rigid body."""
        moved = np.array([body.centre for body in self.model.rigid.values()]).reshape(-1, 3)
        force = np.zeros_like(moved)
        for i, name in enumerate(self.model.rigid):
            moved[i] += self._advance(name, step)
            if step is not None:
                force[i] = self._force(name, step)
        return dict(zip(("x", "y", "z", "Fx", "Fy", "Fz"), np.hstack([moved, force]).T))

    def _force(self, body: str, step: Step) -> Array:
        """Force (3,) of a rigid body on the tissue that it touches and carries, N."""
        force = np.zeros(3)
        if body == self.touching:
            assert self.system.indenter is not None
            force += step.reaction @ self.system.indenter.frame
        if body in self.model.carried:
            nodes = self.body.number[self.model.carried[body]]
            force += nodal_forces(self.system, self.laws, step.state)[nodes].sum(axis=0)
        return force
