"""A FEBio input as limbfit's own problem: same mesh, supports, materials, history and time steps."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from ..arrays import Array, Indices
from ..errors import ProblemError
from ..fe import Activation, Indenter, Pressure, Problem, StepControl, Support
from .drive import Drive, find_drive, group_contacts
from .parts import (
    TissueMesh,
    build_indenter,
    build_rigid_body,
    build_tissue,
    find_rigid_corners,
    find_touched_faces,
)
from .penalty import compute_mean_penalty, find_smallest_depth
from .reading.model import FebModel
from .reading.rigid import merge_knots

MAX_ITERATIONS_PER_STEP = 20  # Newton iterations, in the mean over FEBio's many steps


def to_problem(model: FebModel, indenter: Indenter | None = None, **settings: Any) -> Problem:
    """Convert a FEBio input to a problem.

    FEBio's rigid body consists of faces, which become an indenter of shape ``stl``. If ``indenter`` is given,
    the faces stand for its shape, which is put where the body's foremost point is. Regions have the names of
    the parts.

    Parameters
    ----------
    settings : further fields of `Problem` (``element``, ``contact_rule``, ..).

    Raises
    ------
    ProblemError
        If the input has no deformable part, several element types, or motions that are not one history.
    """
    tissue, driven = build_tissue(model), find_drive(model, shaped=indenter is not None)
    touching, name = group_contacts(model), driven.indenter
    faces, placed = np.zeros((0, 3), np.int64), None
    if touching:
        faces = find_touched_faces(model, next(iter(touching.values())), tissue)
    if driven.axis is not None:
        placed = (
            build_indenter(model, driven.axis, name, find_smallest_depth(tissue.mesh, faces))
            if indenter is None
            else _place_indenter(model, driven.axis, name, indenter)
        )
    elif indenter is not None and touching:
        raise ProblemError("no single rigid body goes straight into the tissue, to stand for an indenter")
    fixed, supports = _build_supports(model, tissue.node_index, driven)
    element = next(iter(model.select_parts(model.materials).values())).element
    friction = 0.0 if placed is None else touching[name][0].friction
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
        fibres=_build_fibres(model, tissue),
        activation=_build_activation(model),
        prestretch=_build_prestretch(model, tissue),
        **{"element": element, "contact_rule": _choose_contact_rule(model, tissue), **settings},
    )


def _build_fibres(model: FebModel, tissue: TissueMesh) -> Array | None:
    """Return the direction of the fibres in every cell, which is arbitrary where there are none."""
    if not model.fibres:
        return None
    found = np.tile([1.0, 0.0, 0.0], (len(tissue.mesh.cells), 1))
    for r, name in enumerate(tissue.mesh.region_names):
        if name in model.fibres:
            found[tissue.mesh.regions == r] = model.fibres[name]
    return found


def _build_prestretch(model: FebModel, tissue: TissueMesh) -> Array | None:
    """Return the pre-strain of every cell, fully grown; the identity where there is none."""
    if not model.prestrains:
        return None
    found = np.tile(np.eye(3), (len(tissue.mesh.cells), 1, 1))
    for r, name in enumerate(tissue.mesh.region_names):
        one = model.prestrains.get(name)
        if one is not None:
            grown = one.factor * (float(model.curves[one.curve].at(0.0)) if one.curve else 1.0)
            found[tissue.mesh.regions == r] = (1.0 - grown) * np.eye(3) + grown * one.gradient
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


def _place_indenter(model: FebModel, axis: Array, name: str, indenter: Indenter) -> Indenter:
    centre = model.rigid[name].centre
    foremost = float(((find_rigid_corners(model, name) - centre) @ axis).max())
    return replace(indenter, centre=centre + foremost * axis, axis=axis)


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
        _check_agreement(model, driven, name)
        if way.any():
            supports += [Support(number[carried], i, float(way[i])) for i in range(3)]
        else:
            nodes.append(number[carried])
    return np.unique(np.concatenate(nodes)) if nodes else np.zeros(0, np.int64), tuple(supports)


def _check_agreement(model: FebModel, driven: Drive, name: str) -> None:
    """Refuse conditions on nodes that a rigid body carries elsewhere."""
    for m, factor in zip(model.motions, driven.factors):
        both = np.isin(m.nodes, model.carried_nodes[name])
        if both.any() and not np.isclose(factor, driven.travel[name][m.component]):
            node = model.geometry.node_ids[m.nodes[both][0]]
            what = f"node {node} of {m.target!r} moves with the rigid body {name!r}, which goes elsewhere"
            raise ProblemError(what, place=f"line {m.line}")


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

    Raises
    ------
    ProblemError
        If some contacts have it, and some have limbfit's own.
    """
    found = {contact.has_penalty for contact in model.contacts}
    if len(found) == 2:
        place = f"line {model.contacts[1].line}, <contact>"
        what = "contacts with a penalty beside augmented or nodal ones are not supported"
        raise ProblemError(what, place=place, remedy="give all of them one laugon")
    return True in found
