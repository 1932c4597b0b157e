"""The few worst tetrahedra of a mesh are improved by moving their nodes."""

from collections.abc import Callable

import numpy as np

from ...arrays import Array, Indices, Mask
from ...mesh import Mesh
from .background import Field, project_safely, project_to_level
from .extrusion import Columns
from .layers import LimbFields
from .regions import build_region_level, find_interfaces

GOOD_DEG = 9.0
IMPROVED_BELOW_DEG = 11.0
SWEEPS = 6
STEPS = (0.3, 0.15, 0.05)  # of the shortest edge at the node
DIRECTIONS = np.stack(np.meshgrid(*[[-1.0, 0.0, 1.0]] * 3), axis=-1).reshape(-1, 3)
DIRECTIONS = DIRECTIONS[np.any(DIRECTIONS != 0, axis=1)]
# The corners of a tetrahedron opposite to each, in an order that keeps its sense; pairs of its faces.
OPPOSITE = np.array([[1, 2, 3], [0, 3, 2], [0, 1, 3], [0, 2, 1]])
PAIRS = np.triu_indices(4, 1)
ProposePlaces = Callable[[int, Array, Array], Array]  # places (k, 3) of a node after moves (k, 3) from (3,)


def limit_moves(points: Array, normals: Array, in_layers: Mask, fields: LimbFields) -> ProposePlaces:
    """How nodes may go: along a plane, freely, or in the layers along the skin at the depth that they have.

    A plane would lead a node of the layers far out of a bent or rough skin, from where no cell lets it back.
    ``normals`` (n, 3) are those of the planes, zero where a node moves freely.
    """
    depths = np.full(len(points), np.nan)
    depths[in_layers] = np.sqrt(fields.skin.find_nearest(points[in_layers])[0])

    def propose_places(node: int, here: Array, moves: Array) -> Array:
        normal, depth = normals[node], depths[node]
        places = here + moves - (moves @ normal)[:, None] * normal
        if np.isnan(depth):
            return np.asarray(places)
        squared, _, nearest = fields.skin.find_nearest(places)
        share = depth / np.maximum(np.sqrt(squared), 1e-12)
        return np.asarray(nearest + share[:, None] * (places - nearest))

    return propose_places


def smooth_elements(mesh: Mesh, fields: LimbFields, stack: Columns) -> Mesh:
    """A tet4 mesh with its poor elements improved and its boundary nodes put back on the smooth surfaces.

    Inner nodes move freely, those of the layers along the skin, those on bone or cut along these, nodes on
    two of them not at all. Where the limb was cut off about the site, the boundary has no shape to keep.
    """
    normals, movable = find_constraints(mesh, fields, stack)
    propose = limit_moves(mesh.points, normals, _find_places(mesh, stack)[1], fields)
    points = improve_angles(mesh.points, mesh.cells, IMPROVED_BELOW_DEG, propose, movable)
    return mesh.with_points(project_nodes(points, mesh, fields, stack))


def project_nodes(points: Array, mesh: Mesh, fields: LimbFields, stack: Columns) -> Array:
    """Moved points (n, 3) of a mesh, those of surfaces put on them as far as cells allow."""
    on_plane, in_layers, on_bone = _find_places(mesh, stack)
    walls = _find_region_walls(mesh, fields)
    target, free = points.copy(), np.where(on_plane, 0.0, 1.0)
    alone = np.sum([on_plane, in_layers, on_bone, *(chosen for chosen, _ in walls)], axis=0) < 2
    own = [(np.flatnonzero(chosen & alone), level) for chosen, level in (*walls, (on_bone, fields.void))]
    for nodes, level in (*own, (stack.base, fields.layer), (stack.top, fields.depth)):
        target[nodes] = project_to_level(level, target[nodes], free[nodes])
    return project_safely(points, target, mesh.cells, GOOD_DEG)


def find_constraints(mesh: Mesh, fields: LimbFields, stack: Columns) -> tuple[Array, Mask]:
    """Unit normals (n, 3) of the surface that a node moves on, zero for inner ones; which may move (n,)."""
    points = mesh.points
    on_plane, in_layers, on_bone = _find_places(mesh, stack)
    normals = np.where(on_plane[:, None], [0.0, 0.0, 1.0], np.zeros((len(points), 3)))
    walls = _find_region_walls(mesh, fields)
    for chosen, level in ((in_layers, fields.depth), (on_bone, fields.void), *walls):
        slope = level(points[chosen])[1]
        normals[chosen] = slope / np.maximum(np.linalg.norm(slope, axis=1, keepdims=True), 1e-12)
    return normals, np.sum([on_plane, in_layers, on_bone, *(chosen for chosen, _ in walls)], axis=0) < 2


