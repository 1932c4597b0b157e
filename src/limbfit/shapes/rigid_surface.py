"""A closed triangle surface as a rigid indenter: checks, rounding, and its signed distance.

Like the other shapes it is taken as a smaller body grown by a rounding radius: the faces move inwards by
the radius and the distance from them, less the radius, is the distance from the body with rounded edges.
The flat faces stay where they are, and the gradient is continuous as deep as the radius.
"""

from dataclasses import dataclass, field

import numpy as np
from numba import njit

from ..arrays import Array, Indices
from ..errors import ProblemError
from .triangles import (
    INSIDE,
    Tree,
    build_tree,
    check_triangles,
    closest_point,
    compute_normal_spread,
    compute_triangle_normals,
    curvature,
    feature_normal,
    find_neighbours,
)

# Corners (m, 3, 3); unit normals (m, 3) of faces and (m, 3, 3) of their edges and corners; directions
# (m, 3, 3) of the straight edge that a corner lies on (zero: a true corner); trees over all and front faces.
Body = tuple[Array, Array, Array, Array, Array, Tree, Tree]

SMALLEST_MM, LARGEST_MM = 0.5, 500.0  # of an indenter's width: beyond, the file is not in mm
MIN_FRONT_COSINE = 0.1  # faces whose unit normal leans at least so much towards the tissue
PARALLEL = 1e-8  # squared sine below which normals or edges count as parallel
FLAT_SPREAD = 2.5e-3  # squared sine of a spread of normals that a moved corner need not follow


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
