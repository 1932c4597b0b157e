"""Materials of FEBio as limbfit's, and the state of the tissue that they make.

Laws are uncoupled and hyperelastic, with fibres beside and Prony terms around them. A contraction may stand
beside, and a pre-strain around all of it. Fibres and pre-strains may have a value for each cell.

Source: FEBio User Manual 4.0, sections 4.1.1 and 4.1.3, on local material axes and on ``MeshData``; FEBio's
feature manual, ``uncoupled active fiber stress``, ``uncoupled prestrain elastic`` and ``prestrain gradient``.
"""

from collections.abc import Container, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ...arrays import Array
from ...errors import ProblemError
from ...fe import ContractileMaterial, FibredMaterial, Material, MooneyRivlin, NeoHookean, Ogden, OgdenQLV
from ...fe.materials import Uncoupled
from .geometry import Part
from .timing import LoadCurve, read_curve_number
from .tree import XmlNode

ELASTIC = {
    "Ogden": {f"{letter}{i}" for letter in "cm" for i in range(1, 7)},
    "Mooney-Rivlin": {"c1", "c2"},
    "incomp neo-Hookean": {"G"},
}
_SHARED = {"k", "density", "pressure_model", "laugon", "atol", "mat_axis"}
MIXTURE, RELAXED = "uncoupled solid mixture", "uncoupled viscoelastic"
FIBRE, ACTIVE, PRESTRAINED = (
    "fiber-exp-pow-uncoupled", "uncoupled active fiber stress", "uncoupled prestrain elastic",
)  # fmt: skip
_RELAXING = {"g0", "elastic"} | {f"{letter}{i}" for letter in "gt" for i in range(1, 7)}
_VOLUMETRIC = {
    "": "log", "default": "log", "0": "log",
    "NIKE3D": "nike3d", "1": "nike3d",
    "Abaqus": "abaqus", "2": "abaqus",
    "Abaqus (GOH)": "abaqus-goh", "3": "abaqus-goh",
}  # fmt: skip
GRADIENT, MATRIX = "prestrain gradient", "mat3"
FIRST_AXIS = (1.0, 0.0, 0.0)  # FEBio's, where nothing is said


@dataclass(frozen=True)
class RigidMaterial:
    """A rigid material: its number in the file, centre of mass (3,), mm (NaN: to be found), and line."""

    number: int
    centre: Array
    line: int = 0


def read_materials(
    section: XmlNode, used: Container[str]
) -> tuple[dict[str, Material], dict[str, RigidMaterial], tuple[str, ...]]:
    """Read deformable and rigid materials by name, with notes on those that limbfit does not have.

    Those are an error if a part is made of one (``used``: their names).

    Raises `ProblemError` for a law, or a parameter of one, that limbfit does not have.
    """
    soft: dict[str, Material] = {}
    rigid: dict[str, RigidMaterial] = {}
    numbers, notes = set(), list[str]()
    for node in section:
        name, number = node.attribute("name"), node.identity()
        if name in soft or name in rigid or number in numbers:
            raise node.error(f"material {name!r} or its id is there twice")
        numbers.add(number)
        if node.attribute("type") == "rigid body":
            centre = node.find("center_of_mass")
            at = np.array([np.nan] * 3 if centre is None else centre.numbers(3))
            rigid[name] = RigidMaterial(number, at, node.line)
            continue
        try:
            soft[name] = _read_law(node)
        except ProblemError as error:
            if name not in used:
                notes.append(f"{node.place}: material {name!r} not read: no part is made of it")
                continue
            what = f"material {name}: {error.what}"
            raise ProblemError(what, place=error.place or node.place, remedy=error.remedy) from None
    return soft, rigid, tuple(notes)


@dataclass(frozen=True)
class _Surroundings:
    """What stands around an elastic law: bulk modulus ``k`` (MPa), factor of its moduli, and relaxation."""

    k: float
    volumetric: str
    scale: float = 1.0
    prony: tuple[tuple[float, float], ...] = ()


def _read_law(node: XmlNode) -> Material:
    around = _Surroundings(node.number("k", 0.0), _read_volumetric(node))
    if node.attribute("type") != PRESTRAINED:
        return _read_uncoupled(node, around)
    _check_parameters(node, {"elastic", "prestrain"} | _SHARED)
    inner = node.child("elastic")
    if inner.number("k", 0.0) != 0.0:
        raise inner.error("has a bulk modulus of its own in a pre-strain", "give that of the outer material")
    _check_volumetric(inner, around)
    return _read_uncoupled(inner, around)


