"""A rigid surface that is met from one side, smooth whatever its triangles are, and that may grow: a socket.

Its distance is a tricubic B-spline on a grid around it.  Near the wall the distance is sampled at the nodes
of the grid; the coefficients of the spline are made of a node's sample and those of its neighbours
(quasi-interpolation, exact for cubic polynomials; de Boor and Fix 1973).  Value, gradient and hessian are
continuous, whatever the facets are.  A surface with a ``clear`` shape has two splines, and between them the
blend ``(1 - s) d_clear + s d_final`` at the growth ``s``.  The gradient of a blend is as long as ``sqrt(1 - s
(1 - s) |n_clear - n_final|^2)``: 0.992 half-way where the two walls are at 15 degrees to each other.  A gap
on the way is the distance to that share, a penetration and its pressure likewise; at the end of growth it is
the distance.

Past its brim the wall goes on along its tangent, so that the distance is smooth there, too, and fades: how
far beyond the brim a place is makes a second spline, and the gap is multiplied by a weight that falls from
one to nothing over ``fade`` mm, with two continuous derivatives.  Points beyond, and points farther away than
the reach, are free.
"""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass, field
from typing import Self

import numpy as np
from numba import njit
from numpy.typing import NDArray

from ...arrays import Array, Indices, Mask
from ...errors import ProblemError
from ...shapes.triangles import (
    Tree,
    build_tree,
    closest_point,
    compute_normal_spread,
    compute_triangle_normals,
    feature_normal,
    find_neighbours,
)
from .rigid import Wall, check_open_surface, compute_features


@dataclass(frozen=True, eq=False)
class SmoothSurface(Wall):
    """A smooth surface as a rigid body; see the module docstring.  It is made by `of`.

    Parameters
    ----------
    points, faces, centre, axis, edge : as in `Wall`; the final shape.
    clear : (n, 3) mm, the points of the shape that it grows from; None: it does not grow.
    start, end : (2, x, y, z) coefficients of the splines of the clear and of the final shape.
    grid : their nodes.
    reach : distance from which the surface is not felt, mm.
    fade : how far past the brim it ends, mm.
    growth : 0: the clear shape, 1: the final one.
    """

    clear: Array | None = field(kw_only=True)
    start: Array = field(kw_only=True)
    end: Array = field(kw_only=True)
    grid: DistanceGrid = field(kw_only=True)
    reach: float = field(kw_only=True)
    fade: float = field(kw_only=True)
    growth: float = 1.0

    @classmethod
    def of(
        cls, points: Array, faces: NDArray, clear: Array | None = None, *, spacing: float = 2.0,
        reach: float = 10.0, fade: float | None = None, centre: Sequence[float] | Array = (0.0, 0.0, 0.0),
        axis: Sequence[float] | Array = (0.0, 0.0, 1.0), edge: Sequence[float] | Array = (1.0, 0.0, 0.0),
    ) -> SmoothSurface:  # fmt: skip
        """The surface of triangles.

        Raises `ProblemError` where it is no triangle surface, its triangles do not agree on a side, or the
        shapes do not match.

        Parameters
        ----------
        points : (n, 3) mm, in the body's frame.
        faces : (m, 3) corners, counter-clockwise seen from the tissue.
        clear : (n, 3) the points before it grows, mm; the same faces join them.
        spacing : of the grid, mm.  Details smaller than it are smoothed away: of facets that meet at an angle
            ``a`` (rad) at most ``spacing a / 8``.
        reach : distance from which the surface is not felt, mm; added to it is what it grows by.
        fade : how far past the brim the wall ends, mm; two spacings where not given.
        """
        final, triangles = check_open_surface(points, faces, "the smooth surface")
        if not (spacing > 0.0 and reach > 0.0):
            raise ProblemError("the spacing and the reach of a smooth surface are not positive")
        both = used = final[np.unique(triangles)]
        if clear is not None:
            clear = np.asarray(clear, dtype=float)
            if clear.shape != final.shape:
                raise ProblemError(f"the clear shape has points {clear.shape}, the final one {final.shape}")
            check_open_surface(clear, triangles, "the clear shape")
            both = np.concatenate([used, clear[np.unique(triangles)]])
            reach += float(np.linalg.norm(clear - final, axis=1)[np.unique(triangles)].max())
        grid = DistanceGrid.enclose(both, reach, spacing)
        end = fit_spline_coefficients(grid, final, triangles, reach)
        start = end if clear is None else fit_spline_coefficients(grid, clear, triangles, reach)
        fade = 2.0 * spacing if fade is None else fade
        return cls(
            final, triangles, centre, axis, edge, clear=clear, start=start, end=end, grid=grid, reach=reach,
            fade=fade,
        )  # fmt: skip

    @property
    def grows(self) -> bool:
        return self.clear is not None

    def grown(self, share: float) -> Self:
        other = copy(self)
        other.__dict__["growth"] = share
        return other

    def find_near(self, points: Array) -> Mask:
        place = (points - self.grid.low) / self.grid.spacing
        return np.asarray(((place >= 1.0) & (place < np.array(self.grid.shape) - 2.0)).all(axis=1))

    def _distances(self, x: Array) -> tuple[Array, Array, Array]:
        return smooth_distances(
            x, self.start, self.end, self.growth, self.grid.low, self.grid.spacing, self.reach, self.fade
        )


