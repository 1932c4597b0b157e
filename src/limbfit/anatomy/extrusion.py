"""The skin layer as prisms between the interface and the skin, and nodes put exactly on their surfaces."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from ..mesh import dihedral_angles
from .background import volumes

Array = NDArray[np.float64]
Ints = NDArray[np.int64]
Field = Callable[[Array], tuple[Array, Array]]

NEWTON_STEPS = 4
BISECTIONS = 4


def projected(field: Field, points: Array, z_freedom: Array) -> Array:
    """Points (n, 3) moved to ``field = 0`` along its gradient with the z component weighted.

    ``z_freedom`` (n,) is 1 for free points and 0 for those that must keep their z (on the cut plane).
    """
    points = points.copy()
    for _ in range(NEWTON_STEPS):
        value, slope = field(points)
        way = slope * np.column_stack([np.ones((len(points), 2)), z_freedom])
        rate = np.maximum(np.einsum("ij,ij->i", slope, way), 0.05)  # a kink must not send a point away
        points -= (value / rate)[:, None] * way
    return points


def guarded(points: Array, target: Array, tets: Ints, floor_deg: float) -> Array:
    """Points moved towards ``target`` as far as no dihedral angle falls below the floor or sinks under it."""
    share = np.ones(len(points))
    before = np.minimum(dihedral_angles(points, tets).min(axis=1), floor_deg)
    for attempt in range(BISECTIONS + 1):
        moved = points + share[:, None] * (target - points)
        sound = volumes(moved, tets) > 0
        after = np.where(sound, dihedral_angles(moved, tets).min(axis=1), -1.0)
        bad = np.unique(tets[after < before - 1e-6])
        if not len(bad):
            return moved
        share[bad] = share[bad] / 2 if attempt < BISECTIONS - 1 else 0.0
    return points


def prism_tets(triangles: Ints, top: Ints) -> Ints:
    """Three tetrahedra per prism (3 m, 4) over outward triangles (m, 3); ``top`` maps base to upper nodes.

    Each quadrilateral is split from its lower-numbered base node, so neighbouring prisms agree. Volumes are
    positive where the prism is not folded.
    """
    order = np.argsort(triangles, axis=1)
    a, b, c = np.take_along_axis(triangles, order, axis=1).T
    A, B, C = top[a], top[b], top[c]
    tets = np.stack([a, b, c, C, a, b, C, B, a, A, B, C], axis=1).reshape(-1, 3, 4)
    odd = (order[:, 1] - order[:, 0]) % 3 == 2
    tets[odd] = tets[odd][:, :, [1, 0, 2, 3]]
    return tets.reshape(-1, 4)
