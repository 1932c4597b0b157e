"""A socket's face moved clear of the limb along its rays, which cannot fold it."""

from __future__ import annotations

import igl
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from ..anatomy.frame import Frame
from ..anatomy.surfaces.surfaces import compute_signed_distance
from ..anatomy.surfaces.triangles import Surface, find_half_edges
from ..arrays import Array
from ..errors import SurfaceError
from .rays import LimbProfile

Ints = NDArray[np.int64]

CLEAR_MM = 0.5  # what is promised
AIM_MM = 0.8  # what is aimed at where it is measured
ROUNDS = 12


def apply_clearance(points: Array, faces: Ints, limb: LimbProfile, outer: Surface, frame: Frame) -> Array:
    """The points of a face (limb frame) where the face is clear of the limb by ``CLEAR_MM`` or more.

    Each stays on its ray and moves outwards only. What is measured are the face's points, middles of edges
    and faces, and the limb's points.

    Raises
    ------
    SurfaceError
        Where that takes more than ``ROUNDS`` rounds.
    """
    local = Surface(frame.to_limb(outer.points), outer.faces)
    angle, station, radius = limb.rays.coordinates(points)
    neighbours = _build_neighbours(faces, len(points))
    radius = np.maximum(radius, limb.at(angle, station) + AIM_MM)
    for _ in range(ROUNDS):
        moved = limb.rays.points(angle, station, radius)
        need = _compute_moves(moved, faces, local)
        if need.max() <= AIM_MM - CLEAR_MM:
            return moved
        # A point's neighbours go with it, so that the face stays smooth.
        beside = neighbours.multiply(need[None, :]).max(axis=1).toarray().ravel()
        radius = radius + 1.3 * np.maximum(need, 0.5 * beside)
    raise SurfaceError(
        "the socket cannot be moved clear of the limb",
        remedy="smooth the limb's surface, or trim below where it is folded",
    )


def _build_neighbours(faces: Ints, count: int) -> csr_array:
    edges = find_half_edges(faces)
    both = np.vstack([edges, edges[:, ::-1]])
    return csr_array((np.ones(len(both)), (both[:, 0], both[:, 1])), shape=(count, count))


def _compute_moves(points: Array, faces: Ints, limb: Surface) -> Array:
    """(n,) by how much each point should move out so that all that is measured near it is clear, mm."""
    need = np.maximum(AIM_MM - compute_signed_distance(limb, points), 0.0)
    for corners in ((0, 1), (1, 2), (2, 0), (0, 1, 2)):
        ends = faces[:, list(corners)]
        short = np.maximum(AIM_MM - compute_signed_distance(limb, points[ends].mean(axis=1)), 0.0)
        for end in ends.T:
            np.maximum.at(need, end, short)
    squared, nearest, _ = igl.point_mesh_squared_distance(limb.points, points, faces)
    short = np.maximum(AIM_MM - np.sqrt(squared), 0.0)
    for end in faces[nearest].T:
        np.maximum.at(need, end, short)
    return need
