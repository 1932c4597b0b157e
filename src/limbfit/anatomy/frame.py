"""Where a limb lies: its proximal end on an image's grid, and the limb frame.

In the limb frame the proximal cut is the plane z = 0 and the limb lies at z <= 0; millimetres.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..arrays import Array, Mask
from ..errors import LabelError
from .grid import Grid
from .morphology import find_box


@dataclass(frozen=True, eq=False)
class Frame:
    """The rigid map between patient space and the limb frame."""

    rotation: Array
    origin: Array

    def to_limb(self, points: Array) -> Array:
        """Patient space (..., 3) to the limb frame."""
        return (np.asarray(points, dtype=float) - self.origin) @ self.rotation.T

    def to_patient(self, points: Array) -> Array:
        """The limb frame (..., 3) to patient space."""
        return points @ self.rotation + self.origin


def build_limb_frame(cut_point: Array, cut_normal: Array) -> Frame:
    """The frame whose z axis is the proximal normal and whose origin is ``cut_point``."""
    z = np.asarray(cut_normal, dtype=float) / np.linalg.norm(cut_normal)
    helper = np.eye(3)[np.argmin(np.abs(z))]
    x = np.cross(helper, z)
    x /= np.linalg.norm(x)
    return Frame(np.array([x, np.cross(z, x), z]), np.asarray(cut_point, dtype=float))


def format_place(point: Array, digits: int = 1) -> str:
    """A point (3,) in mm as messages give it."""
    return "(" + ", ".join(f"{x:.{digits}f}" for x in point) + ") mm"


@dataclass(frozen=True)
class ProximalEnd:
    """The proximal end of a limb on its grid.

    ``axis`` is 0, 1, 2 for i, j, k; ``side`` -1 or 1, the sense of that axis that is proximal; ``layer`` the
    last index that holds limb.
    """

    axis: int
    side: int
    layer: int

    def direction(self, grid: Grid) -> Array:
        """(3,) unit vector, proximal, LPS."""
        return self.side * grid.direction[:, self.axis]

    def order_distal_first(self, array: NDArray) -> NDArray:
        """A view of ``[k, j, i]`` whose first axis runs along the limb from distal to proximal."""
        view = np.moveaxis(array, 2 - self.axis, 0)
        return view[::-1] if self.side < 0 else view


def find_longest_axis(limb: Mask, grid: Grid) -> int:
    """The grid axis (0, 1, 2 for i, j, k) along which a mask is longest."""
    extents = [part.stop - part.start for part in find_box(limb)[::-1]]
    return int(np.argmax(extents * grid.spacing))


def find_proximal_end(
    limb: Mask, grid: Grid, axis: int | None = None, normal: Array | None = None
) -> ProximalEnd:
    """Where the limb was cut: at the border of the image that it reaches, else at its thicker end.

    The limb's axis is the grid axis along which it is longest, if it is not given. Of two ends at the
    border, as of an intact leg, the superior one is proximal. A proximal direction, ``normal`` (3,) in LPS,
    decides about both: a short limb may be wider than long, an arm may be held up.
    """
    if not limb.any():
        raise LabelError("the label map is empty", remedy="give one with the limb labelled")
    if normal is not None:
        axis = int(np.abs(normal @ grid.direction).argmax())
    axis = find_longest_axis(limb, grid) if axis is None else axis
    part = find_box(limb)[2 - axis]
    low, high = part.start, part.stop - 1
    ends = [ProximalEnd(axis, -1, low), ProximalEnd(axis, 1, high)]
    if normal is not None:
        return max(ends, key=lambda end: end.direction(grid) @ normal)
    border = [end for end in ends if end.layer in (0, grid.size[axis] - 1)]
    if len(border) == 1:
        return border[0]
    if len(border) == 2:
        return max(border, key=lambda end: end.direction(grid)[2])
    depth = min(3, high - low)
    return max(ends, key=lambda end: int(select_layer(limb, axis, end.layer - depth * end.side).sum()))


def select_layer(mask: Mask, axis: int, index: int) -> Mask:
    """One layer of ``[k, j, i]`` across grid axis 0, 1, 2 (i, j, k)."""
    return np.take(mask, index, axis=2 - axis)
