"""A square prism with rounded edges: the paper's indenter."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numba import njit

from .facets import ARC, FLAT, Facets, build_quadrilaterals, steps
from .shape import Array, Distance, Shape


@dataclass(frozen=True)
class Square(Shape):
    """A prism without a far end; ``width`` is its edge length."""

    name: ClassVar = "square"
    words: ClassVar = "square indenter"
    is_edge_doubted: ClassVar = True
    variants: ClassVar = {"square": 0.0, "square, rounded edge": 0.1}

    def distance(self, points: Array) -> Distance:
        """See `Shape.distance`."""
        return _distances(points, self.width / 2, self.radius)

    def facets(self) -> Facets:
        """A flat square, rounded at edges and corners."""
        inner, radius = self.width / 2 - self.radius, self.radius
        angles = steps()
        flat = np.linspace(-inner, inner, 2 * FLAT + 1)
        base = np.concatenate([np.full(ARC, -inner), flat, np.full(ARC, inner)])
        slope = np.concatenate([-np.tan(angles[::-1]), np.zeros(len(flat)), np.tan(angles)])
        x, y = np.meshgrid(base, base, indexing="ij")
        a, b = np.meshgrid(slope, slope, indexing="ij")
        length = np.sqrt(a**2 + b**2 + 1.0)
        grid = np.stack([x + radius * a / length, y + radius * b / length, radius / length - radius], axis=-1)
        return Facets(
            grid.reshape(-1, 3), build_quadrilaterals(np.arange(x.size).reshape(x.shape)), rounding=radius
        )


@njit(cache=True)
def _distances(points, half, radius):  # type: ignore[no-untyped-def]
    """A box shrunk by its rounding, grown again (Quilez' rounded box)."""
    n = len(points)
    values, slopes, bends = np.empty(n), np.zeros((n, 3)), np.zeros((n, 3, 3))
    inner = half - radius
    for k in range(n):
        x, gradient, hessian = points[k], slopes[k], bends[k]
        z = x[2] + radius
        p, q, up = max(abs(x[0]) - inner, 0.0), max(abs(x[1]) - inner, 0.0), max(z, 0.0)
        r = np.sqrt(p * p + q * q + up * up)
        if r <= 1e-12 * half:
            gradient[2] = 1.0
            values[k] = z - radius
            continue
        gradient[0], gradient[1], gradient[2] = np.sign(x[0]) * p / r, np.sign(x[1]) * q / r, up / r
        for i in range(3):
            active = (p if i == 0 else (q if i == 1 else up)) > 0.0
            for j in range(3):
                hessian[i, j] = ((1.0 if i == j and active else 0.0) - gradient[i] * gradient[j]) / r
        values[k] = r - radius
    return values, slopes, bends
