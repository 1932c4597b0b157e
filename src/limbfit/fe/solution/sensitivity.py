"""Direct differentiation: the derivative of every step with respect to every material parameter.

At a converged step ``R(u, history, p) = 0``, hence ``K du/dp = -dR/dp``; the right-hand side holds the
explicit derivative and that of the history, which is carried along at the quadrature points
(Michaleris, Tortorelli and Vidal 1994, transient problems).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from ..history import Memory
from ..kernel.kinematics import (
    deformation_gradient,
    from_principal,
    logarithmic_stretches,
    mean_dilatation,
    principal,
)
from ..kernel.laws import Laws
from ..materials import prony_factors
from ..materials.ogden import ogden, ogden_derivative
from ..materials.volumetric import volumetric
from ..system import Evaluation, Increment, System
from .direction import solve_at
from .factor import Factor

Array = NDArray[np.float64]
# Residual of the linear systems, relative to their right-hand sides: what is left then in the force is of
# second order, but what the history hands on is not.
TOLERANCE = 2e-4


@dataclass(frozen=True)
class Explicit:
    """What the parameters change in a step at fixed displacement.

    Parameters
    ----------
    forces : (n, 3, p) derivative of the internal forces, N; no contact in it.
    elastic : (m, q, 6, p) derivative of the elastic stress Se.
    stress : (m, q, 6) Se itself, MPa.
    moduli : (m, q, 6, 9) derivative of Se with respect to the deformation gradient, column by column, MPa.
    """

    forces: Array
    elastic: Array
    stress: Array
    moduli: Array


@dataclass(frozen=True)
class MemoryDerivative:
    """Derivatives of a `Memory`: ``elastic, before (m, q, 6, p)``, ``prony (l, m, q, 6, p)``."""

    elastic: Array
    prony: Array
    before: Array | None = None

    @classmethod
    def rest(cls, system: System, laws: Laws) -> MemoryDerivative:
        shape = (*system.weights.shape, 6, laws.count)
        return cls(np.zeros(shape), np.zeros((laws.prony.shape[1], *shape)))

    def turned(self) -> MemoryDerivative:
        """That of `Memory.turned`."""
        return MemoryDerivative(self.elastic, self.prony)

    def explicit(
        self, system: System, laws: Laws, memory: Memory, increment: Increment, u: Array, dt: float
    ) -> Explicit:
        """What the parameters change in the step of ``dt`` s that ended at displacement ``u (n, 3)``."""
        bends = laws.d_terms.any(axis=(2, 3))  # parameters of the elastic law
        derivatives = laws.d_terms, bends, laws.d_kappa, laws.parameter_index
        coefficients = _step_coefficients(laws, dt, memory.duration)
        past = memory.elastic if memory.before is None else memory.before
        elastic, stress = np.zeros_like(self.elastic), np.empty_like(memory.elastic)
        moduli = np.empty((*stress.shape, 9))
        d_past = self.elastic if self.before is None else self.before
        d_elastic, d_past, d_prony = (
            a.reshape(*a.shape[:-2], -1) for a in (self.elastic, d_past, self.prony)
        )

        def part(cells: slice) -> Array:
            forces = np.zeros((*u.shape, laws.count))
            explicit_derivatives(
                system.cells[cells], system.gradients[cells], system.weights[cells],
                system.element.mean_dilatation, system.regions[cells], laws.tables, derivatives,
                increment.scale, coefficients, memory.elastic[cells], past[cells], memory.prony[:, cells],
                d_elastic[cells], d_past[cells], d_prony[:, cells], u,
                forces, elastic[cells], stress[cells], moduli[cells],
            )  # fmt: skip
            return forces

        return Explicit(np.asarray(sum(system.over_cells(part))), elastic, stress, moduli)

    def advanced(
        self, system: System, laws: Laws, before: Memory, step: Explicit, du: Array, dt: float
    ) -> MemoryDerivative:
        """The derivative of the memory after the step, given ``du (n, 3, p)``; uses up ``step.elastic``."""
        found = prony_factors(dt, laws.prony[..., 1], before.duration)
        slopes = (found.d_decay, found.d_ramp, found.d_back)
        d_factors = tuple(laws.d_prony[..., 1] * slope[:, None] for slope in slopes)
        factors = (found.decay, found.ramp, found.back, *d_factors)
        past = before.elastic if before.before is None else before.before
        d_past = self.elastic if self.before is None else self.before
        prony = np.empty_like(self.prony)

        def part(cells: slice) -> None:
            advance(
                system.cells[cells], system.gradients[cells], system.regions[cells], factors,
                laws.parameter_index, step.moduli[cells], step.stress[cells] - before.elastic[cells],
                before.elastic[cells] - past[cells], before.prony[:, cells], self.elastic[cells],
                d_past[cells], self.prony[:, cells], du,
                step.elastic[cells], prony[:, cells],
            )  # fmt: skip

        system.over_cells(part)
        return MemoryDerivative(step.elastic, prony, self.elastic)


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


def _step_coefficients(laws: Laws, dt: float, before: float) -> tuple[Array, ...]:
    """Weights in the history tensor K of H, of Se and of Se a step earlier, their explicit derivatives (for
    the changes of Se: in this step, that of the scale, and in the one before)."""
    f = prony_factors(dt, laws.prony[..., 1], before)
    gamma = laws.prony[..., 0]
    d_gamma, d_tau = laws.d_prony[..., 0], laws.d_prony[..., 1]
    on_prony = gamma * f.decay
    on_elastic = (gamma * (f.back - f.ramp)).sum(axis=1)
    on_before = -(gamma * f.back).sum(axis=1)
    d_on_prony, d_scale, d_back = (
        d_gamma * value[:, None] + d_tau * (gamma * slope)[:, None]
        for value, slope in ((f.decay, f.d_decay), (f.ramp, f.d_ramp), (f.back, f.d_back))
    )
    return on_prony, on_elastic, on_before, d_on_prony, d_scale.sum(axis=2), d_back.sum(axis=2)


_KERNEL: dict[str, Any] = {"cache": True, "nogil": True, "error_model": "numpy", "fastmath": {"contract"}}
_SHEAR = ((0, 3, 5), (3, 1, 4), (5, 4, 2))  # place of each entry of a symmetric tensor in its six numbers


@njit(cache=True, fastmath={"contract"})
def elastic_moduli(beta, slope, quotient, c2, N, F, scratch, out):  # type: ignore[no-untyped-def]
    """Derivative (6, 9) of the elastic stress Se with respect to ``F``, column by column.

    ``dSe/dC`` is that of principal stresses ``beta_i/c2_i`` with axes ``N``; ``scratch (3, 6, 6)``.
    """
    v, w, C = scratch[0], scratch[1], scratch[2]
    total = (slope[0] + slope[1] + slope[2]) / 9.0
    for t in range(6):
        x, y = t % 3, (t + (1 if t > 2 else 0)) % 3
        for i in range(3):
            j, h = (i + 1) % 3, (i + 2) % 3
            v[i, t] = N[x, i] * N[y, i] / c2[i]
            v[3 + i, t] = N[x, j] * N[y, h] + N[x, h] * N[y, j]
    for i in range(3):
        j, h = (i + 1) % 3, (i + 2) % 3
        x = 0.5 * ((c2[j] + c2[h]) * quotient[i] - beta[j] - beta[h]) / (c2[j] * c2[h])
        y = slope[i] - 2.0 * beta[i]
        for t in range(6):
            rest = (total - slope[i] / 3.0) * (v[0, t] + v[1, t] + v[2, t])
            rest -= (slope[0] * v[0, t] + slope[1] * v[1, t] + slope[2] * v[2, t]) / 3.0
            w[i, t] = y * v[i, t] + rest
            w[3 + i, t] = x * v[3 + i, t]
    for s in range(6):
        for t in range(s + 1):
            C[s, t] = v[0, s] * w[0, t] + v[1, s] * w[1, t] + v[2, s] * w[2, t]
            C[s, t] += v[3, s] * w[3, t] + v[4, s] * w[4, t] + v[5, s] * w[5, t]
            C[t, s] = C[s, t]
    for t in range(6):
        for j in range(3):
            x, y, z = C[t, _SHEAR[j][0]], C[t, _SHEAR[j][1]], C[t, _SHEAR[j][2]]
            for i in range(3):
                out[t, 3 * j + i] = x * F[i, 0] + y * F[i, 1] + z * F[i, 2]


@njit(cache=True, error_model="numpy", fastmath={"contract"})
def _add_forces(S, F, grad, weight, FS, fe):  # type: ignore[no-untyped-def]
    """Add the weighted nodal forces of stresses ``S (6, p)`` at a point to ``fe (k, row)``; FS is scratch."""
    P, row = S.shape[1], fe.shape[1]
    for i in range(3):
        x, y, z = weight * F[i, 0], weight * F[i, 1], weight * F[i, 2]
        for p in range(P):
            FS[0, i * P + p] = x * S[0, p] + y * S[3, p] + z * S[5, p]
            FS[1, i * P + p] = x * S[3, p] + y * S[1, p] + z * S[4, p]
            FS[2, i * P + p] = x * S[5, p] + y * S[4, p] + z * S[2, p]
    for a in range(fe.shape[0]):
        x, y, z = grad[0, a], grad[1, a], grad[2, a]
        for c in range(row):
            fe[a, c] += x * FS[0, c] + y * FS[1, c] + z * FS[2, c]


@njit(**_KERNEL)
def explicit_derivatives(  # type: ignore[no-untyped-def]
    cells, grads, weights, mean, regions, tables, d_tables, scale, coefficients, Se, past, H, dSe, d_past, dH,
    u, forces, elastic, stress, moduli
):  # fmt: skip
    """The kernel of `MemoryDerivative.explicit`; adds to ``forces`` and to ``elastic``.

    The forces are those of ``dS/dp = ds Se + s dSe/dp|_C + dp J C^-1 + dK``; ``past`` is Se one step
    earlier, ``d_past`` its derivative.  Rows of the work arrays hold
    three components of all parameters and are padded to whole vectors.
    """
    terms, _, law = tables
    d_terms, bends, d_kappa, index = d_tables
    on_prony, on_elastic, on_before, d_on_prony, d_scale, d_back = coefficients
    m, k = cells.shape
    P = forces.shape[2]
    row = 16 * ((3 * P + 15) // 16)
    ue, matrix, vector, scratch = np.empty((3, k)), np.empty((3, 3, 3)), np.empty((6, 3)), np.empty((3, 6, 6))
    F, A, N = matrix[0], matrix[1], matrix[2]
    c2, e, beta, slope, quotient, value = vector[0], vector[1], vector[2], vector[3], vector[4], vector[5]
    S, part, inverse = np.empty((6, P)), np.empty(6), np.empty(6)
    flat = S.reshape(6 * P)
    fe, FS = np.empty((k, row)), np.zeros((3, row))
    for el in range(m):
        for a in range(k):
            for i in range(3):
                ue[i, a] = u[cells[el, a], i]
        region = regions[el]
        fe[:] = 0.0
        ratio = mean_dilatation(grads[el], weights[el], ue, F) if mean else 1.0
        for q in range(grads.shape[1]):
            J = deformation_gradient(grads[el, q], ue, F)
            if not mean:
                ratio = J
            principal(F, A, c2, N)
            logarithmic_stretches(c2, e)
            ogden(terms[region], c2, e, beta, slope, quotient)
            elastic_moduli(beta, slope, quotient, c2, N, F, scratch, moduli[el, q])
            for i in range(3):
                value[i] = 1.0 / c2[i]
                beta[i] /= c2[i]
            from_principal(value, N, inverse)
            from_principal(beta, N, stress[el, q])
            for c in range(6 * P):
                flat[c] = on_elastic[region] * dSe[el, q, c] + on_before[region] * d_past[el, q, c]
            for l in range(H.shape[0]):
                for c in range(6 * P):
                    flat[c] += on_prony[region, l] * dH[l, el, q, c]
            for j in range(index.shape[1]):
                p = index[region, j]
                if p < 0:
                    continue
                part[:] = 0.0
                if bends[region, j]:
                    ogden_derivative(terms[region], d_terms[region, j], e, value)
                    for i in range(3):
                        value[i] /= c2[i]
                    from_principal(value, N, part)
                d_JU = 0.0
                if d_kappa[region, j] != 0.0:
                    d_JU = volumetric(law[region], d_kappa[region, j], ratio)[1] * J / ratio
                for t in range(6):
                    total = scale[region] * part[t] + d_JU * inverse[t]
                    total += d_scale[region, j] * (stress[el, q, t] - Se[el, q, t])
                    total += d_back[region, j] * (Se[el, q, t] - past[el, q, t])
                    for l in range(H.shape[0]):
                        total += d_on_prony[region, j, l] * H[l, el, q, t]
                    elastic[el, q, t, p] += part[t]
                    S[t, p] += total
            _add_forces(S, F, grads[el, q], weights[el, q], FS, fe)
        for a in range(k):
            for i in range(3):
                for p in range(P):
                    forces[cells[el, a], i, p] += fe[a, i * P + p]


@njit(**_KERNEL)
def advance(  # type: ignore[no-untyped-def]
    cells, grads, regions, factors, index, moduli, change, earlier, H, dSe, d_past, dH, du, elastic, prony
):
    """The kernel of `MemoryDerivative.advanced`: adds to ``elastic`` what ``du`` does, and fills ``prony``.

    ``change, earlier (m, q, 6)`` are those of Se in the step and in the one before.
    """
    decay, ramp, back, d_decay, d_ramp, d_back = factors
    m, k = cells.shape
    P = du.shape[2]
    row = 16 * ((3 * P + 15) // 16)
    due, dF = np.zeros((k, row)), np.empty((3, row))
    for el in range(m):
        for a in range(k):
            for i in range(3):
                for p in range(P):
                    due[a, i * P + p] = du[cells[el, a], i, p]
        region = regions[el]
        for q in range(grads.shape[1]):
            dF[:] = 0.0
            for a in range(k):
                x, y, z = grads[el, q, 0, a], grads[el, q, 1, a], grads[el, q, 2, a]
                for c in range(row):
                    dF[0, c] += x * due[a, c]
                    dF[1, c] += y * due[a, c]
                    dF[2, c] += z * due[a, c]
            for t in range(6):
                D = moduli[el, q, t]
                d0, d1, d2, d3, d4, d5, d6, d7, d8 = D[0], D[1], D[2], D[3], D[4], D[5], D[6], D[7], D[8]
                for p in range(P):
                    elastic[el, q, t, p] += (
                        d0 * dF[0, p] + d1 * dF[0, P + p] + d2 * dF[0, 2 * P + p]
                        + d3 * dF[1, p] + d4 * dF[1, P + p] + d5 * dF[1, 2 * P + p]
                        + d6 * dF[2, p] + d7 * dF[2, P + p] + d8 * dF[2, 2 * P + p]
                    )  # fmt: skip
            for l in range(H.shape[0]):
                x, y, z = decay[region, l], ramp[region, l], back[region, l]
                for t in range(6):
                    for p in range(P):
                        prony[l, el, q, t, p] = x * dH[l, el, q, t, p]
                        prony[l, el, q, t, p] += y * (elastic[el, q, t, p] - dSe[el, q, t, p])
                        prony[l, el, q, t, p] += z * (dSe[el, q, t, p] - d_past[el, q, t, p])
                for j in range(index.shape[1]):
                    x, y, z = d_decay[region, j, l], d_ramp[region, j, l], d_back[region, j, l]
                    if index[region, j] >= 0 and (x != 0.0 or y != 0.0 or z != 0.0):
                        for t in range(6):
                            total = x * H[l, el, q, t] + y * change[el, q, t] + z * earlier[el, q, t]
                            prony[l, el, q, t, index[region, j]] += total
