"""Rigid bodies of a FEBio input: their centre of mass, the tissue that they carry, and their motions.

In every step a body is held, displaced, turned, or under a force.

Source: FEBio User Manual 4.0, sections 3.10 (rigid conditions and loads) and 3.13 (steps).
"""

from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Literal

import numpy as np

from ...arrays import Array, Indices, Mask
from ...errors import ProblemError
from ...fe import ELEMENTS, Motion
from ...fe.kernel.elements import compute_reference_gradients
from .geometry import Geometry, Part, collect_nodes, find_node_set, split_into_triangles
from .materials import RigidMaterial
from .timing import ControlPhase, LoadCurve, compute_step_times, read_curve_number
from .tree import XmlNode

_PRISM = ([0, 1, 2, 5], [0, 1, 5, 4], [0, 4, 5, 3])  # three tetrahedra of a penta6
FREEDOMS = "xyzuvw"  # of a rigid body: along the axes, about them
_FIXED, _MOVED = ("rigid_fixed", "fix"), ("rigid_displacement", "rigid_rotation", "prescribe")
_FORCED = ("rigid_force", "rigid_moment", "force")
_RAIL = "rigid prismatic joint"


def compute_centre_of_mass(points: Array, parts: Iterable[Part]) -> Array:
    """Return the centre of mass (3,) of parts of one density, mm.

    Solids count by volume, shells by area times thickness. The centre of a body without volume is the origin,
    as in FEBio.
    """
    total, moment = 0.0, np.zeros(3)
    for part in parts:
        mass, at = _lump_mass(points, part)
        total += float(mass.sum())
        moment += mass @ at
    return moment / total if total > 0.0 else moment


def _lump_mass(points: Array, part: Part) -> tuple[Array, Array]:
    """Return a part as masses (k,) at places (k, 3)."""
    if part.cell_type in ELEMENTS:
        element = ELEMENTS[part.cell_type]
        _, volumes = compute_reference_gradients(element, points, part.cells)
        values, _ = element.shape(element.points)
        return np.abs(volumes).ravel(), np.einsum("qk,mki->mqi", values, points[part.cells]).reshape(-1, 3)
    if part.cell_type == "penta6":
        tets = points[np.concatenate([part.cells[:, corners] for corners in _PRISM])]
        return np.abs(np.linalg.det(tets[:, 1:] - tets[:, :1])) / 6.0, tets.mean(axis=1)
    corners = part.cells[:, : 4 if part.cell_type == "quad4" else 3]
    flat = points[split_into_triangles(corners)]
    area = 0.5 * np.linalg.norm(np.cross(flat[:, 1] - flat[:, 0], flat[:, 2] - flat[:, 0]), axis=1)
    return part.thickness * area, flat.mean(axis=1)


def find_carried_nodes(
    geometry: Geometry,
    soft: Collection[str],
    bodies: Collection[str],
    conditions: Sequence[tuple[str, XmlNode]],
) -> dict[str, Indices]:
    """Find the nodes of tissue that move with each rigid body: those of its own parts, and sets tied to it.

    Raises `ProblemError` for a node that two bodies would carry.

    ``soft``, ``bodies``: names of the deformable and of the rigid materials; ``conditions``: rigid body and
    ``<bc type="rigid">`` of every set that is tied.
    """
    tissue = collect_nodes(geometry.select_parts(soft).values())
    found = {}
    for name in bodies:
        found[name] = np.intersect1d(collect_nodes(geometry.select_parts([name]).values()), tissue)
    for name, condition in conditions:
        nodes = find_node_set(geometry, condition.attribute("node_set"), condition)
        found[name] = np.union1d(found[name], np.intersect1d(nodes, tissue))
    for (one, nodes), (other, others) in combinations(found.items(), 2):
        if len(twice := np.intersect1d(nodes, others)):
            number = geometry.node_ids[twice[0]]
            raise ProblemError(f"node {number} is of two rigid bodies, {one!r} and {other!r}")
    return {name: nodes for name, nodes in found.items() if len(nodes)}


