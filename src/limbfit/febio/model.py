"""Inputs of FEBio 4 (``.feb``) as arrays: mesh, named sets, materials, boundary conditions, load curves.

Read is what an indentation needs; a part of the format that would change the mechanics and is not
understood is an error, never skipped (FEBio User Manual 4.0, chapter 3).
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..errors import ProblemError
from ..fe import OgdenQLV

Array = NDArray[np.float64]
Indices = NDArray[np.int64]
COMPONENTS = ("x", "y", "z")


@dataclass(frozen=True)
class Part:
    """Cells (m, k) of one type in FEBio's (and VTK's) node order, and the name of their material."""

    cell_type: str
    cells: Indices
    material: str


@dataclass(frozen=True)
class Motion:
    """Displacement ``component`` of a node set or rigid body: ``factor`` times the load curve (0: held)."""

    target: str
    component: int
    factor: float


@dataclass(frozen=True)
class FebModel:
    """A ``.feb`` in mm, N, s, MPa; nodes are numbered from 0 in the order of the file.

    ``materials`` are the deformable ones, ``rigid`` the centres of mass (3,) of the rigid ones, both by name;
    ``surfaces`` faces (f, k) by name; ``contact`` the surface that may touch the rigid body, or empty;
    ``load (n, 2)`` time and value of the load curve.
    """

    points: Array
    parts: Mapping[str, Part]
    node_sets: Mapping[str, Indices]
    surfaces: Mapping[str, Indices]
    materials: Mapping[str, OgdenQLV]
    rigid: Mapping[str, Array]
    node_motions: tuple[Motion, ...]
    rigid_motions: tuple[Motion, ...]
    contact: str
    load: Array


def read_feb(path: str | Path) -> FebModel:
    """Read a FEBio 4 input.

    Raises
    ------
    ProblemError
        Where the file is missing, is not XML, or holds what limbfit does not know.
    """
    try:
        root = ET.parse(path).getroot()
    except OSError as error:
        raise ProblemError(error.strerror or "cannot be read", file=path) from error
    except ET.ParseError as error:
        raise ProblemError(f"is not well-formed XML: {error}", file=path) from error
    if root.tag != "febio_spec" or not root.get("version", "").startswith("4"):
        raise ProblemError("is no input of FEBio 4", file=path, remedy="save it anew with FEBio Studio 2")
    try:
        return _model(root)
    except ProblemError as error:
        raise ProblemError(error.what, file=path, place=error.place) from error
    except (KeyError, ValueError, TypeError, AttributeError) as error:
        raise ProblemError(
            f"a part of the input is missing or not as expected ({error})", file=path
        ) from error


def _model(root: ET.Element) -> FebModel:
    mesh = _child(root, "Mesh")
    nodes = [node for group in mesh.findall("Nodes") for node in group]
    index = {int(node.attrib["id"]): i for i, node in enumerate(nodes)}

    def numbered(text: str | None) -> list[int]:
        return [index[int(value)] for value in (text or "").split(",")]

    materials, rigid = _materials(_child(root, "Material"))
    owner = {domain.get("name"): domain.get("mat", "") for domain in _child(root, "MeshDomains")}
    pairs = {pair.get("name"): pair.findtext("primary", "") for pair in mesh.findall("SurfacePair")}
    contacts = [pairs[node.get("surface_pair")] for node in root.iterfind("Contact/contact")]
    return FebModel(
        points=np.array([_floats(node) for node in nodes]),
        parts={
            name: Part(group.get("type", ""), np.array([numbered(cell.text) for cell in group]), owner[name])
            for name, group in _named(mesh, "Elements")
        },
        node_sets={name: np.array(numbered(group.text)) for name, group in _named(mesh, "NodeSet")},
        surfaces={
            name: np.array([numbered(face.text) for face in group]) for name, group in _named(mesh, "Surface")
        },
        materials=materials,
        rigid=rigid,
        node_motions=tuple(m for bc in root.iterfind("Boundary/bc") for m in _node_motions(bc)),
        rigid_motions=tuple(m for bc in root.iterfind("Rigid/rigid_bc") for m in _rigid_motions(bc)),
        contact=contacts[0] if contacts else "",
        load=_load(root),
    )


def _child(node: ET.Element, tag: str) -> ET.Element:
    found = node.find(tag)
    if found is None:
        raise ProblemError(f"has no <{tag}>")
    return found


def _named(mesh: ET.Element, tag: str) -> Iterator[tuple[str, ET.Element]]:
    for group in mesh.findall(tag):
        yield group.attrib["name"], group


def _floats(node: ET.Element) -> list[float]:
    return [float(value) for value in (node.text or "").split(",")]


def _value(node: ET.Element, path: str, default: float | None = None) -> float:
    text = node.findtext(path)
    if text is None and default is not None:
        return default
    if text is None:
        raise ProblemError(f"has no <{path}>", place=f"material {node.get('name')}")
    return float(text)


def _materials(section: ET.Element) -> tuple[dict[str, OgdenQLV], dict[str, Array]]:
    soft: dict[str, OgdenQLV] = {}
    rigid: dict[str, Array] = {}
    for node in section:
        name = node.attrib["name"]
        if node.get("type") == "rigid body":
            rigid[name] = np.array(_floats(_child(node, "center_of_mass")))
        else:
            soft[name] = _ogden(node)
    return soft, rigid


def _ogden(node: ET.Element) -> OgdenQLV:
    """The paper's tissue: one Prony term around an Ogden pair ``c, m`` and ``c, -m``."""
    place = f"material {node.get('name')}"
    elastic = node.find("elastic")
    if node.get("type") != "uncoupled viscoelastic" or elastic is None or elastic.get("type") != "Ogden":
        raise ProblemError(f"material type {node.get('type')!r} is not known", place=place)
    c, m = _value(elastic, "c1"), _value(elastic, "m1")
    pair = (_value(elastic, "c2"), _value(elastic, "m2")) == (c, -m)
    if not pair or _value(node, "g0", 1.0) != 1.0 or any(node.find(f"g{i}") is not None for i in range(2, 7)):
        raise ProblemError("is not one Ogden pair c, m and c, -m with g0 = 1 and one Prony term", place=place)
    # The wrapper adds its own k to the elastic material's.
    k = _value(node, "k", 0.0) + _value(elastic, "k", 0.0)
    return OgdenQLV(c, m, _value(node, "g1"), _value(node, "t1"), k / c)


def _node_motions(bc: ET.Element) -> Iterator[Motion]:
    target = bc.attrib["node_set"]
    if bc.get("type") == "zero displacement":
        for component, letter in enumerate(COMPONENTS):
            if bc.findtext(f"{letter}_dof") == "1":
                yield Motion(target, component, 0.0)
    elif bc.get("type") == "prescribed displacement":
        yield Motion(target, COMPONENTS.index(bc.findtext("dof", "")), _value(bc, "value"))
    else:
        raise ProblemError(f"boundary condition {bc.get('type')!r} is not known")


def _rigid_motions(bc: ET.Element) -> Iterator[Motion]:
    if bc.get("type") == "rigid_displacement":
        yield Motion(bc.findtext("rb", ""), COMPONENTS.index(bc.findtext("dof", "")), _value(bc, "value"))
    elif bc.get("type") != "rigid_fixed":
        raise ProblemError(f"rigid boundary condition {bc.get('type')!r} is not known")


def _load(root: ET.Element) -> Array:
    curves = root.findall("LoadData/load_controller")
    if len(curves) != 1 or curves[0].findtext("interpolate") != "LINEAR":
        raise ProblemError("has not exactly one linear load curve")
    return np.array([_floats(point) for point in _child(curves[0], "points")])
