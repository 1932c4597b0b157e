"""Inputs of FEBio 3 and 4 (``.feb``): mesh, named sets, materials, conditions, contact, time and output.

Everything is read that an indentation needs. A part of the format that would change the mechanics and is not
supported is an error that names its line; it is never skipped (FEBio User Manual 4.0, chapter 3).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from ...arrays import Array, Indices
from ...errors import ProblemError
from ...fe import Material
from .controls import ControlPhase, compute_step_times, read_phases
from .curves import LoadCurve, read_curves
from .geometry import Geometry, Part, find_node_set, read_geometry
from .materials import RigidMaterial, read_materials
from .requests import Request, read_requests
from .rigid import (
    RigidCondition,
    RigidRail,
    compute_centre_of_mass,
    find_body,
    find_carried_nodes,
    find_value,
    read_conditions,
    read_factor,
    read_rails,
)
from .tissue_state import (
    Contraction,
    Prestrain,
    compute_settling_time_s,
    read_contractions,
    read_fibres,
    read_prestrains,
)
from .tree import XmlNode, read_tree

COMPONENTS = ("x", "y", "z")
CONTACTS = ("sliding-elastic", "sliding-facet-on-facet", "sliding-node-on-facet")
_UNSUPPORTED_SECTIONS = ("Initial", "Constraints", "Discrete", "MeshAdaptor", "Include")
_KNOWN_SECTIONS = (
    "Module", "Control", "Globals", "Material", "Mesh", "MeshDomains", "Boundary", "Rigid", "Contact",
    "Loads", "LoadData", "MeshData", "Step", "Output",
)  # fmt: skip
# Read by `_find_tied_sets`, and what only shells have.
_OTHER_CONDITIONS = ("rigid", "zero rotation", "zero shell displacement")
# What none of limbfit's contact rules does; the rest of a contact is how FEBio gets there.
_UNSUPPORTED_IN_CONTACT = ("tension", "offset", "node_reloc")


@dataclass(frozen=True)
class NodeMotion:
    """The displacement ``component`` of nodes: ``factor`` times a load curve (0: held)."""

    target: str
    nodes: Indices
    component: int
    factor: float
    curve: int
    line: int


@dataclass(frozen=True)
class Contact:
    """Contact between two surfaces.

    ``penalty`` is a multiple of FEBio's own if ``automatic``; ``friction`` is Coulomb's coefficient.
    """

    rule: str
    surfaces: tuple[str, str]
    penalty: float
    automatic: bool
    augmented: bool
    line: int
    friction: float = 0.0

    @property
    def has_penalty(self) -> bool:
        """True if it has a penalty of FEBio's; augmented and nodal contact are limbfit's own."""
        return not self.augmented and self.rule != "sliding-node-on-facet"

    @property
    def sticking(self) -> str:
        """The law by which it sticks, as in `limbfit.Problem`."""
        return "stepwise" if self.rule == "sliding-elastic" else "anchored"

    def acts_like(self, other: Contact) -> bool:
        """True if both have one law, wherever they act."""
        return replace(self, surfaces=other.surfaces, line=other.line) == other


@dataclass(frozen=True)
class PressureLoad:
    """A pressure on a surface: ``factor`` (MPa) times a load curve, positive when pushing inwards."""

    surface: str
    factor: float
    curve: int
    line: int


@dataclass(frozen=True)
class FebModel:
    """The content of a ``.feb`` file in mm, N, s, MPa.

    ``materials`` are the deformable ones and ``rigid`` the others, both by name. ``motions`` are those of
    nodes, ``conditions`` those of rigid bodies. ``carried_nodes`` are nodes of tissue that move with a rigid
    body, by its name. ``notes`` say what was read and has no meaning for limbfit. ``fibres`` are their
    directions in each cell of the parts that have some, ``rails`` guide rigid bodies. ``settling_time_s`` is
    how long, in FEBio's time, pre-strained tissue settles before the model's own time begins.
    """

    geometry: Geometry
    materials: Mapping[str, Material]
    rigid: Mapping[str, RigidMaterial]
    motions: tuple[NodeMotion, ...]
    conditions: tuple[RigidCondition, ...]
    carried_nodes: Mapping[str, Indices]
    contacts: tuple[Contact, ...]
    pressures: tuple[PressureLoad, ...]
    curves: Mapping[int, LoadCurve]
    phases: tuple[ControlPhase, ...]
    requests: tuple[Request, ...]
    notes: tuple[str, ...]
    fibres: Mapping[str, Array]
    rails: tuple[RigidRail, ...] = ()
    contractions: tuple[Contraction, ...] = ()
    prestrains: Mapping[str, Prestrain] = field(default_factory=dict)
    settling_time_s: float = 0.0

    @property
    def end_s(self) -> float:
        """The end of the analysis, s."""
        return sum(phase.seconds for phase in self.phases)

    @property
    def step_times(self) -> Array:
        """Times (k,) s of FEBio's steps."""
        return compute_step_times(self.phases, self.curves)

    def select_parts(self, materials: Mapping[str, object]) -> dict[str, Part]:
        """Return the parts made of any of these materials."""
        return {name: part for name, part in self.geometry.parts.items() if part.material in materials}


