"""What drives the problem of a FEBio input: one history, and the motions of the bodies that touch tissue.

A single body that goes straight in is an indenter, and its advance the history, of which everything else is
a multiple.  Bodies that turn, that forces drive, that are open, or of which there are several, have motions
of their own; then the history is that of prescribed nodes, and of bodies that carry tissue.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..errors import ProblemError
from ..fe import History, Motion
from .bodies import hollow
from .reading.controls import step_times
from .reading.geometry import boundary, closed
from .reading.model import Contact, FebModel
from .reading.motions import knots, names_of_free, on_rail, rigid_motion, straight, turns_of

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Drive:
    """The drives of a problem.

    ``indenter`` is the name of the body that is one (empty: none), ``axis (3,)`` where it goes.  ``factors``
    of the node motions with respect to the history, in their order; ``travel (3,)`` of every rigid body per
    mm of it, by name; ``motions`` of the other bodies that touch tissue, along and about the axes of space,
    or of a frame whose third axis is their rail's.
    """

    history: History
    indenter: str
    axis: Array | None
    factors: tuple[float, ...]
    travel: Mapping[str, Array]
    motions: Mapping[str, Motion]


@dataclass(frozen=True)
class _Course:
    """Something that follows the history: its values at times, and how to name it in an error."""

    at: Callable[[Array], Array]
    knots: Array
    words: str
    line: int


def contacts_of_bodies(model: FebModel) -> dict[str, tuple[Contact, ...]]:
    """The contacts of every rigid body that touches tissue, by its name, in the order of the file.

    Raises
    ------
    ProblemError
        Where no rigid body is in a contact, and where those of one body differ.
    """
    found: dict[str, tuple[Contact, ...]] = {}
    for contact in model.contacts:
        name = touching_body(model, contact)
        found[name] = (*found.get(name, ()), contact)
        if not contact.acts_as(found[name][0]):
            what = f"the contacts of the rigid body {name!r} differ in law, penalty or friction"
            raise ProblemError(what, place=f"line {contact.line}, <contact>", remedy="state them alike")
    return found


def touching_body(model: FebModel, contact: Contact) -> str:
    """The rigid body that one of the surfaces in contact lies on."""
    surfaces = [model.geometry.surfaces[name] for name in contact.surfaces]
    for name in model.rigid:
        parts = model.parts_of({name: None}).values()
        nodes = np.concatenate([np.zeros(0, np.int64), *(part.cells.ravel() for part in parts)])
        if any(np.isin(surface, nodes).all() for surface in surfaces):
            return name
    place = f"line {contact.line}, <contact>"
    raise ProblemError("neither surface is that of a rigid body", place=place)


def drive(model: FebModel, shaped: bool = False) -> Drive:
    """What drives the problem of an input.

    Parameters
    ----------
    shaped : a shape is given for the body that goes straight in, whose own faces may be open then.

    Raises
    ------
    ProblemError
        Where nodes, or bodies that carry tissue, move by load curves that are not multiples of one another,
        and for motions that limbfit has not.
    """
    touching, motions = contacts_of_bodies(model), _motions(model)
    bodies = {name: motions[name] for name in touching}
    courses = _courses(model, motions)
    if len(bodies) == 1:
        (name,) = bodies
        line = straight(bodies[name])
        around = boundary(model.parts_of({name: None}).values())
        if line is not None and (shaped or (closed(around) and not hollow(model, name, touching[name]))):
            direction, advance = line
            course = _interpolated(bodies[name], advance, name, 0)
            times = _times(model, [course, *courses.values()])
            base = course.at(times)
            try:
                return _scaled(model, courses, times, base, name, direction, {})
            except ProblemError:  # nodes go their own way: the body has a motion of its own
                pass
    return _without_indenter(model, courses, bodies)


def _without_indenter(
    model: FebModel, courses: Mapping[tuple[str, int], _Course], bodies: Mapping[str, Motion]
) -> Drive:
    moving = list(courses.values())
    driven = any(motion.values.any() for motion in bodies.values())
    times = _times(model, moving)
    strained = model.contractions or model.prestrains
    if not (moving or driven or model.pressures or strained):
        raise ProblemError("nothing moves: there is no prescribed displacement, no force and no pressure")
    base = moving[0].at(times) if moving else np.zeros(len(times))
    if moving and not base.any():
        raise ProblemError("nothing moves: the load curve is zero", place=f"line {moving[0].line}")
    return _scaled(model, courses, times, base, "", None, bodies)


def _scaled(
    model: FebModel,
    courses: Mapping[tuple[str, int], _Course],
    times: Array,
    base: Array,
    indenter: str,
    direction: Array | None,
    bodies: Mapping[str, Motion],
) -> Drive:
    """The drives with the history ``base (k,)`` at ``times (k,)``, turned so that it goes forward."""
    sign = float(np.sign(base[np.abs(base).argmax()])) or 1.0
    scales = {key: sign * _multiple(course, times, base) for key, course in courses.items()}
    factors = tuple(m.factor * scales.get(("", m.curve), 0.0) for m in model.motions)
    travel = {name: np.array([scales.get((name, i), 0.0) for i in range(3)]) for name in model.rigid}
    if direction is not None:
        travel[indenter] = sign * direction
    axis = None if direction is None else sign * direction
    return Drive(History(times, sign * base), indenter, axis, factors, travel, bodies)


def _motions(model: FebModel) -> dict[str, Motion]:
    """The motions of all rigid bodies of which there are parts, checked for what they carry."""
    found, touching, rails = {}, contacts_of_bodies(model), {rail.body: rail for rail in model.rails}
    for name, body in model.rigid.items():
        if not model.parts_of({name: None}) and name not in model.carried:
            continue
        motion = rigid_motion(name, model.conditions, model.curves, model.phases)
        if name in rails:
            motion = on_rail(motion, rails[name])
        found[name] = motion
        place = f"line {body.line}, <material>"
        if name in model.carried and motion.free.any():
            raise ProblemError(
                f"the rigid body {name!r} is neither fixed nor displaced in {names_of_free(motion)}",
                place=place,
                remedy="limbfit solves only for bodies that carry no tissue: fix it there with rigid_fixed",
            )
        lines = [c.line for c in model.conditions if c.body == name and c.kind != "fixed" and c.curve]
        if name in model.carried and turns_of(motion):
            what = f"the rigid body {name!r} carries tissue, and turns: that is not supported"
            raise ProblemError(what, place=f"line {lines[0]}")
        if name not in model.carried and name not in touching and motion.values.any():
            what = f"the rigid body {name!r} moves, and neither touches nor carries tissue"
            raise ProblemError(what, place=f"line {lines[0]}")
    for rail in model.rails:
        base = found.get(rail.base)
        if base is None or base.values.any() or base.free.any():
            what = f"the rigid body {rail.base!r}, to which the joint is fixed, is not held still"
            raise ProblemError(what, place=f"line {rail.line}, <rigid_connector>", remedy="fix it")
    return found


def _courses(model: FebModel, motions: Mapping[str, Motion]) -> dict[tuple[str, int], _Course]:
    """What follows the history: load curves of nodes, by ``("", number)``, and moves of the bodies that carry
    tissue, by name and component."""
    every, end = step_times(model.phases, model.curves), _end(model)
    found: dict[tuple[str, int], _Course] = {}
    for m in model.motions:
        if m.factor != 0.0:
            curve = model.curves[m.curve]
            at = knots([curve], every, 0.0, end)
            found.setdefault(("", m.curve), _Course(curve.at, at, f"load curve {m.curve}", m.line))
    for name in model.carried:
        for i, values in enumerate(motions[name].values[:, :3].T):
            if values.any():
                line = next(c.line for c in model.conditions if c.body == name and c.freedom == i and c.curve)
                found[name, i] = _interpolated(motions[name], values, name, line)
    return found


def _interpolated(motion: Motion, values: Array, name: str, line: int) -> _Course:
    times = np.asarray(motion.times)
    return _Course(
        lambda t: np.interp(t, times, values), times, f"the motion of the rigid body {name!r}", line
    )


def _times(model: FebModel, courses: Sequence[_Course]) -> Array:
    """Times (k,) from 0 to the end between which everything is linear."""
    end = _end(model)
    every = np.unique(np.concatenate([np.zeros(0), *(course.knots for course in courses)]))
    return np.concatenate([[0.0], every[(every > 0.0) & (every < end * (1.0 - 1e-9))], [end]])


def _end(model: FebModel) -> float:
    return sum(phase.seconds for phase in model.phases)


def _multiple(course: _Course, times: Array, base: Array) -> float:
    values = course.at(times)
    scale = float(values @ base / (base @ base))
    if np.abs(values - scale * base).max() > 1e-9 * np.abs(values).max():
        raise ProblemError(
            f"{course.words} is not a multiple of that of the other motions",
            place=f"line {course.line}",
            remedy="limbfit moves nodes, and bodies that carry tissue, by one history",
        )
    return scale
