"""Rigid bodies of a FEBio input as limbfit's: indenters, and bodies with motions of their own."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ..errors import ProblemError
from ..fe import Indenter, Motion, OpenSurface, RigidBody, RigidSurface, SmoothSurface
from ..shapes import SHARP_EDGE
from .penalty import thinnest
from .reading.geometry import boundary, bulging, closed, refuse_part, triangles
from .reading.model import Contact, FebModel
from .tissue import Tissue

Array = NDArray[np.float64]
Indices = NDArray[np.int64]


def _contact_faces(model: FebModel, contact: Contact, tissue: Tissue) -> Indices:
    """The deformable of the two surfaces in contact, in the numbers of the tissue's nodes."""
    for name in contact.surfaces:
        faces = tissue.number[model.geometry.surfaces[name]]
        if (faces >= 0).all():
            return np.asarray(faces)
    raise ProblemError("neither surface lies on tissue", place=f"line {contact.line}, <contact>")


def touched_faces(model: FebModel, contacts: Sequence[Contact], tissue: Tissue) -> Indices:
    """The faces (f, k) of tissue in contacts, each once, in the numbers of the tissue's nodes."""
    return _union([_contact_faces(model, contact, tissue) for contact in contacts])


# Facets of a hollow wall that meet at no more than this, rad, stand for a smooth one: FEBio's contact acts
# along the skin's normal, which does not jump where a point passes from facet to facet (docs/benchmarks.md).
SMOOTH = 0.3
HOLLOW = 0.02  # how far facets look at each other in the mean, over the size of all


def hollow(model: FebModel, name: str, contacts: Sequence[Contact]) -> bool:
    """Whether the faces of a rigid body that touch are those of a hollow, all but smooth wall: a socket."""
    corners = model.geometry.points[_front(model, name, contacts)]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    middles = corners.mean(axis=1)
    ahead = middles @ normals.T - (middles * normals).sum(axis=1)  # of each middle over each facet's plane
    if not ahead.mean() > HOLLOW * np.ptp(middles, axis=0).max():
        return False
    edges: dict[tuple[tuple[float, ...], ...], list[int]] = {}
    for i, points in enumerate(corners):
        for a, b in ((0, 1), (1, 2), (2, 0)):
            edges.setdefault(tuple(sorted((tuple(points[a]), tuple(points[b])))), []).append(i)
    pairs = np.array([pair for pair in edges.values() if len(pair) == 2]).reshape(-1, 2)
    cosines = (normals[pairs[:, 0]] * normals[pairs[:, 1]]).sum(axis=1)
    return bool((cosines > np.cos(SMOOTH)).all())


def _front(model: FebModel, name: str, contacts: Sequence[Contact]) -> Indices:
    """The triangles (m, 3) of a rigid body's faces that touch, in the numbers of the model's nodes."""
    own = np.concatenate([part.cells.ravel() for part in model.parts_of({name: None}).values()])
    sides = [model.geometry.surfaces[side] for contact in contacts for side in contact.surfaces]
    return triangles(_union([side for side in sides if np.isin(side, own).all()]))


def rigid_corners(model: FebModel, name: str) -> Array:
    """Corners (m, 3, 3) of the triangles around a rigid body, mm."""
    return np.asarray(model.geometry.points[triangles(boundary(model.parts_of({name: None}).values()))])


def indenter_of(model: FebModel, axis: Array, name: str, depth: float, edge: Array | None = None) -> Indenter:
    """The faces of a rigid body as an indenter whose axis passes through the middle of the body.

    Its sharp edges are rounded by no more than the elements that it touches are deep (``depth``, mm).
    """
    faces = bulging(model.geometry.points, boundary(model.parts_of({name: None}).values()))
    used, faces = np.unique(faces, return_inverse=True)
    frame = Indenter("sphere", axis=axis, edge=edge).frame
    points = model.geometry.points[used] @ frame.T
    middle = 0.5 * (points.min(axis=0) + points.max(axis=0))
    middle[2] = points[:, 2].max()
    try:
        surface = RigidSurface(points - middle, faces.reshape(-1, 3))
    except ProblemError as error:
        raise _of_part(model, name, error) from None
    sharp = min(SHARP_EDGE, depth / surface.width)
    return Indenter("stl", surface=surface, centre=middle @ frame, axis=axis, edge=edge, sharp=sharp)


