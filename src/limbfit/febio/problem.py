"""A FEBio input as limbfit's own problem: same mesh, supports, materials and history."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import ProblemError
from ..fe import History, Indenter, Problem, Support
from ..mesh import Mesh
from .model import FebModel

Array = NDArray[np.float64]
Indices = NDArray[np.int64]


def to_problem(model: FebModel, indenter: Indenter | None = None, **settings: Any) -> Problem:
    """The problem of a FEBio input.

    FEBio's rigid body is faces; ``indenter`` gives the shape that they stand for, which is put where the
    body's foremost point is, along its motion.  Regions carry the names of the parts.

    Parameters
    ----------
    settings : further fields of `Problem` (``element``, ``contact_rule``, ..).

    Raises
    ------
    ProblemError
        Where the input has no deformable part, or no rigid body for the indenter.
    """
    mesh, number = _body(model)
    fixed, supports = _supports(model, number)
    faces = np.zeros((0, 3), np.int64)
    if indenter is not None:
        indenter = _placed(model, indenter)
        faces = number[model.surfaces[model.contact]]
    names = mesh.region_names
    return Problem(
        mesh=mesh,
        materials={name: model.materials[model.parts[name].material] for name in names},
        fixed=fixed,
        contact_faces=faces,
        indenter=indenter,
        history=History(*model.load.T),
        supports=supports,
        start="as-given",
        **settings,
    )


def _body(model: FebModel) -> tuple[Mesh, Indices]:
    """The deformable parts as one mesh, and the new number of each node."""
    parts = {name: part for name, part in model.parts.items() if part.material in model.materials}
    if len({part.cell_type for part in parts.values()}) != 1:
        raise ProblemError("the deformable parts are not of one element type")
    cells = np.vstack([part.cells for part in parts.values()])
    regions = np.repeat(np.arange(len(parts)), [len(part.cells) for part in parts.values()])
    used = np.unique(cells)
    number = np.full(len(model.points), -1)
    number[used] = np.arange(len(used))
    cell_type = next(iter(parts.values())).cell_type
    return Mesh(model.points[used], number[cells], cell_type, regions, tuple(parts)), number


def _supports(model: FebModel, number: Indices) -> tuple[Indices, tuple[Support, ...]]:
    """Nodes held in all directions, and single components held or moved."""
    held = {
        target: {m.component for m in model.node_motions if m.target == target and m.factor == 0.0}
        for target in model.node_sets
    }
    clamped = [target for target, components in held.items() if len(components) == 3]
    nodes = [number[model.node_sets[target]] for target in clamped]
    single = tuple(
        Support(number[model.node_sets[m.target]], m.component, m.factor)
        for m in model.node_motions
        if m.target not in clamped
    )
    return np.unique(np.concatenate(nodes)) if nodes else np.zeros(0, np.int64), single


def motion_axis(model: FebModel) -> Array:
    """Unit vector (3,) along which the rigid body moves."""
    direction = np.zeros(3)
    for motion in model.rigid_motions:
        direction[motion.component] += motion.factor
    length = np.linalg.norm(direction)
    if abs(length - 1.0) > 1e-6:
        raise ProblemError("the rigid body does not move by the load curve along one direction")
    return direction / length


def _placed(model: FebModel, indenter: Indenter) -> Indenter:
    axis = motion_axis(model)
    ((name, centre),) = model.rigid.items()
    cells = [part.cells.ravel() for part in model.parts.values() if part.material == name]
    foremost = ((model.points[np.concatenate(cells)] - centre) @ axis).max()
    return replace(indenter, centre=centre + foremost * axis, axis=axis)
