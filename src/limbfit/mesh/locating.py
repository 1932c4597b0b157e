"""Which cell a point lies in, and where in it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..arrays import Array
from ..errors import ProblemError
from .volume import Mesh

Ints = NDArray[np.int64]

NEAREST = 24  # cells that are looked at, by their middles
_STEPS = 8  # of Newton's iteration; one is enough where edges are straight and cells are tetrahedra
_FARTHEST = 4.0  # local coordinates that mean nothing any more


def locate(mesh: Mesh, points: Array, region: int) -> tuple[Ints, Array, Array]:
    """Cells (k,) of a region that hold ``points`` (k, 3), mm, or come nearest to that.

    Returns
    -------
    cells : (k,) their numbers.
    local : (k, 3) local coordinates of the points, moved into the cell where they are out of it.
    off_mm : (k,) how far they were moved.

    Raises
    ------
    ProblemError
        Where no cell is of that region.
    """
    own = np.flatnonzero(mesh.regions == region)
    if not len(own):
        what = f"the mesh has no cell of {mesh.region_names[region]}"
        raise ProblemError(what, remedy="mesh the site anew")
    middles = mesh.points[mesh.corners[own]].mean(axis=1)
    cells, local, off = (
        np.empty(len(points), dtype=np.int64),
        np.empty((len(points), 3)),
        np.empty(len(points)),
    )
    for k, point in enumerate(points):
        near = own[np.argsort(np.linalg.norm(middles - point, axis=1))[:NEAREST]]
        inside = _clip_into_cell(mesh, _find_local_coordinates(mesh, near, point))
        values, _ = mesh.kind.shape(inside)
        away = np.linalg.norm(np.einsum("mk,mki->mi", values, mesh.points[mesh.cells[near]]) - point, axis=1)
        best = int(np.argmin(away))
        cells[k], local[k], off[k] = near[best], inside[best], away[best]
    return cells, local, off


def _find_local_coordinates(mesh: Mesh, cells: Ints, point: Array) -> Array:
    """Local coordinates (m, 3) of a point in each of the cells (m,), inside or not."""
    corners = mesh.points[mesh.cells[cells]]
    middle = mesh.kind.nodes[: mesh.kind.corners].mean(axis=0)
    x = np.tile(middle, (len(cells), 1))
    for _ in range(_STEPS):
        values, slopes = mesh.kind.shape(x)
        missed = point - np.einsum("mk,mki->mi", values, corners)
        x = x + np.linalg.solve(np.einsum("mki,mkj->mij", corners, slopes), missed[..., None])[..., 0]
        x = np.clip(x, -_FARTHEST, _FARTHEST)
    return x


def _clip_into_cell(mesh: Mesh, local: Array) -> Array:
    """Local coordinates (m, 3), moved into the cell."""
    if not mesh.kind.is_tetrahedron:
        return np.asarray(np.clip(local, -1.0, 1.0))
    shares = np.column_stack([1.0 - local.sum(axis=1), local]).clip(0.0)
    return np.asarray((shares / shares.sum(axis=1, keepdims=True))[:, 1:])
