"""Small limb-like bodies for benchmarks: structured grids of tetrahedra mapped onto curved shapes.

A body is a grid of boxes, six tetrahedra each, whose lines follow the bone below (level 0) and the skin above
(last level); the skin layer is the uppermost level.  Bones are voids: the nodes on them are held.
Lengths in mm; the limb's axis is z, its proximal end at the top.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from limbfit.mesh import TET10_EDGES, Mesh, boundary_faces, node_jacobians, to_tet10
from limbfit.mesh.cells import SIX_TETS

FINE_MM = 3.5  # longest interval under the indenter: what limbfit's mesher makes there by default
Array = NDArray[np.float64]
Indices = NDArray[np.int64]


@dataclass(frozen=True)
class Body:
    """A tet10 mesh with regions ``skin`` and ``muscle`` and face set ``skin``; ``bone (n,)`` are the nodes on
    bones, ``held (n,)`` those and the proximal cut; ``site (3,)`` lies on the skin, ``inward (3,)`` is its
    unit normal into the body."""

    mesh: Mesh
    bone: Indices
    held: Indices
    site: Array
    inward: Array


@dataclass(frozen=True)
class Grid:
    """Corner points (a, b, levels, 3) of a structured grid; ``ring``: the first direction closes on itself;
    ``capped``: the last line of the second direction is the proximal cut."""

    points: Array
    ring: bool = False
    capped: bool = False

    @property
    def numbers(self) -> Indices:
        """Node numbers (a, b, levels)."""
        return np.arange(self.points[..., 0].size).reshape(self.points.shape[:3])


def graded(inner: float, outer: float, near: int, far: int) -> Array:
    """Lines from -outer to outer: ``near`` even intervals within +-inner, ``far`` growing ones beyond."""
    rest = inner + (outer - inner) * (np.arange(1, far + 1) / far) ** 1.4
    return np.concatenate([-rest[::-1], np.linspace(-inner, inner, near + 1), rest])


def fine(inner: float) -> int:
    """Number of intervals within +-inner mm."""
    return int(np.ceil(2.0 * inner / FINE_MM))


def levels(bottom: Array, top: Array, layer: float, count: int) -> Array:
    """Heights (..., count + 2): muscle in ``count`` levels and one skin layer, at most half of the tissue."""
    interface = top - np.minimum(layer, 0.5 * (top - bottom))
    share = np.linspace(0.0, 1.0, count + 1)
    muscle = bottom[..., None] + (interface - bottom)[..., None] * share
    return np.concatenate([muscle, top[..., None]], axis=-1)


def slab(
    thickness: float, layer: float, inner: float, half: float, ridge: float, edge: float, count: int
) -> Body:
    """A block; its held bottom rises by ``ridge`` mm beyond x = ``edge``, over 8 mm; site (0, 0, 0)."""
    lines = graded(inner, half, fine(inner), 2)
    x, y = np.meshgrid(lines, lines, indexing="ij")
    rise = np.clip((x - edge) / 8.0 + 0.5, 0.0, 1.0)
    bottom = -thickness + ridge * rise**2 * (3.0 - 2.0 * rise)
    z = levels(bottom, np.zeros_like(x), layer, count)
    points = np.stack([np.broadcast_to(v[..., None], z.shape) for v in (x, y)] + [z], axis=-1)
    return _body(Grid(points), None, np.zeros(3), np.array([0.0, 0.0, -1.0]))


def limb(
    radius: float, bone: float, thin: float, taper: float, layer: float, angle: float, inner: float,
    count: int, second: tuple[float, float, float] | None = None,
) -> Body:  # fmt: skip
    """A tapered cylinder around an eccentric round bone of radius ``bone``; the distal end is rounded.

    Parameters
    ----------
    thin : tissue over the bone where it is thinnest (direction +x), mm.
    taper : how much the radius shrinks from the site to the distal end, as a share.
    angle : of the site around the bone, rad, counted from +x.
    inner : half width of the finely divided patch, mm.
    second : radius, distance from the first bone's axis (mm) and angle (rad) of a second bone.
    """
    offset = radius - bone - thin  # how far the skin's axis lies behind the bone's
    z = graded(inner, 2.2 * inner, fine(inner), 2)

    def skin(theta: Array, height: Array) -> Array:
        shrunk = radius * (1.0 - taper * np.clip(-height / z[-1], 0.0, 1.0) ** 2)
        centre = -offset * shrunk / radius
        return centre * np.cos(theta) + np.sqrt(shrunk**2 - (centre * np.sin(theta)) ** 2)

    reach = float(skin(np.array(angle), np.array(0.0)))
    near = min(inner / reach, 1.2)
    far = graded(near, np.pi, fine(near * reach), 4)[:-1]  # -pi and pi are the same line
    theta, height = np.meshgrid(angle + far, z, indexing="ij")
    outer = np.maximum(skin(theta, height), bone + 0.6 * thin)
    r = levels(np.full_like(outer, bone), outer, layer, count)
    theta, height = theta[..., None], np.broadcast_to(height[..., None], r.shape)
    points = np.stack([r * np.cos(theta), r * np.sin(theta), height], axis=-1)
    distance = None if second is None else _rod(*second)
    site = np.array([reach * np.cos(angle), reach * np.sin(angle), 0.0])
    return _body(Grid(points, ring=True, capped=True), distance, site, -_outward(skin, angle))


def _outward(skin: Callable[[Array, Array], Array], angle: float) -> Array:
    """Unit normal of the surface r = skin(theta, z) at (angle, 0)."""

    def at(theta: float, height: float) -> Array:
        r = float(skin(np.array(theta), np.array(height)))
        return np.array([r * np.cos(theta), r * np.sin(theta), height])

    h = 1e-4
    normal = np.cross(at(angle + h, 0.0) - at(angle - h, 0.0), at(angle, h) - at(angle, -h))
    return normal / np.linalg.norm(normal)


def _rod(radius: float, away: float, angle: float) -> Callable[[Array], Array]:
    """Signed distance to an endless cylinder along z."""
    centre = away * np.array([np.cos(angle), np.sin(angle)])
    return lambda points: np.linalg.norm(points[:, :2] - centre, axis=1) - radius


def _body(grid: Grid, hole: Callable[[Array], Array] | None, site: Array, inward: Array) -> Body:
    numbers, points = grid.numbers, grid.points.reshape(-1, 3).copy()
    boxes, level = _boxes(grid)
    cells = boxes[:, SIX_TETS].reshape(-1, 4)
    upside_down = np.linalg.det(points[cells[:, 1:]] - points[cells[:, :1]]) < 0
    cells[upside_down] = cells[upside_down][:, [0, 2, 1, 3]]
    regions = np.where(np.repeat(level, 6) == numbers.shape[2] - 2, 0, 1)
    bone, skin, proximal = (np.zeros(len(points), dtype=bool) for _ in range(3))
    bone[numbers[:, :, 0]] = skin[numbers[:, :, -1]] = True
    proximal[numbers[:, -1, :]] = grid.capped
    if hole is not None:
        points = _snapped(points, cells, hole, bone | skin)
        bone |= hole(points) <= 1e-6
        keep = ~bone[cells].all(axis=1)
        cells, regions = cells[keep], regions[keep]
    used, flat = np.unique(cells, return_inverse=True)
    bone, skin, proximal = bone[used], skin[used], proximal[used]
    linear = Mesh(points[used], flat.reshape(-1, 4), "tet4", regions.astype(np.int64), ("skin", "muscle"))
    faces = boundary_faces(linear)
    mesh = to_tet10(replace(linear, face_sets={"skin": faces[skin[faces].all(axis=1)]}))
    assert (node_jacobians(mesh) > 0).all(), "the grid is folded"
    return Body(mesh, _with_middles(mesh, bone), _with_middles(mesh, bone | proximal), site, inward)


def _boxes(grid: Grid) -> tuple[Indices, Indices]:
    """Corner nodes (m, 8) of the boxes, numbered 4 i + 2 j + k, and the level (m,) that each is in."""
    numbers = grid.numbers
    if grid.ring:
        numbers = np.concatenate([numbers, numbers[:1]])
    ends = (slice(None, -1), slice(1, None))
    corners = [numbers[i, j, k] for i in ends for j in ends for k in ends]
    level = np.broadcast_to(np.arange(numbers.shape[2] - 1), corners[0].shape)
    return np.stack([corner.ravel() for corner in corners], axis=1), level.ravel()


def _snapped(points: Array, cells: Indices, distance: Callable[[Array], Array], stay: NDArray) -> Array:
    """Points close to the surface ``distance`` = 0 moved onto it, where that inverts no cell."""
    pairs = cells[:, TET10_EDGES].reshape(-1, 2)
    shortest = np.full(len(points), np.inf)
    length = np.linalg.norm(points[pairs[:, 0]] - points[pairs[:, 1]], axis=1)
    for end in (0, 1):
        np.minimum.at(shortest, pairs[:, end], length)
    d, h = distance(points), 1e-5
    slope = np.stack([(distance(points + h * e) - d) / h for e in np.eye(3)], axis=1)
    move = (np.abs(d) < 0.4 * shortest) & ~stay
    while True:
        moved = points - np.where(move, d, 0.0)[:, None] * slope
        edges = moved[cells[:, 1:]] - moved[cells[:, :1]]
        thin = np.linalg.det(edges) < 0.05 * shortest[cells].min(axis=1) ** 3
        bad = np.intersect1d(cells[thin], np.flatnonzero(move))
        if not len(bad):
            return moved
        move[bad] = False


def _with_middles(mesh: Mesh, corners: NDArray) -> Indices:
    """Marked corner nodes and the mid-edge nodes between two of them, of a tet10 mesh."""
    marked = np.zeros(len(mesh.points), dtype=bool)
    marked[: len(corners)] = corners
    both = marked[mesh.cells[:, TET10_EDGES]].all(axis=2)
    marked[mesh.cells[:, 4:][both]] = True
    return np.flatnonzero(marked)
