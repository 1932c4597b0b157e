"""Inverted tetrahedra of a site mesh are made sound by the least change that does it, which is reported.

Tried in turn, each about the inverted cells alone: nodes moved along the surfaces that they lie on; layers
made thinner from below, where their columns cross; nodes moved off their surfaces.
"""

from collections.abc import Callable

import numpy as np

from ...arrays import Array, Indices, Mask
from ...mesh import Mesh, node_jacobians
from ..frame import format_place
from .background import compute_volumes
from .extrusion import Columns
from .layers import LimbFields, evaluate_distance
from .smoothing import DIRECTIONS, find_constraints, project_nodes

MIN_ROUNDNESS = 0.03  # volume over that of a regular tetrahedron of the same edges; worked on below it
SWEEPS = 12
MAX_SHIFT = 1.0  # that a node goes, over the mean edge at it
STEPS = (0.6, 0.3, 0.15, 0.05)  # of the mean edge at the node
THINNING_FACTOR = 0.5  # what a layer keeps of its thickness at first, and again the second time
_REGULAR = 6.0 * np.sqrt(2.0)  # cube of the edge over volume


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
    for _ in range(SWEEPS):
        poor = _compute_roundness(points[about]) < MIN_ROUNDNESS
        if not poor.any():
            break
        nodes = np.unique(about[poor])
        for node in nodes[movable[nodes]]:
            star = tets[order[starts[node] : starts[node + 1]] // 4]
            points[node] = _find_best_place(points, star, node, normals[node], before)
    return points


def _find_best_place(points: Array, star: Indices, node: int, normal: Array, before: Array) -> Array:
    """Where the worst of the cells about a node is best: here, among a pattern, or amidst its neighbours.

    No farther from where it was at first than its neighbours were: a node would run from hopeless cells.
    """
    here, corners, mine = points[node], points[star], star == node
    around = corners[~mine]
    reach = np.linalg.norm(before[star[~mine]] - before[node], axis=1).mean()
    moves = np.vstack(
        [np.zeros(3), around.mean(axis=0) - here, *(step * reach * DIRECTIONS for step in STEPS)]
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
