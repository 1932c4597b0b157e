"""Points on the skin of a mesh, followed as material points."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..arrays import Array
from ..errors import ProblemError
from ..mesh import Gauge, Mesh
from ..mesh.cells import linear_simplex, quadratic_simplex
from ..shapes.triangles import build_tree, closest_point

Ints = NDArray[np.int64]


@dataclass(frozen=True)
class SkinPoints:
    """Points (k, 3) mm of the skin at rest, and what interpolates nodal values there.

    ``off_mm`` (k,) is how far each is from the point that was asked for. A nodal field is ``weights`` (k, j)
    times its values at ``nodes`` (k, j).
    """

    points: Array
    off_mm: Array
    nodes: Ints
    weights: Array

    def gauges(self, axes: Array) -> tuple[Gauge, ...]:
        """The moves along unit vectors (d, 3): d gauges of the first point, then those of the second."""
        rows = zip(self.nodes, self.weights, strict=True)
        return tuple(Gauge(nodes, weights, axis) for nodes, weights in rows for axis in axes)


def find_skin_points(mesh: Mesh, points: Array) -> SkinPoints:
    """The points of a mesh's face set ``skin`` nearest to ``points`` (k, 3), mm; see `find_nearest_points`.

    Raises
    ------
    ProblemError
        For a mesh without skin.
    """
    faces = mesh.face_sets.get("skin", np.empty((0, 3), dtype=np.int64))
    if not len(faces):
        raise ProblemError("the mesh has no face set 'skin'", remedy="mesh the site anew")
    return find_nearest_points(mesh.points, faces, points)


def find_nearest_points(nodes: Array, faces: Ints, points: Array) -> SkinPoints:
    """The points of a skin with ``nodes`` (n, 3) mm and ``faces`` (f, j) nearest to ``points`` (k, 3), mm.

    Faces count as the flat triangles of their corners, quadrilaterals as two; nodal values are interpolated
    by the face's own functions.
    """
    if faces.shape[1] == 4:
        faces = np.concatenate([faces[:, [0, 1, 2]], faces[:, [0, 2, 3]]])
    corners = np.ascontiguousarray(nodes[faces[:, :3]])
    tree = build_tree(corners, np.arange(len(faces)))
    feet, near = np.empty((len(points), 3)), np.empty(len(points), dtype=np.int64)
    for k, point in enumerate(np.asarray(points, dtype=float)):
        near[k], _, _ = closest_point(corners, tree, point, feet[k])
    a, b, c = np.moveaxis(corners[near], 1, 0)
    sides = np.stack([b - a, c - a], axis=2)
    local = (np.linalg.pinv(sides) @ (feet - a)[:, :, None])[:, :, 0]
    shape = quadratic_simplex if faces.shape[1] == 6 else linear_simplex
    return SkinPoints(feet, np.linalg.norm(feet - points, axis=1), faces[near], shape(local)[0])
