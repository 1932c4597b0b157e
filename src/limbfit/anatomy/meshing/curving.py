"""Mid-edge nodes of quadratic tetrahedra put on the smooth surfaces where the elements stay sound."""

from __future__ import annotations

from dataclasses import replace
from itertools import count

import numpy as np
from numpy.typing import NDArray

from ...arrays import Array
from ...mesh import TET10_EDGES, Mesh, node_jacobians
from .columns import Columns

Ints = NDArray[np.int64]

SMALLEST_JACOBIAN = 0.3  # of the straight element's, at every node
BISECTIONS = 5


def curve_mesh(mesh: Mesh, target: Array, straight: Array) -> Mesh:
    """A tet10 mesh with nodes moved to ``target`` (n, 3), less or not at all where elements would suffer.

    ``straight`` (m,) is the least Jacobian of each element with straight sides.
    """
    share = np.ones(len(mesh.points))
    for attempt in count():
        points = mesh.points + share[:, None] * (target - mesh.points)
        moved = replace(mesh, points=points)
        bad = (node_jacobians(moved).min(axis=1) < SMALLEST_JACOBIAN * straight) & (straight > 0.0)
        nodes = np.unique(mesh.cells[bad])
        if not share[nodes].any():
            return moved
        share[nodes] = share[nodes] / 2 if attempt < BISECTIONS - 1 else 0.0
    raise AssertionError("each pass straightens more")


def curve_diagonals(mesh: Mesh, target: Array, stack: Columns) -> Array:
    """Targets (n, 3) where edges within extruded layers follow the curved edges at their foot and head.

    An edge that stayed straight between two curved ones would fold thin elements.

    Parameters
    ----------
    mesh : tet10, straight-sided.
    target : (n, 3) for the mid-edge nodes of the layers' innermost and outermost faces.
    stack : the layers' columns.
    """
    corners = int(mesh.cells[:, :4].max()) + 1
    ends = np.zeros((len(mesh.points) - corners, 2), dtype=np.int64)
    ends[mesh.cells[:, 4:].ravel() - corners] = mesh.cells[:, TET10_EDGES].reshape(-1, 2)
    column, share = np.full(corners, -1), np.zeros(corners)
    column[stack.base] = np.arange(len(stack.base))
    new = stack.top[0] + np.arange(len(stack.owner))
    column[new] = stack.owner
    foot, head = mesh.points[stack.base], mesh.points[stack.top]
    length = np.linalg.norm(head - foot, axis=1)[stack.owner]
    share[new] = np.linalg.norm(mesh.points[new] - foot[stack.owner], axis=1) / length
    sides = column[ends]
    within = (sides >= 0).all(axis=1) & (sides[:, 0] != sides[:, 1]) & (ends >= stack.top[0]).any(axis=1)
    keys = _number_edges(ends, corners)
    order = np.argsort(keys)
    moved = target - mesh.points
    feet, heads = (
        moved[
            corners + order[np.searchsorted(keys, _number_edges(nodes[sides[within]], corners), sorter=order)]
        ]
        for nodes in (stack.base, stack.top)
    )
    part = share[ends[within]].mean(axis=1)[:, None]
    target = target.copy()
    target[corners + np.flatnonzero(within)] = (
        mesh.points[corners:][within] + (1 - part) * feet + part * heads
    )
    return target


def _number_edges(ends: Ints, count: int) -> Ints:
    """One number (n,) for each edge (n, 2) between ``count`` nodes."""
    low, high = np.sort(ends, axis=1).T
    return np.asarray(low * count + high)
