"""What strains tissue by itself in an input: fibres that contract, and a pre-strain that has settled.

limbfit's pre-strained tissue is in equilibrium, and has relaxed, before time begins.  In FEBio the pre-strain
grows while everything else rests: that step is read as the beginning, and the time after it begins at 0.

Source: FEBio's feature manual, ``uncoupled active fiber stress``, ``uncoupled prestrain elastic`` and
``prestrain gradient``.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...errors import ProblemError
from ...fe import Material
from .controls import ControlPhase
from .curves import Curve
from .geometry import Part
from .materials import ACTIVE, PRESTRAINED
from .motions import RigidCondition
from .tree import Node

Array = NDArray[np.float64]
GRADIENT, MATRIX = "prestrain gradient", "mat3"
RELAXED = 20.0  # longest relaxation times after which no more than 2e-9 of a stress is left


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
    section: Node, materials: Mapping[str, Material], curves: Mapping[int, Curve]
) -> tuple[Contraction, ...]:
    """The courses of the active stresses of the materials that have some."""
    found = []
    for node in section:
        if materials.get(node.attribute("name")) is not None:
            for solid in _all(node):
                if solid.attributes.get("type") == ACTIVE:
                    curve = _curve(solid.child("activation"), curves)
                    found.append(Contraction(node.attribute("name"), curve, solid.line))
    return tuple(found)


def _all(node: Node) -> Iterator[Node]:
    for child in node:
        yield child
        yield from _all(child)


def _curve(value: Node, curves: Mapping[int, Curve]) -> int:
    number = value.attributes.get("lc", "")
    if number and not (number.isdecimal() and int(number) in curves):
        raise value.refuse(f"there is no load curve {number!r}")
    return int(number or 0)


def read_prestrains(
    root: Node, materials: Mapping[str, Material], curves: Mapping[int, Curve], parts: Mapping[str, Part]
) -> dict[str, Prestrain]:
    """The pre-strains of the parts that have some.

    Raises
    ------
    ProblemError
        For generators other than a gradient, and for gradients that change the volume, which FEBio's pressure
        does not see and limbfit's does.
    """
    maps = {(data.attribute("name"), data.attribute("elem_set")): data for data in _matrices(root)}
    nodes = {node.attribute("name"): node for node in root.child("Material")}
    found = {}
    for name, part in parts.items():
        node = nodes[part.material]
        prestrain = node.find("prestrain") if node.attributes.get("type") == PRESTRAINED else None
        if part.material not in materials or prestrain is None:
            continue
        if prestrain.attribute("type") != GRADIENT:
            raise prestrain.refuse(f"a pre-strain is read as {GRADIENT!r} only")
        ramp, value = prestrain.find("ramp"), prestrain.child("F0")
        gradient = _gradient(value, maps, name, len(part.cells))
        if np.abs(np.linalg.det(gradient) - 1.0).max(initial=0.0) > 1e-9:
            raise value.refuse("changes the volume, which FEBio's pressure does not see and limbfit's does")
        curve, factor = (0, 1.0) if ramp is None else (_curve(ramp, curves), ramp.scalar())
        found[name] = Prestrain(gradient, curve, factor, prestrain.line)
    return found


def _matrices(root: Node) -> list[Node]:
    """The matrices of elements in the section of mesh data."""
    section = root.find("MeshData") or ()
    return [data for data in section if data.attributes.get("data_type") == MATRIX]


def _gradient(value: Node, maps: Mapping[tuple[str, str], Node], part: str, count: int) -> Array:
    if value.attributes.get("type") != "map":
        return np.tile(np.reshape(value.numbers(9), (3, 3)), (count, 1, 1))
    name, found = value.text.strip(), np.full((count, 9), np.nan)
    data = maps.get((name, part))
    if data is None:
        raise value.refuse(f"there is no map {name[:40]!r} of the part {part!r}")
    for element in data:
        text = element.attribute("lid")
        if not text.isdecimal() or not 1 <= int(text[:9]) <= count:
            raise element.refuse(f"there is no element {text[:20]} in the part")
        found[int(text) - 1] = element.numbers(9)
    if np.isnan(found).any():
        raise data.refuse("has no value for some element of the part")
    return found.reshape(-1, 3, 3)


def settled_s(
    prestrains: Mapping[str, Prestrain], materials: Mapping[str, Material], phases: tuple[ControlPhase, ...],
    curves: Mapping[int, Curve], others: Mapping[int, str], conditions: tuple[RigidCondition, ...],
) -> float:  # fmt: skip
    """How long the first step is, s, in which pre-strained tissue settles; 0 where it needs none.

    Parameters
    ----------
    others : the load curves of what else moves tissue, each with what it is.

    Raises
    ------
    ProblemError
        Where the pre-strain goes on growing, the tissue has not relaxed, or something else moves it.
    """
    slowest = max(
        (tau for law in materials.values() for g, tau in law.table().prony if g != 0.0), default=0.0
    )
    growing = [one for one in prestrains.values() if one.curve]
    steady = [one for one in prestrains.values() if not one.curve]
    if steady and slowest > 0.0:
        remedy = "let its ramp grow in a first step of its own, and rest"
        raise _refused("acts at once in tissue that relaxes", steady[0], remedy)
    if not growing:
        return 0.0
    first = phases[0].seconds
    if len(phases) < 2:
        raise _refused(
            "grows in the only step", growing[0], "let it grow in a first step of its own, and rest"
        )
    rested = max(_rest_of(one, first, slowest, curves) for one in growing)
    times = np.linspace(rested, first, 101)
    for number, words in others.items():
        values = curves[number].at(times)
        if np.abs(values - values[0]).max() > 0.0:
            raise _refused(f"settles while {words} changes", growing[0], "let it change after the first step")
    for held in conditions:
        gone = held.curve and held.step == 0 and held.kind == "moved"
        later = {(c.body, c.freedom) for c in conditions if c.kind == "moved" and c.step in (None, 1)}
        if gone and held.factor * curves[held.curve].at(first) and (held.body, held.freedom) not in later:
            raise _refused(f"settles while the rigid body {held.body!r} goes elsewhere", growing[0])
    return first


def _rest_of(one: Prestrain, first: float, slowest: float, curves: Mapping[int, Curve]) -> float:
    """When a pre-strain has grown, s; it then rests until the first step ends."""
    points = curves[one.curve].points
    if not len(points) or curves[one.curve].corners is None:
        raise _refused("grows along no line through points", one, "use LINEAR points")
    grown = float(points[np.flatnonzero(points[:, 1] != points[-1, 1]).max(initial=-1) + 1, 0])
    rest = first - grown
    if rest < 0.0:
        raise _refused("goes on growing after the first step", one)
    if rest < RELAXED * slowest:
        what = f"rests for {rest:.4g} s in the first step, in which tissue of {slowest:.4g} s does not relax"
        raise _refused(what, one, f"let it rest for {RELAXED * slowest:.4g} s")
    return grown


def _refused(what: str, one: Prestrain, remedy: str | None = None) -> ProblemError:
    return ProblemError(f"a pre-strain {what}", place=f"line {one.line}, <prestrain>", remedy=remedy)
