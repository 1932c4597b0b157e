"""What a limb lies on or is wedged with: tables and cushions that touch it, taken off its mask.

A slab is thinner than the limb. Opened by a ball wider than it, the mask keeps the limb and loses the slab
but for the strip under the limb; what is lost and reaches far out is slab, and the hull of both its wings
closes the strip between them.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt, find_objects
from scipy.ndimage import label as connected
from scipy.spatial import ConvexHull, QhullError

from ..grid import Grid
from ..labels.contours import fill_even_odd

Mask = NDArray[np.bool_]

BALL_MM = 20.0  # half the thickness of the thickest slab
_REACH_MM = 15.0  # a support sticks out of the limb by more
_SHARE = 0.15  # of the limb's length, along which it does
_BITE_MM = 10.0  # how deep the strip under the limb may be
_STEP_MM = 2.0


def remove_supports(mask: Mask, grid: Grid) -> Mask:
    """The mask ``[k, j, i]`` (k along the limb) without slabs of up to 40 mm that stick out of the limb."""
    steps = np.maximum((_STEP_MM / grid.spacing[::-1]).astype(int), 1)
    coarse = mask[:: steps[0], :: steps[1], :: steps[2]]
    sampling = grid.spacing[::-1] * steps
    body = _open_limb(coarse, sampling)
    wings = _find_wings(coarse & ~body, body, sampling)
    if not wings.any():
        return mask
    strip = _fill_hulls(wings) & (_compute_depth(body, sampling) < _BITE_MM)
    support = wings | strip
    for axis, step in enumerate(steps):
        support = np.repeat(support, step, axis=axis)
    return np.asarray(mask & ~support[: mask.shape[0], : mask.shape[1], : mask.shape[2]])


def _open_limb(mask: Mask, sampling: NDArray[np.float64]) -> Mask:
    """Opened by a large ball; beyond the image the limb goes on, beside it there is nothing."""
    reach = np.ceil(2 * BALL_MM / sampling).astype(int) + 1
    padded = np.pad(mask, [(reach[0], reach[0]), (0, 0), (0, 0)], mode="edge")
    padded = np.pad(padded, [(0, 0), (reach[1], reach[1]), (reach[2], reach[2])])
    inner = distance_transform_edt(padded, sampling=sampling) > BALL_MM
    opened = distance_transform_edt(~inner, sampling=sampling) <= BALL_MM
    return np.asarray(opened[tuple(slice(r, -r) for r in reach)]) & mask


def _find_wings(residue: Mask, body: Mask, sampling: NDArray[np.float64]) -> Mask:
    """Pieces of the residue that stick far out of the body along much of it."""
    away = distance_transform_edt(~body, sampling=sampling)
    length = np.ptp(np.flatnonzero(body.any(axis=(1, 2)))) + 1 if body.any() else 1
    parts, _ = connected(residue, np.ones((3, 3, 3)))
    wings = np.zeros(residue.shape, dtype=bool)
    for value, box in enumerate(find_objects(parts), start=1):
        piece = parts[box] == value
        far = piece & (away[box] > _REACH_MM)
        beside = far.any(axis=(1, 2)) & body[box[0]].any(axis=(1, 2))  # else it is a thin end of the limb
        if beside.sum() > _SHARE * length:
            wings[box] |= piece
    return wings


def _compute_depth(body: Mask, sampling: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray(distance_transform_edt(body, sampling=sampling))


def _fill_hulls(wings: Mask) -> Mask:
    """The convex hull of each slice."""
    found = wings.copy()
    for k, plane in enumerate(wings):
        points = np.argwhere(plane)[:, ::-1].astype(float)
        if len(points) < 3:
            continue
        try:
            corners = points[ConvexHull(points).vertices]
        except QhullError:  # all on one line
            continue
        found[k] |= fill_even_odd([corners], plane.shape[1], plane.shape[0])
    return found