@njit(cache=True)
def smooth_distances(x, start, end, growth, low, spacing, reach, fade):  # type: ignore[no-untyped-def]
    """Gaps (n,) of points (n, 3) with their gradients (n, 3) and hessians (n, 3, 3)."""
    n = len(x)
    values, slopes, bends = np.empty(n), np.zeros((n, 3)), np.zeros((n, 3, 3))
    slope, bend = np.empty(3), np.empty((3, 3))
    for p in range(n):
        values[p] = np.inf
        gap = spline(start[0], end[0], growth, low, spacing, x[p], slopes[p], bends[p])
        beyond = spline(start[1], end[1], growth, low, spacing, x[p], slope, bend)
        if not (abs(gap) <= reach and beyond < fade):
            slopes[p], bends[p] = 0.0, 0.0
            continue
        values[p] = gap
        if beyond <= 0.0:
            continue
        t = beyond / fade
        w = 1.0 - t * t * t * (10.0 - 15.0 * t + 6.0 * t * t)
        w1 = -30.0 * t * t * (1.0 - t) * (1.0 - t) / fade
        w2 = -60.0 * t * (1.0 - t) * (1.0 - 2.0 * t) / (fade * fade)
        for i in range(3):
            for j in range(3):
                mixed = slopes[p, i] * slope[j] + slopes[p, j] * slope[i]
                own = w2 * slope[i] * slope[j] + w1 * bend[i, j]
                bends[p, i, j] = w * bends[p, i, j] + w1 * mixed + gap * own
        for i in range(3):
            slopes[p, i] = w * slopes[p, i] + gap * w1 * slope[i]
        values[p] = w * gap
    return values, slopes, bends


# In grid spacings: how far the wall goes on past its brim, and how far behind the brim its distance is known;
# how often the directions in which it goes on are averaged along the brim.
PAST, BEHIND, AVERAGED = 6.0, 3.0, 5
MARGIN = 4  # nodes around the reach that a spline and its coefficients need


@dataclass(frozen=True)
class DistanceGrid:
    """Nodes at ``low (3,)`` + ``spacing`` (mm) times their indices below ``shape (3,)``."""

    low: Array
    spacing: float
    shape: tuple[int, int, int]

    @classmethod
    def enclose(cls, points: Array, reach: float, spacing: float) -> DistanceGrid:
        """A grid that holds all that is within ``reach`` mm of points (n, 3)."""
        pad = reach + MARGIN * spacing
        low, high = points.min(axis=0) - pad, points.max(axis=0) + pad
        x, y, z = (np.ceil((high - low) / spacing).astype(int) + 1).tolist()
        return cls(low, spacing, (x, y, z))


