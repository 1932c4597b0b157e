"""Mesh and domains of a FEBio input: nodes, parts, named sets; every reference checked."""

from collections import Counter
from collections.abc import Container, Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from ...arrays import Array, Indices
from ...errors import ProblemError
from ...mesh import TET_FACES
from ...mesh.cells import CELLS
from .tree import XmlNode

_Places = dict[int, int]  # of nodes, by FEBio's numbers
CELL_NODES = {"tet4": 4, "tet10": 10, "hex8": 8, "penta6": 6, "tri3": 3, "tri6": 6, "quad4": 4}
FACE_NODES = {"tri3": 3, "tri6": 6, "quad4": 4}
# FEBio's names of an element with its quadrature, as rows of limbfit's element table.
FORMULATIONS = {
    ("tet4", ""): "tet4",
    ("tet4", "TET4G1"): "tet4",
    ("tet10", ""): "tet10g8",
    ("tet10", "TET10G8"): "tet10g8",
    ("tet10", "TET10G4"): "tet10",
    ("hex8", ""): "hex8",
    ("hex8", "HEX8G8"): "hex8",
}


@dataclass(frozen=True)
class Part:
    """Cells (m, k) of one type in FEBio's (and VTK's) node order.

    ``material`` is given by name, ``ids (m,)`` are FEBio's numbers, ``element`` is the row of limbfit's
    element table (empty for a type that limbfit cannot deform), ``line`` the place in the file, ``thickness``
    that of shells, mm.
    """

    cell_type: str
    cells: Indices
    material: str
    ids: Indices
    element: str
    line: int
    thickness: float = 0.0


@dataclass(frozen=True)
class Geometry:
    """The content of ``<Mesh>`` and ``<MeshDomains>``; nodes are numbered from 0 in the order of the file.

    ``element_sets`` hold FEBio's numbers; every part is one, too. ``blocks`` are ``<Nodes>`` with a name,
    which FEBio takes as node sets; ``part_lists`` name parts.
    """

    points: Array
    node_ids: Indices
    parts: Mapping[str, Part]
    node_sets: Mapping[str, Indices]
    element_sets: Mapping[str, Indices]
    surfaces: Mapping[str, Indices]
    pairs: Mapping[str, tuple[str, str]]
    blocks: Mapping[str, Indices]
    part_lists: Mapping[str, tuple[str, ...]]

    def select_parts(self, materials: Container[str]) -> dict[str, Part]:
        """Return the parts made of any of these materials, by name."""
        return {name: part for name, part in self.parts.items() if part.material in materials}


def read_geometry(root: XmlNode, materials: Iterable[str]) -> Geometry:
    """Read ``<Mesh>`` and ``<MeshDomains>``.

    Raises `ProblemError` for a node, element, set or material that does not exist or is there twice.
    """
    mesh = root.child("Mesh")
    nodes = [node for group in mesh.find_all("Nodes") for node in group]
    if not nodes:
        raise mesh.error("has no nodes")
    places: _Places = {}
    for i, node in enumerate(nodes):
        if places.setdefault(node.identity(), i) != i:
            raise node.error(f"node {node.identity()} is there twice")
    node_ids = np.array(list(places), dtype=np.int64)
    owners = _read_domains(root.child("MeshDomains"), materials)
    parts, seen = {}, set[int]()
    for name, group in _find_named(mesh, "Elements"):
        if name not in owners:
            raise group.error(f"part {name!r} has no domain, hence no material")
        parts[name] = _read_part(group, owners[name], places, seen)
    for name, domain in owners.items():
        if name not in parts:
            raise domain.error(f"there is no part {name!r}")
    surfaces = {name: _read_faces(group, places) for name, group in _find_named(mesh, "Surface")}
    pairs = {}
    for name, pair in _find_named(mesh, "SurfacePair"):
        both = pair.string("primary"), pair.string("secondary")
        for surface in both:
            if surface not in surfaces:
                raise pair.error(f"there is no surface {surface!r}")
        pairs[name] = both
    sets = {
        name: np.array(_find_nodes(places, group, _read_ids(group, len(places))), dtype=np.int64)
        for name, group in _find_named(mesh, "NodeSet")
    }
    blocks = {
        group.attributes["name"]: np.array([places[node.identity()] for node in group])
        for group in mesh.find_all("Nodes")
        if group.attributes.get("name")
    }
    elements = {name: part.ids for name, part in parts.items()}
    elements |= {name: np.array(_read_ids(group)) for name, group in _find_named(mesh, "ElementSet")}
    points = np.array([node.numbers(3) for node in nodes])
    lists = {}
    for name, group in _find_named(mesh, "PartList"):
        lists[name] = tuple(part.strip() for part in group.text.split(","))
        for part in lists[name]:
            if part not in parts:
                raise group.error(f"there is no part {part!r}")
    return Geometry(points, node_ids, parts, sets, elements, surfaces, pairs, blocks, lists)