def _read_uncoupled(node: XmlNode, around: _Surroundings) -> Material:
    kind = node.attribute("type")
    if kind == RELAXED:
        return _read_relaxing(node, around)
    if kind not in (*ELASTIC, MIXTURE):
        raise _build_kind_error(node, kind)
    if kind == MIXTURE:
        active = [one for one in node.find_all("solid") if one.attribute("type") == ACTIVE]
        if active:
            return _read_contractile(node, active, around)
    return _read_hyperelastic(node, around)


def _read_relaxing(node: XmlNode, around: _Surroundings) -> Material:
    elastic = node.child("elastic")
    if elastic.attribute("type") not in (*ELASTIC, MIXTURE):
        raise _build_kind_error(elastic, elastic.attribute("type"))
    _check_parameters(node, _RELAXING | _SHARED)
    g0 = node.number("g0", 1.0)
    if not g0 > 0.0:
        raise node.error("g0 is not positive: nothing would hold the tissue in the long term")
    prony = [(node.number(f"g{i}", 0.0), i) for i in range(1, 7)]
    terms = tuple((g / g0, node.number(f"t{i}", 1.0)) for g, i in prony if g != 0.0)
    _check_volumetric(elastic, around)
    # The wrapper adds its own k to the elastic material's; g0 scales the deviatoric part only.
    k = around.k + elastic.number("k", 0.0)
    return _read_hyperelastic(elastic, replace(around, k=k, scale=g0, prony=terms))


def _check_volumetric(inner: XmlNode, around: _Surroundings) -> None:
    if inner.find("pressure_model") is not None and _read_volumetric(inner) != around.volumetric:
        raise inner.error("its pressure_model differs from that of the material around it")


def _read_contractile(node: XmlNode, active: list[XmlNode], around: _Surroundings) -> ContractileMaterial:
    """Read what a mixture bears passively, and the stress of its fibres at full activation."""
    if len(active) > 1:
        raise active[1].error("a mixture is read with one contraction")
    _check_parameters(node, {"solid"} | _SHARED)
    (active_stress,) = active
    _check_parameters(active_stress, {"smax", "activation", "k", "density"})
    rest = [one for one in node.find_all("solid") if one is not active_stress]
    if [one.attribute("type") for one in rest] == [RELAXED]:
        _check_volumetric(rest[0], around)
        passive = _read_relaxing(rest[0], around)
    elif len(rest) == 1 and rest[0].attribute("type") in ELASTIC:
        passive = _read_elastic(rest[0], around)
    else:
        passive = _read_mixture(node, rest, around)
    if not isinstance(passive, FibredMaterial):
        assert isinstance(passive, Uncoupled)
        passive = FibredMaterial(passive, 0.0, 1.0)
    return ContractileMaterial(passive, active_stress.number("smax") * active_stress.number("activation"))


def _read_hyperelastic(node: XmlNode, around: _Surroundings) -> Material:
    """Read an elastic law, and the fibres beside it if it is a mixture."""
    if node.attribute("type") != MIXTURE:
        return _read_elastic(node, around)
    _check_parameters(node, {"solid"} | _SHARED)
    return _read_mixture(node, node.find_all("solid"), around)


def _read_mixture(node: XmlNode, solids: list[XmlNode], around: _Surroundings) -> FibredMaterial:
    """Read the ground and the fibres among the ``solids`` of a mixture."""
    fibres = [one for one in solids if one.attribute("type") == FIBRE]
    grounds = [one for one in solids if one.attribute("type") in ELASTIC]
    if not len(fibres) == len(grounds) == 1 or len(solids) != 2:
        if any(one.attribute("type") == ACTIVE for one in solids):
            raise node.error("an active stress that relaxes is not read", f"put {ACTIVE} beside {RELAXED}")
        raise node.error(f"a mixture is read of one {FIBRE} and one of {', '.join(ELASTIC)}")
    (fibre,), (ground,) = fibres, grounds
    for one in solids:
        if one.number("k", 0.0) != 0.0:
            raise one.error("has a bulk modulus of its own in a mixture", "give that of the mixture alone")
    _check_parameters(fibre, {"ksi", "alpha", "beta", "fiber", "k", "density"})
    stated = fibre.find("fiber")
    if stated is not None and (stated.attribute("type") != "vector" or stated.numbers(3) != [*FIRST_AXIS]):
        raise stated.error("fibres run along the first of the local axes", "state it as mat_axis")
    if fibre.number("beta") != 2.0:
        raise fibre.child("beta").error("limbfit's fibres have beta = 2")
    base = _read_elastic(ground, around)
    return FibredMaterial(base, around.scale * fibre.number("ksi"), fibre.number("alpha"))


