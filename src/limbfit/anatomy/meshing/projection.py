"""Nodes put on smooth surfaces, exactly or as far as their elements allow."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from ...arrays import Array, Indices
from ...mesh import compute_dihedral_angles
from .background import compute_volumes

Field = Callable[[Array], tuple[Array, Array]]

NEWTON_STEPS = 4
BISECTIONS = 4


def project_to_level(field: Field, points: Array, z_freedom: Array) -> Array:
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


def project_safely(points: Array, target: Array, tets: Indices, floor_deg: float) -> Array:
    """Points moved towards ``target`` as far as no dihedral angle falls below the floor or sinks under it."""
    share = np.ones(len(points))
    before = np.minimum(compute_dihedral_angles(points, tets).min(axis=1), floor_deg)
    for attempt in range(BISECTIONS + 1):
        moved = points + share[:, None] * (target - points)
        sound = compute_volumes(moved, tets) > 0
        after = np.where(sound, compute_dihedral_angles(moved, tets).min(axis=1), -1.0)
        bad = np.unique(tets[after < before - 1e-6])
        if not len(bad):
            return moved
        share[bad] = share[bad] / 2 if attempt < BISECTIONS - 1 else 0.0
    return points
