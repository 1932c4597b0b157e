"""The materials of all regions as the arrays that the compiled kernels read, and what they give anywhere."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numba import njit

from ...arrays import Array, Index, Indices
from ...mesh import Mesh
from ..lanes import LANES, workspace
from ..materials import Material
from .elements import Element
from .response import elastic_moduli, elastic_response, pull_back

Tables = tuple[Array, Array, Indices, Indices, Array]


@dataclass(frozen=True)
class Laws:
    """Materials of all regions as padded arrays; see `LawTable`; ``moduli (r,)`` are instantaneous, MPa.

    ``elastic (r, 2)``: addresses of each region's elastic law in this process.  ``parameter_index (r, p)``
    says which global parameter each region's p-th one is (-1: none).  ``fibre (r, 3)``: k1 and active stress
    (MPa) and, between them, k2; ``d_fibre (r, p, 3)``.
    """

    numbers: Array
    kappa: Array
    law: Indices
    elastic: Indices
    prony: Array
    d_numbers: Array
    d_kappa: Array
    d_prony: Array
    parameter_index: Indices
    moduli: Array
    modulus_gradient: Array
    fibre: Array
    d_fibre: Array

    @property
    def tables(self) -> Tables:
        """``numbers (r, k), kappa (r,), law (r,), elastic (r, 2), fibre (r, 3)``, as kernels take them: of
        the elastic stress alone, with no active stress in the last column of ``fibre``."""
        return self.activate(0.0, np.ones(len(self.kappa)))

    def activate(self, share: float, scale: Array) -> Tables:
        """`tables` with a ``share`` of the active stress, which kernels multiply by ``scale (r,)``, as all
        that is elastic."""
        active = share * self.fibre[:, 2]
        active = np.divide(active, scale, out=np.zeros_like(active), where=active != 0.0)
        fibre = np.column_stack([self.fibre[:, :2], active])
        return self.numbers, self.kappa, self.law, self.elastic, fibre

    @property
    def has_fibres(self) -> bool:
        """True if a region has fibres."""
        return bool((self.fibre[:, ::2] > 0.0).any())

    @property
    def modulus(self) -> float:
        """Mean of the regions' instantaneous shear moduli, MPa."""
        return float(self.moduli.mean())

    @property
    def count(self) -> int:
        """Number of parameters of all regions."""
        return len(self.modulus_gradient)

    @classmethod
    def build(cls, materials: Sequence[Material]) -> Laws:
        tables, slopes = [m.table() for m in materials], [m.derivatives() for m in materials]
        K = max(len(t.numbers) for t in tables)
        L = max(len(t.prony) for t in tables)
        P = max(len(d) for d in slopes)
        R = len(materials)
        # What is left over is an Ogden term, or a relaxation, of no size.
        numbers, prony = np.tile([0.0, 1.0], (R, K))[:, :K], np.tile([0.0, 1.0], (R, L, 1))
        d_numbers, d_prony, d_kappa = np.zeros((R, P, K)), np.zeros((R, P, L, 2)), np.zeros((R, P))
        d_fibre = np.zeros((R, P, 3))
        index, at = np.full((R, P), -1), 0
        for r, (table, slope) in enumerate(zip(tables, slopes)):
            numbers[r, : len(table.numbers)], prony[r, : len(table.prony)] = table.numbers, table.prony
            for p, d in enumerate(slope):
                d_numbers[r, p, : len(d.numbers)], d_prony[r, p, : len(d.prony)] = d.numbers, d.prony
                d_kappa[r, p], d_fibre[r, p] = d.kappa, (*d.fibre, d.active)
                index[r, p] = at
                at += 1
        moduli = np.array([m.instantaneous_modulus for m in materials])
        gradient = np.concatenate([m.instantaneous_modulus_gradient for m in materials]) / R
        kappa = np.array([t.kappa for t in tables])
        law = np.array([t.volumetric for t in tables])
        elastic = np.array([t.elastic.addresses for t in tables], dtype=np.int64)
        return cls(
            np.ascontiguousarray(numbers), kappa, law, elastic, prony, d_numbers, d_kappa, d_prony, index,
            moduli, gradient, np.array([(*t.fibre, t.active) for t in tables]), d_fibre,
        )  # fmt: skip


@dataclass(frozen=True)
class EvaluationPoints:
    """Points (m,) in a mesh, each as an element with one point.

    ``cells (m, k)`` are nodes of its element, ``gradients (m, 1, 3, k)`` of their shape functions at the
    point, 1/mm; ``regions (m,)``, ``fibres`` and ``prestretch`` as a `System` has them.
    """

    cells: Index
    gradients: Array
    weights: Array
    regions: Index
    fibres: Array
    prestretch: Array

    @classmethod
    def from_cells(
        cls, mesh: Mesh, element: Element, cells: Indices, local: Array, fibres: Array, prestretch: Array
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

    Returns ``stress``: (m, 6) deviatoric second Piola-Kirchhoff stress Se, MPa. ``moduli``: (m, 6, 6) its
    derivative by the strain E; tensor components in both, MPa. ``gradient``: (m, 3, 3) the deformation
    gradient.
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
        pull_back(p, len(elements[4]) > 0)
        elastic_moduli(p, element[0], len(elements[4]) > 0)
        for l in range(min(LANES, m - start)):
            for r in range(6):
                stress[start + l, r] = p.tau[r, l]
                for s in range(6):
                    D[start + l, r, s] = p.D[r, s, l]
            for i in range(3):
                for j in range(3):
                    F[start + l, i, j] = p.F[i, j, l]
