"""A FEBio input as limbfit's own problem: same mesh, supports, materials, history and time steps.

A single body that goes straight in is an indenter. Its advance is the history, and everything else is a
multiple of it. Bodies that turn, that forces drive, or that are open, and several bodies at once, have
motions of their own. Then the history is that of prescribed nodes, and of bodies that carry tissue.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ..arrays import Array, Indices
from ..errors import ProblemError
from ..fe import Activation, History, Indenter, Motion, Pressure, Problem, StepControl, Support
from .parts import TissueMesh, build_indenter, build_rigid_body, build_tissue, find_touched_faces, is_hollow
from .penalty import compute_mean_penalty, find_smallest_depth
from .reading.geometry import collect_nodes, find_boundary_faces, is_closed
from .reading.model import Contact, FebModel
from .reading.rigid import (
    FREEDOMS,
    build_motion,
    find_straight_line,
    merge_knots,
    merge_times,
    restrict_to_rail,
)

MAX_ITERATIONS_PER_STEP = 20  # Newton iterations, in the mean over FEBio's many steps


def to_problem(model: FebModel, indenter: Indenter | None = None, **settings: Any) -> Problem:
    """Convert a FEBio input to a problem.

    FEBio's rigid body consists of faces, which become an indenter of shape ``stl``. If ``indenter`` is given,
    the faces stand for its shape, which is put where the body's foremost point is. Regions have the names of
    the parts.

    Raises `ProblemError` if the input has no deformable part, several element types, or motions that are not
    one history.

    ``settings``: further fields of `Problem` (``element``, ``contact_rule``, ..).
    """
    tissue, driven = build_tissue(model), find_drive(model, shaped=indenter is not None)
    touching, name = group_contacts(model), driven.indenter
    faces, placed = np.zeros((0, 3), np.int64), None
    if touching:
        faces = find_touched_faces(model, next(iter(touching.values())), tissue)
    if indenter is None and driven.axis is not None:
        placed = build_indenter(model, driven.axis, name, find_smallest_depth(tissue.mesh, faces))
    elif indenter is not None and driven.axis is not None:
        centre = model.rigid[name].centre
        nodes = np.concatenate(find_boundary_faces(model.geometry.select_parts([name]).values()))
        foremost = float(((model.geometry.points[nodes] - centre) @ driven.axis).max())
        placed = replace(indenter, centre=centre + foremost * driven.axis, axis=driven.axis)
    elif indenter is not None and touching:
        raise ProblemError("no single rigid body goes straight into the tissue, to stand for an indenter")
    fixed, supports = _build_supports(model, tissue.node_index, driven)
    element = next(iter(model.geometry.select_parts(model.materials).values())).element
    friction = 0.0 if placed is None else touching[name][0].friction
    prestrains = {}  # of a part's cells (m, 3, 3), fully grown
    for part, one in model.prestrains.items():
        grown = one.factor * (float(model.curves[one.curve].at(0.0)) if one.curve else 1.0)
        prestrains[part] = (1.0 - grown) * np.eye(3) + grown * one.gradient
    return Problem(
        mesh=tissue.mesh,
        materials={
            name: model.materials[model.geometry.parts[name].material] for name in tissue.mesh.region_names
        },
        fixed=fixed,
        contact_faces=faces,
        indenter=placed,
        history=driven.history,
        supports=supports,
        start="as-given",
        friction=friction or "frictionless",
        sticking="anchored" if placed is None else touching[name][0].sticking,
        bodies=tuple(
            build_rigid_body(model, name, touching[name], motion, tissue)
            for name, motion in driven.motions.items()
        ),
        pressures=_build_pressures(model, tissue),
        fibres=_fill_cells(tissue, model.fibres, np.array([1.0, 0.0, 0.0])),
        activation=_build_activation(model),
        prestretch=_fill_cells(tissue, prestrains, np.eye(3)),
        **{"element": element, "contact_rule": _choose_contact_rule(model, tissue), **settings},
    )


def _fill_cells(tissue: TissueMesh, by_part: Mapping[str, Array], elsewhere: Array) -> Array | None:
    """Return a value of every cell (m, ...) from those of some parts; None if no part has any."""
    if not by_part:
        return None
    found = np.tile(elsewhere, (len(tissue.mesh.cells), *np.ones(elsewhere.ndim, dtype=int)))
    for r, name in enumerate(tissue.mesh.region_names):
        if name in by_part:
            found[tissue.mesh.regions == r] = by_part[name]
    return found


def _build_activation(model: FebModel) -> Activation | None:
    """Return the one course of all contractions."""
    if not model.contractions:
        return None
    end, every = model.end_s, model.step_times
    curves = [model.curves[one.curve] for one in model.contractions if one.curve]
    times = merge_knots(curves, every, 0.0, end)
    courses = [
        model.curves[one.curve].at(times) if one.curve else np.ones(len(times)) for one in model.contractions
    ]
    for one, course in zip(model.contractions, courses):
        if np.abs(course - courses[0]).max() > 1e-9 * np.abs(courses[0]).max():
            other = model.contractions[0].material
            what = f"the contraction of {one.material!r} has another course than that of {other!r}"
            raise ProblemError(what, place=f"line {one.line}, <solid>", remedy="give all one load curve")
    return Activation(times, courses[0])


def _choose_contact_rule(model: FebModel, tissue: TissueMesh) -> str:
    """Choose where FEBio's contact acts."""
    nodal = {contact.rule == "sliding-node-on-facet" for contact in model.contacts}
    if len(nodal) == 2:
        place = f"line {model.contacts[1].line}, <contact>"
        raise ProblemError("contact at nodes and on faces in one input is not supported", place=place)
    if True in nodal:
        return "nodes"
    return "gauss7" if tissue.mesh.cell_type == "tet10" else "gauss"  # FEBio's quadrature


