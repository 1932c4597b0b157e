"""Normals and neighbours of the triangles of a surface."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..arrays import Array
from ..errors import ProblemError

Faces = NDArray[np.int64]


def check_triangles(points: Array, faces: NDArray, name: str) -> None:
    """Raise `ProblemError` where the arrays are no triangles of the surface ``name``."""
    if points.ndim != 2 or points.shape[1] != 3 or not np.isfinite(points).all():
        raise ProblemError(f"{name} has points that are not three finite numbers each")
    if faces.ndim != 2 or faces.shape[1] != 3 or not np.issubdtype(faces.dtype, np.integer):
        raise ProblemError(f"{name} is not made of triangles", remedy="triangulate it")
    if not len(faces) or faces.min() < 0 or faces.max() >= len(points):
        raise ProblemError(f"the faces of {name} refer to points that it does not have")


def compute_triangle_normals(corners: Array) -> tuple[Array, Array]:
    """Unit normals (m, 3), zero for degenerate triangles, and areas (m,)."""
    vectors = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = np.linalg.norm(vectors, axis=1)
    flat = length <= 1e-14 * length.max()
    return np.where(flat[:, None], 0.0, vectors / np.where(flat, 1.0, length)[:, None]), 0.5 * length


def _compute_angles(corners: Array) -> Array:
    """Angles (m, 3) of triangles at their corners."""
    ahead = np.roll(corners, -1, axis=1) - corners
    back = np.roll(corners, 1, axis=1) - corners
    sine = np.linalg.norm(np.cross(ahead, back), axis=2)
    return np.arctan2(sine, np.einsum("mij,mij->mi", ahead, back))


def compute_normal_spread(points: Array, faces: Faces, normals: Array) -> tuple[Array, Array]:
    """Sums over the faces at each point, weighted by angle, of ``n n^T (n, 3, 3)`` and ``n (n, 3)``."""
    weights = _compute_angles(points[faces])
    outer, sums = np.zeros((len(points), 3, 3)), np.zeros((len(points), 3))
    for corner in range(3):
        w = weights[:, corner, None] * normals
        np.add.at(outer, faces[:, corner], w[:, :, None] * normals[:, None, :])
        np.add.at(sums, faces[:, corner], w)
    return outer, sums


def find_neighbours(faces: Faces) -> Faces:
    """(m, 3): the triangle beyond each edge, from each corner to the next; -1 where there is none."""
    ahead = np.roll(faces, -1, axis=1)
    count = int(faces.max()) + 1
    there, back = (faces * count + ahead).ravel(), (ahead * count + faces).ravel()
    order = np.argsort(there)
    at = np.minimum(np.searchsorted(there[order], back), len(back) - 1)
    return np.where(there[order][at] == back, order[at] // 3, -1).reshape(faces.shape)
