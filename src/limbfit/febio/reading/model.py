"""Inputs of FEBio 3 and 4 (``.feb``): mesh, named sets, materials, conditions, contact, time and output.

Read is what an indentation needs; a part of the format that would change the mechanics and is not
understood is an error that names its line, never skipped (FEBio User Manual 4.0, chapter 3).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...errors import ProblemError
from ...fe import Material
from .controls import ControlPhase, read_phases
from .curves import Curve, read_curves
from .fibres import read_fibres
from .geometry import Geometry, Indices, Part, node_set, read_geometry
from .materials import RigidMaterial, read_materials
from .motions import RigidCondition, RigidRail, amount, body_of, curved, read_conditions, read_rails
from .requests import Request, read_requests
from .rigid import carried_nodes, centre_of_mass
from .straining import Contraction, Prestrain, read_contractions, read_prestrains, settled_s
from .tree import Node, read_tree

Array = NDArray[np.float64]
COMPONENTS = ("x", "y", "z")
CONTACTS = ("sliding-elastic", "sliding-facet-on-facet", "sliding-node-on-facet")
_EMPTY = ("Initial", "Constraints", "Discrete", "MeshAdaptor", "Include")
_READ = (
    "Module", "Control", "Globals", "Material", "Mesh", "MeshDomains", "Boundary", "Rigid", "Contact",
    "Loads", "LoadData", "MeshData", "Step", "Output",
)  # fmt: skip
# Read by `_tied`, and what only shells have.
_ELSEWHERE = ("rigid", "zero rotation", "zero shell displacement")
# What none of limbfit's contact rules does; the rest of a contact is how FEBio gets there.
_CONTACT_ZERO = ("tension", "offset", "node_reloc")


@dataclass(frozen=True)
class NodeMotion:
    """Displacement ``component`` of nodes: ``factor`` times a load curve (0: held)."""

    target: str
    nodes: Indices
    component: int
    factor: float
    curve: int
    line: int


@dataclass(frozen=True)
class Contact:
    """Contact between two surfaces; ``penalty`` is times FEBio's own where ``automatic``; ``friction`` is
    Coulomb's coefficient."""

    rule: str
    surfaces: tuple[str, str]
    penalty: float
    automatic: bool
    augmented: bool
    line: int
    friction: float = 0.0

    @property
    def penalised(self) -> bool:
        """Whether it has a penalty of FEBio's; augmented and nodal contact are limbfit's own."""
        return not self.augmented and self.rule != "sliding-node-on-facet"

    @property
    def sticking(self) -> str:
        """The law by which it sticks, as in `limbfit.Problem`."""
        return "stepwise" if self.rule == "sliding-elastic" else "anchored"

    def acts_as(self, other: Contact) -> bool:
        """Whether both have one law, wherever they act."""
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
    """A ``.feb`` in mm, N, s, MPa.

    ``materials`` are the deformable ones, ``rigid`` the others, both by name; ``motions`` those of nodes,
    ``conditions`` those of rigid bodies; ``carried`` nodes of tissue that move with a rigid body, by its
    name; ``notes`` what was read and has no meaning for limbfit; ``fibres`` their direction in each
    cell of the parts that have some; ``rails`` what guides rigid bodies; ``settled_s``: how long, in FEBio's
    time, pre-strained tissue settles before the model's own time begins.
    """

    geometry: Geometry
    materials: Mapping[str, Material]
    rigid: Mapping[str, RigidMaterial]
    motions: tuple[NodeMotion, ...]
    conditions: tuple[RigidCondition, ...]
    carried: Mapping[str, Indices]
    contacts: tuple[Contact, ...]
    pressures: tuple[PressureLoad, ...]
    curves: Mapping[int, Curve]
    phases: tuple[ControlPhase, ...]
    requests: tuple[Request, ...]
    notes: tuple[str, ...]
    fibres: Mapping[str, Array]
    rails: tuple[RigidRail, ...] = ()
    contractions: tuple[Contraction, ...] = ()
    prestrains: Mapping[str, Prestrain] = field(default_factory=dict)
    settled_s: float = 0.0

    def parts_of(self, materials: Mapping[str, object]) -> dict[str, Part]:
        """The parts made of any of these materials."""
        return {name: part for name, part in self.geometry.parts.items() if part.material in materials}


def read_feb(path: str | Path) -> FebModel:
    """Read a FEBio 3 or 4 input.

    Raises
    ------
    ProblemError
        Where the file is missing, is not XML, or holds what limbfit does not know; with its line.
    """
    root = read_tree(path)
    try:
        version = root.attributes.get("version", "")
        if root.tag != "febio_spec" or version.partition(".")[0] not in ("3", "4"):
            raise root.refuse("is not an input of FEBio 3 or 4", "save it again with FEBio Studio 2")
        return _model(root)
    except ProblemError as error:
        raise ProblemError(error.what, file=path, place=error.place, remedy=error.remedy) from None


