"""A face of even triangles between rings of points around a limb."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from ..arrays import Array

Ints = NDArray[np.int64]


def resample_ring(ring: Array, count: int, turn: float) -> tuple[Array, Array]:
    """``count`` points evenly spaced along a dense closed ring (n, 3), from the share ``turn`` of a step on.

    Returns
    -------
    points : (count, 3) on the periodic cubic spline through the ring.
    shares : (count,) of the ring's length at which they lie.
    """
    closed = np.vstack([ring, ring[:1]])
    length = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(closed, axis=0), axis=1)))
    shares = (np.arange(count) + turn) / count
    return CubicSpline(length / length[-1], closed, bc_type="periodic")(shares), shares


def join_rings(lower: Array, upper: Array, first: int, second: int) -> Ints:
    """Triangles between two rings whose points lie at shares ``lower`` (a,) and ``upper`` (b,) of them.

    The points of the rings are numbered from ``first`` and ``second`` on. Seen from inside, where shares grow
    clockwise about the upward axis from without, the triangles run counter-clockwise.
    """
    a, b = len(lower), len(upper)
    faces, i, j = [], 0, 0
    ends = np.append(lower, lower[0] + 1.0), np.append(upper, upper[0] + 1.0)
    while i < a or j < b:
        step_lower = j >= b or (i < a and ends[0][i + 1] <= ends[1][j + 1])
        low, high = first + i % a, second + j % b
        if step_lower:
            i += 1
            faces.append([low, high, first + i % a])
        else:
            j += 1
            faces.append([low, high, second + j % b])
    return np.array(faces, dtype=np.int64)


def join_all_rings(shares: Sequence[Array]) -> Ints:
    """Triangles between rings, the first of which is a point, numbered one ring after the other."""
    starts = np.cumsum([0, *(len(ring) for ring in shares)])
    around = np.arange(len(shares[1]))
    pole = np.column_stack([np.zeros_like(around), 1 + around, 1 + np.roll(around, -1)])
    bands = [
        join_rings(shares[k], shares[k + 1], starts[k], starts[k + 1]) for k in range(1, len(shares) - 1)
    ]
    return np.vstack([pole, *bands])
