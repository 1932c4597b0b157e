"""A socket's face clear of the limb, moved along its rays, which cannot fold it, and of the bones inside."""

from collections.abc import Mapping

import numpy as np
from scipy.sparse import csr_array

from ..anatomy.grid import Frame
from ..anatomy.surfaces.mending import open_loops
from ..anatomy.surfaces.triangles import Surface, find_half_edges
from ..arrays import Array, Indices
from ..errors import SurfaceError
from .rays import LimbProfile
from .shape import close_by_fans

CLEAR_MM = 0.5  # what is promised
TARGET_MM = 0.8  # what is aimed at where it is measured
MAX_ROUNDS = 12


def apply_clearance(points: Array, faces: Indices, limb: LimbProfile, outer: Surface, frame: Frame) -> Array:
    """Move the points of a face (limb frame) until it is clear of the limb by ``CLEAR_MM`` or more.

    Each stays on its ray and moves outwards only. What is measured are the face's points, middles of edges
    and faces, and the limb's points. Raises `SurfaceError` where that takes more than ``MAX_ROUNDS`` rounds.
    """
    local = Surface(frame.to_limb(outer.points), outer.faces)
    angle, station, radius = limb.rays.coordinates(points)
    edges = find_half_edges(faces)
    both = np.vstack([edges, edges[:, ::-1]])
    neighbours = csr_array((np.ones(len(both)), (both[:, 0], both[:, 1])), shape=(len(points), len(points)))
    radius = np.maximum(radius, limb.at(angle, station) + TARGET_MM)
    for _ in range(MAX_ROUNDS):
        moved = limb.rays.points(angle, station, radius)
        need = _compute_moves(moved, faces, local)
        if need.max() <= TARGET_MM - CLEAR_MM:
            return moved
        # A point's neighbours go with it, so that the face stays smooth.
        beside = neighbours.multiply(need[None, :]).max(axis=1).toarray().ravel()
        radius = radius + 1.3 * np.maximum(need, 0.5 * beside)
    raise SurfaceError(
        "the socket cannot be moved clear of the limb",
        remedy="smooth the limb's surface, or trim below where it is folded",
    )


def _compute_moves(points: Array, faces: Indices, limb: Surface) -> Array:
    """Compute by how much each point (n,) should move out so that all measured near it is clear, mm."""
    need = np.maximum(TARGET_MM - limb.signed_distance(points), 0.0)
    for corners in ((0, 1), (1, 2), (2, 0), (0, 1, 2)):
        ends = faces[:, list(corners)]
        short = np.maximum(TARGET_MM - limb.signed_distance(points[ends].mean(axis=1)), 0.0)
        for end in ends.T:
            np.maximum.at(need, end, short)
    squared, nearest, _ = Surface(points, faces).find_nearest(limb.points)
    short = np.maximum(TARGET_MM - np.sqrt(squared), 0.0)
    for end in faces[nearest].T:
        np.maximum.at(need, end, short)
    return need


BONE_ROUGHNESS_MM = 0.5  # by which a bone may reach through the face: roughness


def refuse_bones(
    face: Surface,
    brim: Indices,
    frame: Frame,
    bones: Mapping[str, Surface],
    *,
    remedy: str,
    spare_mm: float = 0.0,
) -> None:
    """Refuse a face that a bone reaches through, below the brim and above an open end.

    Parameters
    ----------
    face, brim : of a `Socket`, LPS mm.
    frame : of the limb.
    bones : closed surfaces, LPS mm.
    spare_mm : how far a bone may do so besides roughness: a liner that the face was drawn without.

    Raises
    ------
    SurfaceError
        With the bone, how far it reaches through, and the remedy.
    """
    face = Surface(frame.to_limb(face.points), face.faces)
    closed = close_by_fans(face.flipped)
    lowest = float(face.points[brim, 2].min())
    ends = [face.points[loop, 2].max() for loop in open_loops(face) if loop[0] not in brim]
    for name, bone in bones.items():
        local = frame.to_limb(bone.points)
        height = local[:, 2]
        below = local[(height < lowest - BONE_ROUGHNESS_MM) & (height > max(ends, default=-np.inf))]
        if not len(below):
            continue
        out = float(closed.signed_distance(below).max()) - spare_mm
        if out > BONE_ROUGHNESS_MM:
            raise SurfaceError(f"the socket cuts {out:.1f} mm into the bone {name}", remedy=remedy)
