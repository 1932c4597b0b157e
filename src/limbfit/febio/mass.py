"""Where the mass of a rigid body lies, for inputs that leave it to FEBio."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from ..fe import ELEMENTS
from ..fe.kernel.elements import reference_gradients
from .geometry import Part, triangles

Array = NDArray[np.float64]
_PRISM = ([0, 1, 2, 5], [0, 1, 5, 4], [0, 4, 5, 3])  # three tetrahedra of a penta6


def centre_of_mass(points: Array, parts: Iterable[Part]) -> Array:
    """Centre of mass (3,) of parts of one density, mm: solids by volume, shells by area times thickness.

    That of a body without volume is the origin, as in FEBio.
    """
    total, moment = 0.0, np.zeros(3)
    for part in parts:
        mass, at = _lumps(points, part)
        total += float(mass.sum())
        moment += mass @ at
    return moment / total if total > 0.0 else moment


def _lumps(points: Array, part: Part) -> tuple[Array, Array]:
    """A part as masses (k,) at places (k, 3)."""
    if part.cell_type in ELEMENTS:
        element = ELEMENTS[part.cell_type]
        _, volumes = reference_gradients(element, points, part.cells)
        values, _ = element.shape(element.points)
        return np.abs(volumes).ravel(), np.einsum("qk,mki->mqi", values, points[part.cells]).reshape(-1, 3)
    if part.cell_type == "penta6":
        tets = points[np.concatenate([part.cells[:, corners] for corners in _PRISM])]
        return np.abs(np.linalg.det(tets[:, 1:] - tets[:, :1])) / 6.0, tets.mean(axis=1)
    corners = part.cells[:, : 4 if part.cell_type == "quad4" else 3]
    flat = points[triangles(corners)]
    area = 0.5 * np.linalg.norm(np.cross(flat[:, 1] - flat[:, 0], flat[:, 2] - flat[:, 0]), axis=1)
    return part.thickness * area, flat.mean(axis=1)
