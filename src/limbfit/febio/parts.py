"""The parts of a FEBio input as limbfit's: tissue as one mesh, rigid bodies as indenters or moving bodies."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..arrays import Array, Indices
from ..errors import ProblemError
from ..fe import ELEMENTS, Indenter, Motion, OpenSurface, RigidBody, RigidSurface, SmoothSurface
from ..fe.kernel.elements import compute_reference_gradients
from ..mesh import Mesh
from ..shapes import SHARP_EDGE
from .penalty import find_smallest_depth
from .reading.geometry import (
    build_part_error,
    collect_nodes,
    find_boundary_faces,
    is_closed,
    split_convexly,
    split_into_triangles,
)
from .reading.model import Contact, FebModel

# Facets of a hollow wall that meet at no more than this, rad, stand for a smooth one: FEBio's contact acts
# along the skin's normal, which does not jump where a point passes from facet to facet (docs/benchmarks.md).
MAX_SMOOTH_ANGLE = 0.3
MIN_HOLLOWNESS = 0.02  # how far facets look at each other in the mean, over the size of all


def find_touched_faces(model: FebModel, contacts: Sequence[Contact], tissue: TissueMesh) -> Indices:
    """Return the faces (f, k) of tissue in contacts, each once, in the numbers of the tissue's nodes."""
    groups: list[Indices] = []
    for contact in contacts:
        sides = [tissue.node_index[model.geometry.surfaces[name]] for name in contact.surfaces]
        on_tissue = [side for side in sides if (side >= 0).all()]
        if not on_tissue:
            raise ProblemError("neither surface lies on tissue", place=f"line {contact.line}, <contact>")
        groups.append(on_tissue[0])
    return _merge_faces(groups)


def is_hollow(model: FebModel, name: str, contacts: Sequence[Contact]) -> bool:
    """True if the faces of a rigid body that touch are those of a hollow, nearly smooth wall: a socket."""
    corners = model.geometry.points[_find_front(model, name, contacts)]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    middles = corners.mean(axis=1)
    ahead = middles @ normals.T - (middles * normals).sum(axis=1)  # of each middle over each facet's plane
    if not ahead.mean() > MIN_HOLLOWNESS * np.ptp(middles, axis=0).max():
        return False
    edges: dict[tuple[tuple[float, ...], ...], list[int]] = {}
    for i, points in enumerate(corners):
        for a, b in ((0, 1), (1, 2), (2, 0)):
            edges.setdefault(tuple(sorted((tuple(points[a]), tuple(points[b])))), []).append(i)
    pairs = np.array([pair for pair in edges.values() if len(pair) == 2]).reshape(-1, 2)
    cosines = (normals[pairs[:, 0]] * normals[pairs[:, 1]]).sum(axis=1)
    return bool((cosines > np.cos(MAX_SMOOTH_ANGLE)).all())


def _find_front(model: FebModel, name: str, contacts: Sequence[Contact]) -> Indices:
    """Return the triangles (m, 3) of a rigid body's faces that touch, in the numbers of the model's nodes."""
    own = collect_nodes(model.geometry.select_parts([name]).values())
    sides = [model.geometry.surfaces[side] for contact in contacts for side in contact.surfaces]
    return split_into_triangles(_merge_faces([side for side in sides if np.isin(side, own).all()]))


def build_indenter(
    model: FebModel, axis: Array, name: str, depth: float, edge: Array | None = None
) -> Indenter:
    """Build an indenter of a rigid body's faces; its axis passes through the middle of the body.

    Its sharp edges are rounded by no more than the depth of the elements that it touches (``depth``, mm).
    """
    parts = model.geometry.select_parts([name]).values()
    faces = split_convexly(model.geometry.points, find_boundary_faces(parts))
    used, faces = np.unique(faces, return_inverse=True)
    frame = Indenter("sphere", axis=axis, edge=edge).frame
    points = model.geometry.points[used] @ frame.T
    middle = 0.5 * (points.min(axis=0) + points.max(axis=0))
    middle[2] = points[:, 2].max()
    try:
        surface = RigidSurface(points - middle, faces.reshape(-1, 3))
    except ProblemError as error:
        raise _name_part(model, name, error) from None
    sharp = min(SHARP_EDGE, depth / surface.width)
    return Indenter("stl", surface=surface, centre=middle @ frame, axis=axis, edge=edge, sharp=sharp)


