"""Direct differentiation: the derivative of every step with respect to every material parameter.

At a converged step ``R(u, history, p) = 0``, hence ``K du/dp = -dR/dp``; the right-hand side holds the
explicit derivative and that of the history, which is carried along at the quadrature points (Michaleris,
Tortorelli and Vidal 1994, transient problems).  So are the forces that bodies take over from what held them:
where a displacement drives a coordinate that a force drives next, and that force is left open, it begins as
what held the coordinate.  A stiffer limb held the donned socket by more.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numba import njit

from ...arrays import Array
from ..bodies import Bodies
from ..kernel.laws import Laws
from ..kernel.response import elastic_moduli, elastic_response, pressures, pull_back, stress_rates
from ..lanes import LANES, workspace
from ..materials import compute_prony_factors
from ..memory import Memory
from ..motion import RigidBody
from ..result import State
from ..system import Evaluation, Increment, System
from .direction import solve_at
from .factor import Factor

# Residual of the linear systems, relative to their right-hand sides.  What is left then in the force is of
# second order, but what the history hands on is not: 6e-6 of a force's derivative, 2e-4 of a displacement's.
TOLERANCE = 1e-3


@dataclass(frozen=True)
class ExplicitDerivative:
    """What the parameters change in a step at fixed displacement.

    ``forces``: (n, 3, p) derivative of the internal forces, N; no contact in it. ``elastic``: (m, q, 6, p)
    derivative of the elastic stress Se. ``stress``: (m, q, 6) Se itself, MPa. ``moduli``: (m, q, 6, 9)
    derivative of Se with respect to the deformation gradient, column by column, MPa.
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

    def drop_past(self) -> MemoryDerivative:
        """That of `Memory.drop_past`."""
        return MemoryDerivative(self.elastic, self.prony)

    def differentiate_step(
        self, system: System, laws: Laws, memory: Memory, increment: Increment, u: Array, dt: float
    ) -> ExplicitDerivative:
        """What the parameters change in the step of ``dt`` s that ended at displacement ``u (n, 3)``."""
        bends = laws.d_numbers.any(axis=2)  # parameters of the elastic law
        by_kappa = laws.d_kappa / laws.kappa[:, None]
        d_fibre = laws.d_fibre * [1.0, 1.0, increment.activation]
        derivatives = laws.d_numbers, bends, by_kappa, laws.parameter_index, d_fibre
        coefficients = _step_coefficients(laws, dt, memory.duration)
        past = memory.elastic if memory.before is None else memory.before
        elastic, stress = np.zeros_like(self.elastic), np.empty_like(memory.elastic)
        slopes = np.empty((*stress.shape, 9))
        d_past = self.elastic if self.before is None else self.before
        d_elastic, d_past, d_prony = (
            a.reshape(*a.shape[:-2], 6 * laws.count) for a in (self.elastic, d_past, self.prony)
        )

        def part(cells: slice) -> Array:
            forces = np.zeros((*u.shape, laws.count))
            points, law, numbers, _, _, element, _, rates = workspace(
                0, stress.shape[1], laws.numbers.shape[1]
            )
            explicit_derivatives(
                system.elements(cells), system.element.mean_dilatation, laws.tables, derivatives,
                increment.scale, coefficients, memory.elastic[cells], past[cells], memory.prony[:, cells],
                d_elastic[cells], d_past[cells], d_prony[:, cells], u,
                forces, elastic[cells], stress[cells], slopes[cells],
                (points, law, numbers, element, rates),
            )  # fmt: skip
            return forces

        return ExplicitDerivative(np.asarray(sum(system.map_cells(part))), elastic, stress, slopes)

    def advance(
        self, system: System, laws: Laws, before: Memory, step: ExplicitDerivative, du: Array, dt: float
    ) -> MemoryDerivative:
        """The derivative of the memory after the step, given ``du (n, 3, p)``; uses up ``step.elastic``."""
        found = compute_prony_factors(dt, laws.prony[..., 1], before.duration)
        slopes = (found.d_decay, found.d_ramp, found.d_back)
        d_factors = tuple(laws.d_prony[..., 1] * slope[:, None] for slope in slopes)
        factors = (found.decay, found.ramp, found.back, *d_factors)
        past = before.elastic if before.before is None else before.before
        d_past = self.elastic if self.before is None else self.before
        prony = np.empty_like(self.prony)

        def part(cells: slice) -> None:
            _advance_derivative(
                system.cells[cells], system.gradients[cells], system.regions[cells], factors,
                laws.parameter_index, step.moduli[cells], step.stress[cells] - before.elastic[cells],
                before.elastic[cells] - past[cells], before.prony[:, cells], self.elastic[cells],
                d_past[cells], self.prony[:, cells], du,
                step.elastic[cells], prony[:, cells],
            )  # fmt: skip

        system.map_cells(part)
        return MemoryDerivative(step.elastic, prony, self.elastic)


