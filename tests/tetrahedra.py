"""Tetrahedra that tests make by hand."""

import numpy as np

from limbfit.arrays import Array, Indices


def turn_upright(points: Array, tets: Indices) -> Indices:
    """The tetrahedra (m, 4) with those turned over that are inside out."""
    edges = points[tets[:, 1:]] - points[tets[:, :1]]
    flip = np.linalg.det(edges) < 0.0
    tets[flip] = tets[flip][:, [0, 2, 1, 3]]
    return tets
