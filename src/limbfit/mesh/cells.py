"""Cell types: nodes, shape functions, faces and quadrature of each, and its names elsewhere, as data.

Also grids of boxes, and the cells that they are cut into.

Local coordinates: tetrahedra and triangles on the unit simplex, hexahedra and quadrilaterals on [-1, 1]^d,
nodes in VTK order.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ..arrays import Array, Indices

ShapeFunctions = Callable[[Array], tuple[Array, Array]]

TET10_EDGES = np.array([[0, 1], [1, 2], [2, 0], [0, 3], [1, 3], [2, 3]])
TET_FACES = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]])  # outward for positive volume
TRI6_EDGES = np.array([[0, 1], [1, 2], [2, 0]])
QUAD_CORNERS = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]], dtype=float)
HEX_CORNERS = np.vstack([np.column_stack([QUAD_CORNERS, np.full(4, z)]) for z in (-1.0, 1.0)])
_TET_NODES = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
_TET10_FACES = np.array([[0, 2, 1, 6, 5, 4], [0, 1, 3, 4, 8, 7], [1, 2, 3, 5, 9, 8], [0, 3, 2, 7, 9, 6]])
_HEX_FACES = np.array([[0, 3, 2, 1], [4, 5, 6, 7], [0, 1, 5, 4], [1, 2, 6, 5], [2, 3, 7, 6], [3, 0, 4, 7]])
# Keast's five points; the Jacobian of a quadratic tetrahedron is cubic.
_KEAST = np.vstack([np.full(3, 0.25), np.full((3, 3), 1 / 6) + np.eye(3) / 3, np.full(3, 1 / 6)])
# Kuhn's six tetrahedra of a box whose corners are numbered 4 i + 2 j + k.
SIX_TETS = np.array([[0, 1, 3, 7], [0, 3, 2, 7], [0, 2, 6, 7], [0, 6, 4, 7], [0, 4, 5, 7], [0, 5, 1, 7]])
HEX = np.array([0, 4, 6, 2, 1, 5, 7, 3])


@dataclass(frozen=True)
class CellType:
    """A kind of cell.

    Parameters
    ----------
    name, vtk, meshio : limbfit's name, VTK's number, meshio's name.
    nodes : (k, 3) local coordinates.
    corners, face_corners : how many of a cell's, and of a face's, first nodes are corners.
    faces : (f, j) nodes of each face, outward, corners first.
    turned : (k,) the same cell with its corners the other way round.
    shape : values (q, k) and derivatives (q, k, 3) at local coordinates (q, 3).
    points, weights : (q, 3) and (q,), a rule that integrates the Jacobian exactly.
    side : length of the local axes.
    """

    name: str
    vtk: int
    meshio: str
    nodes: Array
    corners: int
    face_corners: int
    faces: Indices
    turned: tuple[int, ...]
    shape: ShapeFunctions
    points: Array
    weights: Array
    side: float = 1.0

    @property
    def is_tetrahedron(self) -> bool:
        return self.corners == 4


def linear_simplex(x: Array) -> tuple[Array, Array]:
    """Linear triangle (d = 2) or tetrahedron (d = 3)."""
    gradients = np.vstack([-np.ones(x.shape[1]), np.eye(x.shape[1])])
    return np.column_stack([1.0 - x.sum(axis=1), x]), np.tile(gradients, (len(x), 1, 1))


def quadratic_simplex(x: Array) -> tuple[Array, Array]:
    """Quadratic triangle (6 nodes) or tetrahedron (10 nodes)."""
    L, dL = linear_simplex(x)
    i, j = (TRI6_EDGES if x.shape[1] == 2 else TET10_EDGES).T
    values = np.hstack([L * (2.0 * L - 1.0), 4.0 * L[:, i] * L[:, j]])
    corner = (4.0 * L - 1.0)[:, :, None] * dL
    middle = 4.0 * (L[:, i, None] * dL[:, j] + L[:, j, None] * dL[:, i])
    return values, np.concatenate([corner, middle], axis=1)


def linear_tensor(x: Array) -> tuple[Array, Array]:
    """Bilinear quadrilateral (d = 2) or trilinear hexahedron (d = 3)."""
    corners = QUAD_CORNERS if x.shape[1] == 2 else HEX_CORNERS
    factors = 0.5 * (1.0 + x[:, None, :] * corners[None])
    gradients = np.empty((len(x), *corners.shape))
    for i in range(x.shape[1]):
        gradients[:, :, i] = 0.5 * corners[None, :, i] * np.delete(factors, i, axis=2).prod(axis=2)
    return factors.prod(axis=2), gradients


CELLS: dict[str, CellType] = {
    cell.name: cell
    for cell in (
        CellType(
            "tet4", 10, "tetra", _TET_NODES, 4, 3, TET_FACES, (0, 2, 1, 3),
            linear_simplex, np.full((1, 3), 0.25), np.array([1 / 6]),
        ),
        CellType(
            "tet10", 24, "tetra10", np.vstack([_TET_NODES, _TET_NODES[TET10_EDGES].mean(axis=1)]), 4, 3,
            _TET10_FACES, (0, 2, 1, 3, 6, 5, 4, 7, 9, 8),
            quadratic_simplex, _KEAST, np.array([-0.8, 0.45, 0.45, 0.45, 0.45]) / 6,
        ),
        CellType(
            "hex8", 12, "hexahedron", HEX_CORNERS, 8, 4, _HEX_FACES, (4, 5, 6, 7, 0, 1, 2, 3),
            linear_tensor, HEX_CORNERS / np.sqrt(3.0), np.ones(8), side=2.0,
        ),
    )
}  # fmt: skip


def build_boxes(x: Array, y: Array, z: Array) -> tuple[Array, Indices]:
    """Grid points (n, 3) and the corners (m, 8) of each box, numbered 4 i + 2 j + k."""
    grid = np.stack(np.meshgrid(x, y, z, indexing="ij"), axis=-1)
    index = np.arange(grid[..., 0].size).reshape(grid.shape[:3])
    low, high = slice(None, -1), slice(1, None)
    corners = [index[i, j, k].ravel() for i in (low, high) for j in (low, high) for k in (low, high)]
    return grid.reshape(-1, 3), np.stack(corners, axis=1)