def rigid_body(
    model: FebModel, name: str, contacts: Sequence[Contact], motion: Motion, tissue: Tissue
) -> RigidBody:
    """A rigid body with a motion of its own, in a frame along the axes of space, or along its rail.

    A closed one is an indenter whose front is the side that looks at the tissue, an open or hollow one the
    faces that touch.  It turns about its centre of mass.
    """
    rail = next((rail.along for rail in model.rails if rail.body == name), None)
    faces = touched_faces(model, contacts, tissue)
    front = _front(model, name, contacts)
    smooth = hollow(model, name, contacts)
    shape: Indenter | OpenSurface | SmoothSurface
    if closed(boundary(model.parts_of({name: None}).values())) and not smooth:
        a, b, c = (model.geometry.points[front[:, i]] for i in range(3))
        towards = np.cross(b - a, c - a).sum(axis=0)
        main = int(np.abs(towards).argmax())
        axis, edge = np.sign(towards[main]) * np.eye(3)[main], np.eye(3)[(main + 1) % 3]
        if rail is not None:
            axis, edge = np.sign(towards @ rail) * rail, np.eye(3)[np.abs(rail).argmin()]
        shape = indenter_of(model, axis, name, thinnest(tissue.mesh, faces), edge)
    else:
        used, front = np.unique(front, return_inverse=True)
        try:
            shape = _wall(model.geometry.points[used], front.reshape(-1, 3), rail, smooth)
        except ProblemError as error:
            raise _of_part(model, name, error) from None
    if rail is None:
        turn = np.kron(np.eye(2), shape.frame)  # a permutation with signs
        forced = np.asarray(motion.forced)[:, np.abs(turn).argmax(axis=1)]
        moved = Motion(motion.times, motion.values @ turn.T, forced)
    else:
        moved = Motion(motion.times, motion.values * np.sign(shape.frame[2] @ rail), motion.forced)
    friction = contacts[0].friction or "frictionless"
    sticking = contacts[0].sticking
    return RigidBody(shape, faces, moved, friction, model.rigid[name].centre, name, sticking=sticking)


def _wall(points: Array, faces: Indices, rail: Array | None, smooth: bool) -> OpenSurface | SmoothSurface:
    """A wall that is met from one side, in a frame along its rail, if it has one."""
    axis, edge = np.eye(3)[2], np.eye(3)[0]
    if rail is not None:
        axis, edge = rail, np.eye(3)[np.abs(rail).argmin()]
    frame = OpenSurface(points, faces, axis=axis, edge=edge).frame
    if smooth:
        edges = np.linalg.norm(points[faces] - points[np.roll(faces, 1, axis=1)], axis=2)
        spacing = 0.5 * float(np.median(edges.min(axis=1)))  # no detail but the edges of facets is smoothed
        return SmoothSurface.of(points @ frame.T, faces, spacing=spacing, axis=axis, edge=edge)
    return OpenSurface(points @ frame.T, faces, axis=axis, edge=edge)


def _of_part(model: FebModel, name: str, error: ProblemError) -> ProblemError:
    """The error of a surface, with the part that it is made of."""
    part_name, part = next(iter(model.parts_of({name: None}).items()))
    return refuse_part(part, part_name, error.what)


def _union(groups: Sequence[Indices]) -> Indices:
    """Faces of several surfaces, each once, in their order."""
    faces = np.concatenate(groups)
    _, first = np.unique(np.sort(faces, axis=1), axis=0, return_index=True)
    return np.asarray(faces[np.sort(first)])
