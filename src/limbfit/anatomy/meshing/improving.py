"""Nodes of a site mesh are moved: the few worst tetrahedra are improved, inverted ones mended, faces curved.

Inverted ones are made sound by the least change that does it, which is reported. Tried in turn, each about
the inverted cells alone: nodes moved along the surfaces that they lie on; layers made thinner from below,
where their columns cross; nodes moved off their surfaces.

Mid-edge nodes of quadratic tetrahedra are put on the smooth surfaces where the elements stay sound. Faces on
bone lie on it in the mean, where they are too coarse to follow it. A bone bulges: coarse faces with their
nodes on it cut into it, also curved ones where elements do not allow their mid-edge nodes as far out. Tissue
over the bone is then too thick, and a site too soft (by 5 % at 11 mm over a rod of 8 mm). So their nodes are
moved off the bone by what the faces around them lack.
"""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from ...arrays import Array, Indices, Mask
from ...mesh import TET10_EDGES, Mesh, node_jacobians
from ...mesh.cells import quadratic_simplex
from ..grid import format_place
from ..surfaces.triangles import cross_edges
from .background import Field, compute_volumes, project_safely, project_to_level
from .extrusion import Columns, find_bone_faces, find_inner_faces
from .layers import LimbFields, evaluate_distance
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
MIN_ROUNDNESS = 0.03  # volume over that of a regular tetrahedron of the same edges; worked on below it
UNTANGLING_SWEEPS = 12
MAX_SHIFT = 1.0  # that a node goes, over the mean edge at it
UNTANGLING_STEPS = (0.6, 0.3, 0.15, 0.05)  # of the mean edge at the node
THINNING_FACTOR = 0.5  # what a layer keeps of its thickness at first, and again the second time
_REGULAR = 6.0 * np.sqrt(2.0)  # cube of the edge over volume
SMALLEST_JACOBIAN = 0.3  # of the straight element's, at every node
BISECTIONS = 5  # of moves onto curved faces
ROUNDS = 4  # of moves off the bone
SPLITS = 4  # of each edge of a face: the level is averaged at so many squared places


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
    propose = limit_moves(mesh.points, normals, _find_surfaces(mesh, fields, stack)[0][1], fields)
    points = improve_angles(mesh.points, mesh.cells, IMPROVED_BELOW_DEG, propose, movable)
    return mesh.with_points(project_nodes(points, mesh, fields, stack))


def project_nodes(points: Array, mesh: Mesh, fields: LimbFields, stack: Columns) -> Array:
    """Moved points (n, 3) of a mesh, those of surfaces put on them as far as cells allow."""
    (on_plane, _, on_bone), walls, alone = _find_surfaces(mesh, fields, stack)
    target, free = points.copy(), np.where(on_plane, 0.0, 1.0)
    own = [(np.flatnonzero(chosen & alone), level) for chosen, level in (*walls, (on_bone, fields.void))]
    for nodes, level in (*own, (stack.base, fields.layer), (stack.top, fields.depth)):
        target[nodes] = project_to_level(level, target[nodes], free[nodes])
    return project_safely(points, target, mesh.cells, GOOD_DEG)


def find_constraints(mesh: Mesh, fields: LimbFields, stack: Columns) -> tuple[Array, Mask]:
    """Unit normals (n, 3) of the surface that a node moves on, zero for inner ones; which may move (n,)."""
    points = mesh.points
    (on_plane, in_layers, on_bone), walls, alone = _find_surfaces(mesh, fields, stack)
    normals = np.where(on_plane[:, None], [0.0, 0.0, 1.0], np.zeros((len(points), 3)))
    for chosen, level in ((in_layers, fields.depth), (on_bone, fields.void), *walls):
        slope = level(points[chosen])[1]
        normals[chosen] = slope / np.maximum(np.linalg.norm(slope, axis=1, keepdims=True), 1e-12)
    return normals, alone