def _model(root: Node) -> FebModel:
    for section in root:
        if "from" in section.attributes:
            raise section.refuse("stands in another file", "write the input as one file")
        if section.tag in _EMPTY and len(section):
            raise section[0].refuse(f"nothing in <{section.tag}> is supported")
        if section.tag not in (*_EMPTY, *_READ):
            raise section.refuse("this section is not supported")
        if section.tag == "Module" and section.attributes.get("type", "solid") != "solid":
            raise section.refuse(f"module {section.attributes['type']!r} is not supported, only solid")
    used = {domain.attributes.get("mat", "") for domain in root.child("MeshDomains")}
    materials, bodies, unread = read_materials(root.child("Material"), used)
    rigid = dict(bodies)
    geometry = read_geometry(root, (*materials, *rigid))
    for name, body in bodies.items():
        if np.isnan(body.centre).any():
            parts = [part for part in geometry.parts.values() if part.material == name]
            rigid[name] = replace(body, centre=centre_of_mass(geometry.points, parts))
    load = root.find("LoadData")
    curves = read_curves(load)
    requests, notes = read_requests(root.find("Output"), geometry)
    model = FebModel(
        geometry,
        materials,
        rigid,
        tuple(_node_motions(root.find("Boundary"), geometry, curves)),
        read_conditions(root, rigid, curves),
        carried_nodes(geometry, materials, rigid, _tied(root.find("Boundary"), rigid)),
        tuple(_contact(node, geometry) for node in root.find("Contact") or ()),
        tuple(_pressures(root.find("Loads"), geometry, curves)),
        curves,
        read_phases(root, curves),
        requests,
        (*unread, *notes),
        read_fibres(root, materials, geometry.parts),
        read_rails(root, rigid),
        read_contractions(root.child("Material"), materials, curves),
        read_prestrains(root, materials, curves, geometry.parts),
    )
    return _settled(model)


def _settled(model: FebModel) -> FebModel:
    """The model from where its pre-strained tissue has settled; its time begins anew there."""
    others = {m.curve: f"the node set {m.target!r}" for m in model.motions if m.curve}
    others |= {c.curve: f"the rigid body {c.body!r}" for c in model.conditions if c.curve and not c.step}
    others |= {p.curve: f"the pressure on {p.surface!r}" for p in model.pressures}
    others |= {c.curve: f"the contraction of {c.material!r}" for c in model.contractions if c.curve}
    first = settled_s(model.prestrains, model.materials, model.phases, model.curves, others, model.conditions)
    if not first:
        return model
    kept = (c for c in model.conditions if c.step != 0)
    return replace(
        model,
        curves={number: curve.after(first) for number, curve in model.curves.items()},
        phases=model.phases[1:],
        conditions=tuple(replace(c, step=None if c.step is None else c.step - 1) for c in kept),
        settled_s=first,
    )


def _node_motions(
    section: Node | None, geometry: Geometry, curves: Mapping[int, Curve]
) -> Iterator[NodeMotion]:
    for bc in section or ():
        if bc.tag != "bc":
            raise bc.refuse("only <bc> is supported here")
        target, kind = bc.attribute("node_set"), bc.attribute("type")
        nodes = node_set(geometry, target, bc)
        if kind in ("zero displacement", "fix"):
            for i, letter in enumerate(COMPONENTS):
                named = letter in [dof.strip() for dof in bc.string("dofs", "").split(",")]
                if named or bc.flag(f"{letter}_dof"):
                    yield NodeMotion(target, nodes, i, 0.0, 0, bc.line)
        elif kind in ("prescribed displacement", "prescribe"):
            yield NodeMotion(target, nodes, *_driven(bc, curves), bc.line)
        elif kind not in _ELSEWHERE:
            raise bc.refuse(f"boundary condition {kind!r} is not supported")


def _driven(bc: Node, curves: Mapping[int, Curve]) -> tuple[int, float, int]:
    """Component, factor and load curve of a prescribed displacement."""
    dof = bc.string("dof").lower().removeprefix("r")  # FEBio 3 calls those of a rigid body RX, ..
    if dof not in COMPONENTS:
        raise bc.refuse(f"degree of freedom {bc.string('dof')!r} is not supported")
    if bc.flag("relative"):
        raise bc.child("relative").refuse("relative displacements are not supported")
    return COMPONENTS.index(dof), *curved(amount(bc), curves)


def _pressures(
    section: Node | None, geometry: Geometry, curves: Mapping[int, Curve]
) -> Iterator[PressureLoad]:
    """Follower pressures; no other load is read."""
    for load in section or ():
        kind = load.attribute("type")
        if load.tag != "surface_load" or kind != "pressure":
            raise load.refuse(f"the load {kind!r} is not supported", "limbfit reads pressures on surfaces")
        if load.flag("linear"):
            raise load.child("linear").refuse("a pressure that does not follow the surface is not supported")
        name = load.attribute("surface")
        if name not in geometry.surfaces:
            raise load.refuse(f"there is no surface {name!r}")
        factor, curve = curved(load.child("pressure"), curves)
        if factor != 0.0:
            yield PressureLoad(name, factor, curve, load.line)


def _tied(section: Node | None, rigid: Mapping[str, RigidMaterial]) -> list[tuple[str, Node]]:
    """Sets of nodes that are tied to a rigid body: its name, and the condition."""
    return [(body_of(bc, rigid), bc) for bc in section or () if bc.attributes.get("type") == "rigid"]


def _contact(node: Node, geometry: Geometry) -> Contact:
    rule, pair = node.attribute("type"), node.attribute("surface_pair")
    if rule not in CONTACTS:
        raise node.refuse(f"contact {rule!r} is not supported", "limbfit has " + ", ".join(CONTACTS))
    if pair not in geometry.pairs:
        raise node.refuse(f"there is no surface pair {pair!r}")
    for tag in _CONTACT_ZERO:
        if node.number(tag, 0.0) != 0.0:
            raise node.child(tag).refuse("is supported as 0 only")
    augmented = node.string("laugon", "PENALTY").upper() not in ("PENALTY", "0")
    penalty = node.number("penalty", 1.0)
    if not penalty > 0.0:
        raise node.child("penalty").refuse("is not positive")
    friction = node.number("fric_coeff", 0.0)
    if friction < 0.0:
        raise node.child("fric_coeff").refuse("is negative")
    automatic = node.flag("auto_penalty")
    return Contact(rule, geometry.pairs[pair], penalty, automatic, augmented, node.line, friction)
