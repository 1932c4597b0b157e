"""Triangle surfaces for contact: normals, neighbours, and the closest point by a tree of bounding boxes.

A tree is three flat arrays, for compiled code: ``boxes (k, 6)`` (lower and upper corner), ``links (k, 2)``
(the two halves of an inner box, or ``-1 - start`` and ``stop`` of a leaf) and ``order (m,)`` (the faces, leaf
by leaf).
"""

import numpy as np
from numba import njit
from numpy.typing import NDArray

from ..arrays import Array, Indices
from ..errors import ProblemError

Tree = tuple[Array, Indices, Indices]
LEAF_SIZE = 4
INSIDE = 0  # features of a triangle: 0 its inside, 1 + i the edge from corner i, 4 + i corner i


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
def _on_triangle(a, b, c, x, point):  # type: ignore[no-untyped-def]
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
            kind = _on_triangle(corners[f, 0], corners[f, 1], corners[f, 2], x, trial)
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
