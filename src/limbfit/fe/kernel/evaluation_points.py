"""The elastic law at any points of the elements, not only at their quadrature points."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from ...arrays import Array
from ...mesh import Mesh
from ..lanes import LANES, workspace
from .elements import Element
from .laws import Laws
from .response import (
    add_material_fibre_moduli,
    add_material_fibre_stress,
    elastic_moduli,
    elastic_response,
    pull_back,
)

Ints = NDArray[np.int64]


@dataclass(frozen=True)
class EvaluationPoints:
    """Points (m,) in a mesh, each as an element with one point (`Points` of `fe.system`).

    ``cells (m, k)`` are nodes of its element, ``gradients (m, 1, 3, k)`` of their shape functions at the
    point, 1/mm; ``regions (m,)``, ``fibres`` and ``prestretch`` as a `System` has them.
    """

    cells: NDArray[np.int32]
    gradients: Array
    weights: Array
    regions: NDArray[np.int32]
    fibres: Array
    prestretch: Array

    @classmethod
    def at(
        cls, mesh: Mesh, element: Element, cells: Ints, local: Array, fibres: Array, prestretch: Array
    ) -> EvaluationPoints:
        """Points with ``local`` coordinates (m, 3) in ``cells`` (m,) of a mesh.

        ``fibres`` and ``prestretch`` are those of all cells, or of none.
        """
        nodes = mesh.cells[cells]
        _, slopes = element.shape(local)
        jacobian = np.einsum("mki,mkj->mij", mesh.points[nodes], slopes)
        gradients = np.einsum("mkj,mji->mik", slopes, np.linalg.inv(jacobian))[:, None]
        own = (of_all[cells] if len(of_all) else of_all for of_all in (fibres, prestretch))
        return cls(
            np.ascontiguousarray(nodes, dtype=np.int32),
            np.ascontiguousarray(gradients),
            np.ones((len(cells), 1)),
            np.ascontiguousarray(mesh.regions[cells], dtype=np.int32),
            *own,
        )

    @property
    def elements(self) -> tuple[Any, ...]:
        """As the kernels take elements."""
        return self.cells, self.gradients, self.weights, self.regions, self.fibres, self.prestretch


def evaluate_elastic_at(points: EvaluationPoints, laws: Laws, u: Array) -> tuple[Array, Array, Array]:
    """What the elastic laws give at displacements ``u (n, 3)``, mm.

    Returns
    -------
    stress : (m, 6) deviatoric second Piola-Kirchhoff stress Se, MPa.
    moduli : (m, 6, 6) its derivative by the strain E; tensor components in both, MPa.
    gradient : (m, 3, 3) the deformation gradient.
    """
    m = len(points.cells)
    stress, D, F = np.empty((m, 6)), np.empty((m, 6, 6)), np.empty((m, 3, 3))
    point, law, numbers, _, _, element, *_ = workspace(0, 1, laws.numbers.shape[1])
    records = point, law, numbers, element
    _evaluate_elastic_at(points.elements, laws.tables, u, records, stress, D, F)
    return stress, D, F


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"})
def _evaluate_elastic_at(elements, tables, u, records, stress, D, F):  # type: ignore[no-untyped-def]
    """The kernel of `evaluate_elastic_at`, `LANES` points side by side."""
    points, law, numbers, element = records
    p = points[0]
    m = len(stress)
    for start in range(0, m, LANES):
        elastic_response(elements, start, tables, u, points, law[0], numbers)
        pull_back(p)
        elastic_moduli(p, element[0])
        if len(elements[4]):
            add_material_fibre_stress(p)
            add_material_fibre_moduli(p, element[0])
        for l in range(min(LANES, m - start)):
            for r in range(6):
                stress[start + l, r] = p.tau[r, l]
                for s in range(6):
                    D[start + l, r, s] = p.D[r, s, l]
            for i in range(3):
                for j in range(3):
                    F[start + l, i, j] = p.F[i, j, l]