def _build_pressures(model: FebModel, tissue: TissueMesh) -> tuple[Pressure, ...]:
    """Return the pressures on tissue, over the whole time."""
    found = []
    for load in model.pressures:
        faces = tissue.node_index[model.geometry.surfaces[load.surface]]
        if (faces < 0).any():
            what = f"the surface {load.surface!r} of a pressure does not lie on tissue"
            raise ProblemError(what, place=f"line {load.line}")
        curve = model.curves[load.curve]
        times = merge_knots([curve], model.step_times, 0.0, model.end_s)
        found.append(Pressure(faces, times, load.factor * curve.at(times)))
    return tuple(found)


def _build_supports(model: FebModel, number: Indices, driven: Drive) -> tuple[Indices, tuple[Support, ...]]:
    """Return nodes held in all directions, and single components held or moved; rigid bodies carry theirs."""
    held: dict[str, set[int]] = {}
    for m in model.motions:
        if (number[m.nodes] < 0).any():
            raise ProblemError(f"node set {m.target!r} has nodes of no tissue", place=f"line {m.line}")
        if m.factor == 0.0:
            held.setdefault(m.target, set()).add(m.component)
    clamped = {target: nodes for target, nodes in held.items() if len(nodes) == 3}
    nodes = [number[m.nodes] for m in model.motions if m.target in clamped]
    supports = [
        Support(number[m.nodes], m.component, factor)
        for m, factor in zip(model.motions, driven.factors)
        if m.target not in clamped
    ]
    for name, carried in model.carried_nodes.items():
        way = driven.travel[name]
        for m, factor in zip(model.motions, driven.factors):
            both = np.isin(m.nodes, carried)
            if both.any() and not np.isclose(factor, way[m.component]):
                node = model.geometry.node_ids[m.nodes[both][0]]
                what = f"node {node} of {m.target!r} moves with the rigid body {name!r}, which goes elsewhere"
                raise ProblemError(what, place=f"line {m.line}")
        if way.any():
            supports += [Support(number[carried], i, float(way[i])) for i in range(3)]
        else:
            nodes.append(number[carried])
    return np.unique(np.concatenate(nodes)) if nodes else np.zeros(0, np.int64), tuple(supports)


def build_step_control(model: FebModel, problem: Problem, **settings: Any) -> StepControl:
    """Build the step control that follows FEBio.

    It has FEBio's steps in time, its course of the stress in them, a tolerance no looser than its own and,
    where FEBio penalises contact, its penalty. Augmented and nodal contact are limbfit's own, which keeps the
    penetration below 1 % of the depth.
    """
    times = model.step_times
    finest = min(phase.tolerance for phase in model.phases)
    chosen: dict[str, Any] = {
        "times": tuple(times),
        "stress": "linear",
        "tolerance": min(StepControl.tolerance, max(0.1 * finest, 1e-11)),
        "most_iterations": max(StepControl.most_iterations, MAX_ITERATIONS_PER_STEP * len(times)),
    }
    if has_penalty(model):
        penalty = compute_mean_penalty(model.contacts[0], problem, float(times[0]))
        chosen |= {"penalty": penalty, "penetration": 1.0, "hold_penalty": problem.indenter is None}
    return StepControl(**{**chosen, **settings})