def _build_kind_error(node: XmlNode, kind: str) -> ProblemError:
    remedy = "limbfit has uncoupled materials: " + ", ".join(ELASTIC) + ", uncoupled viscoelastic"
    if kind in ("neo-Hookean", "isotropic elastic"):
        remedy = "use 'incomp neo-Hookean' with G = E / (2 (1 + v)) and k = E / (3 (1 - 2 v))"
    return node.error(f"material type {kind!r} is not known", remedy)


def _read_volumetric(node: XmlNode) -> str:
    name = node.string("pressure_model", "")
    if name not in _VOLUMETRIC:
        raise node.child("pressure_model").error(f"volumetric law {name!r} is not known")
    return _VOLUMETRIC[name]


def _check_parameters(node: XmlNode, allowed: set[str]) -> None:
    for child in node:
        if child.tag not in allowed:
            raise child.error("this parameter of the material is not known")
        varies = child.attributes.get("lc") or child.attributes.get("type") not in (None, "const")
        if varies and child.tag not in ("elastic", "solid", "mat_axis", "fiber", "prestrain", "activation"):
            raise child.error("a parameter that changes in time or space is not supported")
    if node.flag("laugon"):
        raise node.child("laugon").error("augmented incompressibility is not supported")


def _read_elastic(node: XmlNode, around: _Surroundings) -> Uncoupled:
    kind, k, scale, prony = node.attribute("type"), around.k, around.scale, around.prony
    _check_parameters(node, ELASTIC[kind] | _SHARED)
    if not k > 0.0:
        raise node.error("has no positive bulk modulus k")
    shared: dict[str, Any] = {"prony": prony, "volumetric": around.volumetric}
    if kind == "incomp neo-Hookean":
        mu = scale * node.number("G")
        return NeoHookean(mu, kappa_ratio=k / _check_modulus(node, mu), **shared)
    if kind == "Mooney-Rivlin":
        c1, c2 = scale * node.number("c1"), scale * node.number("c2", 0.0)
        return MooneyRivlin(c1, c2, kappa_ratio=k / _check_modulus(node, 2.0 * (c1 + c2)), **shared)
    terms = [(scale * node.number(f"c{i}", 0.0), node.number(f"m{i}", 1.0)) for i in range(1, 7)]
    terms = [term for term in terms if term[0] != 0.0]
    ratio = k / _check_modulus(node, sum(c for c, _ in terms) / 2.0)
    if len(terms) == 2 and around.volumetric == "log":
        (c, m), (other, minus) = terms
        if (c, m) == (other, -minus) and m > 0.0:
            gamma, tau = zip(*prony or ((0.0, 1.0),), strict=True)
            return OgdenQLV(c, m, gamma, tau, ratio)
    return Ogden(tuple(terms), kappa_ratio=ratio, **shared)


def _check_modulus(node: XmlNode, mu: float) -> float:
    if not mu > 0.0:
        raise node.error(f"the shear modulus of small strains is {mu:.4g} MPa, not positive")
    return mu


@dataclass(frozen=True)
class Contraction:
    """The load curve of a material's active stress (0: it is constant)."""

    material: str
    curve: int
    line: int


@dataclass(frozen=True)
class Prestrain:
    """The pre-strain of the cells (m, 3, 3) of a part, and the load curve with which it grows (0: none)."""

    gradient: Array
    curve: int
    factor: float
    line: int


def read_contractions(
    section: XmlNode, materials: Mapping[str, Material], curves: Mapping[int, LoadCurve]
) -> tuple[Contraction, ...]:
    """Read the courses of the active stresses of the materials that have some."""
    found = []
    for node in section:
        if materials.get(node.attribute("name")) is not None:
            for solid in _walk(node):
                if solid.attributes.get("type") == ACTIVE:
                    curve = read_curve_number(solid.child("activation"), curves)
                    found.append(Contraction(node.attribute("name"), curve, solid.line))
    return tuple(found)