@dataclass(frozen=True)
class RigidCondition:
    """One freedom of a rigid body, held, moved by ``factor`` times a load curve, or under such a force.

    ``step`` is the step of the analysis that it belongs to; None: all.
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
    """A joint that lets a rigid body go ``along (3,)`` a line only, beside a fixed body (``base``)."""

    body: str
    base: str
    along: Array
    line: int


def read_rails(root: XmlNode, rigid: Mapping[str, RigidMaterial]) -> tuple[RigidRail, ...]:
    """Read the prismatic joints of rigid bodies.

    Raises `ProblemError` for those that move a body themselves, or are there in some steps only.
    """
    found: list[RigidRail] = []
    for node in root.find("Rigid") or ():
        if node.tag != "rigid_connector" or node.attribute("type") != _RAIL:
            continue
        if node.flag("prescribed_translation") or node.number("force", 0.0) != 0.0:
            raise node.error("a joint that moves its body is not supported", "give the body a rigid_force")
        base, body = (find_body(node, rigid, tag) for tag in ("body_a", "body_b"))
        axis = node.find("translation_axis")
        along = np.array([1.0, 0.0, 0.0] if axis is None else axis.numbers(3))
        if not along.any() or base == body or body in {rail.body for rail in found}:
            raise node.error("needs an axis and two bodies of which it alone guides the second")
        found.append(RigidRail(body, base, along / np.linalg.norm(along), node.line))
    return tuple(found)


def read_conditions(
    root: XmlNode, rigid: Mapping[str, RigidMaterial], curves: Mapping[int, LoadCurve]
) -> tuple[RigidCondition, ...]:
    """Read the conditions and loads of rigid bodies, those of single steps among them.

    Raises `ProblemError` for connectors, loads that follow, and whatever else limbfit does not support.
    """
    sections: list[tuple[XmlNode | None, int | None]] = [(root.find("Rigid"), None)]
    sections += [(step.find("Rigid"), number) for number, step in enumerate(root.find("Step") or ())]
    found: list[RigidCondition] = []
    for section, step in sections:
        for node in section or ():
            if not (step is None and node.tag == "rigid_connector" and node.attribute("type") == _RAIL):
                found += _read_condition(node, rigid, curves, step)
    return tuple(found)


def _read_condition(
    node: XmlNode, rigid: Mapping[str, RigidMaterial], curves: Mapping[int, LoadCurve], step: int | None
) -> Iterator[RigidCondition]:
    kind = node.attribute("type")
    if node.tag not in ("rigid_bc", "rigid_constraint", "rigid_load"):
        raise node.error(f"{kind!r} is not supported", f"limbfit knows no joint but the {_RAIL}")
    if kind not in (*_FIXED, *_MOVED, *_FORCED):
        raise node.error(f"rigid condition {kind!r} is not supported")
    name = find_body(node, rigid)
    if kind in _FIXED:
        for freedom in read_fixed(node, FREEDOMS, "R"):
            yield RigidCondition(name, freedom, "fixed", 0.0, 0, step, node.line)
        return
    if kind in _FORCED and node.string("load_type", "LOAD").upper() not in ("LOAD", "0"):
        raise node.child("load_type").error("a force that follows the body, or ramps up, is not supported")
    freedom, factor, curve = read_drive(node, FREEDOMS, curves)
    yield RigidCondition(
        name, freedom, "forced" if kind in _FORCED else "moved", factor, curve, step, node.line
    )


def find_body(condition: XmlNode, rigid: Mapping[str, RigidMaterial], tag: str = "rb") -> str:
    """Return the name of the rigid body that a condition is about; it gives its name or its number."""
    names = {str(body.number): name for name, body in rigid.items()}
    name = names.get(condition.string(tag), condition.string(tag))
    if name not in rigid:
        raise condition.error(f"there is no rigid body {name!r}")
    return name


def read_fixed(condition: XmlNode, letters: str, prefix: str = "") -> list[int]:
    """Read which freedoms are held: FEBio 3 lists their letters, FEBio 4 has a flag for each."""
    listed = [dof.strip().lower().removeprefix("r") for dof in condition.string("dofs", "").split(",")]
    held = (letter in listed or condition.flag(f"{prefix}{letter}_dof") for letter in letters)
    return [i for i, is_held in enumerate(held) if is_held]


def read_drive(condition: XmlNode, letters: str, curves: Mapping[int, LoadCurve]) -> tuple[int, float, int]:
    """Read the freedom that is moved, or under a force, with factor and load curve."""
    dof = condition.string("dof").lower().removeprefix("r")  # Rx, ..; FEBio 3 has a number for a load's
    if dof not in tuple(letters):
        raise condition.error(f"degree of freedom {condition.string('dof')!r} is not supported")
    if condition.flag("relative"):
        raise condition.child("relative").error("relative displacements and forces are not supported")
    value = condition.find("value")  # FEBio 3 calls that of a motion its scale
    return letters.index(dof), *read_factor(condition.child("scale") if value is None else value, curves)


def read_factor(value: XmlNode, curves: Mapping[int, LoadCurve]) -> tuple[float, int]:
    """Read factor and load curve of a value; 0 and no curve if it is zero."""
    factor, number = value.scalar(), read_curve_number(value, curves)
    if factor == 0.0:
        return 0.0, 0
    if not number:
        raise value.error("needs a load curve")
    return factor, number


def merge_knots(curves: Sequence[LoadCurve], every: Array, start: float, end: float) -> Array:
    """Return times (n,) from ``start`` to ``end`` between which the curves are linear.

    FEBio knows a curve at the ends of its steps only (``every (k,)``): these are the knots of a curve that is
    not linear.
    """
    corners = (curve.corners for curve in curves)
    return merge_times([every if c is None else c for c in corners], start, end)


def merge_times(knots: Sequence[Array], start: float, end: float) -> Array:
    """Return the times (n,) of all ``knots`` (k,) between ``start`` and ``end``, and these two."""
    inner, tiny = np.unique(np.concatenate([np.zeros(0), *knots])), 1e-9 * end
    return np.concatenate([[start], inner[(inner > start + tiny) & (inner < end - tiny)], [end]])


def build_motion(
    name: str,
    conditions: Sequence[RigidCondition],
    curves: Mapping[int, LoadCurve],
    phases: Sequence[ControlPhase],
) -> Motion:
    """Build the motion of the rigid body ``name``: along and about the axes of space, mm, rad, N and N mm.

    What is neither held nor moved in a step is free: a force drives it, of 0 if none is given.

    Raises `ProblemError` if a step holds what was free before it, or if it would turn about several axes.
    """
    own = [condition for condition in conditions if condition.body == name]
    every, end = compute_step_times(tuple(phases), curves), 0.0
    times, values, forced = np.zeros(0), np.zeros((0, 6)), np.zeros((0, 6), dtype=bool)
    for number, phase in enumerate(phases):
        begin, end = end, end + phase.seconds
        active = [c for c in own if c.step in (None, number)]
        at = merge_knots([curves[c.curve] for c in active if c.curve], every, begin, end)
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
    if not has_same_rotation(values, forced):
        lines = [c.line for c in own if c.freedom > 2 and c.kind != "fixed"]
        what = f"the rigid body {name!r} turns about more than one axis"
        place = f"line {lines[0]}" if lines else "<Rigid>"
        raise ProblemError(what, place=place, remedy="hold two of Ru, Rv, Rw, or leave all three free")
    return Motion(times, values, forced)


def restrict_to_rail(motion: Motion, rail: RigidRail) -> Motion:
    """Return the motion of a body that a joint guides, in a frame whose third axis is that of the joint.

    The joint bears what forces have across it.

    Raises `ProblemError` if something else than forces drives the body.
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


