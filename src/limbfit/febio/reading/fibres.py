"""Directions of fibres in an input: axes of materials, and of elements.

Source: FEBio User Manual 4.0, sections on local material axes and on ``MeshData``.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from ...fe import Material
from .geometry import Part
from .straining import MATRIX
from .tree import Node

Array = NDArray[np.float64]
_FIRST = (1.0, 0.0, 0.0)  # FEBio's, where nothing is said


def read_fibres(root: Node, materials: Mapping[str, Material], parts: Mapping[str, Part]) -> dict[str, Array]:
    """The direction of the fibres of each cell (m, 3) of the parts that have some.

    Raises
    ------
    ProblemError
        For axes that are not given by vectors, and for other data of the mesh.
    """
    axes = {node.attribute("name"): _of_material(node) for node in root.child("Material")}
    found = {}
    for name, part in parts.items():
        if part.material in materials and materials[part.material].table().has_fibres:
            found[name] = np.tile(axes[part.material], (len(part.cells), 1))
    for data in root.find("MeshData") or ():
        if data.attributes.get("data_type") == MATRIX:
            continue
        if data.tag != "ElementData" or data.attribute("type") != "mat_axis":
            raise data.refuse(f"of <MeshData> only the mat_axis of elements, and {MATRIX}, are supported")
        name = data.attribute("elem_set")
        if name not in parts:
            raise data.refuse(f"there is no part {name!r}")
        if name in found:
            _of_elements(data, found[name])
    return found


def _of_material(node: Node) -> Array:
    axis = node.find("mat_axis")
    if axis is None:
        return np.array(_FIRST)
    if axis.attribute("type") != "vector":
        raise axis.refuse("is not given by vectors", 'use type="vector" with <a> and <d>')
    return _vector(axis)


def _of_elements(data: Node, out: Array) -> None:
    for element in data:
        text = element.attribute("lid")
        if not text.isdecimal() or not 1 <= int(text[:9]) <= len(out):
            raise element.refuse(f"there is no element {text[:20]} in the part")
        out[int(text) - 1] = _vector(element)


def _vector(node: Node) -> Array:
    found = np.array(node.child("a").numbers(3))
    if not found.any():
        raise node.refuse("has an axis of no length")
    return found
