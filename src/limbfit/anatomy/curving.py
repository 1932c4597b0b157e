"""Mid-edge nodes of quadratic tetrahedra put on the smooth surfaces where the elements stay sound."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ..mesh import TET10_EDGES, Mesh, node_jacobians

Array = NDArray[np.float64]
Ints = NDArray[np.int64]

SMALLEST_JACOBIAN = 0.3  # of the straight element's, at every node
BISECTIONS = 5


def curved(mesh: Mesh, target: Array) -> Mesh:
    """A tet10 mesh with nodes moved to ``target`` (n, 3), less or not at all where elements would suffer."""
    straight = node_jacobians(mesh).min(axis=1)
    share = np.ones(len(mesh.points))
    for attempt in range(BISECTIONS + 1):
        points = mesh.points + share[:, None] * (target - mesh.points)
        moved = replace(mesh, points=points)
        bad = node_jacobians(moved).min(axis=1) < SMALLEST_JACOBIAN * straight
        if not bad.any():
            return moved
        nodes = np.unique(mesh.cells[bad])
        share[nodes] = share[nodes] / 2 if attempt < BISECTIONS - 1 else 0.0
    return mesh


def with_diagonals(mesh: Mesh, target: Array, base: Ints) -> Array:
    """Targets (n, 3) where diagonals across the sides of an extruded layer follow the edges above and below.

    A diagonal that stayed straight between two curved edges would fold thin elements.

    Parameters
    ----------
    mesh : tet10, straight-sided.
    target : (n, 3) for the mid-edge nodes of both faces of the layer.
    base : (corners,) the node under each extruded corner node; itself for any other.
    """
    corners = len(base)
    ends = np.zeros((len(mesh.points), 2), dtype=np.int64)
    ends[mesh.cells[:, 4:].ravel()] = mesh.cells[:, TET10_EDGES].reshape(-1, 2)
    ends = np.sort(ends[corners:], axis=1)
    keys = ends[:, 0] * corners + ends[:, 1]
    extruded = base != np.arange(corners)
    top = np.arange(corners)
    top[base[extruded]] = np.flatnonzero(extruded)
    low, high = ends.T  # extruded nodes have the greater numbers
    diagonal = np.flatnonzero(extruded[high] & ~extruded[low] & (base[high] != low))
    sides = [np.sort([low[diagonal], base[high[diagonal]]], axis=0)]
    sides.append(np.sort(top[sides[0]], axis=0))
    order = np.argsort(keys)
    nodes = [corners + order[np.searchsorted(keys, a * corners + b, sorter=order)] for a, b in sides]
    target = target.copy()
    moved = target - mesh.points
    target[corners + diagonal] += (moved[nodes[0]] + moved[nodes[1]]) / 2
    return target
