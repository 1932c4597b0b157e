"""Mid-edge nodes of quadratic tetrahedra put on the smooth surfaces where the elements stay sound."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ..mesh import Mesh, node_jacobians

SMALLEST_JACOBIAN = 0.3  # of the straight element's, at every node
BISECTIONS = 5


def curved(mesh: Mesh, target: NDArray[np.float64]) -> Mesh:
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
