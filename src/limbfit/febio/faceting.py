"""An indenter as the rigid mesh that FEBio and Abaqus need: its front in quadrilaterals, grown backwards.

The side walls are left out below the steepest part of the rounded edge: faces beside the skin keep FEBio's
contact from converging, and the skin under a punch does not reach them.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..errors import ProblemError
from ..fe import Indenter, Motion, OpenSurface, Problem, SmoothSurface, System
from ..fe.contact.rigid import RigidShape
from .moving import guided, in_space, pushed

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

INDENTER, PATCH, FRONT = "indenter", "contact_patch", "indenter_front"
BLUNT = 0.05  # edge radius over the width that FEBio's contact goes round without retries


@dataclass(frozen=True)
class ToolMesh:
    """A rigid mesh: ``points (n, 3)`` mm, ``cells`` of ``cell_type`` (hex8, or tri3 shells), and the faces
    (f, 4 | 3) that touch, outward."""

    points: Array
    cells: Indices
    cell_type: str
    front: Indices


def blunt(indenter: Indenter) -> bool:
    """Whether the rigid mesh is round enough for FEBio's contact; the edges of a surface are sharp."""
    return indenter.body.facets().rounding >= BLUNT * indenter.width


def tool_mesh(indenter: Indenter) -> ToolMesh:
    """The rigid mesh of an indenter where it stands.

    Shapes carry the rounding that limbfit itself computes with; a surface (``stl``) is written as it is, its
    edges sharp.
    """
    facets = indenter.body.facets()
    if facets.closed is not None:
        return ToolMesh(_placed(indenter, facets.points), facets.closed, "tri3", facets.front)
    count, back = len(facets.points), facets.points - [0.0, 0.0, 0.5 * indenter.width]
    cells = np.hstack([facets.front + count, facets.front])
    return ToolMesh(_placed(indenter, np.vstack([facets.points, back])), cells, "hex8", facets.front)


def _placed(indenter: Indenter, local: Array) -> Array:
    return np.asarray(np.asarray(indenter.centre) + local @ indenter.frame)


@dataclass(frozen=True)
class Body:
    """A rigid body as it is written: its mesh, where its centre of mass (3,) is put, its motion along and
    about the axes of space, the faces (f, k) of tissue that it may touch, and what all that is called.

    ``rail (3,)``: the direction along which it is guided, where forces in space alone would not do.
    """

    name: str
    patch: str
    front: str
    pair: str
    tool: ToolMesh
    centre: Array
    motion: Motion
    faces: Indices
    friction: str | float
    width: float
    rail: Array | None


def written_bodies(problem: Problem, motions: Sequence[Motion] = ()) -> list[Body]:
    """The rigid bodies of a problem where they start; with other ``motions`` than it states, if given.

    Raises
    ------
    ProblemError
        For a motion that FEBio cannot be told, and two bodies of one name.
    """
    system = System(problem)
    found: list[Body] = []
    for i, body in enumerate([] if system.bodies is None else system.bodies.all):
        stated, first = body.stated, i == 0 and problem.indenter is not None
        driven = motions[i] if motions else stated.motion
        name = INDENTER if first else re.sub(r"[^\w-]+", "_", stated.name) or f"body_{i + 1}"
        if name in {other.name for other in found}:
            raise ProblemError(f"two rigid bodies have the name {name!r}", remedy="give each its own")
        patch, front, pair = (PATCH, FRONT, "indentation") if first else (
            f"{name}_patch", f"{name}_front", f"{name}_contact"
        )  # fmt: skip
        rail = guided(driven, body.start.frame)
        motion = in_space(name, driven, body.start.frame) if rail is None else pushed(driven, rail)
        faces = np.asarray(stated.faces, dtype=np.int64)
        tool = _mesh_of(body.start)
        words = name, patch, front, pair
        width = body.start.width
        found.append(Body(*words, tool, body.pivot, motion, faces, stated.friction, width, rail))
    return found


def frame_mesh(bodies: Sequence[Body]) -> ToolMesh:
    """A cube of 1 mm beside the bodies, which stands for what their rails are fixed to."""
    corner = np.vstack([body.tool.points for body in bodies]).min(axis=0) - 10.0
    cube = np.array([[x, y, z] for z in (0, 1) for x, y in ((0, 0), (1, 0), (1, 1), (0, 1))])
    points = corner + cube
    return ToolMesh(points, np.arange(8)[None], "hex8", np.zeros((0, 4), np.int64))


def _mesh_of(shape: RigidShape) -> ToolMesh:
    if isinstance(shape, Indenter):
        return tool_mesh(shape)
    if not isinstance(shape, OpenSurface | SmoothSurface):
        raise ProblemError(f"a rigid body that is a {type(shape).__name__} is not written for FEBio")
    used, faces = np.unique(shape.faces, return_inverse=True)
    faces = faces.reshape(-1, 3)
    points = shape.points[used] @ shape.frame + np.asarray(shape.centre, dtype=float)
    return ToolMesh(points, faces, "tri3", faces)
