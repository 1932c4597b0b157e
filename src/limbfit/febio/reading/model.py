"""Inputs of FEBio 3 and 4 (``.feb``): mesh, named sets, materials, conditions, contact, time and output.

Everything is read that an indentation needs. A part of the format that would change the mechanics and is not
supported is an error that names its line; it is never skipped (FEBio User Manual 4.0, chapter 3).

limbfit's pre-strained tissue is in equilibrium, and has relaxed, before time begins. In FEBio the pre-strain
grows while everything else rests: that step is read as the beginning, and the time after it begins at 0.
"""

from __future__ import annotations

from collections.abc import Container, Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path, PurePosixPath

import numpy as np

from ...arrays import Array, Indices
from ...errors import ProblemError, add_location
from ...fe import Material
from .geometry import Geometry, find_node_set, read_geometry
from .materials import (
    Contraction,
    Prestrain,
    RigidMaterial,
    read_contractions,
    read_fibres,
    read_materials,
    read_prestrains,
)
from .rigid import (
    RigidCondition,
    RigidRail,
    compute_centre_of_mass,
    find_body,
    find_carried_nodes,
    read_conditions,
    read_drive,
    read_factor,
    read_fixed,
    read_rails,
)
from .timing import ControlPhase, LoadCurve, compute_step_times, read_curves, read_phases
from .tree import XmlNode, read_tree

COMPONENTS = "xyz"
CONTACTS = ("sliding-elastic", "sliding-facet-on-facet", "sliding-node-on-facet")
_UNSUPPORTED_SECTIONS = ("Initial", "Constraints", "Discrete", "MeshAdaptor", "Include")
_KNOWN_SECTIONS = (
    "Module", "Control", "Globals", "Material", "Mesh", "MeshDomains", "Boundary", "Rigid", "Contact",
    "Loads", "LoadData", "MeshData", "Step", "Output",
)  # fmt: skip
MIN_RELAXATION_TIMES = 20.0  # longest relaxation times after which no more than 2e-9 of a stress is left
# Sets that are tied to rigid bodies, and what only shells have.
_OTHER_CONDITIONS = ("rigid", "zero rotation", "zero shell displacement")
# What none of limbfit's contact rules does; the rest of a contact is how FEBio gets there.
_UNSUPPORTED_IN_CONTACT = ("tension", "offset", "node_reloc")
UNITS = "mm-N-s"  # FEBio Studio's name of limbfit's units, in which a file is that names none
KNOWN_DATA = {
    "node_data": ("x", "y", "z", "ux", "uy", "uz"),
    "element_data": ("x", "y", "z", "sx", "sy", "sz", "sxy", "syz", "sxz", "s1", "s2", "s3", "J"),
    "rigid_body_data": ("x", "y", "z", "thx", "thy", "thz", "Fx", "Fy", "Fz", "Mx", "My", "Mz"),
}


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


def read_feb(path: str | Path) -> FebModel:
    """Read a FEBio 3 or 4 input. Raises `ProblemError` if the file is missing, is not XML, or holds what
    limbfit does not support; with its line.
    """
    with add_location(file=path):
        return _read_model(read_tree(path))


