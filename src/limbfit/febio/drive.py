"""What drives the problem of a FEBio input: one history, and the motions of the bodies that touch tissue.

A single body that goes straight in is an indenter. Its advance is the history, and everything else is a
multiple of it. Bodies that turn, that forces drive, or that are open, and several bodies at once, have
motions of their own. Then the history is that of prescribed nodes, and of bodies that carry tissue.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from ..arrays import Array
from ..errors import ProblemError
from ..fe import History, Motion
from .parts import is_hollow
from .reading.geometry import find_boundary_faces, is_closed
from .reading.model import Contact, FebModel
from .reading.rigid import (
    build_motion,
    find_straight_line,
    has_rotation,
    merge_knots,
    name_free,
    restrict_to_rail,
)


@dataclass(frozen=True)
class Drive:
    """The drives of a problem.

    ``indenter`` is the name of the body that is one (empty: none), and ``axis (3,)`` its direction.
    ``factors`` are those of the node motions with respect to the history, in their order; ``travel (3,)`` is
    that of every rigid body per mm of the history, by name; ``motions`` are those of the other bodies that
    touch tissue, along and about the axes of space, or of a frame whose third axis is their rail's.
    """

    history: History
    indenter: str
    axis: Array | None
    factors: tuple[float, ...]
    travel: Mapping[str, Array]
    motions: Mapping[str, Motion]


@dataclass(frozen=True)
class _FollowingCurve:
    """A curve that follows the history: its values at times, and how to name it in an error."""

    at: Callable[[Array], Array]
    knots: Array
    words: str
    line: int


def group_contacts(model: FebModel) -> dict[str, tuple[Contact, ...]]:
    """Return the contacts of every rigid body that touches tissue, by its name, in the order of the file.

    Raises
    ------
    ProblemError
        If no rigid body is in a contact, or if the contacts of one body differ.
    """
    found: dict[str, tuple[Contact, ...]] = {}
    for contact in model.contacts:
        name = find_touching_body(model, contact)
        found[name] = (*found.get(name, ()), contact)
        if not contact.acts_like(found[name][0]):
            what = f"the contacts of the rigid body {name!r} differ in law, penalty or friction"
            raise ProblemError(what, place=f"line {contact.line}, <contact>", remedy="state them alike")
    return found


def find_touching_body(model: FebModel, contact: Contact) -> str:
    """Find the rigid body that one of the surfaces in contact lies on."""
    surfaces = [model.geometry.surfaces[name] for name in contact.surfaces]
    for name in model.rigid:
        parts = model.select_parts({name: None}).values()
        nodes = np.concatenate([np.zeros(0, np.int64), *(part.cells.ravel() for part in parts)])
        if any(np.isin(surface, nodes).all() for surface in surfaces):
            return name
    place = f"line {contact.line}, <contact>"
    raise ProblemError("neither surface is that of a rigid body", place=place)


def find_drive(model: FebModel, shaped: bool = False) -> Drive:
    """Find what drives the problem of an input.

    Parameters
    ----------
    shaped : True if a shape is given for the body that goes straight in, whose own faces may then be open.

    Raises
    ------
    ProblemError
        If nodes, or bodies that carry tissue, move by load curves that are not multiples of one another, and
        for motions that limbfit does not support.
    """
    touching, motions = group_contacts(model), _read_body_motions(model)
    bodies = {name: motions[name] for name in touching}
    courses = _find_followers(model, motions)
    if len(bodies) == 1:
        (name,) = bodies
        line = find_straight_line(bodies[name])
        around = find_boundary_faces(model.select_parts({name: None}).values())
        if line is not None and (
            shaped or (is_closed(around) and not is_hollow(model, name, touching[name]))
        ):
            direction, advance = line
            course = _interpolate_motion(bodies[name], advance, name, 0)
            times = _merge_times(model, [course, *courses.values()])
            base = course.at(times)
            try:
                return _scale_to_history(model, courses, times, base, name, direction, {})
            except ProblemError:  # nodes go their own way: the body has a motion of its own
                pass
    return _drive_without_indenter(model, courses, bodies)


def _drive_without_indenter(
    model: FebModel, courses: Mapping[tuple[str, int], _FollowingCurve], bodies: Mapping[str, Motion]
) -> Drive:
    moving = list(courses.values())
    driven = any(motion.values.any() for motion in bodies.values())
    times = _merge_times(model, moving)
    strained = model.contractions or model.prestrains
    if not (moving or driven or model.pressures or strained):
        raise ProblemError("nothing moves: there is no prescribed displacement, no force and no pressure")
    base = moving[0].at(times) if moving else np.zeros(len(times))
    if moving and not base.any():
        raise ProblemError("nothing moves: the load curve is zero", place=f"line {moving[0].line}")
    return _scale_to_history(model, courses, times, base, "", None, bodies)


def _scale_to_history(
    model: FebModel,
    courses: Mapping[tuple[str, int], _FollowingCurve],
    times: Array,
    base: Array,
    indenter: str,
    direction: Array | None,
    bodies: Mapping[str, Motion],
) -> Drive:
    """Build the drives with the history ``base (k,)`` at ``times (k,)``, signed so that it goes forward."""
    sign = float(np.sign(base[np.abs(base).argmax()])) or 1.0
    scales = {key: sign * _find_factor(course, times, base) for key, course in courses.items()}
    factors = tuple(m.factor * scales.get(("", m.curve), 0.0) for m in model.motions)
    travel = {name: np.array([scales.get((name, i), 0.0) for i in range(3)]) for name in model.rigid}
    if direction is not None:
        travel[indenter] = sign * direction
    axis = None if direction is None else sign * direction
    return Drive(History(times, sign * base), indenter, axis, factors, travel, bodies)


def _read_body_motions(model: FebModel) -> dict[str, Motion]:
    """Return the motions of all rigid bodies that have parts, checked for what they carry."""
    found, touching, rails = {}, group_contacts(model), {rail.body: rail for rail in model.rails}
    for name, body in model.rigid.items():
        if not model.select_parts({name: None}) and name not in model.carried_nodes:
            continue
        motion = build_motion(name, model.conditions, model.curves, model.phases)
        if name in rails:
            motion = restrict_to_rail(motion, rails[name])
        found[name] = motion
        place = f"line {body.line}, <material>"
        if name in model.carried_nodes and motion.free.any():
            raise ProblemError(
                f"the rigid body {name!r} is neither fixed nor displaced in {name_free(motion)}",
                place=place,
                remedy="limbfit solves only for bodies that carry no tissue: fix it there with rigid_fixed",
            )
        lines = [c.line for c in model.conditions if c.body == name and c.kind != "fixed" and c.curve]
        if name in model.carried_nodes and has_rotation(motion):
            what = f"the rigid body {name!r} carries tissue, and turns: that is not supported"
            raise ProblemError(what, place=f"line {lines[0]}")
        if name not in model.carried_nodes and name not in touching and motion.values.any():
            what = f"the rigid body {name!r} moves, and neither touches nor carries tissue"
            raise ProblemError(what, place=f"line {lines[0]}")
    for rail in model.rails:
        base = found.get(rail.base)
        if base is None or base.values.any() or base.free.any():
            what = f"the rigid body {rail.base!r}, to which the joint is fixed, is not held still"
            raise ProblemError(what, place=f"line {rail.line}, <rigid_connector>", remedy="fix it")
    return found


def _find_followers(model: FebModel, motions: Mapping[str, Motion]) -> dict[tuple[str, int], _FollowingCurve]:
    """Find the curves that follow the history.

    They are load curves of nodes, by ``("", number)``, and moves of the bodies that carry tissue, by name and
    component.
    """
    every, end = model.step_times, model.end_s
    found: dict[tuple[str, int], _FollowingCurve] = {}
    for m in model.motions:
        if m.factor != 0.0:
            curve = model.curves[m.curve]
            at = merge_knots([curve], every, 0.0, end)
            found.setdefault(("", m.curve), _FollowingCurve(curve.at, at, f"load curve {m.curve}", m.line))
    for name in model.carried_nodes:
        for i, values in enumerate(motions[name].values[:, :3].T):
            if values.any():
                line = next(c.line for c in model.conditions if c.body == name and c.freedom == i and c.curve)
                found[name, i] = _interpolate_motion(motions[name], values, name, line)
    return found


def _interpolate_motion(motion: Motion, values: Array, name: str, line: int) -> _FollowingCurve:
    times = np.asarray(motion.times)
    return _FollowingCurve(
        lambda t: np.interp(t, times, values), times, f"the motion of the rigid body {name!r}", line
    )


def _merge_times(model: FebModel, courses: Sequence[_FollowingCurve]) -> Array:
    """Return times (k,) from 0 to the end between which everything is linear."""
    end = model.end_s
    every = np.unique(np.concatenate([np.zeros(0), *(course.knots for course in courses)]))
    return np.concatenate([[0.0], every[(every > 0.0) & (every < end * (1.0 - 1e-9))], [end]])


def _find_factor(course: _FollowingCurve, times: Array, history: Array) -> float:
    values = course.at(times)
    scale = float(values @ history / (history @ history))
    if np.abs(values - scale * history).max() > 1e-9 * np.abs(values).max():
        raise ProblemError(
            f"{course.words} is not a multiple of that of the other motions",
            place=f"line {course.line}",
            remedy="limbfit moves nodes, and bodies that carry tissue, by one history",
        )
    return scale
