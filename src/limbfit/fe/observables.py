"""Fields of one accepted step, at elements and contact faces."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from .kinematics import (
    deformation_gradient,
    from_principal,
    logarithmic_stretches,
    mean_dilatation,
    principal,
    push_forward,
)
from .laws import Laws
from .materials.ogden import ogden
from .materials.volumetric import volumetric
from .result import State
from .system import System

Array = NDArray[np.float64]


@dataclass(frozen=True)
class ElementFields:
    """Volume averages per element.

    ``cauchy (m, 6)`` MPa in the order xx, yy, zz, xy, yz, zx; ``stretches (m, 3)`` principal, falling;
    ``J (m,)``; ``energy (m,)`` long-term elastic strain energy density, N mm per mm^3.
    """

    cauchy: Array
    stretches: Array
    J: Array
    energy: Array


def element_fields(system: System, laws: Laws, state: State) -> ElementFields:
    """Fields of a state that kept its memory (``store="peak"``, or a step of `iterate`)."""
    if state.memory is None:
        raise ValueError("the state was stored without its stresses")
    history = np.zeros_like(state.memory.elastic)
    gamma = laws.prony[..., 0][system.regions]
    for l in range(gamma.shape[1]):
        history += gamma[:, l, None, None] * state.memory.prony[l]
    out = np.zeros((len(system.cells), 11))
    _fields(
        system.cells, system.gradients, system.weights, system.element.mean_dilatation, system.regions,
        laws.tables, history, state.u, out,
    )  # fmt: skip
    return ElementFields(out[:, :6], out[:, 6:9], out[:, 9], out[:, 10])


def contact_pressure(system: System, state: State, penalty: float) -> Array:
    """Mean contact pressure (f,) on each contact face, MPa over the reference area; penalty in MPa/mm."""
    if system.surface is None or system.indenter is None:
        return np.zeros(0)
    gaps = system.surface.gaps(system.indenter.moved(state.displacement), state.u)
    areas = system.surface.areas
    return penalty * (np.maximum(-gaps, 0.0) * areas).sum(axis=1) / areas.sum(axis=1)


@njit(cache=True)
def _fields(cells, grads, weights, mean, regions, tables, history, u, out):  # type: ignore[no-untyped-def]
    terms, kappa, law = tables
    m, k = cells.shape
    ue, matrix, vector = np.empty((3, k)), np.empty((4, 3, 3)), np.empty((5, 3))
    F, A, N, n = matrix[0], matrix[1], matrix[2], matrix[3]
    c2, e, beta, slope, quotient = vector[0], vector[1], vector[2], vector[3], vector[4]
    tau = np.empty(6)
    for el in range(m):
        for a in range(k):
            for i in range(3):
                ue[i, a] = u[cells[el, a], i]
        r = regions[el]
        ratio = mean_dilatation(grads[el], weights[el], ue, F) if mean else 1.0
        volume = weights[el].sum()
        for q in range(grads.shape[1]):
            J = deformation_gradient(grads[el, q], ue, F)
            principal(F, A, c2, N)
            logarithmic_stretches(c2, e)
            W = ogden(terms[r], c2, e, beta, slope, quotient)
            U, JU, _ = volumetric(law[r], kappa[r], ratio if mean else J)
            pressure = JU * J / ratio if mean else JU
            for i in range(3):
                root = np.sqrt(c2[i])
                for p in range(3):
                    n[p, i] = (F[p, 0] * N[0, i] + F[p, 1] * N[1, i] + F[p, 2] * N[2, i]) / root
            from_principal(beta, n, tau)
            push_forward(F, history[el, q], A, tau, 1.0)
            w = weights[el, q] / volume
            for p in range(6):
                out[el, p] += w / J * (tau[p] + (pressure if p < 3 else 0.0))
            c2.sort()
            for i in range(3):
                out[el, 6 + i] += w * np.sqrt(c2[2 - i])
            out[el, 9] += w * J
            out[el, 10] += w * (W + U)