def read_feb(path: str | Path) -> FebModel:
    """Read a FEBio 3 or 4 input.

    Raises
    ------
    ProblemError
        If the file is missing, is not XML, or holds what limbfit does not support; with its line.
    """
    root = read_tree(path)
    try:
        version = root.attributes.get("version", "")
        if root.tag != "febio_spec" or version.partition(".")[0] not in ("3", "4"):
            raise root.error("is not an input of FEBio 3 or 4", "save it again with FEBio Studio 2")
        return _read_model(root)
    except ProblemError as error:
        raise ProblemError(error.what, file=path, place=error.place, remedy=error.remedy) from None


def _read_model(root: XmlNode) -> FebModel:
    for section in root:
        if "from" in section.attributes:
            raise section.error("stands in another file", "write the input as one file")
        if section.tag in _UNSUPPORTED_SECTIONS and len(section):
            raise section[0].error(f"nothing in <{section.tag}> is supported")
        if section.tag not in (*_UNSUPPORTED_SECTIONS, *_KNOWN_SECTIONS):
            raise section.error("this section is not supported")
        if section.tag == "Module" and section.attributes.get("type", "solid") != "solid":
            raise section.error(f"module {section.attributes['type']!r} is not supported, only solid")
    used = {domain.attributes.get("mat", "") for domain in root.child("MeshDomains")}
    materials, bodies, unread = read_materials(root.child("Material"), used)
    rigid = dict(bodies)
    geometry = read_geometry(root, (*materials, *rigid))
    for name, body in bodies.items():
        if np.isnan(body.centre).any():
            parts = [part for part in geometry.parts.values() if part.material == name]
            rigid[name] = replace(body, centre=compute_centre_of_mass(geometry.points, parts))
    load = root.find("LoadData")
    curves = read_curves(load)
    requests, notes = read_requests(root.find("Output"), geometry)
    model = FebModel(
        geometry,
        materials,
        rigid,
        tuple(_read_node_motions(root.find("Boundary"), geometry, curves)),
        read_conditions(root, rigid, curves),
        find_carried_nodes(geometry, materials, rigid, _find_tied_sets(root.find("Boundary"), rigid)),
        tuple(_read_contact(node, geometry) for node in root.find("Contact") or ()),
        tuple(_read_pressures(root.find("Loads"), geometry, curves)),
        curves,
        read_phases(root, curves),
        requests,
        (*unread, *notes),
        read_fibres(root, materials, geometry.parts),
        read_rails(root, rigid),
        read_contractions(root.child("Material"), materials, curves),
        read_prestrains(root, materials, curves, geometry.parts),
    )
    return _drop_settling(model)


def _drop_settling(model: FebModel) -> FebModel:
    """Return the model from where its pre-strained tissue has settled; its time begins there."""
    others = {m.curve: f"the node set {m.target!r}" for m in model.motions if m.curve}
    others |= {c.curve: f"the rigid body {c.body!r}" for c in model.conditions if c.curve and not c.step}
    others |= {p.curve: f"the pressure on {p.surface!r}" for p in model.pressures}
    others |= {c.curve: f"the contraction of {c.material!r}" for c in model.contractions if c.curve}
    first = compute_settling_time_s(
        model.prestrains, model.materials, model.phases, model.curves, others, model.conditions
    )
    if not first:
        return model
    kept = (c for c in model.conditions if c.step != 0)
    return replace(
        model,
        curves={number: curve.shift(first) for number, curve in model.curves.items()},
        phases=model.phases[1:],
        conditions=tuple(replace(c, step=None if c.step is None else c.step - 1) for c in kept),
        settling_time_s=first,
    )


