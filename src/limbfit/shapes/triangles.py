"""Triangle surfaces for contact: normals, neighbours, and the closest point by a tree of bounding boxes.

A closed one is a rigid indenter: checks, rounding, and its signed distance. Like the other shapes it is taken
as a smaller body grown by a rounding radius: the faces move inwards by the radius and the distance from them,
less the radius, is the distance from the body with rounded edges. The flat faces stay where they are, and the
gradient is continuous as deep as the radius.

A tree is three flat arrays, for compiled code: ``boxes (k, 6)`` (lower and upper corner), ``links (k, 2)``
(the two halves of an inner box, or ``-1 - start`` and ``stop`` of a leaf) and ``order (m,)`` (the faces, leaf
by leaf).
"""

from dataclasses import dataclass, field

import numpy as np
from numba import njit
from numpy.typing import NDArray

from ..arrays import Array, Indices
from ..errors import ProblemError

Tree = tuple[Array, Indices, Indices]
LEAF_SIZE = 4
INSIDE = 0  # features of a triangle: 0 its inside, 1 + i the edge from corner i, 4 + i corner i
# Corners (m, 3, 3); unit normals (m, 3) of faces and (m, 3, 3) of their edges and corners; directions
# (m, 3, 3) of the straight edge that a corner lies on (zero: a true corner); trees over all and front faces.
Body = tuple[Array, Array, Array, Array, Array, Tree, Tree]

SMALLEST_MM, LARGEST_MM = 0.5, 500.0  # of an indenter's width: beyond, the file is not in mm
MIN_FRONT_COSINE = 0.1  # faces whose unit normal leans at least so much towards the tissue
PARALLEL = 1e-8  # squared sine below which normals or edges count as parallel
FLAT_SPREAD = 2.5e-3  # squared sine of a spread of normals that a moved corner need not follow


def check_triangles(points: Array, faces: NDArray, name: str) -> None:
    """Raise `ProblemError` where the arrays are no triangles of the surface ``name``."""
    if points.ndim != 2 or points.shape[1] != 3 or not np.isfinite(points).all():
        raise ProblemError(f"{name} has points that are not three finite numbers each")
    if faces.ndim != 2 or faces.shape[1] != 3 or not np.issubdtype(faces.dtype, np.integer):
        raise ProblemError(f"{name} is not made of triangles", remedy="triangulate it")
    if not len(faces) or faces.min() < 0 or faces.max() >= len(points):
        raise ProblemError(f"the faces of {name} refer to points that it does not have")


def compute_triangle_normals(corners: Array) -> tuple[Array, Array]:
    """Unit normals (m, 3), zero for degenerate triangles, and areas (m,)."""
    vectors = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = np.linalg.norm(vectors, axis=1)
    flat = length <= 1e-14 * length.max()
    return np.where(flat[:, None], 0.0, vectors / np.where(flat, 1.0, length)[:, None]), 0.5 * length


def compute_normal_spread(points: Array, faces: Indices, normals: Array) -> tuple[Array, Array]:
    """Sums over the faces at each point, weighted by angle, of ``n n^T (n, 3, 3)`` and ``n (n, 3)``."""
    corners = points[faces]
    ahead, back = (np.roll(corners, by, axis=1) - corners for by in (-1, 1))
    sine = np.linalg.norm(np.cross(ahead, back), axis=2)
    weights = np.arctan2(sine, np.einsum("mij,mij->mi", ahead, back))
    outer, sums = np.zeros((len(points), 3, 3)), np.zeros((len(points), 3))
    for corner in range(3):
        w = weights[:, corner, None] * normals
        np.add.at(outer, faces[:, corner], w[:, :, None] * normals[:, None, :])
        np.add.at(sums, faces[:, corner], w)
    return outer, sums