def _find_surfaces(
    mesh: Mesh, fields: LimbFields, stack: Columns
) -> tuple[Mask, list[tuple[Mask, Field]], Mask]:
    """Masks (3, n) of the nodes on the cut plane, in the layers, and on bone; that (n,) of the nodes on the
    surface of each region inside the core, with the region's level; that (n,) of nodes on one of them at
    most."""
    interfaces = find_interfaces(mesh, len(fields.depths))
    places = np.zeros((3 + len(interfaces), len(mesh.points)), dtype=bool)
    places[0] = mesh.points[:, 2] == 0.0
    places[1, stack.base] = places[1, stack.top[0] :] = True
    places[2, mesh.node_sets["fixed_bone"]] = True
    for chosen, faces in zip(places[3:], interfaces):
        chosen[faces] = True
    walls = [(chosen, build_region_level(fields, number)) for number, chosen in enumerate(places[3:])]
    return places[:3], walls, places.sum(axis=0) < 2


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

    ``tips`` are (k, 3), each with every base, or (s, 1, 3), one of each base; ``bases`` (s, 3, 3) are
    counter-clockwise seen from the tip's far side.
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


def repair_mesh(mesh: Mesh, fields: LimbFields, stack: Columns) -> tuple[Mesh, tuple[str, ...]]:
    """A tet4 mesh in the limb frame with its inverted cells mended as far as they can be.

    Also what mended how many of them, where (LPS mm), moving nodes how far (mm), in words.
    """
    normals, movable = find_constraints(mesh, fields, stack)
    on_plane = mesh.points[:, 2] == 0.0
    free = np.where(on_plane[:, None], [0.0, 0.0, 1.0], np.zeros((len(mesh.points), 3)))
    attempts: tuple[tuple[str, Callable[[Array], Array]], ...] = (
        (
            "nodes moved along their surfaces",
            lambda p: project_nodes(untangle_cells(p, mesh.cells, normals, movable), mesh, fields, stack),
        ),
        ("layers thinned", lambda p: thin_inverted_layers(p, mesh, stack, normals, movable)),
        (
            "nodes moved off their surfaces",
            lambda p: untangle_cells(p, mesh.cells, free, movable | ~on_plane),
        ),
    )
    repairs = []
    points, bad = mesh.points, find_inverted_cells(mesh)
    for what, attempt in attempts:
        if not bad.any():
            break
        tried = attempt(points)
        left = compute_volumes(tried, mesh.cells) <= 0.0
        if left.sum() < bad.sum():
            where = format_place(fields.frame.to_patient(points[mesh.cells[bad]].reshape(-1, 3).mean(axis=0)))
            moved = np.linalg.norm(tried - points, axis=1).max()
            cells = bad.sum() - left.sum()
            repairs.append(f"{cells} inverted cells at {where} mended: {what} by up to {moved:.2f} mm")
            points, bad = tried, left
    return mesh.with_points(points), tuple(repairs)


def find_inverted_cells(mesh: Mesh) -> Mask:
    """Cells (m,) that have no positive Jacobian at one of their nodes."""
    return np.asarray(node_jacobians(mesh).min(axis=1) <= 0.0)


