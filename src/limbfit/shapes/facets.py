"""The front of an indenter in flat faces: grids of quadrilaterals, disks, bodies of revolution."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ..arrays import Array, Indices

STEEPEST_DEG = 68.0  # of a face: the skin under a punch does not reach what is steeper
FLAT, ARC, RINGS = 8, 4, 6  # divisions of half a face, of its rounding, and around the middle of a disk


@dataclass(frozen=True)
class Facets:
    """The front of an indenter in its frame, outward, without the side walls.

    Parameters
    ----------
    points : (n, 3) mm.
    front : (f, 4) faces, which are grown backwards into a solid; (f, 3) with ``closed`` faces.
    rounding : radius of the roundest edge that the facets stand for, mm; 0 where edges are sharp.
    closed : (m, 3) the whole surface, where that is what the shape is.
    """

    points: Array
    front: Indices
    rounding: float
    closed: Indices | None = None


def steps(steepest_deg: float = STEEPEST_DEG) -> Array:
    """Angles (k,) along a rounded edge, from its start to its steepest face, rad."""
    return np.linspace(0.0, np.radians(steepest_deg), ARC + 1)[1:]


def build_quadrilaterals(number: Indices) -> Indices:
    """Indices (f, 4) of a grid (k, l) of node numbers, counter-clockwise where the axes are."""
    corners = number[:-1, :-1], number[1:, :-1], number[1:, 1:], number[:-1, 1:]
    return np.stack(corners, axis=-1).reshape(-1, 4)


def revolved(
    disk: float, beyond: Array, outline: Callable[[Array], tuple[Array, Array]]
) -> tuple[Array, Indices]:
    """Points (n, 3) and faces (f, 4) of the front of a body of revolution.

    Parameters
    ----------
    disk : arc length from the axis, mm, up to which the front is a disk without a kink.
    beyond : (k,) arc lengths of the circles around it.
    outline : radius and z, mm, at arc lengths from the axis.
    """
    plane, faces = _build_disk(disk, beyond)
    length = np.linalg.norm(plane, axis=1)
    rho, z = outline(length)
    direction = plane / np.maximum(length, 1e-300)[:, None]
    return np.column_stack([rho[:, None] * direction, z]), faces


def _build_disk(radius: float, beyond: Array) -> tuple[Array, Indices]:
    """Points (n, 2) and faces (f, 4) of a disk and of circles ``beyond`` it: a grid, rings around it."""
    side = np.linspace(-1.0, 1.0, 2 * FLAT + 1)
    square = np.stack(np.meshgrid(side, side, indexing="ij"), axis=-1)
    size = np.abs(square).max(axis=-1, keepdims=True)
    circle = size * square / np.maximum(np.linalg.norm(square, axis=-1, keepdims=True), 1e-300)
    core = 0.5 * radius * (0.6 * square + 0.4 * circle)
    number = np.arange(len(side) ** 2).reshape(len(side), -1)
    around = np.concatenate([number[:-1, 0], number[-1, :-1], number[:0:-1, -1], number[0, :0:-1]])
    rim = core.reshape(-1, 2)[around]
    angle = -0.75 * np.pi + 2.0 * np.pi * np.arange(len(around)) / len(around)
    unit = np.column_stack([np.cos(angle), np.sin(angle)])
    shares = np.arange(1, RINGS + 1)[:, None, None] / RINGS
    rings = np.concatenate([(1.0 - shares) * rim + shares * radius * unit, beyond[:, None, None] * unit])
    numbers = np.vstack(
        [around, number.size + np.arange(rings.shape[0] * len(around)).reshape(len(rings), -1)]
    )
    outside = build_quadrilaterals(np.hstack([numbers, numbers[:, :1]]))
    points = np.concatenate([core.reshape(-1, 2), rings.reshape(-1, 2)])
    return points, np.vstack([build_quadrilaterals(number), outside])
