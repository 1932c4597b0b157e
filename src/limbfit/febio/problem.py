"""A FEBio input as limbfit's own problem: same mesh, supports, materials, history and time steps."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import ProblemError
from ..fe import ELEMENTS, History, Indenter, Pressure, Problem, RigidSurface, StepControl, Support
from ..fe.kernel.elements import reference_gradients
from ..mesh import Mesh
from ..shapes import SHARP_EDGE
from .controls import step_times
from .geometry import boundary, bulging, refuse_part, triangles
from .model import FebModel, Motion
from .penalty import mean_penalty, thinnest

Array = NDArray[np.float64]
Indices = NDArray[np.int64]


@dataclass(frozen=True)
class Body:
    """The deformable parts as one mesh; ``nodes (n,)`` are the places of its nodes in the model's, ``number``
    the way back (-1: none), ``cell_ids (m,)`` FEBio's numbers."""

    mesh: Mesh
    nodes: Indices
    number: Indices
    cell_ids: Indices


@dataclass(frozen=True)
class Drive:
    """The one history of a problem: advance (mm) in time, and the ``axis (3,)`` of the rigid body, if any.

    ``factors`` of the node motions with respect to it, in their order; ``travel (3,)`` of every rigid body
    per mm of it, by the body's name.
    """

    history: History
    axis: Array | None
    factors: tuple[float, ...]
    travel: Mapping[str, Array]


def to_problem(model: FebModel, indenter: Indenter | None = None, **settings: Any) -> Problem:
    """The problem of a FEBio input.

    FEBio's rigid body is faces, which become an indenter of shape ``stl``; where ``indenter`` is given, they
    stand for its shape, which is put where the body's foremost point is.  Regions carry the names of the
    parts.

    Parameters
    ----------
    settings : further fields of `Problem` (``element``, ``contact_rule``, ..).

    Raises
    ------
    ProblemError
        Where the input has no deformable part, several element types, or motions that are not one history.
    """
    body, driven = deformable_body(model), drive(model)
    faces, placed = np.zeros((0, 3), np.int64), None
    if model.contact is not None:
        faces, name = contact_faces(model, body), touching_body(model)
        depth = thinnest(body.mesh, faces)
        placed = (
            _tool(model, driven, name, depth) if indenter is None else _placed(model, driven, name, indenter)
        )
    fixed, supports = _supports(model, body.number, driven)
    element = next(iter(model.parts_of(model.materials).values())).element
    friction = 0.0 if model.contact is None else model.contact.friction
    rule = "gauss7" if body.mesh.cell_type == "tet10" else "gauss"  # FEBio's quadrature
    if model.contact and model.contact.rule == "sliding-node-on-facet":
        rule = "nodes"
    return Problem(
        mesh=body.mesh,
        materials={
            name: model.materials[model.geometry.parts[name].material] for name in body.mesh.region_names
        },
        fixed=fixed,
        contact_faces=faces,
        indenter=placed,
        history=driven.history,
        supports=supports,
        start="as-given",
        friction=friction or "frictionless",
        pressures=_pressures(model, body),
        **{"element": element, "contact_rule": rule, **settings},
    )


def deformable_body(model: FebModel) -> Body:
    """The deformable parts as one mesh.

    Raises
    ------
    ProblemError
        Where there is none, where their elements differ, or where one is inverted.
    """
    parts = model.parts_of(model.materials)
    if not parts:
        raise ProblemError("no part is made of a deformable material")
    first = next(iter(parts.values()))
    for name, part in parts.items():
        if not part.element:
            raise refuse_part(part, name, "only tet4, tet10 and hex8 can deform")
        if part.element != first.element:
            raise refuse_part(
                part, name, f"all tissue must be of one element type, not also {first.cell_type}"
            )
    cells = np.vstack([part.cells for part in parts.values()])
    ids = np.concatenate([part.ids for part in parts.values()])
    regions = np.repeat(np.arange(len(parts)), [len(part.cells) for part in parts.values()])
    nodes = np.unique(cells)
    number = np.full(len(model.geometry.points), -1)
    number[nodes] = np.arange(len(nodes))
    points = model.geometry.points[nodes]
    mesh = Mesh(points, number[cells], first.cell_type, regions, tuple(parts), _node_sets(model, number))
    _, weights = reference_gradients(ELEMENTS[first.element], points, mesh.cells)
    bad = np.flatnonzero((weights <= 0.0).any(axis=1))
    if len(bad):
        part_name = mesh.region_names[regions[bad[0]]]
        what = f"{len(bad)} elements are inverted or flat, the first is element {ids[bad[0]]}"
        raise refuse_part(parts[part_name], part_name, what)
    return Body(mesh, nodes, number, ids)