def find_neighbours(faces: Indices) -> Indices:
    """(m, 3): the triangle beyond each edge, from each corner to the next; -1 where there is none."""
    ahead = np.roll(faces, -1, axis=1)
    count = int(faces.max()) + 1
    there, back = (faces * count + ahead).ravel(), (ahead * count + faces).ravel()
    order = np.argsort(there)
    at = np.minimum(np.searchsorted(there[order], back), len(back) - 1)
    return np.where(there[order][at] == back, order[at] // 3, -1).reshape(faces.shape)


def build_tree(corners: Array, faces: Indices) -> Tree:
    """The tree over some ``faces`` of triangles ``corners (m, 3, 3)``, halved along the longest side."""
    low, high, centre = corners.min(axis=1), corners.max(axis=1), corners.mean(axis=1)
    order = np.array(faces, dtype=np.int64)
    boxes: list[Array] = []
    links: list[list[int]] = []
    waiting = [(0, len(order), -1, 0)]
    while waiting:
        start, stop, parent, side = waiting.pop()
        if parent >= 0:
            links[parent][side] = len(boxes)
        of = order[start:stop]
        box = np.concatenate([low[of].min(axis=0), high[of].max(axis=0)])
        boxes.append(box)
        if stop - start <= LEAF_SIZE:
            links.append([-1 - start, stop])
            continue
        middle = (stop - start) // 2
        longest = int(np.argmax(np.ptp(centre[of], axis=0)))
        order[start:stop] = of[np.argpartition(centre[of, longest], middle)]
        links.append([0, 0])
        here = len(links) - 1
        waiting += [(start, start + middle, here, 0), (start + middle, stop, here, 1)]
    return np.array(boxes), np.array(links, dtype=np.int64), order


@njit(cache=True)
def _box_distance(box, x):  # type: ignore[no-untyped-def]
    """Squared distance of ``x`` from a box, 0 inside."""
    total = 0.0
    for i in range(3):
        d = max(box[i] - x[i], x[i] - box[3 + i], 0.0)
        total += d * d
    return total


@njit(cache=True)
def _find_on_triangle(a, b, c, x, point):  # type: ignore[no-untyped-def]
    """Fill ``point`` with the closest point of a triangle and return its feature (Ericson 2005, 5.1.5)."""
    d1 = d2 = d3 = d4 = d5 = d6 = 0.0
    for i in range(3):
        ab, ac = b[i] - a[i], c[i] - a[i]
        d1 += ab * (x[i] - a[i])
        d2 += ac * (x[i] - a[i])
        d3 += ab * (x[i] - b[i])
        d4 += ac * (x[i] - b[i])
        d5 += ab * (x[i] - c[i])
        d6 += ac * (x[i] - c[i])
    va, vb, vc = d3 * d6 - d5 * d4, d5 * d2 - d1 * d6, d1 * d4 - d3 * d2
    v = w = 0.0
    if d1 <= 0.0 and d2 <= 0.0:
        feature = 4
    elif d3 >= 0.0 and d4 <= d3:
        feature, v = 5, 1.0
    elif d6 >= 0.0 and d5 <= d6:
        feature, w = 6, 1.0
    elif vc <= 0.0 and d1 >= 0.0 and d3 <= 0.0:
        feature, v = 1, d1 / (d1 - d3)
    elif vb <= 0.0 and d2 >= 0.0 and d6 <= 0.0:
        feature, w = 3, d2 / (d2 - d6)
    elif va <= 0.0 and d4 - d3 >= 0.0 and d5 - d6 >= 0.0:
        w = (d4 - d3) / ((d4 - d3) + (d5 - d6))
        feature, v = 2, 1.0 - w
    else:
        feature, v, w = INSIDE, vb / (va + vb + vc), vc / (va + vb + vc)
    for i in range(3):
        point[i] = a[i] + v * (b[i] - a[i]) + w * (c[i] - a[i])
    return feature


@njit(cache=True)
def closest_point(corners, tree, x, point, within=np.inf):  # type: ignore[no-untyped-def]
    """Closest point to ``x`` on the triangles of a tree; returns face, feature and squared distance.

    The face is -1 where none is nearer than the squared distance ``within``.
    """
    boxes, links, order = tree
    stack, trial = np.empty(128, dtype=np.int64), np.empty(3)
    stack[0], depth = 0, 1
    best, face, feature = within, -1, 0
    while depth > 0:
        depth -= 1
        k = stack[depth]
        if _box_distance(boxes[k], x) >= best:
            continue
        if links[k, 0] >= 0:
            near, far = links[k, 0], links[k, 1]
            if _box_distance(boxes[far], x) < _box_distance(boxes[near], x):
                near, far = far, near
            stack[depth], stack[depth + 1] = far, near
            depth += 2
            continue
        for p in range(-1 - links[k, 0], links[k, 1]):
            f = order[p]
            kind = _find_on_triangle(corners[f, 0], corners[f, 1], corners[f, 2], x, trial)
            distance = 0.0
            for i in range(3):
                distance += (x[i] - trial[i]) ** 2
            if distance < best:
                best, face, feature = distance, f, kind
                point[:] = trial
    return face, feature, best


@njit(cache=True)
def feature_normal(normals, edge_normals, corner_normals, face, feature, out):  # type: ignore[no-untyped-def]
    """Fill ``out (3,)`` with the pseudo-normal of a feature, of any length."""
    if feature == INSIDE:
        out[:] = normals[face]
    elif feature < 4:
        out[:] = edge_normals[face, feature - 1]
    else:
        out[:] = corner_normals[face, feature - 4]


@njit(cache=True)
def curvature(corners, face, feature, axis, gradient, inverse, out):  # type: ignore[no-untyped-def]
    """Fill ``out (3, 3)`` with the hessian of the distance from an edge or a corner, at ``1 / inverse`` mm.

    ``axis (3,)``: direction of a straight edge that a corner lies on, zero for a true corner; of an edge it
    is filled.
    """
    if feature < 4:
        a, b = feature - 1, feature % 3
        length = 0.0
        for i in range(3):
            axis[i] = corners[face, b, i] - corners[face, a, i]
            length += axis[i] * axis[i]
        for i in range(3):
            axis[i] /= np.sqrt(length)
    for i in range(3):
        for j in range(3):
            identity = 1.0 if i == j else 0.0
            out[i, j] = inverse * (identity - gradient[i] * gradient[j] - axis[i] * axis[j])


@dataclass(frozen=True, eq=False)
class RigidSurface:
    """A closed surface in the indenter's frame: x and y across, z along the axis into the tissue; mm.

    It is moved along z until its foremost point lies at z = 0; the axis x = y = 0 must pass through it.

    Parameters
    ----------
    points : (n, 3) mm.
    faces : (m, 3) corners, all counter-clockwise seen from outside (or all from inside).

    Raises
    ------
    ProblemError
        Where it is no closed triangle surface, encloses nothing, is not in mm or lies beside its axis.
    """

    points: Array
    faces: Indices
    _rounded: dict[tuple[float, bool], tuple[float, Body]] = field(
        default_factory=dict, init=False, repr=False
    )

    def __post_init__(self) -> None:
        points, faces = np.asarray(self.points, dtype=float), np.asarray(self.faces)
        check_triangles(points, faces, "the indenter's surface")
        faces = faces.astype(np.int64)
        _check_closed(faces)
        points = points - [0.0, 0.0, points[faces, 2].max()]
        used = points[np.unique(faces)]
        _check_size(used)
        corners = points[faces] - used.mean(axis=0)
        volume = float(np.linalg.det(corners).sum()) / 6.0
        if abs(volume) < 1e-6 * np.ptp(used, axis=0).max() ** 3:
            raise ProblemError("the indenter's surface is flat: it encloses no volume")
        object.__setattr__(self, "points", points)
        object.__setattr__(self, "faces", faces if volume > 0 else np.ascontiguousarray(faces[:, ::-1]))

    @property
    def width(self) -> float:
        """Twice the largest distance from the axis along x or y, mm."""
        return 2.0 * float(np.abs(self.points[self.faces][..., :2]).max())

    def round_edges(self, radius: float, exact: bool) -> tuple[float, Body]:
        """The body whose edges are rounded by ``radius`` mm, as the kernels read it, and the radius.

        Where the surface has details that such a radius would swallow, it is halved; or refused, with
        ``exact``.
        """
        key = radius, exact
        if key not in self._rounded:
            trials = (radius / 2**k for k in range(1 if exact else 13))
            shrunk = ((trial, self._shrink(trial)) for trial in trials)
            sound = next(((trial, points) for trial, points in shrunk if points is not None), None)
            if sound is None:
                raise ProblemError(
                    f"the indenter's surface has details that cannot be rounded by {radius:g} mm",
                    remedy="give a smaller edge radius or a coarser surface",
                )
            self._rounded[key] = sound[0], _build_body(sound[1], self.faces)
        return self._rounded[key]

    def _shrink(self, radius: float) -> Array | None:
        """Points (n, 3) of the surface whose faces moved in by ``radius``; None where a face turns over."""
        normals, areas = compute_triangle_normals(self.points[self.faces])
        spread, along = compute_normal_spread(self.points, self.faces, normals)
        values, axes = np.linalg.eigh(spread)
        keep = values > FLAT_SPREAD * values[:, -1:]
        inverse = np.where(keep, 1.0 / np.where(keep, values, 1.0), 0.0)
        moved = self.points - radius * np.einsum("nij,nj,nkj,nk->ni", axes, inverse, axes, along)
        after, left = compute_triangle_normals(moved[self.faces])
        solid = areas > 1e-12 * areas.max()
        upright = (np.einsum("mi,mi->m", normals, after) > 0.5) & (left > 0.0)
        return moved if upright[solid].all() else None


def _check_closed(faces: Indices) -> None:
    """Every edge belongs to two faces, that run along it in opposite directions."""
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    count = int(faces.max()) + 1
    there, back = edges @ [count, 1], edges @ [1, count]
    _, times = np.unique(there, return_counts=True)
    single = ~np.isin(there, back)
    if (edges[:, 0] == edges[:, 1]).any():
        raise ProblemError("the indenter's surface has faces with a doubled corner", remedy="clean it")
    if single.any() or times.max() > 1:
        what = f"is open or not oriented: {int(single.sum())} edges have a face on one side only"
        if not single.any():
            what = "has edges with more than two faces"
        raise ProblemError(f"the indenter's surface {what}", remedy="export a closed solid")


def _check_size(points: Array) -> None:
    low, high = points.min(axis=0), points.max(axis=0)
    width = float((high - low)[:2].max())
    if not SMALLEST_MM <= width <= LARGEST_MM:
        raise ProblemError(f"the indenter's surface is {width:g} mm wide", remedy="give it in millimetres")
    if (low[:2] > 0).any() or (high[:2] < 0).any():
        raise ProblemError(
            "the indenter's surface lies beside its axis",
            remedy="give it in the indenter's frame: z along the axis, x = y = 0 in its middle",
        )


def _build_body(points: Array, faces: Indices) -> Body:
    """The arrays of the kernels; pseudo-normals after Baerentzen and Aanaes (2005)."""
    corners = np.ascontiguousarray(points[faces])
    normals, areas = compute_triangle_normals(corners)
    spread, sums = compute_normal_spread(points, faces, normals)
    values, axes = np.linalg.eigh(spread)
    on_edge = (values[:, 0] < PARALLEL * values[:, 2]) & (values[:, 1] > PARALLEL * values[:, 2])
    along = np.where(on_edge[:, None], axes[:, :, 0], 0.0)
    solid = np.flatnonzero(areas > 1e-12 * areas.max())
    facing = normals[solid, 2] > min(MIN_FRONT_COSINE, 0.5 * normals[solid, 2].max())
    trees = build_tree(corners, solid), build_tree(corners, solid[facing])
    edges = normals[:, None] + normals[find_neighbours(faces)]
    return corners, normals, edges, sums[faces], along[faces], *trees


@njit(cache=True)
def surface_distance(body, radius, x, gradient, hessian):  # type: ignore[no-untyped-def]
    """Distance of ``x (3,)`` from the rounded surface; fills its gradient (3,) and hessian (3, 3).

    Deeper than the rounding the way out is through the front faces, as for the other shapes.
    """
    corners, normals, edge_normals, corner_normals, along, tree, front = body
    point, axis, outward = np.empty(3), np.zeros(3), np.empty(3)
    face, feature, squared = closest_point(corners, tree, x, point)
    feature_normal(normals, edge_normals, corner_normals, face, feature, outward)
    side = 0.0
    for i in range(3):
        side += (x[i] - point[i]) * outward[i]
    sign = 1.0
    if side < 0.0:
        sign = -1.0
        face, feature, squared = closest_point(corners, front, x, point)
        feature_normal(normals, edge_normals, corner_normals, face, feature, outward)
    d = np.sqrt(squared)
    hessian[:, :] = 0.0
    if d <= 1e-9 * radius:
        length = np.sqrt(outward[0] ** 2 + outward[1] ** 2 + outward[2] ** 2)
        for i in range(3):
            gradient[i] = outward[i] / length
        return sign * d - radius
    away = 0.0
    for i in range(3):
        gradient[i] = sign * (x[i] - point[i]) / d
        away += (gradient[i] - normals[face, i]) ** 2
    if feature == INSIDE or away < 1e-12:
        return sign * d - radius
    if feature >= 4:
        axis[:] = along[face, feature - 4]
    curvature(corners, face, feature, axis, gradient, sign / d, hessian)
    return sign * d - radius
