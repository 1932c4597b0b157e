"""Rigid bodies of a FEBio input as limbfit's: indenters, and bodies with motions of their own."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ..errors import ProblemError
from ..fe import Indenter, Motion, OpenSurface, RigidBody, RigidSurface
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

    A closed one is an indenter whose front is the side that looks at the tissue, an open one the faces that
    touch.  It turns about its centre of mass.
    """
    rail = next((rail.along for rail in model.rails if rail.body == name), None)
    faces = touched_faces(model, contacts, tissue)
    parts = model.parts_of({name: None}).values()
    own = np.concatenate([part.cells.ravel() for part in parts])
    sides = [model.geometry.surfaces[side] for contact in contacts for side in contact.surfaces]
    front = triangles(_union([side for side in sides if np.isin(side, own).all()]))
    shape: Indenter | OpenSurface
    if closed(boundary(parts)):
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
            shape = OpenSurface(model.geometry.points[used], front.reshape(-1, 3))
            if rail is not None:
                shape = _along(shape, rail)
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


def _along(surface: OpenSurface, axis: Array) -> OpenSurface:
    """The same surface in a frame along ``axis (3,)``."""
    placed = surface.placed(np.zeros(3), axis, np.eye(3)[np.abs(axis).argmin()])
    return replace(placed, points=surface.points @ placed.frame.T)


def _of_part(model: FebModel, name: str, error: ProblemError) -> ProblemError:
    """The error of a surface, with the part that it is made of."""
    part_name, part = next(iter(model.parts_of({name: None}).items()))
    return refuse_part(part, part_name, error.what)


def _union(groups: Sequence[Indices]) -> Indices:
    """Faces of several surfaces, each once, in their order."""
    faces = np.concatenate(groups)
    _, first = np.unique(np.sort(faces, axis=1), axis=0, return_index=True)
    return np.asarray(faces[np.sort(first)])
