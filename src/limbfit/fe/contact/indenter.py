"""Rigid indenters as signed distances with gradient and curvature.

The indenter's frame: origin at the middle of its foremost face (``centre``), coordinates ``(x, y, z)`` along
``edge``, ``axis x edge`` and ``axis``; the body lies at ``z <= 0``.  Square, sphere and cylinder have no far
end (a sphere is the end of a round rod); a triangle surface is the body that it encloses.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numba import njit
from numpy.typing import NDArray

from ...errors import ProblemError
from .rigid_surface import NO_BODY, Body, RigidSurface, surface_distance

SHAPES = {"square": 0, "sphere": 1, "cylinder": 2, "stl": 3}
Kernel = tuple[int, float, float, Body]
# No mesh resolves the singularity of a sharp edge; this rounding over the width stands for it.
SHARP_EDGE = 0.01


@dataclass(frozen=True)
class Indenter:
    """A rigid indenter that moves along ``axis``.

    Parameters
    ----------
    shape : ``square`` (prism), ``sphere``, ``cylinder`` (flat end) or ``stl`` (the ``surface``).
    width : edge length or diameter, mm, rounding included; with a surface it is measured.
    edge_radius : rounding of the edges, mm.  Less than 1 % of the width (also 0, a sharp edge) is taken as
        1 % of the width, with a surface as much of it as its details allow; a sphere has none.
    centre : (3,) the middle of the foremost face, mm.
    axis : (3,) into the tissue; any length.
    edge : (3,) direction of one edge of the square; by default the cross product of ``axis`` and z.
    surface : triangles in the indenter's frame, for ``stl`` only.
    sharp : the rounding over the width that stands for a sharp edge, where 1 % is too coarse for the tissue.
    """

    shape: str = "square"
    width: float = 20.0
    edge_radius: float = 0.0
    centre: Sequence[float] | NDArray[np.float64] = (0.0, 0.0, 0.0)
    axis: Sequence[float] | NDArray[np.float64] = (0.0, 0.0, -1.0)
    edge: Sequence[float] | NDArray[np.float64] | None = None
    surface: RigidSurface | None = None
    sharp: float = SHARP_EDGE

    def __post_init__(self) -> None:
        if self.shape not in SHAPES:
            raise ProblemError(f"unknown indenter shape {self.shape!r}; use one of {sorted(SHAPES)}")
        if (self.surface is not None) != (self.shape == "stl"):
            raise ProblemError("an indenter of shape 'stl' needs a surface, and only such a one has it")
        if self.surface is not None:
            object.__setattr__(self, "width", self.surface.width)
        if not (math.isfinite(self.width) and self.width > 0):
            raise ProblemError(f"indenter width {self.width} mm is not positive")
        if not 0 < self.sharp <= SHARP_EDGE:
            raise ProblemError(
                f"a sharp edge of {self.sharp} of the width is not above 0 and up to {SHARP_EDGE}"
            )
        if not 0 <= self.edge_radius <= self.width / 2:
            raise ProblemError(f"edge radius {self.edge_radius} mm does not fit a width of {self.width} mm")
        if self.surface is not None:
            self.surface.rounded(*self._rounding)  # refuses a radius that does not fit
        for name in ("centre", "axis"):
            value = np.asarray(getattr(self, name), dtype=float)
            if value.shape != (3,) or not np.isfinite(value).all():
                raise ProblemError(f"indenter {name} is not three finite numbers")
        if np.linalg.norm(self.axis) < 1e-12:
            raise ProblemError("indenter axis has no length")
        if np.linalg.norm(np.cross(self.axis, self._edge_guess())) < 1e-9:
            raise ProblemError("indenter edge is parallel to its axis")

    def _edge_guess(self) -> NDArray[np.float64]:
        if self.edge is not None:
            return np.asarray(self.edge, dtype=float)
        axis = np.asarray(self.axis, dtype=float)
        guess = np.cross(axis, [0.0, 0.0, 1.0])
        small = np.linalg.norm(guess) < 1e-6 * np.linalg.norm(axis)
        return np.array([1.0, 0.0, 0.0]) if small else guess

    @property
    def frame(self) -> NDArray[np.float64]:
        """(3, 3) orthonormal rows: edge, axis x edge, axis."""
        axis = np.asarray(self.axis, dtype=float) / np.linalg.norm(self.axis)
        edge = self._edge_guess()
        edge = edge - (edge @ axis) * axis
        edge = edge / np.linalg.norm(edge)
        return np.array([edge, np.cross(axis, edge), axis])

    @property
    def _rounding(self) -> tuple[float, bool]:
        """Edge radius, mm, and whether it was asked for."""
        least = self.sharp * self.width
        return max(self.edge_radius, least), self.edge_radius >= least

    @property
    def kernel(self) -> Kernel:
        """Code, half width, effective edge radius and triangles, as the compiled kernels read them."""
        radius, body = self._rounding[0], NO_BODY
        if self.surface is not None:
            radius, body = self.surface.rounded(*self._rounding)
        return SHAPES[self.shape], self.width / 2, radius, body

    @property
    def length(self) -> float:
        """From the foremost point to the far end of a surface; the width for shapes without one, mm."""
        return self.width if self.surface is None else -float(self.surface.points[:, 2].min())

    def moved(self, distance: float, across: Sequence[float] = (0.0, 0.0)) -> Indenter:
        """The indenter, advanced along its axis by ``distance`` mm and ``across`` it, along x and y of its
        frame."""
        move = np.array([*across, distance]) @ self.frame
        return replace(self, centre=np.asarray(self.centre, dtype=float) + move)

    def placed(
        self, centre: NDArray[np.float64], axis: NDArray[np.float64], edge: NDArray[np.float64]
    ) -> Indenter:
        """The indenter with another frame."""
        return replace(self, centre=centre, axis=axis, edge=edge)

    def signed_distance(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Distance (n,) of points (n, 3), mm; negative inside."""
        local = (np.asarray(points, dtype=float) - np.asarray(self.centre, dtype=float)) @ self.frame.T
        return self.local_distance(local)[0]

    def near(self, points: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Which points (n, 3) of its frame it may touch; the distance of others is not looked for."""
        half = self.width / 2
        reach = 1.8 * half
        x, y, z = points.T
        return np.asarray((z <= half) & (np.abs(x) <= reach) & (np.abs(y) <= reach))

    def local_distance(
        self, points: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        """Distance (...), mm, gradient (..., 3) and hessian (..., 3, 3) at points (..., 3) of its frame."""
        shape = points.shape[:-1]
        x = np.ascontiguousarray(points, dtype=float).reshape(-1, 3)
        values, slopes, bends = signed_distances(x, self.kernel)
        return values.reshape(shape), slopes.reshape(*shape, 3), bends.reshape(*shape, 3, 3)


@njit(cache=True)
def signed_distance(kernel, x, gradient, hessian):  # type: ignore[no-untyped-def]
    """Distance of the local point ``x (3,)``; fills its gradient (3,) and hessian (3, 3).

    The prism is a box shrunk by its rounding, grown again (Quilez' rounded box).  Deeper than the rounding
    the way out is always through the foremost face: a point that a large step left inside must go back to
    where it came from, not sideways through the nearest wall.
    """
    shape, half, radius, body = kernel
    if shape == 3:
        return surface_distance(body, radius, x, gradient, hessian)
    gradient[:] = 0.0
    hessian[:, :] = 0.0
    if shape == 1:
        z = max(x[2] + half, 0.0)
        r = max(np.sqrt(x[0] * x[0] + x[1] * x[1] + z * z), 1e-300)
        gradient[0], gradient[1], gradient[2] = x[0] / r, x[1] / r, z / r
        for i in range(3):
            for j in range(3):
                identity = 1.0 if i == j and (i < 2 or z > 0.0) else 0.0
                hessian[i, j] = (identity - gradient[i] * gradient[j]) / r
        return r - half
    inner, z = half - radius, x[2] + radius
    if shape == 0:
        p, q = max(abs(x[0]) - inner, 0.0), max(abs(x[1]) - inner, 0.0)
    else:
        rho = np.sqrt(x[0] * x[0] + x[1] * x[1])
        p, q = max(rho - inner, 0.0), 0.0
    up = max(z, 0.0)
    r = np.sqrt(p * p + q * q + up * up)
    if r <= 1e-12 * half:
        gradient[2] = 1.0
        return z - radius
    if shape == 0:
        gradient[0], gradient[1], gradient[2] = np.sign(x[0]) * p / r, np.sign(x[1]) * q / r, up / r
        for i in range(3):
            active = (p if i == 0 else (q if i == 1 else up)) > 0.0
            for j in range(3):
                hessian[i, j] = ((1.0 if i == j and active else 0.0) - gradient[i] * gradient[j]) / r
        return r - radius
    _cylinder(x, p, up, r, gradient, hessian)
    return r - radius


@njit(cache=True)
def _cylinder(x, p, up, r, gradient, hessian):  # type: ignore[no-untyped-def]
    """Chain rule from the half plane (rho, z) to space."""
    gradient[2] = up / r
    if p > 0.0:
        rho = np.sqrt(x[0] * x[0] + x[1] * x[1])
        c, s = x[0] / rho, x[1] / rho
        gradient[0], gradient[1] = c * p / r, s * p / r
        hessian[0, 0] = c * c / r + s * s / rho * p / r
        hessian[1, 1] = s * s / r + c * c / rho * p / r
        hessian[0, 1] = c * s / r - c * s / rho * p / r
        hessian[1, 0] = hessian[0, 1]
    if up > 0.0:
        hessian[2, 2] = 1.0 / r
    for i in range(3):
        for j in range(3):
            hessian[i, j] -= gradient[i] * gradient[j] / r


@njit(cache=True)
def signed_distances(local, kernel):  # type: ignore[no-untyped-def]
    """`signed_distance` of many local points (n, 3) with its derivatives."""
    n = len(local)
    values, slopes, bends = np.empty(n), np.empty((n, 3)), np.empty((n, 3, 3))
    for i in range(n):
        values[i] = signed_distance(kernel, local[i], slopes[i], bends[i])
    return values, slopes, bends
