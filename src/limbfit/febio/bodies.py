"""The bodies of a FEBio input: the mesh of tissue and rigid bodies, named sets, and what drives them.

Motions are written as load curves, rigid conditions and steps of the analysis.

An indenter becomes the rigid mesh that FEBio and Abaqus need: its front in quadrilaterals, extended
backwards. The side walls are left out below the steepest part of the rounded edge: faces beside the skin keep
FEBio's contact from converging, and the skin under a punch does not reach them.
"""

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np

from ..arrays import Array, Indices, Mask
from ..errors import ProblemError
from ..fe import Indenter, Motion, OpenSurface, Problem, SmoothSurface, System
from ..fe.contact.rigid import RigidShape
from .reading.rigid import FREEDOMS, find_straight_line, has_same_rotation

FIXED_SET = "held"
FRAME_BODY = "frame"  # the rigid body that rails are fixed to
INDENTER, PATCH, FRONT = "indenter", "contact_patch", "indenter_front"
MIN_EDGE_ROUNDING = 0.05  # edge radius over the width that FEBio's contact goes round without retries
# FEBio's names of limbfit's elements; hex8 with an uncoupled material is three-field by itself.
QUADRATURE = {"tet4": "", "tet10": "TET10G4", "tet10p0": "TET10G4", "tet10g8": "TET10G8", "hex8": ""}


class CurveList(list[dict[str, Any]]):
    """The load curves of a file, for the template; `add` gives a curve its number."""

    def add(self, name: str, points: Array, interpolate: str = "LINEAR") -> int:
        """Add points (n, 2), time in s and value; return the number of the curve."""
        self.append({"name": name, "points": points, "interpolate": interpolate})
        return len(self)


def to_space(name: str, motion: Motion, frame: Array) -> Motion:
    """Return a body's motion along and about the axes of space, from that in its ``frame (3, 3)``.

    Raises `ProblemError` if a force drives it along, or about, an axis between those of space, because
    FEBio holds and drives along its own; if it turns about several axes, grows, or leaves a force open.
    """
    if motion.grows:
        raise ProblemError(f"{name}: a body that grows is not written for FEBio, which has none")
    if np.isnan(motion.values).any():
        what = f"{name}: a force that takes over what held the body is not written for FEBio"
        raise ProblemError(what, remedy="state the force, as Result.reactions tell it")
    turn, forced = np.kron(np.eye(2), frame), np.asarray(motion.forced)
    own = forced.copy()
    for block in (slice(0, 3), slice(3, 6)):
        mixed = forced[:, block].any(axis=1) & ~forced[:, block].all(axis=1)
        if not mixed.any():
            continue
        main = np.abs(frame).argmax(axis=0)  # of each axis of space, that of the frame
        if not np.allclose(np.abs(frame[main, range(3)]), 1.0, atol=1e-12):
            what = f"{name}: a force along an axis that lies between x, y and z is not written for FEBio"
            raise ProblemError(what, remedy="turn the problem first (limbfit.febio.turn_to_indenter_frame)")
        own[:, block] = forced[:, block][:, main]
    values = motion.values @ turn
    values[:, :3] = np.where(np.abs(values[:, :3]) < 1e-15 * np.abs(values).max(), 0.0, values[:, :3])
    if not has_same_rotation(values, own):
        what = f"{name}: a turn about several axes is not written for FEBio, which adds it up another way"
        raise ProblemError(what)
    return Motion(motion.times, values, own)


def find_rail(motion: Motion, frame: Array) -> Array | None:
    """Return the direction (3,) along which a rail guides a body, or None for any other motion.

    A rail is needed if nothing but a force drives the body, along one axis of its ``frame (3, 3)`` that lies
    between the axes of space.
    """
    (own,) = np.nonzero(motion.free)
    if len(own) != 1 or own[0] > 2 or motion.grows or np.isnan(motion.values).any():
        return None
    along = np.asarray(frame[own[0]])
    askew = not np.isclose(np.abs(along).max(), 1.0, rtol=0.0, atol=1e-12)
    return along if askew and not np.delete(motion.values, own[0], axis=1).any() else None


def to_rail_motion(motion: Motion, along: Array) -> Motion:
    """Return the motion in space of a body guided ``along (3,)`` by a rail, which bears all but the force."""
    values = np.zeros((len(motion.times), 6))
    values[:, :3] = motion.values[:, :3].sum(axis=1)[:, None] * along
    under = np.asarray(np.asarray(motion.forced).any(axis=1))
    return Motion(motion.times, values, under[:, None].repeat(6, axis=1))