def fit_spline_coefficients(grid: DistanceGrid, points: Array, faces: Indices, reach: float) -> Array:
    """(2, x, y, z) of the distance from the wall, positive on the side from which its triangles run
    counter-clockwise, and of the way beyond its brim, mm.

    Not a number where a spline would need samples farther away than the reach.
    """
    whole, all_faces = _extend_past_brim(points, faces, PAST * grid.spacing)
    corners, normals, edges, sums = compute_features(whole, all_faces)
    own, past = np.arange(len(faces)), np.arange(len(faces), len(all_faces))
    trees: tuple[Tree, Tree, Tree] = (
        build_tree(corners, np.arange(len(corners))),
        build_tree(corners, own),
        build_tree(corners, past if len(past) else own),
    )
    out = np.full((2, *grid.shape), np.nan)
    facets = corners, normals, edges, sums, trees
    _sample(facets, len(faces), len(past) > 0, grid.low, grid.spacing, reach + MARGIN * grid.spacing, out)
    for axis in (1, 2, 3):
        inner = np.moveaxis(out, axis, 0)
        bend = np.full_like(inner, np.nan)
        bend[1:-1] = inner[:-2] - 2.0 * inner[1:-1] + inner[2:]
        inner -= bend / 6.0
    return out


def _extend_past_brim(points: Array, faces: Indices, by: float) -> tuple[Array, Indices]:
    """The surface with a strip of ``by`` mm past its brim; the strip's faces are the last ones."""
    ahead = np.roll(faces, -1, axis=1)
    brim = find_neighbours(faces) < 0
    if not brim.any():
        return points, faces
    a, b = faces[brim], ahead[brim]
    normals = compute_triangle_normals(points[faces])[0]
    spread = compute_normal_spread(points, faces, normals)[1]
    outward = np.cross(points[b] - points[a], normals[np.nonzero(brim)[0]])
    outward /= np.linalg.norm(outward, axis=1)[:, None]
    used, places = np.unique(np.concatenate([a, b]), return_inverse=True)
    a_at, b_at = places[: len(a)], places[len(a) :]

    def gather_edges(of_edges: Array) -> Array:
        out = np.zeros((len(used), 3))
        np.add.at(out, a_at, of_edges)
        np.add.at(out, b_at, of_edges)
        return out

    upright = spread[used] / np.linalg.norm(spread[used], axis=1)[:, None]
    way = gather_edges(outward)
    for _ in range(AVERAGED):
        way -= np.einsum("ni,ni->n", way, upright)[:, None] * upright
        way /= np.linalg.norm(way, axis=1)[:, None]
        way = gather_edges(way[a_at] + way[b_at])
    way -= np.einsum("ni,ni->n", way, upright)[:, None] * upright
    way /= np.linalg.norm(way, axis=1)[:, None]
    a_past, b_past = len(points) + a_at, len(points) + b_at
    strip = np.concatenate([np.column_stack([b, a, a_past]), np.column_stack([b, a_past, b_past])])
    return np.concatenate([points, points[used] + by * way]), np.concatenate([faces, strip])


@njit(cache=True)
def _sample(facets, own, brim, low, spacing, reach, out):  # type: ignore[no-untyped-def]
    """Fill ``out (2, x, y, z)`` at nodes within ``reach`` of the wall; a face from ``own`` on is past it."""
    corners, normals, edge_normals, corner_normals, trees = facets
    whole, inside, past = trees
    x, point, other, outward = np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    behind = BEHIND * spacing
    for i in range(out.shape[1]):
        for j in range(out.shape[2]):
            last = np.inf
            for k in range(out.shape[3]):
                x[0], x[1], x[2] = low[0] + i * spacing, low[1] + j * spacing, low[2] + k * spacing
                # No node is farther from the wall than the one before it by more than a spacing.
                near = min(reach, last + 1.001 * spacing)
                face, feature, squared = closest_point(corners, whole, x, point, near * near)
                last = np.inf
                if face < 0:
                    continue
                last = np.sqrt(squared)
                feature_normal(normals, edge_normals, corner_normals, face, feature, outward)
                side = 0.0
                for c in range(3):
                    side += (x[c] - point[c]) * outward[c]
                out[0, i, j, k] = last if side >= 0.0 else -last
                out[1, i, j, k] = -behind
                if not brim:
                    continue
                if face >= own:
                    found = closest_point(corners, inside, point, other)
                    out[1, i, j, k] = np.sqrt(found[2])
                else:
                    found = closest_point(corners, past, point, other, behind * behind)
                    out[1, i, j, k] = -np.sqrt(found[2])


