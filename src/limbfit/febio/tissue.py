"""The deformable parts of a FEBio input as one mesh."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..errors import ProblemError
from ..fe import ELEMENTS
from ..fe.kernel.elements import reference_gradients
from ..mesh import Mesh
from .reading.geometry import refuse_part
from .reading.model import FebModel

Array = NDArray[np.float64]
Indices = NDArray[np.int64]


@dataclass(frozen=True)
class Tissue:
    """The deformable parts as one mesh; ``nodes (n,)`` are the places of its nodes in the model's, ``number``
    the way back (-1: none)."""

    mesh: Mesh
    nodes: Indices
    number: Indices


def tissue_of(model: FebModel) -> Tissue:
    """The deformable parts as one mesh.

    Raises
    ------
    ProblemError
        Where there is none, where their elements differ, or where one is inverted.
    """
    parts = model.parts_of(model.materials)
    if not parts:
        raise ProblemError("no part is made of a deformable material")
    first = next(iter(parts.values()))
    for name, part in parts.items():
        if not part.element:
            raise refuse_part(part, name, "only tet4, tet10 and hex8 can deform")
        if part.element != first.element:
            raise refuse_part(
                part, name, f"all tissue must be of one element type, not also {first.cell_type}"
            )
    cells = np.vstack([part.cells for part in parts.values()])
    ids = np.concatenate([part.ids for part in parts.values()])
    regions = np.repeat(np.arange(len(parts)), [len(part.cells) for part in parts.values()])
    nodes = np.unique(cells)
    number = np.full(len(model.geometry.points), -1)
    number[nodes] = np.arange(len(nodes))
    points = model.geometry.points[nodes]
    mesh = Mesh(points, number[cells], first.cell_type, regions, tuple(parts), _node_sets(model, number))
    _, weights = reference_gradients(ELEMENTS[first.element], points, mesh.cells)
    bad = np.flatnonzero((weights <= 0.0).any(axis=1))
    if len(bad):
        part_name = mesh.region_names[regions[bad[0]]]
        what = f"{len(bad)} elements are inverted or flat, the first is element {ids[bad[0]]}"
        raise refuse_part(parts[part_name], part_name, what)
    return Tissue(mesh, nodes, number)


def _node_sets(model: FebModel, number: Indices) -> dict[str, Indices]:
    sets = {name: number[nodes] for name, nodes in model.geometry.node_sets.items()}
    return {name: nodes for name, nodes in sets.items() if (nodes >= 0).all()}
