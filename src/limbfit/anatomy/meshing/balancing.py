"""Faces on bone that lie on it in the mean, where they are too coarse to follow it.

A bone bulges: coarse faces with their nodes on it cut into it, also curved ones where elements do not allow
their mid-edge nodes as far out. Tissue over the bone is then too thick, and a site too soft (by 5 % at
11 mm over a rod of 8 mm). So their nodes are moved off the bone by what the faces around them lack.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ...arrays import Array
from ...mesh import TET10_EDGES, Mesh
from ...mesh.cells import quadratic_simplex
from .curving import curve_mesh
from .layered import find_bone_faces
from .layers import LimbFields

Ints = NDArray[np.int64]

ROUNDS = 4
SPLITS = 4  # of each edge of a face: so many squared places tell where it lies


def balance_bone_faces(mesh: Mesh, fields: LimbFields, straight: Array) -> Mesh:
    """A tet10 mesh in the limb frame whose bone faces lie on the bone in the mean, as far as elements allow.

    No node comes nearer to the layers than bone may. ``straight`` (m,) is the least Jacobian of each
    straight-sided element, which keeps a share of it.
    """
    faces = find_bone_faces(mesh)
    if not len(faces):
        return mesh
    nodes = np.unique(faces)
    in_plane = mesh.points[nodes, 2] == 0.0
    shapes = _compute_shape_functions()
    for _ in range(ROUNDS):
        corners = mesh.points[faces[:, :3]]
        area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
        places = np.einsum("qk,fki->fqi", shapes, mesh.points[faces])
        level, _ = fields.void(places.reshape(-1, 3))
        lack = -level.reshape(places.shape[:2]).mean(axis=1)
        total, away = (
            np.bincount(faces.ravel(), np.repeat(of_faces, faces.shape[1]))
            for of_faces in (area, area * lack)
        )
        _, slope = fields.void(mesh.points[nodes])
        room = np.maximum(fields.layer(mesh.points[nodes])[0] - fields.bone_clearance_mm, 0.0)
        moves = np.zeros_like(mesh.points)
        moves[nodes] = np.minimum(away[nodes] / total[nodes], room)[:, None] * slope
        moves[nodes[in_plane], 2] = 0.0
        mesh = curve_mesh(mesh, mesh.points + _move_mid_nodes(mesh, moves, nodes), straight)
    return mesh


def _move_mid_nodes(mesh: Mesh, moves: Array, stated: Ints) -> Array:
    """Moves (n, 3) in which mid-edge nodes other than those ``stated`` go with the ends of their edges."""
    found = moves.copy()
    middles, ends = mesh.cells[:, 4:].ravel(), mesh.cells[:, TET10_EDGES].reshape(-1, 2)
    found[middles] = moves[ends].mean(axis=1)
    found[stated] = moves[stated]
    return found


def _compute_shape_functions() -> Array:
    """Shape functions (q, 6) of a quadratic triangle at the middles of equal parts of it."""
    i, j = (axis.ravel() for axis in np.meshgrid(range(SPLITS), range(SPLITS), indexing="ij"))
    whole = np.column_stack([i, j])
    upright, turned = whole[i + j < SPLITS] + 1 / 3, whole[i + j < SPLITS - 1] + 2 / 3
    return quadratic_simplex(np.concatenate([upright, turned]) / SPLITS)[0]
