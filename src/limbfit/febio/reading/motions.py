"""What moves the rigid bodies of a FEBio input, step by step: held, displaced, turned, or under a force.

Source: FEBio User Manual 4.0, sections 3.10 (rigid conditions and loads) and 3.13 (steps).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from ...errors import ProblemError
from ...fe import Motion
from .controls import ControlPhase, step_times
from .curves import Curve
from .materials import RigidMaterial
from .tree import Node

Array = NDArray[np.float64]
FREEDOMS = "xyzuvw"  # of a rigid body: along the axes, about them
_FIXED, _MOVED = ("rigid_fixed", "fix"), ("rigid_displacement", "rigid_rotation", "prescribe")
_FORCED = ("rigid_force", "rigid_moment", "force")
_RAIL = "rigid prismatic joint"


@dataclass(frozen=True)
class RigidCondition:
    """One freedom of a rigid body, held, moved by ``factor`` times a load curve, or under such a force.

    ``step``: the step of the analysis that it belongs to; None: all.
    """

    body: str
    freedom: int
    kind: Literal["fixed", "moved", "forced"]
    factor: float
    curve: int
    step: int | None
    line: int


@dataclass(frozen=True)
class RigidRail:
    """A joint that lets a rigid body go ``along (3,)`` a line only, beside a fixed one (``base``)."""

    body: str
    base: str
    along: Array
    line: int


def read_rails(root: Node, rigid: Mapping[str, RigidMaterial]) -> tuple[RigidRail, ...]:
    """The prismatic joints of rigid bodies.

    Raises
    ------
    ProblemError
        For those that move a body themselves, or are there in some steps only.
    """
    found: list[RigidRail] = []
    for node in root.find("Rigid") or ():
        if node.tag != "rigid_connector" or node.attribute("type") != _RAIL:
            continue
        if node.flag("prescribed_translation") or node.number("force", 0.0) != 0.0:
            raise node.refuse("a joint that moves its body is not supported", "give the body a rigid_force")
        base, body = (body_of(node, rigid, tag) for tag in ("body_a", "body_b"))
        axis = node.find("translation_axis")
        along = np.array([1.0, 0.0, 0.0] if axis is None else axis.numbers(3))
        if not along.any() or base == body or body in {rail.body for rail in found}:
            raise node.refuse("needs an axis and two bodies of which it alone guides the second")
        found.append(RigidRail(body, base, along / np.linalg.norm(along), node.line))
    return tuple(found)


def read_conditions(
    root: Node, rigid: Mapping[str, RigidMaterial], curves: Mapping[int, Curve]
) -> tuple[RigidCondition, ...]:
    """The conditions and loads of rigid bodies, those of single steps among them.

    Raises
    ------
    ProblemError
        For connectors, loads that follow, and whatever else limbfit does not know.
    """
    sections: list[tuple[Node | None, int | None]] = [(root.find("Rigid"), None)]
    sections += [(step.find("Rigid"), number) for number, step in enumerate(root.find("Step") or ())]
    found: list[RigidCondition] = []
    for section, step in sections:
        for node in section or ():
            if not (step is None and node.tag == "rigid_connector" and node.attribute("type") == _RAIL):
                found += _conditions(node, rigid, curves, step)
    return tuple(found)


def _conditions(
    node: Node, rigid: Mapping[str, RigidMaterial], curves: Mapping[int, Curve], step: int | None
) -> Iterator[RigidCondition]:
    kind = node.attribute("type")
    if node.tag not in ("rigid_bc", "rigid_constraint", "rigid_load"):
        raise node.refuse(f"{kind!r} is not supported", f"limbfit knows no joint but the {_RAIL}")
    if kind not in (*_FIXED, *_MOVED, *_FORCED):
        raise node.refuse(f"rigid condition {kind!r} is not supported")
    name = body_of(node, rigid)
    if kind in _FIXED:
        for letter in sorted(_fixed(node)):
            yield RigidCondition(name, FREEDOMS.index(letter), "fixed", 0.0, 0, step, node.line)
        return
    dof = node.string("dof").lower().removeprefix("r")  # Rx, ..; FEBio 3 has a number for a load's
    if dof not in tuple(FREEDOMS):
        raise node.refuse(f"degree of freedom {node.string('dof')!r} is not supported")
    if node.flag("relative"):
        raise node.child("relative").refuse("relative displacements and forces are not supported")
    if kind in _FORCED and node.string("load_type", "LOAD").upper() not in ("LOAD", "0"):
        raise node.child("load_type").refuse("a force that follows the body, or ramps up, is not supported")
    factor, curve = curved(amount(node), curves)
    yield RigidCondition(
        name, FREEDOMS.index(dof), "forced" if kind in _FORCED else "moved", factor, curve, step, node.line
    )


def body_of(condition: Node, rigid: Mapping[str, RigidMaterial], tag: str = "rb") -> str:
    """The name of the rigid body that a condition is about; it gives its name or its number."""
    names = {str(body.number): name for name, body in rigid.items()}
    name = names.get(condition.string(tag), condition.string(tag))
    if name not in rigid:
        raise condition.refuse(f"there is no rigid body {name!r}")
    return name


def _fixed(condition: Node) -> set[str]:
    """What a ``rigid_fixed`` (FEBio 3: ``fix``) holds, of `FREEDOMS`."""
    listed = [dof.strip().lower().removeprefix("r") for dof in condition.string("dofs", "").split(",")]
    return {letter for letter in FREEDOMS if letter in listed or condition.flag(f"R{letter}_dof")}


def amount(condition: Node) -> Node:
    """What a prescribed motion amounts to; FEBio 3 calls it a scale."""
    value = condition.find("value")
    return condition.child("scale") if value is None else value


def curved(value: Node, curves: Mapping[int, Curve]) -> tuple[float, int]:
    """Factor and load curve of an amount; 0 and no curve where it is nothing."""
    factor, number = value.scalar(), value.attributes.get("lc", "")
    if factor == 0.0:
        return 0.0, 0
    if not (number.isdecimal() and int(number) in curves):
        raise value.refuse(f"there is no load curve {number!r}" if number else "needs a load curve")
    return factor, int(number)


def knots(curves: Sequence[Curve], every: Array, start: float, end: float) -> Array:
    """Times (n,) from ``start`` to ``end`` between which the curves are linear.

    FEBio knows a curve at the ends of its steps only (``every (k,)``): there are the knots of what is not
    linear.
    """
    corners = [curve.corners for curve in curves]
    inner = np.unique(np.concatenate([np.zeros(0), *(every if c is None else c for c in corners)]))
    tiny = 1e-9 * end
    return np.concatenate([[start], inner[(inner > start + tiny) & (inner < end - tiny)], [end]])


def rigid_motion(
    name: str,
    conditions: Sequence[RigidCondition],
    curves: Mapping[int, Curve],
    phases: Sequence[ControlPhase],
) -> Motion:
    """What moves the rigid body ``name``: along and about the axes of space, mm, rad, N and N mm.

    What is neither held nor moved in a step is free: a force drives it, of 0 where none is given.

    Raises
    ------
    ProblemError
        Where a step holds what was free before it, and where it would turn about several axes.
    """
    own = [condition for condition in conditions if condition.body == name]
    every, end = step_times(tuple(phases), curves), 0.0
    times, values, forced = np.zeros(0), np.zeros((0, 6)), np.zeros((0, 6), dtype=bool)
    for number, phase in enumerate(phases):
        begin, end = end, end + phase.seconds
        active = [c for c in own if c.step in (None, number)]
        at = knots([curves[c.curve] for c in active if c.curve], every, begin, end)
        value, under = np.zeros((len(at), 6)), np.ones(6, dtype=bool)
        for freedom in range(6):
            here = [c for c in active if c.freedom == freedom]
            moved, held = [c for c in here if c.kind == "moved"], [c for c in here if c.kind == "fixed"]
            under[freedom] = not (moved or held)
            for c in here if under[freedom] else moved:
                if c.curve:
                    value[:, freedom] += c.factor * curves[c.curve].at(at)
            if held and not moved and len(times):
                if forced[-1, freedom]:
                    what = f"the rigid body {name!r} is held in R{FREEDOMS[freedom]} after it was free"
                    raise ProblemError(what, place=f"line {held[0].line}", remedy="give it a displacement")
                value[:, freedom] = values[-1, freedom]
        later = len(times) > 0
        goes_on = later and np.array_equal(under, forced[-1]) and np.array_equal(value[0], values[-1])
        first = int(goes_on)
        between = len(at) - 1 + int(later and not goes_on)  # an interval of no time parts two drives
        times, values = np.concatenate([times, at[first:]]), np.concatenate([values, value[first:]])
        forced = np.concatenate([forced, np.broadcast_to(under, (between, 6))])
    if not agrees_in_turning(values, forced):
        lines = [c.line for c in own if c.freedom > 2 and c.kind != "fixed"]
        raise ProblemError(
            f"the rigid body {name!r} turns about more than one axis",
            place=f"line {lines[0]}" if lines else "<Rigid>",
            remedy="hold two of Ru, Rv, Rw, or leave all three free",
        )
    return Motion(times, values, forced)


def on_rail(motion: Motion, rail: RigidRail) -> Motion:
    """The motion of a body that a joint guides, in a frame whose third axis is that of the joint.

    The joint bears what forces have across it.

    Raises
    ------
    ProblemError
        Where something else than forces drives the body.
    """
    forced, values = np.asarray(motion.forced), np.zeros_like(motion.values)
    values[:, 2] = motion.values[:, :3] @ rail.along
    under = np.asarray(forced.all(axis=1))
    still = np.append(~under, False) | np.append(False, ~under)  # rows between which it is moved
    off = np.abs(motion.values[:, :3] - values[:, 2:3] * rail.along)[still].max(initial=0.0)
    if not (under | ~forced.any(axis=1)).all() or motion.values[:, 3:].any() or off > 1e-9:
        what = f"the rigid body {rail.body!r} is guided by a joint, and held, moved or turned otherwise"
        raise ProblemError(what, place=f"line {rail.line}, <rigid_connector>", remedy="give it forces only")
    return Motion(motion.times, values, under[:, None] & (np.arange(6) == 2))


def agrees_in_turning(values: Array, forced: NDArray[np.bool_]) -> bool:
    """Whether FEBio, which adds turns up step by step, and limbfit's one rotation vector agree on a motion.

    ``values (n, 6)``, ``forced (n - 1, 6)``: they do where it turns about one line, and where nothing
    stated turns it.
    """
    free = np.asarray(forced.any(axis=0))[3:]
    turns = np.where(free, 0.0, values[:, 3:])
    if free.any():
        pushed = values[:, 3:].any()  # moments about three free axes would turn with the body
        return bool(not turns.any() and (free.sum() == 1 or (free.all() and not pushed)))
    longest = turns[np.linalg.norm(turns, axis=1).argmax()]
    return bool(np.abs(np.cross(turns, longest)).max() <= 1e-9 * (longest @ longest))


def straight(motion: Motion) -> tuple[Array, Array] | None:
    """Direction (3,) and advance (n,) mm of a motion along a line; None for any other, and for none."""
    still = (
        np.asarray(motion.forced).any() or motion.values[:, 3:].any() or (np.diff(motion.times) == 0).any()
    )
    lengths = np.linalg.norm(motion.values[:, :3], axis=1)
    if still or not lengths.any():
        return None
    direction = motion.values[lengths.argmax(), :3] / lengths.max()
    advance = motion.values[:, :3] @ direction
    off = np.abs(motion.values[:, :3] - advance[:, None] * direction).max()
    return (direction, advance) if off <= 1e-12 * lengths.max() else None


def names_of_free(motion: Motion) -> str:
    """The freedoms that nothing holds at some time, as FEBio calls them."""
    return ", ".join(f"R{letter}" for letter, free in zip(FREEDOMS, motion.free) if free)


def turns_of(motion: Motion) -> bool:
    """Whether a motion turns its body at a stated angle."""
    return any(values.any() for values in motion.values[:, 3:].T)