def solve_with_adjoint(
    at: Evaluation, factor: Factor, b: Array, guess: Array, advance: Array
) -> tuple[Array, Array]:
    """Solutions (n, p) of the tangent for ``b (n, p)``, and their products (p,) with ``advance (n,)``.

    The products are the force's derivatives, and better than the solutions: with the adjoint solution
    ``K a = advance`` a residual ``r`` changes a product by ``a . r``; with that added, what is left is a
    product of two errors (Pierce and Giles 2000).  Columns that are sums of others are not solved for: under
    a stated displacement nothing moves where all moduli grow alike.
    """
    kept, weights = find_independent_columns(b)
    right = np.column_stack([b[:, kept], advance])
    found = solve_at(at, factor, right, np.column_stack([guess[:, kept], np.zeros(len(b))]), TOLERANCE)
    x, adjoint = found[:, :-1] @ weights, found[:, -1:].copy()
    missed = advance - factor.multiply(at.tangent, adjoint)[:, 0]
    return x, adjoint[:, 0] @ b + missed @ x


def find_independent_columns(b: Array) -> tuple[list[int], Array]:
    """Columns of ``b (n, p)`` of which the others are sums within `TOLERANCE`, and the weights (k, p)."""
    size = np.linalg.norm(b, axis=0)
    unit = b / np.where(size > 0.0, size, 1.0)
    products = unit.T @ unit
    kept: list[int] = []
    weights: Array = np.zeros((0, b.shape[1]))
    for j in range(b.shape[1]):
        left = products[j, j] - products[j, kept] @ weights[:, j]
        if left > TOLERANCE**2:
            kept.append(j)
            weights = np.asarray(np.linalg.solve(products[np.ix_(kept, kept)], products[kept]), dtype=float)
    return kept, weights * size / size[kept, None]


def _step_coefficients(laws: Laws, dt: float, before: float) -> tuple[Array, ...]:
    """Weights in the history tensor K of H, of Se and of Se a step earlier, their explicit derivatives (for
    the changes of Se: in this step, that of the scale, and in the one before)."""
    f = compute_prony_factors(dt, laws.prony[..., 1], before)
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


@njit(cache=True, error_model="numpy", fastmath={"contract"})
def _differentiate_by_gradient(p, l, out):  # type: ignore[no-untyped-def]
    """Derivative (6, 9) of Se with respect to ``F``, column by column, in a lane of a POINT with moduli."""
    for t in range(6):
        for j in range(3):
            x, y, z = p.D[t, _SHEAR[j][0], l], p.D[t, _SHEAR[j][1], l], p.D[t, _SHEAR[j][2], l]
            for i in range(3):
                out[t, 3 * j + i] = x * p.F[i, 0, l] + y * p.F[i, 1, l] + z * p.F[i, 2, l]


@njit(cache=True, error_model="numpy", fastmath={"contract"})
def _add_forces(S, p, l, grad, weight, FS, fe):  # type: ignore[no-untyped-def]
    """Add the weighted nodal forces of stresses ``S (6, P)`` in a lane of a POINT to ``fe (k, row)``; FS is
    scratch."""
    P, row = S.shape[1], fe.shape[1]
    for i in range(3):
        x, y, z = weight * p.F[i, 0, l], weight * p.F[i, 1, l], weight * p.F[i, 2, l]
        for c in range(P):
            FS[0, i * P + c] = x * S[0, c] + y * S[3, c] + z * S[5, c]
            FS[1, i * P + c] = x * S[3, c] + y * S[1, c] + z * S[4, c]
            FS[2, i * P + c] = x * S[5, c] + y * S[4, c] + z * S[2, c]
    for a in range(fe.shape[0]):
        x, y, z = grad[0, a], grad[1, a], grad[2, a]
        for c in range(row):
            fe[a, c] += x * FS[0, c] + y * FS[1, c] + z * FS[2, c]