def _walk(node: XmlNode) -> Iterator[XmlNode]:
    for child in node:
        yield child
        yield from _walk(child)


def read_prestrains(
    root: XmlNode,
    materials: Mapping[str, Material],
    curves: Mapping[int, LoadCurve],
    parts: Mapping[str, Part],
) -> dict[str, Prestrain]:
    """Read the pre-strains of the parts that have some.

    Raises `ProblemError` for generators other than a gradient, and for gradients that change the volume,
    which FEBio's pressure does not see and limbfit's does.
    """
    matrices = [d for d in root.find("MeshData") or () if d.attributes.get("data_type") == MATRIX]
    maps = {(data.attribute("name"), data.attribute("elem_set")): data for data in matrices}
    nodes = {node.attribute("name"): node for node in root.child("Material")}
    found = {}
    for name, part in parts.items():
        node = nodes[part.material]
        prestrain = node.find("prestrain") if node.attributes.get("type") == PRESTRAINED else None
        if part.material not in materials or prestrain is None:
            continue
        if prestrain.attribute("type") != GRADIENT:
            raise prestrain.error(f"a pre-strain is read as {GRADIENT!r} only")
        ramp, value = prestrain.find("ramp"), prestrain.child("F0")
        gradient = _read_gradient(value, maps, name, len(part.cells))
        if np.abs(np.linalg.det(gradient) - 1.0).max(initial=0.0) > 1e-9:
            raise value.error("changes the volume, which FEBio's pressure does not see and limbfit's does")
        curve, factor = (0, 1.0) if ramp is None else (read_curve_number(ramp, curves), ramp.scalar())
        found[name] = Prestrain(gradient, curve, factor, prestrain.line)
    return found


def _read_gradient(value: XmlNode, maps: Mapping[tuple[str, str], XmlNode], part: str, count: int) -> Array:
    if value.attributes.get("type") != "map":
        return np.tile(np.reshape(value.numbers(9), (3, 3)), (count, 1, 1))
    name, found = value.text.strip(), np.full((count, 9), np.nan)
    data = maps.get((name, part))
    if data is None:
        raise value.error(f"there is no map {name[:40]!r} of the part {part!r}")
    for element in data:
        found[_find_cell(element, count)] = element.numbers(9)
    if np.isnan(found).any():
        raise data.error("has no value for some element of the part")
    return found.reshape(-1, 3, 3)


def read_fibres(
    root: XmlNode, materials: Mapping[str, Material], parts: Mapping[str, Part]
) -> dict[str, Array]:
    """Read the direction of the fibres of each cell (m, 3) of the parts that have some.

    Raises `ProblemError` for axes that are not given by vectors, and for other data of the mesh.
    """
    axes = {node.attribute("name"): _read_material_axis(node) for node in root.child("Material")}
    found = {}
    for name, part in parts.items():
        if part.material in materials and materials[part.material].table().has_fibres:
            found[name] = np.tile(axes[part.material], (len(part.cells), 1))
    for data in root.find("MeshData") or ():
        if data.attributes.get("data_type") == MATRIX:
            continue
        if data.tag != "ElementData" or data.attribute("type") != "mat_axis":
            raise data.error(f"of <MeshData> only the mat_axis of elements, and {MATRIX}, are supported")
        name = data.attribute("elem_set")
        if name not in parts:
            raise data.error(f"there is no part {name!r}")
        if name in found:
            for element in data:
                found[name][_find_cell(element, len(found[name]))] = _read_vector(element)
    return found


def _read_material_axis(node: XmlNode) -> Array:
    axis = node.find("mat_axis")
    if axis is None:
        return np.array(FIRST_AXIS)
    if axis.attribute("type") != "vector":
        raise axis.error("is not given by vectors", 'use type="vector" with <a> and <d>')
    return _read_vector(axis)


def _find_cell(element: XmlNode, count: int) -> int:
    """Return the place of an element among the ``count`` cells of its part, by the attribute ``lid``."""
    text = element.attribute("lid")
    if not text.isdecimal() or not 1 <= int(text[:9]) <= count:
        raise element.error(f"there is no element {text[:20]} in the part")
    return int(text) - 1


def _read_vector(node: XmlNode) -> Array:
    found = np.array(node.child("a").numbers(3))
    if not found.any():
        raise node.error("has an axis of no length")
    return found