def _find_nodes(places: _Places, node: XmlNode, ids: list[int]) -> list[int]:
    try:
        return [places[i] for i in ids]
    except KeyError as error:
        raise node.error(f"there is no node {error.args[0]}") from None


def _find_named(mesh: XmlNode, tag: str) -> list[tuple[str, XmlNode]]:
    found: dict[str, XmlNode] = {}
    for group in mesh.find_all(tag):
        name = group.attribute("name")
        if name in found:
            raise group.error(f"{name!r} is there twice")
        found[name] = group
    return list(found.items())


def _read_domains(section: XmlNode, materials: Iterable[str]) -> dict[str, XmlNode]:
    known, owners = set(materials), dict[str, XmlNode]()
    for domain in section:
        name = domain.attribute("name")
        if domain.tag not in ("SolidDomain", "ShellDomain"):
            raise domain.error("this kind of domain is not supported")
        if domain.attribute("mat") not in known:
            raise domain.error(f"there is no material {domain.attribute('mat')!r}")
        if name in owners:
            raise domain.error(f"part {name!r} has two domains")
        owners[name] = domain
    return owners


def _read_part(group: XmlNode, domain: XmlNode, places: _Places, used_ids: set[int]) -> Part:
    # FEBio also takes the quadrature in the place of the type: TET10G4, HEX8G8, ..
    given = group.attribute("type")
    cell_type, rule = given.lower(), domain.attributes.get("elem_type", "")
    for (kind, name), _ in FORMULATIONS.items():
        if given == name:
            cell_type, rule = kind, rule or name
    if cell_type not in CELL_NODES:
        raise group.error(f"elements of type {given!r} are not supported")
    count = CELL_NODES[cell_type]
    ids, cells = [], []
    for element in group:
        number, corners = element.identity(), element.integers()
        if number in used_ids:
            raise element.error(f"element {number} is there twice")
        if len(corners) != count:
            raise element.error(f"element {number} has {len(corners)} nodes; {cell_type} has {count}")
        used_ids.add(number)
        ids.append(number)
        cells.append(_find_nodes(places, element, corners))
    if not ids:
        raise group.error("has no elements")
    formulation = _choose_formulation(domain, cell_type, rule)
    material = domain.attribute("mat")
    thickness = domain.number("shell_thickness", 0.0)
    return Part(cell_type, np.array(cells), material, np.array(ids), formulation, group.line, thickness)


def _choose_formulation(domain: XmlNode, cell_type: str, rule: str) -> str:
    """Return limbfit's element, or an empty text if the cell type is one for rigid bodies only."""
    kind = domain.attributes.get("type", "")
    if kind in ("", "rigid-solid", "rigid-shell") or cell_type not in ("tet4", "tet10", "hex8"):
        known = True
    else:  # hex8 with an uncoupled material is three-field by itself; one point makes tet4 both
        natural = {"tet4": ("elastic-solid", "three-field-solid"), "tet10": ("elastic-solid",)}
        known = kind in natural.get(cell_type, ("three-field-solid",))
        if (cell_type, rule, kind) == ("tet10", "TET10G4", "three-field-solid"):
            return "tet10p0"
    if not known or (cell_type in ("tet4", "tet10", "hex8") and (cell_type, rule) not in FORMULATIONS):
        raise domain.error(f"{cell_type} as {kind or rule!r} is not supported")
    return FORMULATIONS.get((cell_type, rule), "")


def _read_faces(group: XmlNode, places: _Places) -> Indices:
    kinds = {face.tag for face in group}
    if len(kinds) != 1 or not kinds <= set(FACE_NODES):
        raise group.error(f"a surface needs faces of one type of {', '.join(FACE_NODES)}")
    count = FACE_NODES[kinds.pop()]
    faces = []
    for face in group:
        corners = face.integers()
        if len(corners) != count:
            raise face.error(f"has {len(corners)} nodes, not {count}")
        faces.append(_find_nodes(places, face, corners))
    return np.array(faces)