def has_penalty(model: FebModel) -> bool:
    """True if contact has FEBio's penalty.

    Raises `ProblemError` if some contacts have it, and some have limbfit's own.
    """
    found = {contact.has_penalty for contact in model.contacts}
    if len(found) == 2:
        place = f"line {model.contacts[1].line}, <contact>"
        what = "contacts with a penalty beside augmented or nodal ones are not supported"
        raise ProblemError(what, place=place, remedy="give all of them one laugon")
    return True in found


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

    Raises `ProblemError` if no rigid body is in a contact, or if the contacts of one body differ.
    """
    found: dict[str, tuple[Contact, ...]] = {}
    for contact in model.contacts:
        name = find_touching_body(model, contact)
        found[name] = (*found.get(name, ()), contact)
        if replace(contact, surfaces=found[name][0].surfaces, line=found[name][0].line) != found[name][0]:
            what = f"the contacts of the rigid body {name!r} differ in law, penalty or friction"
            raise ProblemError(what, place=f"line {contact.line}, <contact>", remedy="state them alike")
    return found


def find_touching_body(model: FebModel, contact: Contact) -> str:
    """Find the rigid body that one of the surfaces in contact lies on."""
    surfaces = [model.geometry.surfaces[name] for name in contact.surfaces]
    for name in model.rigid:
        nodes = collect_nodes(model.geometry.select_parts([name]).values())
        if any(np.isin(surface, nodes).all() for surface in surfaces):
            return name
    place = f"line {contact.line}, <contact>"
    raise ProblemError("neither surface is that of a rigid body", place=place)


def find_drive(model: FebModel, shaped: bool = False) -> Drive:
    """Find what drives the problem of an input.

    Raises `ProblemError` if nodes, or bodies that carry tissue, move by load curves that are not
    multiples of one another, and for motions that limbfit does not support.

    ``shaped``: True if a shape is given for the body that goes straight in, whose own faces may then be open.
    """
    touching, motions = group_contacts(model), _read_body_motions(model)
    bodies = {name: motions[name] for name in touching}
    courses = _find_followers(model, motions)
    if len(bodies) == 1:
        (name,) = bodies
        line = find_straight_line(bodies[name])
        around = find_boundary_faces(model.geometry.select_parts([name]).values())
        if line is not None and (
            shaped or (is_closed(around) and not is_hollow(model, name, touching[name]))
        ):
            direction, advance = line
            course = _interpolate_motion(bodies[name], advance, name, 0)
            followers = [course, *courses.values()]
            times = merge_times([one.knots for one in followers], 0.0, model.end_s)
            base = course.at(times)
            try:
                return _scale_to_history(model, courses, times, base, name, direction, {})
            except ProblemError:  # nodes go their own way: the body has a motion of its own
                pass
    moving = list(courses.values())
    driven = any(motion.values.any() for motion in bodies.values())
    times = merge_times([one.knots for one in moving], 0.0, model.end_s)
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
        if not model.geometry.select_parts([name]) and name not in model.carried_nodes:
            continue
        motion = build_motion(name, model.conditions, model.curves, model.phases)
        if name in rails:
            motion = restrict_to_rail(motion, rails[name])
        found[name] = motion
        place = f"line {body.line}, <material>"
        if name in model.carried_nodes and motion.free.any():
            freedoms = ", ".join(f"R{letter}" for letter, free in zip(FREEDOMS, motion.free) if free)
            what = f"the rigid body {name!r} is neither fixed nor displaced in {freedoms}"
            remedy = "limbfit solves only for bodies that carry no tissue: fix it there with rigid_fixed"
            raise ProblemError(what, place=place, remedy=remedy)
        lines = [c.line for c in model.conditions if c.body == name and c.kind != "fixed" and c.curve]
        if name in model.carried_nodes and motion.values[:, 3:].any():
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


def _find_factor(course: _FollowingCurve, times: Array, history: Array) -> float:
    values = course.at(times)
    scale = float(values @ history / (history @ history))
    if np.abs(values - scale * history).max() > 1e-9 * np.abs(values).max():
        what = f"{course.words} is not a multiple of that of the other motions"
        remedy = "limbfit moves nodes, and bodies that carry tissue, by one history"
        raise ProblemError(what, place=f"line {course.line}", remedy=remedy)
    return scale