def has_same_rotation(values: Array, forced: Mask) -> bool:
    """True if FEBio, which adds turns up step by step, and limbfit's one rotation vector agree on a motion.

    ``values (n, 6)``, ``forced (n - 1, 6)``: they agree if it turns about one line, or if no given angle
    turns it.
    """
    free = np.asarray(forced.any(axis=0))[3:]
    turns = np.where(free, 0.0, values[:, 3:])
    if free.any():
        pushed = values[:, 3:].any()  # moments about three free axes would turn with the body
        return bool(not turns.any() and (free.sum() == 1 or (free.all() and not pushed)))
    longest = turns[np.linalg.norm(turns, axis=1).argmax()]
    return bool(np.abs(np.cross(turns, longest)).max() <= 1e-9 * (longest @ longest))


def find_straight_line(motion: Motion) -> tuple[Array, Array] | None:
    """Return direction (3,) and advance (n,) mm of a motion along a line; None for any other motion."""
    lengths = np.linalg.norm(motion.values[:, :3], axis=1)
    turns_or_free = np.asarray(motion.forced).any() or motion.values[:, 3:].any()
    if turns_or_free or (np.diff(motion.times) == 0).any() or not lengths.any():
        return None
    direction = motion.values[lengths.argmax(), :3] / lengths.max()
    advance = motion.values[:, :3] @ direction
    off = np.abs(motion.values[:, :3] - advance[:, None] * direction).max()
    return (direction, advance) if off <= 1e-12 * lengths.max() else None