def _node_sets(model: FebModel, number: Indices) -> dict[str, Indices]:
    sets = {name: number[nodes] for name, nodes in model.geometry.node_sets.items()}
    return {name: nodes for name, nodes in sets.items() if (nodes >= 0).all()}


def contact_faces(model: FebModel, body: Body) -> Indices:
    """The deformable of the two surfaces in contact, in the numbers of the body's nodes."""
    assert model.contact is not None
    for name in model.contact.surfaces:
        faces = body.number[model.geometry.surfaces[name]]
        if (faces >= 0).all():
            return np.asarray(faces)
    raise ProblemError("neither surface lies on tissue", place=f"line {model.contact.line}, <contact>")


def touching_body(model: FebModel) -> str:
    """The rigid body that one of the surfaces in contact lies on."""
    assert model.contact is not None
    surfaces = [model.geometry.surfaces[name] for name in model.contact.surfaces]
    for name in model.rigid:
        parts = model.parts_of({name: None}).values()
        nodes = np.concatenate([np.zeros(0, np.int64), *(part.cells.ravel() for part in parts)])
        if any(np.isin(surface, nodes).all() for surface in surfaces):
            return name
    place = f"line {model.contact.line}, <contact>"
    raise ProblemError("neither surface is that of a rigid body", place=place)


def drive(model: FebModel) -> Drive:
    """The motions of the input as one history.

    Raises
    ------
    ProblemError
        Where bodies or nodes move by load curves that are not multiples of one another.
    """
    end = sum(phase.seconds for phase in model.phases)
    moving = [m for m in (*model.rigid_motions, *model.motions) if m.factor != 0.0]
    if not moving:
        if not model.pressures:
            raise ProblemError("nothing moves: there is no prescribed displacement, and no pressure")
        still, nowhere = np.zeros(2), {name: np.zeros(3) for name in model.rigid}
        return Drive(History(np.array([0.0, end]), still), None, (0.0,) * len(model.motions), nowhere)
    corners = [model.curves[m.curve].corners for m in moving]
    times = _knots(model, corners, end)
    base = model.curves[moving[0].curve].at(times)
    if not base.any():
        raise ProblemError("nothing moves: the load curve is zero", place=f"line {moving[0].line}")
    scales = {m.curve: _multiple(model.curves[m.curve].at(times), base, m) for m in moving}
    sign = float(np.sign(base[np.abs(base).argmax()]))
    travel = {name: np.zeros(3) for name in model.rigid}
    for m in model.rigid_motions:
        travel[m.target][m.component] += m.factor * scales.get(m.curve, 0.0)
    axis, length = _advance(model, travel)
    factors = tuple(m.factor * scales.get(m.curve, 0.0) * sign / length for m in model.motions)
    travel = {name: sign / length * way for name, way in travel.items()}
    return Drive(History(times, sign * length * base), None if axis is None else sign * axis, factors, travel)


def _knots(model: FebModel, corners: Sequence[Array | None], end: float) -> Array:
    """Times (n,) from 0 to ``end`` between which load curves are linear.

    FEBio knows a curve at the ends of its steps only: there are the knots of what is not linear.
    """
    every = step_times(model.phases, model.curves) if any(c is None for c in corners) else np.zeros(0)
    knots = np.unique(np.concatenate([every, *(c for c in corners if c is not None)]))
    return np.concatenate([[0.0], knots[(knots > 0.0) & (knots < end * (1.0 - 1e-9))], [end]])


def _pressures(model: FebModel, body: Body) -> tuple[Pressure, ...]:
    """The pressures on tissue, over the whole time."""
    found, end = [], sum(phase.seconds for phase in model.phases)
    for load in model.pressures:
        faces = body.number[model.geometry.surfaces[load.surface]]
        if (faces < 0).any():
            what = f"the surface {load.surface!r} of a pressure lies not on tissue"
            raise ProblemError(what, place=f"line {load.line}")
        curve = model.curves[load.curve]
        times = _knots(model, [curve.corners], end)
        found.append(Pressure(faces, times, load.factor * curve.at(times)))
    return tuple(found)


def _advance(model: FebModel, travel: Mapping[str, Array]) -> tuple[Array | None, float]:
    """Direction (3,) of the rigid body that touches tissue and its length, from ``travel`` of all bodies."""
    touching = "" if model.contact is None else touching_body(model)
    for m in model.rigid_motions:
        if travel[m.target].any() and m.target != touching and m.target not in model.carried:
            what = f"the rigid body {m.target!r} moves, and neither touches nor carries tissue"
            raise ProblemError(what, place=f"line {m.line}")
    length = float(np.linalg.norm(travel[touching])) if touching else 0.0
    return (travel[touching] / length, length) if length > 0.0 else (None, 1.0)


