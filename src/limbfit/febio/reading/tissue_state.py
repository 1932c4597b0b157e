"""The state of tissue in an input: directions of fibres, their contraction, and a pre-strain that has
settled.

limbfit's pre-strained tissue is in equilibrium, and has relaxed, before time begins. In FEBio the pre-strain
grows while everything else rests: that step is read as the beginning, and the time after it begins at 0.

Source: FEBio's feature manual, ``uncoupled active fiber stress``, ``uncoupled prestrain elastic`` and
``prestrain gradient``; User Manual 4.0, sections on local material axes and on ``MeshData``.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from ...arrays import Array
from ...errors import ProblemError
from ...fe import Material
from .controls import ControlPhase
from .curves import LoadCurve
from .geometry import Part
from .materials import ACTIVE, PRESTRAINED
from .rigid import RigidCondition
from .tree import XmlNode

GRADIENT, MATRIX = "prestrain gradient", "mat3"
MIN_RELAXATION_TIMES = 20.0  # longest relaxation times after which no more than 2e-9 of a stress is left
_FIRST = (1.0, 0.0, 0.0)  # FEBio's, where nothing is said


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
                    curve = _read_curve_number(solid.child("activation"), curves)
                    found.append(Contraction(node.attribute("name"), curve, solid.line))
    return tuple(found)


def _walk(node: XmlNode) -> Iterator[XmlNode]:
    for child in node:
        yield child
        yield from _walk(child)


def _read_curve_number(value: XmlNode, curves: Mapping[int, LoadCurve]) -> int:
    number = value.attributes.get("lc", "")
    if number and not (number.isdecimal() and int(number) in curves):
        raise value.error(f"there is no load curve {number!r}")
    return int(number or 0)


def read_prestrains(
    root: XmlNode,
    materials: Mapping[str, Material],
    curves: Mapping[int, LoadCurve],
    parts: Mapping[str, Part],
) -> dict[str, Prestrain]:
    """Read the pre-strains of the parts that have some.

    Raises
    ------
    ProblemError
        For generators other than a gradient, and for gradients that change the volume, which FEBio's pressure
        does not see and limbfit's does.
    """
    maps = {(data.attribute("name"), data.attribute("elem_set")): data for data in _find_matrices(root)}
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
        curve, factor = (0, 1.0) if ramp is None else (_read_curve_number(ramp, curves), ramp.scalar())
        found[name] = Prestrain(gradient, curve, factor, prestrain.line)
    return found


def _find_matrices(root: XmlNode) -> list[XmlNode]:
    """Return the matrices of elements in the section of mesh data."""
    section = root.find("MeshData") or ()
    return [data for data in section if data.attributes.get("data_type") == MATRIX]


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


def compute_settling_time_s(
    prestrains: Mapping[str, Prestrain], materials: Mapping[str, Material], phases: tuple[ControlPhase, ...],
    curves: Mapping[int, LoadCurve], other_curves: Mapping[int, str], conditions: tuple[RigidCondition, ...],
) -> float:  # fmt: skip
    """Return the length of the first step, s, in which pre-strained tissue settles; 0 if it needs none.

    Parameters
    ----------
    other_curves : the load curves of what else moves tissue, each with a description.

    Raises
    ------
    ProblemError
        If the pre-strain goes on growing, the tissue has not relaxed, or something else moves it.
    """
    slowest = max(
        (tau for law in materials.values() for g, tau in law.table().prony if g != 0.0), default=0.0
    )
    growing = [one for one in prestrains.values() if one.curve]
    steady = [one for one in prestrains.values() if not one.curve]
    if steady and slowest > 0.0:
        remedy = "let its ramp grow in a first step of its own, and rest"
        raise _build_prestrain_error("acts at once in tissue that relaxes", steady[0], remedy)
    if not growing:
        return 0.0
    first = phases[0].seconds
    if len(phases) < 2:
        raise _build_prestrain_error(
            "grows in the only step", growing[0], "let it grow in a first step of its own, and rest"
        )
    rested = max(_compute_rest_start(one, first, slowest, curves) for one in growing)
    times = np.linspace(rested, first, 101)
    for number, description in other_curves.items():
        values = curves[number].at(times)
        if np.abs(values - values[0]).max() > 0.0:
            raise _build_prestrain_error(
                f"settles while {description} changes", growing[0], "let it change after the first step"
            )
    for held in conditions:
        gone = held.curve and held.step == 0 and held.kind == "moved"
        later = {(c.body, c.freedom) for c in conditions if c.kind == "moved" and c.step in (None, 1)}
        if gone and held.factor * curves[held.curve].at(first) and (held.body, held.freedom) not in later:
            raise _build_prestrain_error(
                f"settles while the rigid body {held.body!r} goes elsewhere", growing[0]
            )
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


def read_fibres(
    root: XmlNode, materials: Mapping[str, Material], parts: Mapping[str, Part]
) -> dict[str, Array]:
    """Read the direction of the fibres of each cell (m, 3) of the parts that have some.

    Raises
    ------
    ProblemError
        For axes that are not given by vectors, and for other data of the mesh.
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
            _read_element_axes(data, found[name])
    return found


def _read_material_axis(node: XmlNode) -> Array:
    axis = node.find("mat_axis")
    if axis is None:
        return np.array(_FIRST)
    if axis.attribute("type") != "vector":
        raise axis.error("is not given by vectors", 'use type="vector" with <a> and <d>')
    return _read_vector(axis)


def _read_element_axes(data: XmlNode, out: Array) -> None:
    for element in data:
        out[_find_cell(element, len(out))] = _read_vector(element)


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