@njit(**_KERNEL)
def explicit_derivatives(  # type: ignore[no-untyped-def]
    elements, mean, tables, d_tables, scale, coefficients, Se, past, H, dSe, d_past, dH, u,
    forces, elastic, stress, slopes, records
):  # fmt: skip
    """The kernel of `MemoryDerivative.differentiate_step`; adds to ``forces`` and to ``elastic``.

    The forces are those of ``dS/dp = ds Se + s dSe/dp|_C + dp J C^-1 + dK``; ``past`` is Se one step
    earlier, ``d_past`` its derivative.  The elastic law is asked for `LANES` elements at once.  Rows of the
    work arrays hold three components of all parameters and are padded to whole vectors.
    """
    cells, grads, weights, regions, fibres, _ = elements
    points, law, numbers, element, rates = records
    d_numbers, bends, d_kappa, index, d_fibre = d_tables
    on_prony, on_elastic, on_before, d_on_prony, d_scale, d_back = coefficients
    m, k = cells.shape
    n, P = len(numbers), forces.shape[2]
    row = 16 * ((3 * P + 15) // 16)
    S, part, inverse = np.empty((6, P)), np.empty(6), np.empty(6)
    flat = S.reshape(6 * P)
    fe, FS = np.empty((k, row)), np.zeros((3, row))
    for start in range(0, m, LANES):
        elastic_response(elements, start, tables, u, points, law[0], numbers)
        pressures(weights, regions, tables, mean, start, points, element[0])
        for q in range(len(points)):
            pull_back(points[q], len(fibres) > 0)
            stress_rates(points[q], law[0], numbers, rates[q * n : (q + 1) * n])
            elastic_moduli(points[q], element[0], len(fibres) > 0)
        for el in range(start, min(start + LANES, m)):
            l, region = el - start, regions[el]
            fe[:] = 0.0
            for q in range(len(points)):
                at = points[q]
                _differentiate_by_gradient(at, l, slopes[el, q])
                for t in range(6):
                    x, y = t % 3, (t + (1 if t > 2 else 0)) % 3
                    stress[el, q, t] = at.tau[t, l]
                    inverse[t] = 0.0
                    for i in range(3):
                        inverse[t] += at.inverse[i, x, l] * at.inverse[i, y, l]
                for c in range(6 * P):
                    flat[c] = on_elastic[region] * dSe[el, q, c] + on_before[region] * d_past[el, q, c]
                for h in range(H.shape[0]):
                    for c in range(6 * P):
                        flat[c] += on_prony[region, h] * dH[h, el, q, c]
                for j in range(index.shape[1]):
                    p = index[region, j]
                    if p < 0:
                        continue
                    part[:] = 0.0
                    if bends[region, j]:
                        for i in range(n):
                            for t in range(6):
                                part[t] += d_numbers[region, j, i] * rates[q * n + i].S[t, l]
                    if len(fibres):
                        rate = d_fibre[region, j, 0] * at.fibre_tension_rates[0, l]
                        rate += d_fibre[region, j, 1] * at.fibre_tension_rates[1, l]
                        for t in range(6):
                            x, y = t % 3, (t + (1 if t > 2 else 0)) % 3
                            along = at.material_fibre[x, l] * at.material_fibre[y, l] - inverse[t] / 3.0
                            part[t] += rate * along
                            S[t, p] += d_fibre[region, j, 2] * along
                    d_JU = d_kappa[region, j] * at.pressure[l]
                    for t in range(6):
                        total = scale[region] * part[t] + d_JU * inverse[t]
                        total += d_scale[region, j] * (stress[el, q, t] - Se[el, q, t])
                        total += d_back[region, j] * (Se[el, q, t] - past[el, q, t])
                        for h in range(H.shape[0]):
                            total += d_on_prony[region, j, h] * H[h, el, q, t]
                        elastic[el, q, t, p] += part[t]
                        S[t, p] += total
                _add_forces(S, at, l, grads[el, q], weights[el, q], FS, fe)
            for a in range(k):
                for i in range(3):
                    for p in range(P):
                        forces[cells[el, a], i, p] += fe[a, i * P + p]


@njit(**_KERNEL)
def _advance_derivative(  # type: ignore[no-untyped-def]
    cells, grads, regions, factors, index, moduli, change, earlier, H, dSe, d_past, dH, du, elastic, prony
):
    """The kernel of `MemoryDerivative.advance`: adds to ``elastic`` what ``du`` does, and fills ``prony``.

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


@dataclass(frozen=True)
class ForceTakeover:
    """The forces that bodies took over from what held them, and their derivatives.

    ``since (b,)``: when each body did so last, s; not a number where it never did.  ``slopes (r - n, 3, p)``:
    derivatives of the forces in the rows of `System`, N over mm.
    """

    since: Array
    slopes: Array

    @classmethod
    def begin(cls, bodies: Sequence[RigidBody], slopes: Array) -> ForceTakeover:
        """That of bodies that have taken nothing over; ``slopes`` are zeros."""
        return cls(np.full(len(bodies), np.nan), slopes)

    def update(self, took: Sequence[bool], bodies: Bodies, state: State, modulus: float) -> ForceTakeover:
        """The same after some bodies ``took (b,)`` over what held them in a state with derivatives.

        ``modulus``: that to which the contact's stiffness is relative, MPa.
        """
        assert state.bodies is not None
        since, slopes = self.since.copy(), self.slopes.copy()
        slopes_here = bodies.differentiate_holding_forces(state.drives, state.penalty * modulus, state.bodies)
        for i, rows in enumerate(bodies.own_rows):
            if took[i]:
                since[i], slopes[rows] = state.time, slopes_here[rows]
        return replace(self, since=since, slopes=slopes)

    def differentiate_remaining(self, rigid_bodies: Sequence[RigidBody], bodies: Bodies, t: float) -> Array:
        """Derivatives (r - n, 3, p) of the part of the forces that is left at time ``t``."""
        shares = np.zeros(len(self.slopes))
        for body, since, rows in zip(rigid_bodies, self.since, bodies.own_rows, strict=True):
            shares[rows] = body.motion.remaining_share(since, t)
        return np.asarray(self.slopes * shares[:, None, None])
