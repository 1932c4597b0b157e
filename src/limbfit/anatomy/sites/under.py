"""Soft tissue under an indenter: how far it is to bone along the indenter's axis."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from ..surfaces.surfaces import Anatomy
from .sites import Array, compute_square_edges

DEEPEST_MM = 40.0  # beyond it, bone no longer stiffens what is felt
_TICKS = np.linspace(-0.5, 0.5, 5)


def measure_tissue_under(anatomy: Anatomy, position: ArrayLike, axis: ArrayLike, width: float) -> float:
    """Least distance (mm) along the axis from the skin to a bone under a square footprint, at most 40.

    Parameters
    ----------
    position : (3,) the footprint's centre, on the skin.
    axis : (3,) unit, into the limb.
    width : side of the square, mm.
    """
    centre, direction = np.asarray(position, dtype=float), np.asarray(axis, dtype=float)
    along, across = compute_square_edges(direction)
    u, v = np.meshgrid(width * _TICKS, width * _TICKS)
    # From outside: at its edges the footprint may lie off a curved skin.
    starts = centre + u.reshape(-1, 1) * along + v.reshape(-1, 1) * across - width * direction
    skin = _find_first_hits(starts, direction, anatomy.skin.points[anatomy.skin.faces])
    least = DEEPEST_MM
    for bone in anatomy.bones.values():
        hits = _find_first_hits(starts, direction, bone.points[bone.faces])
        through = np.isfinite(hits) & np.isfinite(skin) & (hits > skin)
        depth = hits[through] - skin[through]
        least = min(least, float(depth.min(initial=least)))
    return least


def _find_first_hits(starts: Array, direction: Array, triangles: Array) -> Array:
    """Distance (n,) along one direction from each start to the nearest triangle (m, 3, 3); inf for none.

    Möller and Trumbore 1997.
    """
    a, e1, e2 = triangles[:, 0], triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]
    normal = np.cross(direction, e2)
    det = np.einsum("mi,mi->m", e1, normal)
    facing = np.abs(det) > 1e-12
    a, e1, e2, normal, inverse = a[facing], e1[facing], e2[facing], normal[facing], 1 / det[facing]
    found = np.full(len(starts), np.inf)
    for i, start in enumerate(starts):
        offset = start - a
        q = np.cross(offset, e1)
        u, v = np.einsum("mi,mi->m", offset, normal) * inverse, q @ direction * inverse
        t = np.einsum("mi,mi->m", e2, q) * inverse
        inside = (u >= 0) & (v >= 0) & (u + v <= 1) & (t > 0)
        found[i] = t[inside].min(initial=np.inf)
    return found
