"""An indenter as the rigid mesh that FEBio and Abaqus need: its front in quadrilaterals, grown backwards.

The side walls are left out below the steepest part of the rounded edge: faces beside the skin keep FEBio's
contact from converging, and the skin under a punch does not reach them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..errors import ProblemError
from ..fe import Indenter

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

STEEPEST_DEG = {"square": 68.0, "cylinder": 68.0, "sphere": 75.0, "stl": 68.0}
BLUNT = 0.05  # edge radius over the width that FEBio's contact goes round without retries
FLAT, ARC, RINGS = 8, 4, 6  # divisions of half a face, of its rounding, and around the middle of a disk


@dataclass(frozen=True)
class Tool:
    """A rigid mesh: ``points (n, 3)`` mm, ``cells`` of ``cell_type`` (hex8, or tri3 shells), and the faces
    (f, 4 | 3) that touch, outward."""

    points: Array
    cells: Indices
    cell_type: str
    front: Indices


def blunt(indenter: Indenter) -> bool:
    """Whether the rigid mesh is round enough for FEBio's contact; the edges of a surface are sharp."""
    if indenter.shape in ("sphere", "stl"):
        return indenter.shape == "sphere"
    return indenter.kernel[2] >= BLUNT * indenter.width


def tool_mesh(indenter: Indenter) -> Tool:
    """The rigid mesh of an indenter where it stands.

    Square, cylinder and sphere carry the rounding that limbfit itself computes with; a surface (``stl``) is
    written as it is, its edges sharp.
    """
    if indenter.shape == "stl":
        return _shells(indenter)
    local, front = FRONTS[indenter.shape](indenter)
    back = local - [0.0, 0.0, 0.5 * indenter.width]
    cells = np.hstack([front + len(local), front])
    return Tool(_placed(indenter, np.vstack([local, back])), cells, "hex8", front)


def _quadrilaterals(number: Indices) -> Indices:
    """Faces (f, 4) of a grid (k, l) of node numbers, counter-clockwise where the axes are."""
    corners = number[:-1, :-1], number[1:, :-1], number[1:, 1:], number[:-1, 1:]
    return np.stack(corners, axis=-1).reshape(-1, 4)


def _placed(indenter: Indenter, local: Array) -> Array:
    return np.asarray(np.asarray(indenter.centre) + local @ indenter.frame)


def _shells(indenter: Indenter) -> Tool:
    surface = indenter.surface
    assert surface is not None
    used, faces = np.unique(surface.faces, return_inverse=True)
    points, faces = surface.points[used], faces.reshape(-1, 3)
    a, b, c = (points[faces[:, i]] for i in range(3))
    normals = np.cross(b - a, c - a)
    steep = np.cos(np.radians(STEEPEST_DEG["stl"]))
    front = faces[normals[:, 2] > steep * np.linalg.norm(normals, axis=1)]
    if not len(front):
        raise ProblemError("no face of the indenter's surface looks along its axis")
    return Tool(_placed(indenter, points), faces, "tri3", front)


def _edge(indenter: Indenter) -> tuple[float, float, Array]:
    """Half width of the flat part, rounding radius, and the angles along the rounding."""
    _, half, radius, _ = indenter.kernel
    steepest = np.radians(STEEPEST_DEG[indenter.shape])
    return half - radius, radius, np.linspace(0.0, steepest, ARC + 1)[1:]


def _rounded_square(indenter: Indenter) -> tuple[Array, Indices]:
    """Points (n, 3) in the indenter's frame and faces of a flat square, rounded at edges and corners."""
    inner, radius, angles = _edge(indenter)
    flat = np.linspace(-inner, inner, 2 * FLAT + 1)
    base = np.concatenate([np.full(ARC, -inner), flat, np.full(ARC, inner)])
    slope = np.concatenate([-np.tan(angles[::-1]), np.zeros(len(flat)), np.tan(angles)])
    x, y = np.meshgrid(base, base, indexing="ij")
    a, b = np.meshgrid(slope, slope, indexing="ij")
    length = np.sqrt(a**2 + b**2 + 1.0)
    grid = np.stack([x + radius * a / length, y + radius * b / length, radius / length - radius], axis=-1)
    return grid.reshape(-1, 3), _quadrilaterals(np.arange(x.size).reshape(x.shape))


def _round(indenter: Indenter) -> tuple[Array, Indices]:
    """Points (n, 3) in the indenter's frame and faces of the front of a cylinder or sphere.

    A grid in the middle of a disk, rings around it; the disk's radius is the arc length from the middle.
    """
    inner, radius, angles = _edge(indenter)
    if indenter.shape == "sphere":
        inner, radius = 0.0, 0.5 * indenter.width
        disk, arcs = radius * np.radians(STEEPEST_DEG["sphere"]), np.zeros(0)
    else:
        disk, arcs = inner, inner + radius * angles
    plane, faces = _disk(disk, arcs)
    length = np.linalg.norm(plane, axis=1)
    turned = np.maximum(length - inner, 0.0) / radius
    rho = np.minimum(length, inner) + radius * np.sin(turned)
    direction = plane / np.maximum(length, 1e-300)[:, None]
    return np.column_stack([rho[:, None] * direction, radius * (np.cos(turned) - 1.0)]), faces


# The shapes that are meshed here; a surface is its own mesh.
FRONTS = {"square": _rounded_square, "cylinder": _round, "sphere": _round}


def _disk(radius: float, beyond: Array) -> tuple[Array, Indices]:
    """Points (n, 2) and faces of a disk, with circles ``beyond`` it."""
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
    outside = _quadrilaterals(np.hstack([numbers, numbers[:, :1]]))
    points = np.concatenate([core.reshape(-1, 2), rings.reshape(-1, 2)])
    return points, np.vstack([_quadrilaterals(number), outside])
