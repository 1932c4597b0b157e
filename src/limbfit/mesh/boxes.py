"""Grids of boxes, and the cells that they are cut into."""

import numpy as np

from ..arrays import Array, Indices

# Kuhn's six tetrahedra of a box whose corners are numbered 4 i + 2 j + k.
SIX_TETS = np.array([[0, 1, 3, 7], [0, 3, 2, 7], [0, 2, 6, 7], [0, 6, 4, 7], [0, 4, 5, 7], [0, 5, 1, 7]])
HEX = np.array([0, 4, 6, 2, 1, 5, 7, 3])


def build_boxes(x: Array, y: Array, z: Array) -> tuple[Array, Indices]:
    """Grid points (n, 3) and the corners (m, 8) of each box, numbered 4 i + 2 j + k."""
    grid = np.stack(np.meshgrid(x, y, z, indexing="ij"), axis=-1)
    index = np.arange(grid[..., 0].size).reshape(grid.shape[:3])
    low, high = slice(None, -1), slice(1, None)
    corners = [index[i, j, k].ravel() for i in (low, high) for j in (low, high) for k in (low, high)]
    return grid.reshape(-1, 3), np.stack(corners, axis=1)
