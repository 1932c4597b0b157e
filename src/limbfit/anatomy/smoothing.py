"""The few worst tetrahedra of a mesh made better by moving their nodes."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from ..mesh import dihedral_angles
from .background import volumes

Array = NDArray[np.float64]
Ints = NDArray[np.int64]

SWEEPS = 6
STEPS = (0.3, 0.15, 0.05)  # of the shortest edge at the node
DIRECTIONS = np.stack(np.meshgrid(*[[-1.0, 0.0, 1.0]] * 3), axis=-1).reshape(-1, 3)
DIRECTIONS = DIRECTIONS[np.any(DIRECTIONS != 0, axis=1)]


def improved(points: Array, tets: Ints, goal_deg: float, allowed: Callable[[int, Array], Array]) -> Array:
    """Points (n, 3) with nodes of poor tetrahedra moved so that the smallest dihedral angle about each grows.

    Parameters
    ----------
    points, tets : the mesh.
    goal_deg : tetrahedra below it are worked on.
    allowed : (node, candidates (k, 3)) to the candidates as the node may take them, on its surfaces.
    """
    points = points.copy()
    order = np.argsort(tets, axis=None, kind="stable")
    starts = np.searchsorted(tets.ravel()[order], np.arange(len(points) + 1))
    worst = _worst_angle(points[tets])
    for _ in range(SWEEPS):
        poor = tets[worst < goal_deg]
        before = points.copy()
        for node in np.unique(poor):
            star = order[starts[node] : starts[node + 1]] // 4
            points[node] = _best_place(points, tets[star], node, allowed)
            worst[star] = _worst_angle(points[tets[star]])
        if np.array_equal(before, points):
            break
    return points


def _best_place(points: Array, star: Ints, node: int, allowed: Callable[[int, Array], Array]) -> Array:
    """Where the smallest angle of the star about a node is greatest, among a pattern of places."""
    here = points[node]
    corners = points[star]
    mine = star == node
    spokes = np.linalg.norm(corners - here, axis=2)
    reach = spokes[~mine].min()
    pattern = here + np.concatenate([step * reach * DIRECTIONS for step in STEPS])
    places = np.vstack([here, allowed(node, pattern)])
    trial = np.where(mine[None, :, :, None], places[:, None, None, :], corners[None])
    angle = _worst_angle(trial.reshape(-1, 4, 3)).reshape(len(places), -1).min(axis=1)
    return places[int(np.argmax(angle))]


def _worst_angle(corners: Array) -> Array:
    """Smallest dihedral angle (m,) of tetrahedra (m, 4, 3), degrees; -1 where inverted."""
    flat = corners.reshape(-1, 3)
    tets = np.arange(len(flat)).reshape(-1, 4)
    sound = volumes(flat, tets) > 1e-12
    angle = np.full(len(tets), -1.0)
    angle[sound] = dihedral_angles(flat, tets[sound]).min(axis=1)
    return angle
