"""Viscoelastic history at the quadrature points and its update, step by step."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from .kinematics import deformation_gradient, from_principal, logarithmic_stretches, principal
from .laws import Laws
from .materials import prony_factors
from .materials.ogden import ogden
from .system import Increment, System

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Memory:
    """``elastic (m, q, 6)``: deviatoric second Piola-Kirchhoff stress Se; ``prony (l, m, q, 6)``: H; MPa."""

    elastic: Array
    prony: Array

    @classmethod
    def rest(cls, system: System, laws: Laws) -> Memory:
        shape = (*system.weights.shape, 6)
        return cls(np.zeros(shape), np.zeros((laws.prony.shape[1], *shape)))

    def increment(
        self, system: System, laws: Laws, time: float, dt: float, displacement: float, penalty: float
    ) -> Increment:
        """The step of ``dt`` s that ends at ``time``."""
        decay, ramp, *_ = prony_factors(dt, laws.prony[..., 1])
        gamma = laws.prony[..., 0]
        of = system.regions
        K = -((gamma * ramp).sum(axis=1))[of][:, None, None] * self.elastic
        for l in range(gamma.shape[1]):
            K += (gamma * decay)[of, l][:, None, None] * self.prony[l]
        return Increment(time, displacement, 1.0 + (gamma * ramp).sum(axis=1), K, penalty)

    def advanced(self, system: System, laws: Laws, elastic: Array, dt: float) -> Memory:
        """The memory at the end of a step of ``dt`` s that ended with the elastic stress ``elastic``."""
        decay, ramp, *_ = prony_factors(dt, laws.prony[..., 1])
        of = system.regions
        prony = np.empty_like(self.prony)
        for l in range(len(prony)):
            change = ramp[of, l][:, None, None] * (elastic - self.elastic)
            prony[l] = decay[of, l][:, None, None] * self.prony[l] + change
        return Memory(elastic, prony)


def elastic_stresses(system: System, laws: Laws, u: Array) -> Array:
    """Deviatoric second Piola-Kirchhoff stress ``Se (m, q, 6)`` of the elastic law at ``u (n, 3)``, MPa."""
    stress = np.empty((*system.weights.shape, 6))

    def part(cells: slice) -> None:
        elastic_stress(
            system.cells[cells], system.gradients[cells], system.regions[cells], laws.terms, u, stress[cells]
        )

    system.over_cells(part)
    return stress


@njit(cache=True, nogil=True)
def elastic_stress(cells, grads, regions, terms, u, out):  # type: ignore[no-untyped-def]
    """The kernel of `elastic_stresses`."""
    m, k = cells.shape
    ue, matrix, vector = np.empty((3, k)), np.empty((3, 3, 3)), np.empty((7, 3))
    F, A, N = matrix[0], matrix[1], matrix[2]
    c2, e, beta, slope, quotient = vector[0], vector[1], vector[2], vector[3], vector[4]
    for el in range(m):
        for a in range(k):
            for i in range(3):
                ue[i, a] = u[cells[el, a], i]
        for q in range(grads.shape[1]):
            deformation_gradient(grads[el, q], ue, F)
            principal(F, A, c2, N)
            logarithmic_stretches(c2, e)
            ogden(terms[regions[el]], c2, e, beta, slope, quotient)
            for i in range(3):
                beta[i] /= c2[i]
            from_principal(beta, N, out[el, q])