def _read_ids(group: XmlNode, most: int = 10**7) -> list[int]:
    """Read the numbers of a set; a range holds at most ``most``."""
    if group:  # FEBio 3: <n id="1"/>
        return [node.identity() for node in group]
    ids: list[int] = []
    for text in group.text.replace(",", " ").split():
        first, _, last = text.partition(":")
        try:
            low, high = int(first), int(last or first)
        except ValueError:
            raise group.error(f"{text[:40]!r} is no number") from None
        if not 0 <= high - low < most:
            raise group.error(f"there are no items {low} to {high}")
        ids += range(low, high + 1)
    return ids


def find_node_set(geometry: Geometry, name: str, node: XmlNode) -> Indices:
    """Return the nodes of a set or, as ``@surface:name``, of a surface; ``node`` is what asks for it.

    ``@elem_set:`` and ``@part_list:`` stand for the nodes of elements (FEBio User Manual 4.0, section 3.6).
    """
    kind, _, of = name.partition(":")
    for known in (geometry.node_sets, geometry.blocks):
        if name in known:
            return known[name]
    if kind == "@surface" and of in geometry.surfaces:
        return np.unique(geometry.surfaces[of])
    if kind == "@elem_set" and of in geometry.element_sets:
        return collect_nodes(geometry.parts.values(), geometry.element_sets[of])
    if kind == "@part_list" and of in geometry.part_lists:
        return collect_nodes([geometry.parts[part] for part in geometry.part_lists[of]])
    raise node.error(f"there is no node set {name!r}")


def collect_nodes(parts: Iterable[Part], elements: Indices | None = None) -> Indices:
    """Return the nodes of the cells of parts, or of those cells that have these of FEBio's numbers."""
    cells = [part.cells if elements is None else part.cells[np.isin(part.ids, elements)] for part in parts]
    return np.unique(np.concatenate([np.zeros(0, np.int64), *(cell.ravel() for cell in cells)]))


def find_boundary_faces(parts: Iterable[Part]) -> list[Indices]:
    """Return the faces (3 or 4 corners, as in the parts) that belong to one cell only; shells are faces."""
    single: dict[tuple[int, ...], Indices] = {}
    for part in parts:
        for local in _FACES[part.cell_type]:
            for face in part.cells[:, local]:
                key = tuple(sorted(face.tolist()))
                if single.pop(key, None) is None:
                    single[key] = face
    return list(single.values())


def is_closed(faces: Iterable[Indices]) -> bool:
    """True if every edge of the faces belongs to two of them."""
    edges = Counter(
        frozenset(pair) for face in faces for pair in zip(face.tolist(), np.roll(face, -1).tolist())
    )
    return bool(edges) and set(edges.values()) == {2}


_FACES: dict[str, Iterable[Sequence[int]]] = {
    "tet4": TET_FACES.tolist(),
    "tet10": TET_FACES.tolist(),
    "hex8": CELLS["hex8"].faces.tolist(),
    "penta6": ([0, 2, 1], [3, 4, 5], [0, 1, 4, 3], [1, 2, 5, 4], [2, 0, 3, 5]),
    "tri3": ([0, 1, 2],),
    "tri6": ([0, 1, 2],),
    "quad4": ([0, 1, 2, 3],),
}


def split_into_triangles(faces: Iterable[Indices]) -> Indices:
    """Split faces of three or four corners into triangles (m, 3)."""
    out = []
    for face in faces:
        out += [face[:3]] if len(face) == 3 else [face[[0, 1, 2]], face[[0, 2, 3]]]
    return np.array(out, dtype=np.int64).reshape(-1, 3)


def split_convexly(points: Array, faces: Iterable[Indices]) -> Indices:
    """Split faces around a body into triangles (m, 3), those of four corners where they bulge.

    A warped face split along its other diagonal has a valley: there the way out of the body jumps from one
    side to the other, and contact has no smooth energy. The faces all run in the same sense, seen from
    outside.
    """
    faces = list(faces)
    corners = points[split_into_triangles(faces)]
    outward = np.sign(np.linalg.det(corners - corners.mean(axis=(0, 1))).sum())
    parted = []
    for face in faces:
        a, b, c, d = points[face[[0, 1, 2, -1]]]
        valley = outward * float(np.cross(b - a, c - a) @ (d - a)) > 0.0
        parted.append(np.roll(face, -1) if valley else face)
    return split_into_triangles(parted)


def build_part_error(part: Part, name: str, what: str) -> ProblemError:
    """Return the error that names a part and its line."""
    ids = f"elements {part.ids.min()} to {part.ids.max()}"
    return ProblemError(f"part {name!r} ({part.cell_type}, {ids}): {what}", place=f"line {part.line}")