def build_rigid_body(
    model: FebModel, name: str, contacts: Sequence[Contact], motion: Motion, tissue: TissueMesh
) -> RigidBody:
    """Build a rigid body with a motion of its own, in a frame along the axes of space, or along its rail.

    A closed body is an indenter whose front is the side that faces the tissue; an open or hollow one consists
    of the faces that touch. It turns about its centre of mass.
    """
    rail = next((rail.along for rail in model.rails if rail.body == name), None)
    faces = find_touched_faces(model, contacts, tissue)
    front = _find_front(model, name, contacts)
    smooth = is_hollow(model, name, contacts)
    shape: Indenter | OpenSurface | SmoothSurface
    if is_closed(find_boundary_faces(model.geometry.select_parts([name]).values())) and not smooth:
        a, b, c = (model.geometry.points[front[:, i]] for i in range(3))
        towards = np.cross(b - a, c - a).sum(axis=0)
        main = int(np.abs(towards).argmax())
        axis, edge = np.sign(towards[main]) * np.eye(3)[main], np.eye(3)[(main + 1) % 3]
        if rail is not None:
            axis, edge = np.sign(towards @ rail) * rail, np.eye(3)[np.abs(rail).argmin()]
        shape = build_indenter(model, axis, name, find_smallest_depth(tissue.mesh, faces), edge)
    else:
        used, front = np.unique(front, return_inverse=True)
        try:
            shape = _build_wall(model.geometry.points[used], front.reshape(-1, 3), rail, smooth)
        except ProblemError as error:
            raise _name_part(model, name, error) from None
    if rail is None:
        turn = np.kron(np.eye(2), shape.frame)  # a permutation with signs
        forced = np.asarray(motion.forced)[:, np.abs(turn).argmax(axis=1)]
        moved = Motion(motion.times, motion.values @ turn.T, forced)
    else:
        moved = Motion(motion.times, motion.values * np.sign(shape.frame[2] @ rail), motion.forced)
    friction = contacts[0].friction or "frictionless"
    sticking = contacts[0].sticking
    return RigidBody(shape, faces, moved, friction, model.rigid[name].centre, name, sticking=sticking)


def _build_wall(
    points: Array, faces: Indices, rail: Array | None, smooth: bool
) -> OpenSurface | SmoothSurface:
    """Build a wall that is met from one side, in a frame along its rail, if it has one."""
    axis, edge = np.eye(3)[2], np.eye(3)[0]
    if rail is not None:
        axis, edge = rail, np.eye(3)[np.abs(rail).argmin()]
    frame = OpenSurface(points, faces, axis=axis, edge=edge).frame
    if smooth:
        edges = np.linalg.norm(points[faces] - points[np.roll(faces, 1, axis=1)], axis=2)
        spacing = 0.5 * float(np.median(edges.min(axis=1)))  # no detail but the edges of facets is smoothed
        return SmoothSurface.of(points @ frame.T, faces, spacing=spacing, axis=axis, edge=edge)
    return OpenSurface(points @ frame.T, faces, axis=axis, edge=edge)


def _name_part(model: FebModel, name: str, error: ProblemError) -> ProblemError:
    """Return the error of a surface, with the part that it is made of."""
    part_name, part = next(iter(model.geometry.select_parts([name]).items()))
    return build_part_error(part, part_name, error.what)


def _merge_faces(groups: Sequence[Indices]) -> Indices:
    """Return the faces of several surfaces, each once, in their order."""
    faces = np.concatenate(groups)
    _, first = np.unique(np.sort(faces, axis=1), axis=0, return_index=True)
    return np.asarray(faces[np.sort(first)])


@dataclass(frozen=True)
class TissueMesh:
    """The deformable parts as one mesh.

    ``nodes (n,)`` are the places of its nodes among the model's, ``node_index`` the way back (-1: none).
    """

    mesh: Mesh
    nodes: Indices
    node_index: Indices


def build_tissue(model: FebModel) -> TissueMesh:
    """Build one mesh of the deformable parts.

    Raises `ProblemError` if there is none, if their elements differ, or if one is inverted.
    """
    parts = model.geometry.select_parts(model.materials)
    if not parts:
        raise ProblemError("no part is made of a deformable material")
    first = next(iter(parts.values()))
    for name, part in parts.items():
        if not part.element:
            raise build_part_error(part, name, "only tet4, tet10 and hex8 can deform")
        if part.element != first.element:
            raise build_part_error(
                part, name, f"all tissue must be of one element type, not also {first.cell_type}"
            )
    cells = np.vstack([part.cells for part in parts.values()])
    ids = np.concatenate([part.ids for part in parts.values()])
    regions = np.repeat(np.arange(len(parts)), [len(part.cells) for part in parts.values()])
    nodes = np.unique(cells)
    number = np.full(len(model.geometry.points), -1)
    number[nodes] = np.arange(len(nodes))
    points = model.geometry.points[nodes]
    sets = {name: number[nodes] for name, nodes in model.geometry.node_sets.items()}
    sets = {name: nodes for name, nodes in sets.items() if (nodes >= 0).all()}
    mesh = Mesh(points, number[cells], first.cell_type, regions, tuple(parts), sets)
    _, weights = compute_reference_gradients(ELEMENTS[first.element], points, mesh.cells)
    bad = np.flatnonzero((weights <= 0.0).any(axis=1))
    if len(bad):
        part_name = mesh.region_names[regions[bad[0]]]
        what = f"{len(bad)} elements are inverted or flat, the first is element {ids[bad[0]]}"
        raise build_part_error(parts[part_name], part_name, what)
    return TissueMesh(mesh, nodes, number)