def _find_region_walls(mesh: Mesh, fields: LimbFields) -> list[tuple[Mask, Field]]:
    """Mask (n,) of the nodes on the surface of each region inside the core, and the region's level."""
    found = []
    for number, faces in enumerate(find_interfaces(mesh, len(fields.depths))):
        chosen = np.zeros(len(mesh.points), dtype=bool)
        chosen[faces] = True
        found.append((chosen, build_region_level(fields, number)))
    return found


def _find_places(mesh: Mesh, stack: Columns) -> Mask:
    """Masks (3, n) of the nodes on the cut plane, in the layers, and on bone."""
    places = np.zeros((3, len(mesh.points)), dtype=bool)
    places[0] = mesh.points[:, 2] == 0.0
    places[1, stack.base] = places[1, stack.top[0] :] = True
    places[2, mesh.node_sets["fixed_bone"]] = True
    return places


def improve_angles(
    points: Array, tets: Indices, goal_deg: float, propose: ProposePlaces, movable: Mask
) -> Array:
    """Points (n, 3) with nodes of poor tetrahedra moved so that the smallest dihedral angle about each grows.

    Parameters
    ----------
    points, tets : the mesh.
    goal_deg : tetrahedra below it are worked on.
    propose : where a node may go.
    movable : (n,) nodes that may move.
    """
    points = points.copy()
    order = np.argsort(tets, axis=None, kind="stable")
    starts = np.searchsorted(tets.ravel()[order], np.arange(len(points) + 1))
    worst = compute_worst_angles(points[tets[:, 0], None], points[tets[:, 1:]])[:, 0]
    for _ in range(SWEEPS):
        before = points.copy()
        nodes = np.unique(tets[worst < goal_deg])
        for node in nodes[movable[nodes]]:
            at = order[starts[node] : starts[node + 1]]
            star, corner = at // 4, at % 4
            opposite = np.take_along_axis(tets[star], OPPOSITE[corner], axis=1)
            points[node], worst[star] = _find_best_place(points, opposite, node, propose)
        if np.array_equal(before, points):
            break
    return points


def _find_best_place(
    points: Array, opposite: Indices, node: int, propose: ProposePlaces
) -> tuple[Array, Array]:
    """Where the smallest angle of the tetrahedra about a node is greatest, among a pattern of places.

    ``opposite`` (s, 3) are their other nodes.  Also the smallest angle (s,) of each with the node there.
    """
    here, others = points[node], points[opposite]
    reach = np.linalg.norm(others - here, axis=2).min()
    moves = np.concatenate([step * reach * DIRECTIONS for step in STEPS])
    places = np.vstack([here, propose(node, here, moves)])
    angles = compute_worst_angles(places, others)
    best = int(np.argmax(angles.min(axis=0)))
    return places[best], angles[:, best]


def compute_worst_angles(tips: Array, bases: Array) -> Array:
    """Smallest dihedral angle (s, k) of tetrahedra between a tip and a base, degrees; -1 where inverted.

    Parameters
    ----------
    tips : (k, 3), each with every base, or (s, 1, 3), one of each base.
    bases : (s, 3, 3), counter-clockwise seen from the tip's far side.
    """
    edges = np.moveaxis(bases[:, None] - tips[..., None, :], (2, 3), (1, 0))  # axis, corner, then (s, k)
    after, last = edges[:, [1, 2, 0]], edges[:, [2, 0, 1]]
    # Area vectors of the faces at the tip; that of the base closes the sum.
    sides = after[[1, 2, 0]] * last[[2, 0, 1]] - after[[2, 0, 1]] * last[[1, 2, 0]]
    volume = (edges[:, 0] * sides[:, 0]).sum(axis=0) / 6.0
    normals = np.concatenate([sides, -sides.sum(axis=1, keepdims=True)], axis=1)
    normals /= np.sqrt((normals * normals).sum(axis=0)) + np.finfo(float).tiny
    cosine = -(normals[:, PAIRS[0]] * normals[:, PAIRS[1]]).sum(axis=0).min(axis=0)
    angle = np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))
    return np.where(volume > 1e-12, angle, -1.0)