def find_step_ends(motions: Iterable[Motion], end: float, settled: float = 0.0) -> list[float]:
    """Return the times at which FEBio must begin another step, s, and the end.

    These are the times at which the kind of drive changes, and at which pre-strained tissue has ``settled``.
    """
    found = {end} | ({settled} if settled else set())
    for motion in motions:
        times = np.asarray(motion.times)
        found |= {float(t) for t in times[1:][np.diff(times) == 0.0] if t < end}
    return sorted(found)


def list_conditions(
    name: str, motion: Motion, ends: list[float], curves: CurveList
) -> list[list[dict[str, Any]]]:
    """List the conditions of a rigid body in every step, from its motion in space, for the template."""
    steps: list[list[dict[str, Any]]] = []
    for begin, end in pairwise([0.0, *ends]):
        label = name if len(ends) == 1 else f"{name}_{len(steps) + 1}"
        conditions = _list_step_conditions(label, *_cut_motion(motion, begin, end), curves)
        steps.append([{"body": name, "label": label, **one} for one in conditions])
    return steps


def _cut_motion(motion: Motion, begin: float, end: float) -> tuple[Array, Array, Mask]:
    """Return times (k,), values (k, 6) and drives of a motion between two ends of steps."""
    times = np.asarray(motion.times)
    inner = times[(times > begin) & (times < end)]
    # Of two values at the start of a step the later one holds, at its end the earlier.
    last = int(np.searchsorted(times, begin, side="right")) - 1
    first = motion.values[last] if times[last] == begin else motion.at(begin)[0]
    values = np.array([first, *(motion.at(t)[0] for t in inner), motion.at(end)[0]])
    return np.array([begin, *inner, end]), values, motion.at(end)[1]


def _list_step_conditions(
    label: str, times: Array, values: Array, forced: Mask, curves: CurveList
) -> Iterator[dict[str, Any]]:
    moving = np.asarray(values.any(axis=0))
    free = forced | moving
    if not free.all():
        yield {"kind": "rigid_fixed", "held": dict(zip(FREEDOMS, ~free))}
    on_line = None if forced.any() else find_straight_line(Motion(times - times[0], values))
    if on_line is not None:  # one curve, and its share along each axis
        direction, advance = on_line
        number = curves.add(f"{label}_advance", np.column_stack([times, advance]))
        for i in np.flatnonzero(direction):
            share = float(direction[i])
            yield {"kind": "rigid_displacement", "freedom": FREEDOMS[i], "curve": number, "factor": share}
        return
    for i in np.flatnonzero(moving):
        turn, letter = i > 2, FREEDOMS[i]
        kind = ("rigid_displacement", "rigid_rotation", "rigid_force", "rigid_moment")[2 * forced[i] + turn]
        number = curves.add(f"{label}_{kind[6:]}_{letter}", np.column_stack([times, values[:, i]]))
        yield {"kind": kind, "freedom": letter, "curve": number, "factor": 1.0}


@dataclass(frozen=True)
class RigidMesh:
    """A rigid mesh: ``points (n, 3)`` mm, ``cells`` of ``cell_type`` (hex8, or tri3 shells).

    ``front`` holds the faces (f, 4 | 3) that touch, outward.
    """

    points: Array
    cells: Indices
    cell_type: str
    front: Indices


def has_round_edges(problem: Problem) -> bool:
    """True if all indenters are round enough for FEBio's contact; the edges of a surface are sharp."""
    shapes = [body.shape for body in problem.rigid_bodies]
    indenters = [shape for shape in shapes if isinstance(shape, Indenter)]
    return all(one.body.facets().rounding >= MIN_EDGE_ROUNDING * one.width for one in indenters)


def build_indenter_mesh(indenter: Indenter) -> RigidMesh:
    """Build the rigid mesh of an indenter where it stands.

    Shapes have the rounding that limbfit itself computes with; a surface (``stl``) is written as it is, with
    sharp edges.
    """
    facets = indenter.body.facets()
    if facets.closed is not None:
        return RigidMesh(_to_space(indenter, facets.points), facets.closed, "tri3", facets.front)
    count, back = len(facets.points), facets.points - [0.0, 0.0, 0.5 * indenter.width]
    cells = np.hstack([facets.front + count, facets.front])
    return RigidMesh(_to_space(indenter, np.vstack([facets.points, back])), cells, "hex8", facets.front)


def _to_space(indenter: Indenter, local: Array) -> Array:
    return np.asarray(np.asarray(indenter.centre) + local @ indenter.frame)


