"""Rigid bodies of a FEBio input: where their mass lies, which tissue they carry."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from ...errors import ProblemError
from ...fe import ELEMENTS
from ...fe.kernel.elements import reference_gradients
from .geometry import Geometry, Indices, Part, node_set, nodes_of, triangles
from .tree import Node

Array = NDArray[np.float64]
_PRISM = ([0, 1, 2, 5], [0, 1, 5, 4], [0, 4, 5, 3])  # three tetrahedra of a penta6


def centre_of_mass(points: Array, parts: Iterable[Part]) -> Array:
    """Centre of mass (3,) of parts of one density, mm: solids by volume, shells by area times thickness.

    That of a body without volume is the origin, as in FEBio.
    """
    total, moment = 0.0, np.zeros(3)
    for part in parts:
        mass, at = _lumps(points, part)
        total += float(mass.sum())
        moment += mass @ at
    return moment / total if total > 0.0 else moment


def _lumps(points: Array, part: Part) -> tuple[Array, Array]:
    """A part as masses (k,) at places (k, 3)."""
    if part.cell_type in ELEMENTS:
        element = ELEMENTS[part.cell_type]
        _, volumes = reference_gradients(element, points, part.cells)
        values, _ = element.shape(element.points)
        return np.abs(volumes).ravel(), np.einsum("qk,mki->mqi", values, points[part.cells]).reshape(-1, 3)
    if part.cell_type == "penta6":
        tets = points[np.concatenate([part.cells[:, corners] for corners in _PRISM])]
        return np.abs(np.linalg.det(tets[:, 1:] - tets[:, :1])) / 6.0, tets.mean(axis=1)
    corners = part.cells[:, : 4 if part.cell_type == "quad4" else 3]
    flat = points[triangles(corners)]
    area = 0.5 * np.linalg.norm(np.cross(flat[:, 1] - flat[:, 0], flat[:, 2] - flat[:, 0]), axis=1)
    return part.thickness * area, flat.mean(axis=1)


def carried_nodes(
    geometry: Geometry, soft: Collection[str], bodies: Collection[str], conditions: Sequence[tuple[str, Node]]
) -> dict[str, Indices]:
    """Nodes of tissue that move with a rigid body, by its name: those of its own parts, and sets tied to it.

    Parameters
    ----------
    soft, bodies : names of the deformable and of the rigid materials.
    conditions : rigid body and ``<bc type="rigid">`` of every set that is tied.

    Raises
    ------
    ProblemError
        For a node that two bodies would carry.
    """
    parts = geometry.parts.values()
    owned = {name: nodes_of(part for part in parts if part.material == name) for name in (*soft, *bodies)}
    tissue = np.unique(np.concatenate([np.zeros(0, np.int64), *(owned[name] for name in soft)]))
    found = {name: np.intersect1d(owned[name], tissue) for name in bodies}
    for name, condition in conditions:
        nodes = node_set(geometry, condition.attribute("node_set"), condition)
        found[name] = np.union1d(found[name], np.intersect1d(nodes, tissue))
    for (one, nodes), (other, others) in combinations(found.items(), 2):
        if len(twice := np.intersect1d(nodes, others)):
            number = geometry.node_ids[twice[0]]
            raise ProblemError(f"node {number} is of two rigid bodies, {one!r} and {other!r}")
    return {name: nodes for name, nodes in found.items() if len(nodes)}