def untangle_cells(points: Array, tets: Indices, normals: Array, movable: Mask) -> Array:
    """Points (n, 3) with nodes of inverted tetrahedra, and of nearly flat ones beside them, where the worst
    about each is best.

    Parameters
    ----------
    points, tets : the mesh.
    normals : (n, 3) unit normals of the surface that a node moves on; zero where it moves freely.
    movable : (n,) nodes that may move.
    """
    before, points = points, points.copy()
    order = np.argsort(tets, axis=None, kind="stable")
    starts = np.searchsorted(tets.ravel()[order], np.arange(len(points) + 1))
    about = tets[np.isin(tets, tets[compute_volumes(points, tets) <= 0.0]).any(axis=1)]
    for _ in range(UNTANGLING_SWEEPS):
        poor = _compute_roundness(points[about]) < MIN_ROUNDNESS
        if not poor.any():
            break
        nodes = np.unique(about[poor])
        for node in nodes[movable[nodes]]:
            star = tets[order[starts[node] : starts[node + 1]] // 4]
            points[node] = _find_roundest_place(points, star, node, normals[node], before)
    return points


def _find_roundest_place(points: Array, star: Indices, node: int, normal: Array, before: Array) -> Array:
    """Where the worst of the cells about a node is best: here, among a pattern, or amidst its neighbours.

    No farther from where it was at first than its neighbours were: a node would run from hopeless cells.
    """
    here, corners, mine = points[node], points[star], star == node
    around = corners[~mine]
    reach = np.linalg.norm(before[star[~mine]] - before[node], axis=1).mean()
    moves = np.vstack(
        [np.zeros(3), around.mean(axis=0) - here, *(step * reach * DIRECTIONS for step in UNTANGLING_STEPS)]
    )
    places = here + moves - (moves @ normal)[:, None] * normal
    places = places[(np.linalg.norm(places - before[node], axis=1) <= MAX_SHIFT * reach) | ~moves.any(axis=1)]
    trial = np.where(mine[None, :, :, None], places[:, None, None, :], corners[None])
    worst = _compute_roundness(trial.reshape(-1, 4, 3)).reshape(len(places), -1).min(axis=1)
    return np.asarray(places[int(np.argmax(worst))])


def _compute_roundness(corners: Array) -> Array:
    """Signed volume (m,) of tetrahedra (m, 4, 3) over that of a regular one of the same mean edge."""
    flat = corners.reshape(-1, 3)
    volume = compute_volumes(flat, np.arange(len(flat)).reshape(-1, 4))
    edges = corners[:, [0, 0, 0, 1, 1, 2]] - corners[:, [1, 2, 3, 2, 3, 3]]
    return np.asarray(_REGULAR * volume / np.maximum((edges**2).sum(axis=2).mean(axis=1) ** 1.5, 1e-30))


def thin_inverted_layers(points: Array, mesh: Mesh, stack: Columns, normals: Array, movable: Mask) -> Array:
    """Layers thinner from below where their cells are inverted: columns that cross do so at their feet."""
    points = points.copy()
    own = stack.top[0] + np.arange(len(stack.owner))
    for _ in range(2):
        bad = compute_volumes(points, mesh.cells) <= 0.0
        chosen = np.isin(stack.base, mesh.cells[bad]) | np.isin(stack.top, mesh.cells[bad])
        if not chosen.any():
            break
        feet, between = stack.base[chosen], chosen[stack.owner]
        nodes = np.concatenate([feet, own[between]])
        heads = points[np.concatenate([stack.top[chosen], stack.top[stack.owner[between]]])]
        points[nodes] = heads + THINNING_FACTOR * (points[nodes] - heads)
        inner = movable.copy()
        inner[feet] = False
        points = untangle_cells(points, mesh.cells, normals, inner)
    return points


def describe_unrepaired(mesh: Mesh, fields: LimbFields) -> str:
    """Where the inverted cells of a mesh in the limb frame are (LPS mm), next to what, and why."""
    bad = find_inverted_cells(mesh)
    number = int(mesh.regions[bad][0])
    region = mesh.region_names[number]
    why = (
        f"there is too little {region} for its elements"
        if number >= len(fields.depths)
        else "the skin is folded, or bent more sharply than its layers are thick"
    )
    where = _place(mesh.points[mesh.corners[bad]].mean(axis=1)[0], fields)
    return f"{int(bad.sum())} of {len(mesh.cells)} cells are inverted, the first in {region} {where}: {why}"


def describe_narrowest_gap(points: Array, tets: Indices, fields: LimbFields) -> str:
    """Where the flattest of tetrahedra in the limb frame is (LPS mm), and next to what."""
    corners = points[tets]
    return _place(corners[np.argmin(_compute_roundness(corners))].mean(axis=0), fields)


def _place(point: Array, fields: LimbFields) -> str:
    """Where a point (3,) of the limb frame is (LPS mm), and how far from which surface."""
    where = point[None]
    near = {
        "the skin": abs(fields.depth(where)[0][0]),
        "the layers' inner face": abs(fields.layer(where)[0][0]),
        "the proximal cut": abs(point[2]),
    }
    bones = {name: abs(evaluate_distance(bone, where)[0][0]) for name, bone in fields.bones.items()}
    near |= {f"the bone {name}": distance for name, distance in bones.items()}
    surface = min(near, key=lambda name: near[name])
    return f"at {format_place(fields.frame.to_patient(point))}, {near[surface]:.1f} mm from {surface}"


def curve_mesh(mesh: Mesh, target: Array, straight: Array) -> Mesh:
    """A tet10 mesh with nodes moved to ``target`` (n, 3), less or not at all where elements would suffer.

    ``straight`` (m,) is the least Jacobian of each element with straight sides.
    """
    share, attempt = np.ones(len(mesh.points)), 0
    while True:
        points = mesh.points + share[:, None] * (target - mesh.points)
        moved = replace(mesh, points=points)
        bad = (node_jacobians(moved).min(axis=1) < SMALLEST_JACOBIAN * straight) & (straight > 0.0)
        nodes = np.unique(mesh.cells[bad])
        if not share[nodes].any():
            return moved
        share[nodes] = share[nodes] / 2 if attempt < BISECTIONS - 1 else 0.0
        attempt += 1


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