@njit(cache=True)
def _weights(t, out):  # type: ignore[no-untyped-def]
    """Fill ``out (3, 4)`` with the cubic B-splines at ``t`` in a cell, and their two derivatives."""
    s = 1.0 - t
    out[0, 0], out[0, 3] = s * s * s / 6.0, t * t * t / 6.0
    out[0, 1] = (4.0 - 6.0 * t * t + 3.0 * t * t * t) / 6.0
    out[0, 2] = (4.0 - 6.0 * s * s + 3.0 * s * s * s) / 6.0
    out[1, 0], out[1, 3] = -0.5 * s * s, 0.5 * t * t
    out[1, 1], out[1, 2] = 1.5 * t * t - 2.0 * t, 2.0 * s - 1.5 * s * s
    out[2, 0], out[2, 1], out[2, 2], out[2, 3] = s, 3.0 * t - 2.0, 3.0 * s - 2.0, t


@njit(cache=True)
def spline(start, end, share, low, spacing, x, gradient, hessian):  # type: ignore[no-untyped-def]
    """Value at ``x (3,)`` of the spline of coefficients ``start`` (x, y, z), blended into ``end``;
    fills its gradient (3,) and hessian (3, 3).  Not a number outside of the grid."""
    at, w = np.empty(3, dtype=np.int64), np.empty((3, 3, 4))
    gradient[:], hessian[:, :] = 0.0, 0.0
    for d in range(3):
        place = (x[d] - low[d]) / spacing
        at[d] = int(np.floor(place)) - 1
        if not (at[d] >= 0 and at[d] + 3 < start.shape[d]):
            return np.nan
        _weights(place - at[d] - 1, w[d])
    value = gx = gy = gz = xx = yy = zz = xy = yz = zx = 0.0
    for i in range(4):
        v = v_y = v_z = v_yy = v_zz = v_yz = 0.0
        for j in range(4):
            a = a_z = a_zz = 0.0
            for k in range(4):
                c = start[at[0] + i, at[1] + j, at[2] + k]
                c += share * (end[at[0] + i, at[1] + j, at[2] + k] - c)
                a += w[2, 0, k] * c
                a_z += w[2, 1, k] * c
                a_zz += w[2, 2, k] * c
            v += w[1, 0, j] * a
            v_y += w[1, 1, j] * a
            v_yy += w[1, 2, j] * a
            v_z += w[1, 0, j] * a_z
            v_yz += w[1, 1, j] * a_z
            v_zz += w[1, 0, j] * a_zz
        value += w[0, 0, i] * v
        gx += w[0, 1, i] * v
        xx += w[0, 2, i] * v
        gy += w[0, 0, i] * v_y
        xy += w[0, 1, i] * v_y
        yy += w[0, 0, i] * v_yy
        gz += w[0, 0, i] * v_z
        zx += w[0, 1, i] * v_z
        yz += w[0, 0, i] * v_yz
        zz += w[0, 0, i] * v_zz
    n, m = 1.0 / spacing, 1.0 / (spacing * spacing)
    gradient[0], gradient[1], gradient[2] = gx * n, gy * n, gz * n
    hessian[0, 0], hessian[1, 1], hessian[2, 2] = xx * m, yy * m, zz * m
    hessian[0, 1], hessian[1, 2], hessian[2, 0] = xy * m, yz * m, zx * m
    hessian[1, 0], hessian[2, 1], hessian[0, 2] = xy * m, yz * m, zx * m
    return value