def _read_model(root: XmlNode) -> FebModel:
    version = root.attributes.get("version", "")
    if root.tag != "febio_spec" or version.partition(".")[0] not in ("3", "4"):
        raise root.error("is not an input of FEBio 3 or 4", "save it again with FEBio Studio 2")
    for section in root:
        if "from" in section.attributes:
            raise section.error("stands in another file", "write the input as one file")
        if section.tag in _UNSUPPORTED_SECTIONS and len(section):
            raise section[0].error(f"nothing in <{section.tag}> is supported")
        if section.tag not in (*_UNSUPPORTED_SECTIONS, *_KNOWN_SECTIONS):
            raise section.error("this section is not supported")
        if section.tag == "Module":
            kind, units = section.attributes.get("type", "solid"), section.string("units", UNITS)
            if kind != "solid":
                raise section.error(f"module {kind!r} is not supported, only solid")
            if units != UNITS:
                raise section.error(f"units {units!r} are not supported", f"scale the input to {UNITS}")
    used = {domain.attributes.get("mat", "") for domain in root.child("MeshDomains")}
    materials, bodies, unread = read_materials(root.child("Material"), used)
    rigid = dict(bodies)
    geometry = read_geometry(root, (*materials, *rigid))
    for name, body in bodies.items():
        if np.isnan(body.centre).any():
            parts = geometry.select_parts([name]).values()
            rigid[name] = replace(body, centre=compute_centre_of_mass(geometry.points, parts))
    curves = read_curves(root.find("LoadData"))
    boundary = root.find("Boundary")
    tied_sets = [(find_body(bc, rigid), bc) for bc in boundary or () if bc.attributes.get("type") == "rigid"]
    requests, notes = read_requests(root.find("Output"), geometry)
    model = FebModel(
        geometry=geometry,
        materials=materials,
        rigid=rigid,
        motions=tuple(_read_node_motions(boundary, geometry, curves)),
        conditions=read_conditions(root, rigid, curves),
        carried_nodes=find_carried_nodes(geometry, materials, rigid, tied_sets),
        contacts=tuple(_read_contact(node, geometry) for node in root.find("Contact") or ()),
        pressures=tuple(_read_pressures(root.find("Loads"), geometry, curves)),
        curves=curves,
        phases=read_phases(root, curves),
        requests=requests,
        notes=(*unread, *notes),
        fibres=read_fibres(root, materials, geometry.parts),
        rails=read_rails(root, rigid),
        contractions=read_contractions(root.child("Material"), materials, curves),
        prestrains=read_prestrains(root, materials, curves, geometry.parts),
    )
    return _drop_settling(model)


def _drop_settling(model: FebModel) -> FebModel:
    """Return the model from where its pre-strained tissue has settled; its time begins there."""
    others = {m.curve: f"the node set {m.target!r}" for m in model.motions if m.curve}
    others |= {c.curve: f"the rigid body {c.body!r}" for c in model.conditions if c.curve and not c.step}
    others |= {p.curve: f"the pressure on {p.surface!r}" for p in model.pressures}
    others |= {c.curve: f"the contraction of {c.material!r}" for c in model.contractions if c.curve}
    first = _compute_settling_time_s(model, others)
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


def _compute_settling_time_s(model: FebModel, other_curves: Mapping[int, str]) -> float:
    """Return the length of the first step, s, in which pre-strained tissue settles; 0 if it needs none.

    ``other_curves`` are the load curves of what else moves tissue, each with a description. It is an error if
    the pre-strain goes on growing, the tissue has not relaxed, or something else moves it.
    """
    conditions, curves = model.conditions, model.curves
    slowest = max(
        (tau for law in model.materials.values() for g, tau in law.table().prony if g != 0.0), default=0.0
    )
    growing = [one for one in model.prestrains.values() if one.curve]
    steady = [one for one in model.prestrains.values() if not one.curve]
    remedy = "let its ramp grow in a first step of its own, and rest"
    if steady and slowest > 0.0:
        raise _build_prestrain_error("acts at once in tissue that relaxes", steady[0], remedy)
    if not growing:
        return 0.0
    first = model.phases[0].seconds
    if len(model.phases) < 2:
        raise _build_prestrain_error("grows in the only step", growing[0], remedy)
    rested = max(_compute_rest_start(one, first, slowest, curves) for one in growing)
    times = np.linspace(rested, first, 101)
    for number, description in other_curves.items():
        values = curves[number].at(times)
        if np.abs(values - values[0]).max() > 0.0:
            what = f"settles while {description} changes"
            raise _build_prestrain_error(what, growing[0], "let it change after the first step")
    for held in conditions:
        gone = held.curve and held.step == 0 and held.kind == "moved"
        later = {(c.body, c.freedom) for c in conditions if c.kind == "moved" and c.step in (None, 1)}
        if gone and held.factor * curves[held.curve].at(first) and (held.body, held.freedom) not in later:
            what = f"settles while the rigid body {held.body!r} goes elsewhere"
            raise _build_prestrain_error(what, growing[0])
    return first


