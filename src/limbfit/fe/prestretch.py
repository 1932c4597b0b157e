"""Tissue that is strained where the mesh is: its elastic deformation is ``F G``.

``F`` is that of the mesh, ``G`` the pre-stretch of each cell: the deformation from tissue on its own, without
stress, to the mesh before equilibrium (multiplicative pre-strain; Weiss, Gardiner and Bonifasi-Lista 2002,
J. Biomech. 35, 943).  With gradients of shape functions ``G^T grad N`` and weights ``w/det G`` every kernel
sees the tissue on its own; of ``G`` itself only ``F G = G + sum_a u_a x G^T grad N_a`` knows.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..errors import ProblemError

Array = NDArray[np.float64]


def isochoric_stretch(directions: ArrayLike, stretches: ArrayLike) -> Array:
    """Pre-stretches (m, 3, 3) along ``directions`` at constant volume.

    ``directions (m, 3)``, or one (3,), of any length; ``stretches``, one or (m,), along them: what is across
    has their inverse root.  A layer that is stretched by s in its plane has 1/s^2 along its normal.

    Raises
    ------
    ProblemError
        Where a direction has no length, or a stretch is not positive.
    """
    n, along = np.atleast_2d(np.asarray(directions, dtype=float)), np.asarray(stretches, dtype=float)
    length = np.linalg.norm(n, axis=1, keepdims=True)
    if n.shape[1] != 3 or not (np.isfinite(n).all() and (length > 0.0).all()):
        raise ProblemError("a direction of the pre-stretch is no vector of three numbers with a length")
    if not (np.isfinite(along).all() and (along > 0.0).all()):
        raise ProblemError("a pre-stretch is not positive")
    n = n / length
    along = np.broadcast_to(along, len(n))[:, None, None]
    across = along**-0.5
    return np.asarray(across * np.eye(3) + (along - across) * n[:, :, None] * n[:, None, :])


def apply_prestretch(given: ArrayLike, gradients: Array, weights: Array) -> tuple[Array, Array, Array]:
    """Pre-stretches (m, 3, 3), and gradients (m, q, 3, k) 1/mm and weights (m, q) mm^3 of the tissue on its
    own."""
    G = np.ascontiguousarray(np.broadcast_to(np.asarray(given, dtype=float), (len(weights), 3, 3)))
    own = np.einsum("mji,mqjk->mqik", G, gradients)
    return G, np.ascontiguousarray(own), weights / np.linalg.det(G)[:, None]
