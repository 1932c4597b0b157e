"""A rigid surface that is met from one side, smooth whatever its triangles are, and that may grow: a socket.

Its distance is a spline (`distance_grid`).  A surface with a ``clear`` shape has two, and between them the
blend ``(1 - s) d_clear + s d_final`` at the growth ``s``.  The gradient of a blend is as long as
``sqrt(1 - s (1 - s) |n_clear - n_final|^2)``: 0.992 half-way where the two walls are at 15 degrees to each
other.  A gap on the way is the distance to that share, a penetration and its pressure likewise; at the end
of growth it is the distance.

Past its brim the wall goes on along its tangent and fades: the gap is multiplied by a weight that falls from
one to nothing over ``fade`` mm, with two continuous derivatives.  Points beyond, and points farther away than
the reach, are free.
"""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from ...errors import ProblemError
from .distance_grid import DistanceGrid, fit_spline_coefficients, spline
from .wall import Wall, check_open_surface

Array = NDArray[np.float64]


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

    clear: Array | None = None
    start: Array | None = None
    end: Array | None = None
    grid: DistanceGrid | None = None
    reach: float = 10.0
    fade: float = 4.0
    growth: float = 1.0

    @classmethod
    def of(
        cls, points: Array, faces: NDArray, clear: Array | None = None, *, spacing: float = 2.0,
        reach: float = 10.0, fade: float | None = None, centre: Sequence[float] | Array = (0.0, 0.0, 0.0),
        axis: Sequence[float] | Array = (0.0, 0.0, 1.0), edge: Sequence[float] | Array = (1.0, 0.0, 0.0),
    ) -> SmoothSurface:  # fmt: skip
        """The surface of triangles.

        Parameters
        ----------
        points : (n, 3) mm, in the body's frame.
        faces : (m, 3) corners, counter-clockwise seen from the tissue.
        clear : (n, 3) the points before it grows, mm; the same faces join them.
        spacing : of the grid, mm.  Details smaller than it are smoothed away: of facets that meet at an angle
            ``a`` (rad) at most ``spacing a / 8``.
        reach : distance from which the surface is not felt, mm; added to it is what it grows by.
        fade : how far past the brim the wall ends, mm; two spacings where not given.

        Raises
        ------
        ProblemError
            Where it is no triangle surface, its triangles do not agree on a side, or the shapes do not match.
        """
        final, triangles = check_open_surface(points, faces, "the smooth surface")
        if not (spacing > 0.0 and reach > 0.0):
            raise ProblemError("the spacing and the reach of a smooth surface are not positive")
        start = None
        both = used = final[np.unique(triangles)]
        if clear is not None:
            clear = np.asarray(clear, dtype=float)
            if clear.shape != final.shape:
                raise ProblemError(f"the clear shape has points {clear.shape}, the final one {final.shape}")
            check_open_surface(clear, triangles, "the clear shape")
            both = np.concatenate([used, clear[np.unique(triangles)]])
            reach += float(np.linalg.norm(clear - final, axis=1)[np.unique(triangles)].max())
        grid = DistanceGrid.around(both, reach, spacing)
        end = fit_spline_coefficients(grid, final, triangles, reach)
        if clear is not None:
            start = fit_spline_coefficients(grid, clear, triangles, reach)
        fade = 2.0 * spacing if fade is None else fade
        return cls(final, triangles, centre, axis, edge, clear, start, end, grid, reach, fade)

    @property
    def grows(self) -> bool:
        return self.clear is not None

    def grown(self, share: float) -> SmoothSurface:
        """The surface as it is when it has grown so far."""
        other = copy(self)
        other.__dict__["growth"] = share
        return other

    def near(self, points: Array) -> NDArray[np.bool_]:
        """Which points (n, 3) of its frame it may touch."""
        assert self.grid is not None
        place = (points - self.grid.low) / self.grid.spacing
        return np.asarray(((place >= 1.0) & (place < np.array(self.grid.shape) - 2.0)).all(axis=1))

    def _distances(self, x: Array) -> tuple[Array, Array, Array]:
        assert self.grid is not None
        assert self.end is not None
        start = self.end if self.start is None else self.start
        return smooth_distances(
            x, start, self.end, self.growth, self.grid.low, self.grid.spacing, self.reach, self.fade
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
