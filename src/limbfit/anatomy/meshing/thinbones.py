"""Thin bones: the grid that is cut along them is fine enough to keep them, and the mesh shows whether it did.

A grid is cut only where an edge has one end in a bone and one outside. Of a round bone as thin as its spacing
that keeps a quarter, in beads; of one twice as thick nine tenths.
"""

from __future__ import annotations

from functools import partial

import igl
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from ...arrays import Array
from ...mesh import Mesh
from .background import LONGEST_EDGE, TetGrid, refine_grid
from .layered import find_bone_faces
from .layers import LimbFields, compute_signed_distance

PROBE = 1.4  # of the spacing: how far below a bone's surface the depth is measured
FLANK = 0.4  # of that way: a lesser depth is that below the bone's far side; with PROBE, bone thinner than 2
HALVINGS = 2  # tips and edges of a bone are thin at every spacing
LOST_MM = 4.0  # bone that the mesh misses by more than that on a tenth of its surface is lost in part
TRIMMED_MM = 0.5  # from the bone as trimmed: surface that was not left out on purpose
SEEN_RADII = 1.5  # of the zone whose elements have to be good: bone that bears an indentation


def refine_at_bones(grid: TetGrid, fields: LimbFields) -> TetGrid:
    """A box's grid, halved about bone that is thinner than two of its cells."""
    for halving in range(HALVINGS):
        spacing = grid.spacing / 2**halving
        thin = thin_places(fields, spacing)
        if not len(thin):
            break
        grid = refine_grid(grid, partial(_is_near, KDTree(thin), LONGEST_EDGE * spacing), 0.5 * spacing)
    return grid


def thin_places(fields: LimbFields, spacing: float) -> Array:
    """Vertices (k, 3) of bones, in the limb frame, where they are thinner than about two spacings (mm)."""
    found = [np.zeros((0, 3))]
    for bone in fields.bones.values():
        depth = -compute_signed_distance(bone, bone.points - PROBE * spacing * bone.vertex_normals)[0]
        below = bone.points[:, 2] < 0.0
        found.append(bone.points[below & (depth < FLANK * PROBE * spacing)])
    return np.vstack(found)


def _is_near(places: KDTree, distance_mm: float, points: Array) -> NDArray[np.bool_]:
    return np.isfinite(places.query(points, distance_upper_bound=distance_mm)[0])


def warn_of_lost_bone(mesh: Mesh, fields: LimbFields, near: tuple[Array, float] | None) -> tuple[str, ...]:
    """Which bones about a site a mesh in the limb frame lacks in part; ``near``: the place (3,) and radius
    (mm) within which elements have to be good, None for all of the limb."""
    bones = {
        name: places
        for name, bone in fields.bones.items()
        if len(places := _select_kept_vertices(fields, bone.points, near))
    }
    if not bones:
        return ()
    faces = find_bone_faces(mesh)[:, :3]
    warnings = []
    for name, places in bones.items():
        squared = igl.point_mesh_squared_distance(places, mesh.points, faces)[0] if len(faces) else np.inf
        off = float(np.quantile(np.sqrt(squared), 0.9))
        if off > LOST_MM:
            warnings.append(
                f"the mesh loses part of the {name}: a tenth of its surface is off by {off:.0f} mm or more; "
                "choose a smaller mesh.edge_far_mm"
            )
    return tuple(warnings)


def _select_kept_vertices(fields: LimbFields, points: Array, near: tuple[Array, float] | None) -> Array:
    """Of a bone's vertices (n, 3) those below the cut that were not trimmed, near the site."""
    chosen = points[:, 2] < -LOST_MM
    if near is not None:
        place, radius = near
        chosen &= np.linalg.norm(points - place, axis=1) < SEEN_RADII * radius
    points = points[chosen]
    return points[np.abs(fields.void(points)[0]) < TRIMMED_MM] if len(points) else points
