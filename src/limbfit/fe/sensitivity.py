"""Direct differentiation: the derivative of every step with respect to every material parameter.

At a converged step ``R(u, history, p) = 0``, hence ``K du/dp = -dR/dp``; the right-hand side holds the
explicit derivative and that of the history, which is carried along at the quadrature points
(Michaleris, Tortorelli and Vidal 1994, transient problems).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from .direction import solve_at
from .factor import Factor
from .history import Memory
from .kinematics import deformation_gradient, from_principal, logarithmic_stretches, principal
from .laws import Laws
from .materials import prony_factors
from .materials.ogden import ogden, ogden_derivative
from .materials.volumetric import volumetric
from .system import Evaluation, Increment, System

Array = NDArray[np.float64]
# Residual of the linear systems, relative to their right-hand sides: what is left then in the force is of
# second order, but what the history hands on is not.
TOLERANCE = 3e-4


@dataclass(frozen=True)
class MemoryDerivative:
    """Derivatives of a `Memory`: ``elastic (m, q, 6, p)``, ``prony (l, m, q, 6, p)``."""

    elastic: Array
    prony: Array

    @classmethod
    def rest(cls, system: System, laws: Laws) -> MemoryDerivative:
        shape = (*system.weights.shape, 6, laws.count)
        return cls(np.zeros(shape), np.zeros((laws.prony.shape[1], *shape)))

    def residual(
        self, system: System, laws: Laws, memory: Memory, increment: Increment, u: Array, dt: float
    ) -> Array:
        """Derivative (n, 3, p) of the internal forces at fixed displacement ``u``; no contact in it."""
        derivatives = laws.d_terms, laws.d_kappa, laws.parameter_index
        coefficients = _step_coefficients(laws, dt)

        def part(cells: slice) -> Array:
            out = np.zeros((*u.shape, laws.count))
            explicit_forces(
                system.cells[cells], system.gradients[cells], system.weights[cells],
                system.element.mean_dilatation, system.regions[cells], laws.tables, derivatives,
                increment.scale, coefficients, memory.elastic[cells], memory.prony[:, cells],
                self.elastic[cells], self.prony[:, cells], u, out,
            )  # fmt: skip
            return out

        return np.asarray(sum(system.over_cells(part)))

    def advanced(
        self, system: System, laws: Laws, before: Memory, after: Memory, u: Array, du: Array, dt: float
    ) -> MemoryDerivative:
        """The derivative of the memory after the step, given ``du (n, 3, p)``."""
        elastic = np.empty_like(self.elastic)

        def part(cells: slice) -> None:
            elastic_stress_derivative(
                system.cells[cells], system.gradients[cells], system.regions[cells], laws.terms,
                laws.d_terms, laws.parameter_index, u, du, elastic[cells],
            )  # fmt: skip

        system.over_cells(part)
        decay, ramp, d_decay, d_ramp = prony_factors(dt, laws.prony[..., 1])
        of, prony = system.regions, np.empty_like(self.prony)
        for l in range(len(prony)):
            prony[l] = decay[of, l][:, None, None, None] * self.prony[l]
            prony[l] += ramp[of, l][:, None, None, None] * (elastic - self.elastic)
            for r, p in zip(*np.nonzero(laws.d_prony[:, :, l, 1])):
                d_tau, cells = laws.d_prony[r, p, l, 1], of == r
                change = d_decay[r, l] * before.prony[l][cells]
                change += d_ramp[r, l] * (after.elastic - before.elastic)[cells]
                prony[l][cells, :, :, laws.parameter_index[r, p]] += d_tau * change
        return MemoryDerivative(elastic, prony)


def solve_with_adjoint(
    at: Evaluation, factor: Factor, b: Array, guess: Array, advance: Array
) -> tuple[Array, Array]:
    """Solutions (n, p) of the tangent for ``b (n, p)``, and their products (p,) with ``advance (n,)``.

    The products are the force's derivatives, and better than the solutions: with the adjoint solution
    ``K a = advance`` a residual ``r`` changes a product by ``a . r``; with that added, what is left is a
    product of two errors (Pierce and Giles 2000).
    """
    right = np.column_stack([b, advance])
    found = solve_at(at, factor, right, np.column_stack([guess, np.zeros(len(b))]), TOLERANCE)
    x, adjoint = np.ascontiguousarray(found[:, :-1]), found[:, -1:].copy()
    missed = advance - factor.product(at.tangent, adjoint)[:, 0]
    return x, adjoint[:, 0] @ b + missed @ x


def _step_coefficients(laws: Laws, dt: float) -> tuple[Array, ...]:
    """Weights of H and Se in the history tensor K, their explicit derivatives, and that of the scale."""
    decay, ramp, d_decay, d_ramp = prony_factors(dt, laws.prony[..., 1])
    gamma = laws.prony[..., 0]
    d_gamma, d_tau = laws.d_prony[..., 0], laws.d_prony[..., 1]
    on_prony = gamma * decay
    on_elastic = -(gamma * ramp).sum(axis=1)
    d_on_prony = d_gamma * decay[:, None] + d_tau * (gamma * d_decay)[:, None]
    d_scale = (d_gamma * ramp[:, None] + d_tau * (gamma * d_ramp)[:, None]).sum(axis=2)
    return on_prony, on_elastic, d_on_prony, d_scale


@njit(cache=True, nogil=True, fastmath={"contract"})
def explicit_forces(  # type: ignore[no-untyped-def]
    cells, grads, weights, mean, regions, tables, d_tables, scale, coefficients, Se, H, dSe, dH, u, out
):
    """Internal forces of the stress ``dS/dp`` at fixed displacement, added to ``out (n, 3, p)``.

    ``dS/dp = ds Se + s dSe/dp|_C + dp J C^-1 + dK``; the kernel of `MemoryDerivative.residual`.
    """
    terms, _, law = tables
    d_terms, d_kappa, index = d_tables
    on_prony, on_elastic, d_on_prony, d_scale = coefficients
    m, k = cells.shape
    P = out.shape[2]
    ue, matrix, vector = np.empty((3, k)), np.empty((3, 3, 3)), np.empty((7, 3))
    F, A, N = matrix[0], matrix[1], matrix[2]
    c2, e, beta, slope, quotient = vector[0], vector[1], vector[2], vector[3], vector[4]
    d_beta, value = vector[5], vector[6]
    S, part, fe, FS = np.empty((6, P)), np.empty(6), np.empty((k, 3, P)), np.empty((3, P))
    for el in range(m):
        for a in range(k):
            for i in range(3):
                ue[i, a] = u[cells[el, a], i]
        region = regions[el]
        fe[:] = 0.0
        ratio = 1.0
        if mean:
            current = 0.0
            for q in range(grads.shape[1]):
                current += weights[el, q] * deformation_gradient(grads[el, q], ue, F)
            ratio = current / weights[el].sum()
        for q in range(grads.shape[1]):
            J = deformation_gradient(grads[el, q], ue, F)
            principal(F, A, c2, N)
            logarithmic_stretches(c2, e)
            ogden(terms[region], c2, e, beta, slope, quotient)
            for t in range(6):
                for p in range(P):
                    S[t, p] = on_elastic[region] * dSe[el, q, t, p]
                for l in range(H.shape[0]):
                    for p in range(P):
                        S[t, p] += on_prony[region, l] * dH[l, el, q, t, p]
            for j in range(index.shape[1]):
                p = index[region, j]
                if p < 0:
                    continue
                ogden_derivative(terms[region], d_terms[region, j], e, d_beta)
                d_JU = volumetric(law[region], d_kappa[region, j], ratio if mean else J)[1]
                if mean:
                    d_JU *= J / ratio
                for i in range(3):
                    value[i] = d_scale[region, j] * beta[i] + scale[region] * d_beta[i] + d_JU
                    value[i] /= c2[i]
                from_principal(value, N, part)
                for t in range(6):
                    total = part[t] - d_scale[region, j] * Se[el, q, t]
                    for l in range(H.shape[0]):
                        total += d_on_prony[region, j, l] * H[l, el, q, t]
                    S[t, p] += total
            for i in range(3):
                x, y, z = weights[el, q] * F[i, 0], weights[el, q] * F[i, 1], weights[el, q] * F[i, 2]
                for p in range(P):
                    FS[0, p] = x * S[0, p] + y * S[3, p] + z * S[5, p]
                    FS[1, p] = x * S[3, p] + y * S[1, p] + z * S[4, p]
                    FS[2, p] = x * S[5, p] + y * S[4, p] + z * S[2, p]
                for a in range(k):
                    x, y, z = grads[el, q, 0, a], grads[el, q, 1, a], grads[el, q, 2, a]
                    for p in range(P):
                        fe[a, i, p] += x * FS[0, p] + y * FS[1, p] + z * FS[2, p]
        for a in range(k):
            for i in range(3):
                for p in range(P):
                    out[cells[el, a], i, p] += fe[a, i, p]


@njit(cache=True, nogil=True, fastmath={"contract"})
def elastic_stress_derivative(cells, grads, regions, terms, d_terms, index, u, du, out):  # type: ignore[no-untyped-def]
    """Total derivative (m, q, 6, p) of Se: explicit in the parameters, and through ``du (n, 3, p)``."""
    m, k = cells.shape
    P = du.shape[2]
    ue, matrix, vector = np.empty((3, k)), np.empty((3, 3, 3)), np.empty((7, 3))
    F, A, N = matrix[0], matrix[1], matrix[2]
    c2, e, beta, slope, quotient = vector[0], vector[1], vector[2], vector[3], vector[4]
    d_beta = vector[5]
    half, dFN, dC, dS = np.empty((3, 3, P)), np.empty((3, 3, P)), np.empty((3, 3, P)), np.empty((3, 3, P))
    FN, GN, shear, local = np.empty((3, 3)), np.empty(3), np.empty(3), np.empty((3, P))
    for el in range(m):
        for a in range(k):
            for i in range(3):
                ue[i, a] = u[cells[el, a], i]
        region = regions[el]
        for q in range(grads.shape[1]):
            deformation_gradient(grads[el, q], ue, F)
            principal(F, A, c2, N)
            logarithmic_stretches(c2, e)
            ogden(terms[region], c2, e, beta, slope, quotient)
            total = (slope[0] + slope[1] + slope[2]) / 9.0
            local[:] = 0.0
            for j in range(index.shape[1]):
                if index[region, j] >= 0:
                    ogden_derivative(terms[region], d_terms[region, j], e, d_beta)
                    for i in range(3):
                        local[i, index[region, j]] = d_beta[i] / c2[i]
            for i in range(3):
                j, h = (i + 1) % 3, (i + 2) % 3
                shear[i] = 0.5 * ((c2[j] + c2[h]) * quotient[i] - beta[j] - beta[h]) / (c2[j] * c2[h])
                for p in range(3):
                    FN[p, i] = F[p, 0] * N[0, i] + F[p, 1] * N[1, i] + F[p, 2] * N[2, i]
            dFN[:] = 0.0  # dF in columns along the principal directions
            for a in range(k):
                for j in range(3):
                    GN[j] = 0.0
                    for r in range(3):
                        GN[j] += grads[el, q, r, a] * N[r, j]
                for i in range(3):
                    for j in range(3):
                        g = GN[j]
                        for p in range(P):
                            dFN[i, j, p] += g * du[cells[el, a], i, p]
            for i in range(3):  # half of dC in the principal frame
                for j in range(3):
                    for p in range(P):
                        half[i, j, p] = (
                            FN[0, i] * dFN[0, j, p] + FN[1, i] * dFN[1, j, p] + FN[2, i] * dFN[2, j, p]
                        )
            for i in range(3):
                for j in range(3):
                    for p in range(P):
                        dC[i, j, p] = half[i, j, p] + half[j, i, p]
            for i in range(3):
                j, h = (i + 1) % 3, (i + 2) % 3
                for p in range(P):
                    dS[i, i, p] = local[i, p]
                    dS[j, h, p] = shear[i] * dC[j, h, p]
                    dS[h, j, p] = dS[j, h, p]
                for r in range(3):
                    moduli = (
                        total - (slope[i] + slope[r]) / 3.0 + (slope[i] - 2.0 * beta[i] if i == r else 0.0)
                    )
                    moduli /= 2.0 * c2[r] * c2[i]
                    for p in range(P):
                        dS[i, i, p] += moduli * dC[r, r, p]
            for t in range(6):
                x, y = t % 3, (t + (1 if t > 2 else 0)) % 3
                for p in range(P):
                    out[el, q, t, p] = 0.0
                for i in range(3):
                    for j in range(3):
                        g = N[x, i] * N[y, j]
                        for p in range(P):
                            out[el, q, t, p] += g * dS[i, j, p]