def _read_node_motions(
    section: XmlNode | None, geometry: Geometry, curves: Mapping[int, LoadCurve]
) -> Iterator[NodeMotion]:
    for bc in section or ():
        if bc.tag != "bc":
            raise bc.error("only <bc> is supported here")
        target, kind = bc.attribute("node_set"), bc.attribute("type")
        nodes = find_node_set(geometry, target, bc)
        if kind in ("zero displacement", "fix"):
            for i, letter in enumerate(COMPONENTS):
                named = letter in [dof.strip() for dof in bc.string("dofs", "").split(",")]
                if named or bc.flag(f"{letter}_dof"):
                    yield NodeMotion(target, nodes, i, 0.0, 0, bc.line)
        elif kind in ("prescribed displacement", "prescribe"):
            yield NodeMotion(target, nodes, *_read_drive(bc, curves), bc.line)
        elif kind not in _OTHER_CONDITIONS:
            raise bc.error(f"boundary condition {kind!r} is not supported")


def _read_drive(bc: XmlNode, curves: Mapping[int, LoadCurve]) -> tuple[int, float, int]:
    """Read component, factor and load curve of a prescribed displacement."""
    dof = bc.string("dof").lower().removeprefix("r")  # FEBio 3 calls those of a rigid body RX, ..
    if dof not in COMPONENTS:
        raise bc.error(f"degree of freedom {bc.string('dof')!r} is not supported")
    if bc.flag("relative"):
        raise bc.child("relative").error("relative displacements are not supported")
    return COMPONENTS.index(dof), *read_factor(find_value(bc), curves)


def _read_pressures(
    section: XmlNode | None, geometry: Geometry, curves: Mapping[int, LoadCurve]
) -> Iterator[PressureLoad]:
    """Read follower pressures; no other load is supported."""
    for load in section or ():
        kind = load.attribute("type")
        if load.tag != "surface_load" or kind != "pressure":
            raise load.error(f"the load {kind!r} is not supported", "limbfit reads pressures on surfaces")
        if load.flag("linear"):
            raise load.child("linear").error("a pressure that does not follow the surface is not supported")
        name = load.attribute("surface")
        if name not in geometry.surfaces:
            raise load.error(f"there is no surface {name!r}")
        factor, curve = read_factor(load.child("pressure"), curves)
        if factor != 0.0:
            yield PressureLoad(name, factor, curve, load.line)


def _find_tied_sets(section: XmlNode | None, rigid: Mapping[str, RigidMaterial]) -> list[tuple[str, XmlNode]]:
    """Return the sets of nodes that are tied to a rigid body: its name, and the condition."""
    return [(find_body(bc, rigid), bc) for bc in section or () if bc.attributes.get("type") == "rigid"]


def _read_contact(node: XmlNode, geometry: Geometry) -> Contact:
    rule, pair = node.attribute("type"), node.attribute("surface_pair")
    if rule not in CONTACTS:
        raise node.error(f"contact {rule!r} is not supported", "limbfit has " + ", ".join(CONTACTS))
    if pair not in geometry.pairs:
        raise node.error(f"there is no surface pair {pair!r}")
    for tag in _UNSUPPORTED_IN_CONTACT:
        if node.number(tag, 0.0) != 0.0:
            raise node.child(tag).error("is supported as 0 only")
    augmented = node.string("laugon", "PENALTY").upper() not in ("PENALTY", "0")
    penalty = node.number("penalty", 1.0)
    if not penalty > 0.0:
        raise node.child("penalty").error("is not positive")
    friction = node.number("fric_coeff", 0.0)
    if friction < 0.0:
        raise node.child("fric_coeff").error("is negative")
    automatic = node.flag("auto_penalty")
    return Contact(rule, geometry.pairs[pair], penalty, automatic, augmented, node.line, friction)
