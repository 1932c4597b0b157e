"""Mid-edge nodes of quadratic tetrahedra put on the smooth surfaces where the elements stay sound.

Faces on bone lie on it in the mean, where they are too coarse to follow it. A bone bulges: coarse faces with
their nodes on it cut into it, also curved ones where elements do not allow their mid-edge nodes as far out.
Tissue over the bone is then too thick, and a site too soft (by 5 % at 11 mm over a rod of 8 mm). So their
nodes are moved off the bone by what the faces around them lack.
"""

from dataclasses import replace
from itertools import count

import numpy as np

from ...arrays import Array, Indices
from ...mesh import TET10_EDGES, Mesh, node_jacobians
from ...mesh.cells import quadratic_simplex
from ..surfaces.triangles import cross_edges
from .background import project_to_level
from .extrusion import Columns, find_bone_faces, find_inner_faces
from .layers import LimbFields
from .regions import build_region_level, find_interfaces

SMALLEST_JACOBIAN = 0.3  # of the straight element's, at every node
BISECTIONS = 5
ROUNDS = 4
SPLITS = 4  # of each edge of a face: the level is averaged at so many squared places


def curve_mesh(mesh: Mesh, target: Array, straight: Array) -> Mesh:
    """A tet10 mesh with nodes moved to ``target`` (n, 3), less or not at all where elements would suffer.

    ``straight`` (m,) is the least Jacobian of each element with straight sides.
    """
    share = np.ones(len(mesh.points))
    for attempt in count():
        points = mesh.points + share[:, None] * (target - mesh.points)
        moved = replace(mesh, points=points)
        bad = (node_jacobians(moved).min(axis=1) < SMALLEST_JACOBIAN * straight) & (straight > 0.0)
        nodes = np.unique(mesh.cells[bad])
        if not share[nodes].any():
            return moved
        share[nodes] = share[nodes] / 2 if attempt < BISECTIONS - 1 else 0.0
    raise AssertionError("each pass straightens more")


def compute_curved_target(mesh: Mesh, fields: LimbFields) -> Array:
    """Where the mid-edge nodes of skin, layers' inner face, bone and regions would lie on smooth surfaces."""
    target, layers = mesh.points.copy(), len(fields.depths)
    free = np.where(mesh.points[:, 2] == 0.0, 0.0, 1.0)
    surfaces = [
        *((faces, build_region_level(fields, k)) for k, faces in enumerate(find_interfaces(mesh, layers))),
        (mesh.face_sets["skin"], fields.depth),
        (find_inner_faces(mesh, layers - 1), fields.layer),
        (find_bone_faces(mesh), fields.void),
    ]
    for faces, level in surfaces:
        nodes = np.unique(faces[:, 3:])
        target[nodes] = project_to_level(level, target[nodes], free[nodes])
    return target


def curve_diagonals(mesh: Mesh, target: Array, stack: Columns) -> Array:
    """Targets (n, 3) where edges within extruded layers follow the curved edges at their foot and head.

    An edge that stayed straight between two curved ones would fold thin elements. The mesh is tet10 and
    straight-sided; ``target`` (n, 3) is for the mid-edge nodes of the layers' innermost and outermost faces.
    """
    corners = int(mesh.cells[:, :4].max()) + 1
    ends = np.zeros((len(mesh.points) - corners, 2), dtype=np.int64)
    ends[mesh.cells[:, 4:].ravel() - corners] = mesh.cells[:, TET10_EDGES].reshape(-1, 2)
    column, share = np.full(corners, -1), np.zeros(corners)
    column[stack.base] = np.arange(len(stack.base))
    new = stack.top[0] + np.arange(len(stack.owner))
    column[new] = stack.owner
    foot, head = mesh.points[stack.base], mesh.points[stack.top]
    length = np.linalg.norm(head - foot, axis=1)[stack.owner]
    share[new] = np.linalg.norm(mesh.points[new] - foot[stack.owner], axis=1) / length
    sides = column[ends]
    within = (sides >= 0).all(axis=1) & (sides[:, 0] != sides[:, 1]) & (ends >= stack.top[0]).any(axis=1)
    keys = _number_edges(ends, corners)
    order = np.argsort(keys)
    moved = target - mesh.points

    def get_moves(nodes: Indices) -> Array:
        """Moves of the mid-edge nodes between the columns' ends (b,) at the two columns of each edge."""
        edges = _number_edges(nodes[sides[within]], corners)
        return moved[corners + order[np.searchsorted(keys, edges, sorter=order)]]

    part = share[ends[within]].mean(axis=1)[:, None]
    feet, heads = get_moves(stack.base), get_moves(stack.top)
    target = target.copy()
    target[corners:][within] = mesh.points[corners:][within] + (1 - part) * feet + part * heads
    return target


def _number_edges(ends: Indices, count: int) -> Indices:
    """One number (n,) for each edge (n, 2) between ``count`` nodes."""
    low, high = np.sort(ends, axis=1).T
    return np.asarray(low * count + high)


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
        area = np.linalg.norm(cross_edges(mesh.points[faces[:, :3]]), axis=1)
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


def _move_mid_nodes(mesh: Mesh, moves: Array, chosen: Indices) -> Array:
    """Moves (n, 3) in which mid-edge nodes other than those ``chosen`` go with the ends of their edges."""
    found = moves.copy()
    middles, ends = mesh.cells[:, 4:].ravel(), mesh.cells[:, TET10_EDGES].reshape(-1, 2)
    found[middles] = moves[ends].mean(axis=1)
    found[chosen] = moves[chosen]
    return found


def _compute_shape_functions() -> Array:
    """Shape functions (q, 6) of a quadratic triangle at the middles of equal parts of it."""
    i, j = (axis.ravel() for axis in np.meshgrid(range(SPLITS), range(SPLITS), indexing="ij"))
    whole = np.column_stack([i, j])
    upright, turned = whole[i + j < SPLITS] + 1 / 3, whole[i + j < SPLITS - 1] + 2 / 3
    return quadratic_simplex(np.concatenate([upright, turned]) / SPLITS)[0]