def _multiple(values: Array, base: Array, motion: Motion) -> float:
    scale = float(values @ base / (base @ base))
    if np.abs(values - scale * base).max() > 1e-9 * np.abs(values).max():
        raise ProblemError(
            f"load curve {motion.curve} is no multiple of that of the other motions",
            place=f"line {motion.line}",
            remedy="limbfit drives everything by one history",
        )
    return scale


def _supports(model: FebModel, number: Indices, driven: Drive) -> tuple[Indices, tuple[Support, ...]]:
    """Nodes held in all directions, and single components held or moved; rigid bodies carry theirs."""
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
    for name, carried in model.carried.items():
        way = driven.travel[name]
        _check_agreement(model, driven, name)
        if way.any():
            supports += [Support(number[carried], i, float(way[i])) for i in range(3)]
        else:
            nodes.append(number[carried])
    return np.unique(np.concatenate(nodes)) if nodes else np.zeros(0, np.int64), tuple(supports)


def _check_agreement(model: FebModel, driven: Drive, name: str) -> None:
    """Refuse conditions on nodes that a rigid body carries elsewhere."""
    for m, factor in zip(model.motions, driven.factors):
        both = np.isin(m.nodes, model.carried[name])
        if both.any() and not np.isclose(factor, driven.travel[name][m.component]):
            node = model.geometry.node_ids[m.nodes[both][0]]
            what = f"node {node} of {m.target!r} moves with the rigid body {name!r}, which goes elsewhere"
            raise ProblemError(what, place=f"line {m.line}")


def rigid_corners(model: FebModel, name: str) -> Array:
    """Corners (m, 3, 3) of the triangles around a rigid body, mm."""
    return np.asarray(model.geometry.points[triangles(boundary(model.parts_of({name: None}).values()))])


def _along(driven: Drive, name: str) -> Array:
    if driven.axis is None:
        raise ProblemError(f"the rigid body {name!r} that touches the tissue does not move")
    return driven.axis


def _tool(model: FebModel, driven: Drive, name: str, depth: float) -> Indenter:
    """The faces of a rigid body as an indenter whose axis passes through the middle of the body.

    Its sharp edges are rounded by no more than the elements that it touches are deep (``depth``, mm).
    """
    axis = _along(driven, name)
    faces = bulging(model.geometry.points, boundary(model.parts_of({name: None}).values()))
    used, faces = np.unique(faces, return_inverse=True)
    frame = Indenter("sphere", axis=axis).frame
    points = model.geometry.points[used] @ frame.T
    middle = 0.5 * (points.min(axis=0) + points.max(axis=0))
    middle[2] = points[:, 2].max()
    try:
        surface = RigidSurface(points - middle, faces.reshape(-1, 3))
    except ProblemError as error:
        part_name, part = next(iter(model.parts_of({name: None}).items()))
        raise refuse_part(part, part_name, error.what) from None
    sharp = min(SHARP_EDGE, depth / surface.width)
    return Indenter("stl", surface=surface, centre=middle @ frame, axis=axis, sharp=sharp)


def _placed(model: FebModel, driven: Drive, name: str, indenter: Indenter) -> Indenter:
    axis = _along(driven, name)
    centre = model.rigid[name].centre
    foremost = float(((rigid_corners(model, name) - centre) @ axis).max())
    return replace(indenter, centre=centre + foremost * axis, axis=axis)


def step_control(model: FebModel, problem: Problem, **settings: Any) -> StepControl:
    """FEBio's steps in time, its course of the stress in them, a tolerance no looser than its own and, where
    it penalises contact, its penalty.

    Augmented and nodal contact are limbfit's own, which keeps the penetration below 1 % of the depth.
    """
    times = step_times(model.phases, model.curves)
    finest = min(phase.tolerance for phase in model.phases)
    chosen: dict[str, Any] = {
        "times": tuple(times),
        "stress": "linear",
        "tolerance": min(StepControl.tolerance, max(0.1 * finest, 1e-11)),
    }
    if penalised(model):
        assert model.contact is not None
        chosen |= {"penalty": mean_penalty(model.contact, problem, float(times[0])), "penetration": 1.0}
    return StepControl(**{**chosen, **settings})


def penalised(model: FebModel) -> bool:
    """Whether contact has a penalty of FEBio's; augmented and nodal contact are limbfit's own."""
    contact = model.contact
    return contact is not None and not contact.augmented and contact.rule != "sliding-node-on-facet"
