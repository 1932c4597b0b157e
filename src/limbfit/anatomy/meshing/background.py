"""A tetrahedral grid under the proximal cut plane, cut along level sets into conforming regions.

Also how nodes are put on level sets again, exactly or as far as their elements allow.

Cutting bisects every tetrahedron at its crossed edges in one global order of edges. Two tetrahedra that share
a face see that face's edges in the same order, so the result conforms without a table of cases.

Each vertex carries a bit mask of the surfaces it must stay on: ``PLANE`` and one bit per level set; each
tetrahedron the number of its region: 0 for the core, 1 for the first region inside it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from ...arrays import Array, Indices, Mask
from ...mesh import TET10_EDGES, compute_dihedral_angles
from ...mesh.cells import SIX_TETS

Field = Callable[[Array], tuple[Array, Array]]

PLANE, LAYER, BONE, REGION = 1, 2, 4, 8  # of regions the first's; each further one's is twice as large
CELL_FACTORS = (8.0, 4.0, 2.0)  # of the spacing: cells that are settled by one value
CELL_RANGE, CELL_OFFSET = 1 << 20, 1 << 19  # three cell indices in one integer
LONGEST_EDGE = 1.8  # of the spacing: the cubes' diagonal; both ends of a crossed edge are that near
SNAP_FRACTION = 0.15
ROOT_STEPS = 2  # the mesher's nodes are put on the surfaces again
SMALLEST_VOLUME = 1e-3  # of a grid tetrahedron: a snap that leaves less is undone
NEWTON_STEPS, BISECTIONS = 4, 4  # of nodes put on a surface


@dataclass(frozen=True)
class TetGrid:
    """Points (n, 3), tetrahedra (m, 4) of positive volume, surface mask (n,) of the points, spacing in mm.

    ``regions`` (m,) number the tetrahedra's regions.
    """

    points: Array
    tets: Indices
    mask: Indices
    spacing: float
    regions: Indices

    def select(self, keep: Mask) -> TetGrid:
        """The grid of the chosen tetrahedra with its unused points dropped."""
        used, tets = np.unique(self.tets[keep], return_inverse=True)
        tets = tets.reshape(-1, 4)
        return TetGrid(self.points[used], tets, self.mask[used], self.spacing, self.regions[keep])


def build_box_grid(low: Array, high: Array, spacing: float) -> TetGrid:
    """Kuhn tetrahedra over a box whose top z is ``high[2]``, exactly; the box grows to whole cells."""
    counts = np.ceil((high - low) / spacing).astype(int) + 1
    axes = [low[0] + spacing * np.arange(counts[0]), low[1] + spacing * np.arange(counts[1])]
    axes.append(high[2] - spacing * np.arange(counts[2])[::-1])
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    node = np.arange(len(points)).reshape(counts)
    corners = [node[x : x - 1 or None, y : y - 1 or None, z : z - 1 or None].ravel()
               for z in (0, 1) for y in (0, 1) for x in (0, 1)]  # fmt: skip
    tets = np.stack(corners, axis=1)[:, SIX_TETS].reshape(-1, 4)
    mask = np.where(points[:, 2] == axes[2][-1], PLANE, 0)
    return TetGrid(points, tets, mask, spacing, np.zeros(len(tets), dtype=np.int64))


def refine_grid(grid: TetGrid, near: Callable[[Array], Mask], spacing: float) -> TetGrid:
    """The grid of a box halved, again and again, where ``near`` says so of its edges' middles.

    Halving the cubes' diagonals, their faces' and their edges in turn gives eight tetrahedra like the first
    (Maubach 1995, SIAM J Sci Comput 16, 210-227); beside them the order of edges keeps it conforming.
    """
    edge = grid.spacing
    while edge > spacing:
        for length in edge * np.sqrt([3.0, 2.0, 1.0]):
            ends = np.sort(grid.tets[:, TET10_EDGES].reshape(-1, 2), axis=1)
            a, b = np.moveaxis(grid.points[ends], 1, 0)
            ends = _select_unique_edges(ends[np.linalg.norm(b - a, axis=1) > 0.95 * length], len(grid.points))
            edges = ends[near(grid.points[ends].mean(axis=1))]
            grid = _divide_edges(grid, edges, np.full(len(edges), 0.5), 0)
        edge /= 2
    return grid


def compute_volumes(points: Array, tets: Indices) -> Array:
    """Signed volumes (m,) of tetrahedra."""
    a, b, c, d = (points[tets[:, i]] for i in range(4))
    return np.einsum("ij,ij->i", np.cross(b - a, c - a), d - a) / 6.0


def cut(
    grid: TetGrid, field: Field, bit: int, slack: float = 0.0, region: int | None = None
) -> tuple[TetGrid, Mask]:
    """Cut a grid along ``field = 0``; also say which of its tetrahedra lie where the field is positive.

    Parameters
    ----------
    field : signed function of points (k, 3) that gives values (k,) and gradients (k, 3).
    bit : mask bit that the points on the level set receive.
    slack : as for :func:`compute_in_band`.
    region : of the tetrahedra that are cut; others are divided where they share an edge. None: all.
    """
    values = compute_in_band(field, grid.points, LONGEST_EDGE * grid.spacing, grid.spacing, slack)
    chosen = grid.tets if region is None else grid.tets[grid.regions == region]
    ends = np.sort(chosen[:, TET10_EDGES].reshape(-1, 2), axis=1)
    edges = _select_unique_edges(ends[values[ends[:, 0]] * values[ends[:, 1]] < 0], len(values))
    t = _find_roots(grid.points, edges, values, field)
    grid, snapped = _snap_vertices(grid, edges, t, bit)
    values = np.where(snapped, 0.0, values)
    crossed = ~snapped[edges].any(axis=1)
    edges, t = edges[crossed], t[crossed]
    on_level = np.isin(np.arange(len(values)), chosen) & (values == 0)
    grid = _divide_edges(replace(grid, mask=np.where(on_level, grid.mask | bit, grid.mask)), edges, t, bit)
    values = np.concatenate([values, np.zeros(len(edges))])
    return grid, values[grid.tets].sum(axis=1) > 0


def _divide_edges(grid: TetGrid, edges: Indices, t: Array, bit: int) -> TetGrid:
    """The grid with edges (k, 2), sorted, divided at ``t`` (k,); the fresh points receive a mask bit too."""
    a, b = edges.T
    fresh = grid.points[a] + t[:, None] * (grid.points[b] - grid.points[a])
    tets, parent = _bisect_tetrahedra(grid.tets, edges, len(grid.points))
    mask = np.concatenate([grid.mask, (grid.mask[a] & grid.mask[b]) | bit])
    return TetGrid(np.vstack([grid.points, fresh]), tets, mask, grid.spacing, grid.regions[parent])


def compute_in_band(field: Field, points: Array, band: float, spacing: float, slack: float = 0.0) -> Array:
    """Values (n,) of a distance-like field: exact up to ``band``, elsewhere of the right sign and beyond it.

    A field that changes by at most ``slack`` more than 1 per mm cannot come back into the band within a cell
    whose centre is farther from it than that and half the cell's diagonal; such cells of points are settled
    by one value.
    """
    values = np.zeros(len(points))
    open_ = np.arange(len(points))  # indices that are not settled yet
    for cell in [spacing * factor for factor in CELL_FACTORS]:
        index = np.floor(points[open_] / cell).astype(np.int64)
        keys = (index + CELL_OFFSET) @ [CELL_RANGE**2, CELL_RANGE, 1]
        _, first, inverse = np.unique(keys, return_index=True, return_inverse=True)
        centres = np.asarray((index[first] + 0.5) * cell, dtype=np.float64)
        values[open_] = field(centres)[0][inverse]
        open_ = open_[np.abs(values[open_]) <= band + slack + np.sqrt(0.75) * cell]
    values[open_] = field(points[open_])[0]
    return values


def _select_unique_edges(edges: Indices, count: int) -> Indices:
    """Each of some edges (k, 2) between ``count`` points once, sorted."""
    keys = np.unique(edges[:, 0] * count + edges[:, 1])
    return np.stack(np.divmod(keys, max(count, 1)), axis=1)


def _find_roots(points: Array, edges: Indices, values: Array, field: Field) -> Array:
    """Where (k,) the field is zero on each edge, from 0 at its first node to 1; regula falsi (Illinois)."""
    a, b = points[edges[:, 0]], points[edges[:, 1]]
    low, high = np.zeros(len(edges)), np.ones(len(edges))
    f_low, f_high = values[edges[:, 0]], values[edges[:, 1]]
    last = np.zeros(len(edges))
    for _ in range(ROOT_STEPS):
        t = low + (high - low) * f_low / (f_low - f_high)
        f, _ = field(a + t[:, None] * (b - a))
        side = np.where(f * f_low > 0, 1, -1)
        repeated = np.where(side == last, 0.5, 1.0)
        low, high = np.where(side > 0, t, low), np.where(side > 0, high, t)
        f_low = np.where(side > 0, f, f_low * repeated)
        f_high = np.where(side > 0, f_high * repeated, f)
        last = side
    return low + (high - low) * f_low / (f_low - f_high)


def _snap_vertices(grid: TetGrid, edges: Indices, t: Array, bit: int) -> tuple[TetGrid, Mask]:
    """Move vertices that almost touch the level set onto it, along edges that keep them on their surfaces."""
    near, far = np.vstack([edges, edges[:, ::-1]]).T
    t = np.concatenate([t, 1.0 - t])
    free = (grid.mask[near] & ~grid.mask[far]) == 0
    chosen = np.flatnonzero((t < SNAP_FRACTION) & free)
    chosen = chosen[np.argsort(-t[chosen])]  # the nearest crossing of a vertex is written last
    near, far, t = near[chosen], far[chosen], t[chosen]
    target = grid.points.copy()
    target[near] = grid.points[near] + t[:, None] * (grid.points[far] - grid.points[near])
    moved = np.zeros(len(grid.points), dtype=bool)
    moved[near] = True
    moved = _select_sound_moves(grid, target, moved)
    return replace(grid, points=np.where(moved[:, None], target, grid.points)), moved


def _select_sound_moves(grid: TetGrid, target: Array, moved: Mask) -> Mask:
    """The moves that can be made together without flattening a tetrahedron."""
    before = compute_volumes(grid.points, grid.tets)
    floor = np.minimum(SMALLEST_VOLUME * before.max(), 0.2 * before)
    moved = moved.copy()
    while moved.any():
        points = np.where(moved[:, None], target, grid.points)
        bad = compute_volumes(points, grid.tets) < floor
        undo = moved & np.isin(np.arange(len(moved)), grid.tets[bad])
        if not undo.any():
            break
        moved[undo] = False
    return moved


def _bisect_tetrahedra(tets: Indices, edges: Indices, offset: int) -> tuple[Indices, Indices]:
    """Bisect tetrahedra at their crossed ``edges``, the first in order first; edge i gets node offset + i.

    Also the number of the tetrahedron that each came from.
    """
    done, origin = [np.zeros((0, 4), dtype=np.int64)], [np.zeros(0, dtype=np.int64)]
    parent = np.arange(len(tets))
    while len(tets):
        first = _find_first_crossed(tets, edges, offset)
        whole = first == len(edges)
        done.append(tets[whole])
        origin.append(parent[whole])
        tets, first, parent = tets[~whole], first[~whole], np.tile(parent[~whole], 2)
        a, b = edges[first].T[:, :, None]
        middle = offset + first[:, None]
        tets = np.vstack([np.where(tets == b, middle, tets), np.where(tets == a, middle, tets)])
    return np.vstack(done), np.concatenate(origin)


def _find_first_crossed(tets: Indices, edges: Indices, offset: int) -> Indices:
    """Index (m,) of the first crossed edge of each tetrahedron; ``len(edges)`` where there is none."""
    if not len(edges):
        return np.zeros(len(tets), dtype=np.int64)
    ends = np.sort(tets[:, TET10_EDGES], axis=2)
    keys = edges[:, 0] * offset + edges[:, 1]
    # New nodes are on the level.
    key = np.where(ends[..., 1] < offset, ends[..., 0] * offset + ends[..., 1], -1)
    place = np.minimum(np.searchsorted(keys, key), len(keys) - 1)
    return np.where(keys[place] == key, place, len(edges)).min(axis=1)


def project_to_level(field: Field, points: Array, z_freedom: Array) -> Array:
    """Points (n, 3) moved to ``field = 0`` along its gradient with the z component weighted.

    ``z_freedom`` (n,) is 1 for free points and 0 for those that must keep their z (on the cut plane).
    """
    points = points.copy()
    for _ in range(NEWTON_STEPS):
        value, slope = field(points)
        way = slope * np.column_stack([np.ones((len(points), 2)), z_freedom])
        rate = np.maximum(np.einsum("ij,ij->i", slope, way), 0.05)  # a kink must not send a point away
        points -= (value / rate)[:, None] * way
    return points


def project_safely(points: Array, target: Array, tets: Indices, floor_deg: float) -> Array:
    """Points moved towards ``target`` as far as no dihedral angle falls below the floor or sinks under it."""
    share = np.ones(len(points))
    before = np.minimum(compute_dihedral_angles(points, tets).min(axis=1), floor_deg)
    for attempt in range(BISECTIONS + 1):
        moved = points + share[:, None] * (target - points)
        sound = compute_volumes(moved, tets) > 0
        after = np.where(sound, compute_dihedral_angles(moved, tets).min(axis=1), -1.0)
        bad = np.unique(tets[after < before - 1e-6])
        if not len(bad):
            return moved
        share[bad] = share[bad] / 2 if attempt < BISECTIONS - 1 else 0.0
    return points