def _compute_rest_start(
    prestrain: Prestrain, step_end_s: float, slowest: float, curves: Mapping[int, LoadCurve]
) -> float:
    """Return when a pre-strain has grown, s; it then rests until the first step ends."""
    points = curves[prestrain.curve].points
    if not len(points) or curves[prestrain.curve].corners is None:
        raise _build_prestrain_error("grows along no line through points", prestrain, "use LINEAR points")
    grown = float(points[np.flatnonzero(points[:, 1] != points[-1, 1]).max(initial=-1) + 1, 0])
    rest = step_end_s - grown
    if rest < 0.0:
        raise _build_prestrain_error("goes on growing after the first step", prestrain)
    if rest < MIN_RELAXATION_TIMES * slowest:
        what = f"rests for {rest:.4g} s in the first step, in which tissue of {slowest:.4g} s does not relax"
        raise _build_prestrain_error(
            what, prestrain, f"let it rest for {MIN_RELAXATION_TIMES * slowest:.4g} s"
        )
    return grown


def _build_prestrain_error(what: str, prestrain: Prestrain, remedy: str | None = None) -> ProblemError:
    return ProblemError(f"a pre-strain {what}", place=f"line {prestrain.line}, <prestrain>", remedy=remedy)


def _read_node_motions(
    section: XmlNode | None, geometry: Geometry, curves: Mapping[int, LoadCurve]
) -> Iterator[NodeMotion]:
    for bc in section or ():
        if bc.tag != "bc":
            raise bc.error("only <bc> is supported here")
        target, kind = bc.attribute("node_set"), bc.attribute("type")
        nodes = find_node_set(geometry, target, bc)
        if kind in ("zero displacement", "fix"):
            for i in read_fixed(bc, COMPONENTS):
                yield NodeMotion(target, nodes, i, 0.0, 0, bc.line)
        elif kind in ("prescribed displacement", "prescribe"):
            yield NodeMotion(target, nodes, *read_drive(bc, COMPONENTS, curves), bc.line)
        elif kind not in _OTHER_CONDITIONS:
            raise bc.error(f"boundary condition {kind!r} is not supported")


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


@dataclass(frozen=True)
class Request:
    """One table per step: ``names`` of columns, ``items``: sets or ranges of FEBio's numbers (empty: all)."""

    kind: str
    names: tuple[str, ...]
    file: str
    delimiter: str
    items: tuple[Container[int], ...]

    def includes(self, number: int) -> bool:
        """True if the item of that number is asked for."""
        return not self.items or any(number in some for some in self.items)


def read_requests(section: XmlNode | None, geometry: Geometry) -> tuple[tuple[Request, ...], tuple[str, ...]]:
    """Read the requests that limbfit can answer, with a note for everything else.

    Raises `ProblemError` for a set that does not exist, and for items that are no numbers.
    """
    requests, notes = [], list[str]()
    for output in section or ():
        if output.tag != "logfile":
            notes.append(f"{output.place}: not written")
            continue
        for entry in output:
            if entry.tag not in KNOWN_DATA:
                notes.append(f"{entry.place}: not written")
                continue
            names = [name.strip() for name in entry.attribute("data").split(";")]
            known = tuple(name for name in names if name in KNOWN_DATA[entry.tag])
            unknown = [name for name in names if name not in known]
            if unknown:
                what = ", ".join(repr(name[:40]) for name in unknown)
                notes.append(
                    f"{entry.place}: {what} not written; known are {', '.join(KNOWN_DATA[entry.tag])}"
                )
            if known:
                file = PurePosixPath(entry.attributes.get("file", "").replace("\\", "/")).name
                delimiter, items = entry.attributes.get("delim", " "), _read_items(entry, geometry)
                requests.append(Request(entry.tag, known, file, delimiter, items))
    return tuple(requests), tuple(notes)


def _read_items(entry: XmlNode, geometry: Geometry) -> tuple[Container[int], ...]:
    """Read the set that an entry names, or ranges of numbers: ``1,4,10:20``.

    FEBio also has ``10:20:2``, which is refused.
    """
    node, element = entry.attributes.get("node_set"), entry.attributes.get("elem_set")
    if node is not None:
        return (frozenset(geometry.node_ids[find_node_set(geometry, node, entry)].tolist()),)
    if element is not None:
        if element not in geometry.element_sets:
            raise entry.error(f"there is no element set {element!r}")
        return (frozenset(geometry.element_sets[element].tolist()),)
    ranges = []
    for text in filter(None, (part.strip() for part in entry.text.split(","))):
        low, _, high = text.partition(":")
        if not (low.isdecimal() and (high or low).isdecimal()):
            raise entry.error(f"{text[:40]!r} is neither a number nor a range of numbers")
        ranges.append(range(int(low), int(high or low) + 1))
    return tuple(ranges)