@dataclass(frozen=True)
class FebBody:
    """A rigid body as it is written.

    It has a mesh, the place (3,) of its centre of mass, its motion along and about the axes of space, the
    faces (f, k) of tissue that it may touch, and the names of all that. ``rail (3,)`` is the direction along
    which it is guided if forces in space alone would not keep it on its line.
    """

    name: str
    patch: str
    front: str
    pair: str
    tool: RigidMesh
    centre: Array
    motion: Motion
    faces: Indices
    friction: str | float
    width: float
    rail: Array | None

    @property
    def has_friction(self) -> bool:
        """True if it slides with friction."""
        return self.friction not in ("frictionless", 0.0)

    @property
    def reach(self) -> float:
        """How far FEBio searches for contact, mm: half again as far as the body goes in."""
        ways = np.where(self.motion.free, 0.0, np.abs(self.motion.values))[:, :3]
        return max(1.5 * float(ways.max()), 10.0 if self.motion.free.any() else 2.0)

    @property
    def rail_stiffness(self) -> float:
        """Stiffness of the joint on its rail, N/mm, which gives way by a thousandth of a mm at most."""
        under = np.append(False, np.asarray(self.motion.forced)[:, 0])
        return 1e3 * float(np.linalg.norm(self.motion.values[under, :3], axis=1).max())


def build_bodies(problem: Problem, motions: Sequence[Motion] = ()) -> list[FebBody]:
    """Build the rigid bodies of a problem where they start, with other ``motions`` than its own if given.

    Raises `ProblemError` for a motion that FEBio cannot be given, and for two bodies of one name.
    """
    bodies: list[FebBody] = []
    for i, body in enumerate(System(problem).bodies.all):
        stated = body.stated
        if i == 0 and problem.indenter is not None:
            names = INDENTER, PATCH, FRONT, "indentation"
        else:
            name = re.sub(r"[^\w-]+", "_", stated.name) or f"body_{i + 1}"
            names = name, f"{name}_patch", f"{name}_front", f"{name}_contact"
        if names[0] in {other.name for other in bodies}:
            raise ProblemError(f"two rigid bodies have the name {names[0]!r}", remedy="give each its own")
        driven, frame = motions[i] if motions else stated.motion, body.start.frame
        rail = find_rail(driven, frame)
        motion = to_space(names[0], driven, frame) if rail is None else to_rail_motion(driven, rail)
        tool, faces = _mesh_shape(body.start), np.asarray(stated.faces, dtype=np.int64)
        width = body.start.width
        bodies.append(FebBody(*names, tool, body.pivot, motion, faces, stated.friction, width, rail))
    return bodies


def build_frame_mesh(bodies: Sequence[FebBody]) -> RigidMesh:
    """Build a cube of 1 mm beside the bodies, which stands for what their rails are fixed to."""
    corner = np.vstack([body.tool.points for body in bodies]).min(axis=0) - 10.0
    cube = np.array([[x, y, z] for z in (0, 1) for x, y in ((0, 0), (1, 0), (1, 1), (0, 1))])
    points = corner + cube
    return RigidMesh(points, np.arange(8)[None], "hex8", np.zeros((0, 4), np.int64))


def _mesh_shape(shape: RigidShape) -> RigidMesh:
    if isinstance(shape, Indenter):
        return build_indenter_mesh(shape)
    if not isinstance(shape, OpenSurface | SmoothSurface):
        raise ProblemError(f"a rigid body that is a {type(shape).__name__} is not written for FEBio")
    used, faces = np.unique(shape.faces, return_inverse=True)
    faces = faces.reshape(-1, 3)
    points = shape.points[used] @ shape.frame + np.asarray(shape.centre, dtype=float)
    return RigidMesh(points, faces, "tri3", faces)


def list_parts(problem: Problem, rigid: Mapping[str, RigidMesh]) -> Iterator[dict[str, Any]]:
    """List name, type and cells (m, k) of tissues and rigid bodies, and the number of their first cell."""
    mesh, first, node = problem.mesh, 1, len(problem.mesh.points)
    parts = [
        (name, mesh.cell_type, mesh.cells[mesh.regions == r]) for r, name in enumerate(mesh.region_names)
    ]
    for name, body in rigid.items():
        parts.append((name, body.cell_type, body.cells + node))
        node += len(body.points)
    for name, cell_type, cells in parts:
        yield {"name": name, "cell_type": cell_type, "cells": cells, "first": first}
        first += len(cells)


def name_surfaces(problem: Problem, bodies: Sequence[FebBody]) -> dict[str, Indices]:
    """Return the faces (f, k) of a file's surfaces by their names there."""
    mesh, node = problem.mesh, len(problem.mesh.points)
    found = {body.patch: body.faces for body in bodies}
    for body in bodies:
        found[body.front] = body.tool.front + node
        node += len(body.tool.points)
    found |= {f"pressed_{i}": np.asarray(one.faces) for i, one in enumerate(problem.pressures, 1)}
    own = {  # FEBio makes an element set of every part
        f"{name}_surface" if name in mesh.region_names else name: faces
        for name, faces in mesh.face_sets.items()
    }
    return {**found, **own}
