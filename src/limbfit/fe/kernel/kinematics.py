"""Compiled kinematics of one point, and of many side by side (`lanes`): F, principal stretches, push-forward.

Symmetric tensors are six numbers in the order xx, yy, zz, xy, yz, zx (tensor components, not engineering).
"""

from __future__ import annotations

import numpy as np
from numba import njit

from ..lanes import COMPILED, LANES


@njit(cache=True)
def deformation_gradient(grad, u, F):  # type: ignore[no-untyped-def]
    """``F = I + sum_a u_a x grad N_a`` from ``grad (3, k)`` and ``u (3, k)``; returns det F."""
    for i in range(3):
        for j in range(3):
            total = 1.0 if i == j else 0.0
            for a in range(grad.shape[1]):
                total += u[i, a] * grad[j, a]
            F[i, j] = total
    return (
        F[0, 0] * (F[1, 1] * F[2, 2] - F[1, 2] * F[2, 1])
        - F[0, 1] * (F[1, 0] * F[2, 2] - F[1, 2] * F[2, 0])
        + F[0, 2] * (F[1, 0] * F[2, 1] - F[1, 1] * F[2, 0])
    )


@njit(cache=True)
def principal(F, A, c2, N):  # type: ignore[no-untyped-def]
    """Eigenvalues ``c2 (3,)`` and eigenvectors (columns of ``N``) of ``C = F^T F`` by Jacobi rotations.

    Jacobi keeps full relative accuracy where eigenvalues repeat, which closed forms lose.  ``A`` is scratch.
    """
    for i in range(3):
        for j in range(3):
            A[i, j] = F[0, i] * F[0, j] + F[1, i] * F[1, j] + F[2, i] * F[2, j]
            N[i, j] = 1.0 if i == j else 0.0
    scale = A[0, 0] + A[1, 1] + A[2, 2]
    for _ in range(12):
        off = abs(A[0, 1]) + abs(A[1, 2]) + abs(A[0, 2])
        if off <= 1e-17 * scale:
            break
        for r in range(3):
            p = 0 if r < 2 else 1
            q = 1 if r == 0 else 2
            apq = A[p, q]
            if apq == 0.0:
                continue
            theta = 0.5 * (A[q, q] - A[p, p]) / apq
            if abs(theta) > 1e15:
                A[p, q] = 0.0
                A[q, p] = 0.0
                continue
            t = (1.0 if theta >= 0.0 else -1.0) / (abs(theta) + np.sqrt(theta * theta + 1.0))
            c = 1.0 / np.sqrt(t * t + 1.0)
            s = t * c
            k = 3 - p - q
            A[p, p] -= t * apq
            A[q, q] += t * apq
            A[p, q] = 0.0
            A[q, p] = 0.0
            akp, akq = A[k, p], A[k, q]
            A[k, p] = c * akp - s * akq
            A[p, k] = A[k, p]
            A[k, q] = s * akp + c * akq
            A[q, k] = A[k, q]
            for i in range(3):
                nip, niq = N[i, p], N[i, q]
                N[i, p] = c * nip - s * niq
                N[i, q] = s * nip + c * niq
    for i in range(3):
        c2[i] = A[i, i]


@njit(cache=True)
def logarithmic_stretches(c2, e):  # type: ignore[no-untyped-def]
    """Isochoric logarithmic stretches ``ln(lambda_i) - ln(J)/3`` from squared stretches."""
    for i in range(3):
        e[i] = 0.5 * np.log(c2[i])
    mean = (e[0] + e[1] + e[2]) / 3.0
    for i in range(3):
        e[i] -= mean


@njit(cache=True)
def from_principal(values, N, out):  # type: ignore[no-untyped-def]
    """``sum_i values_i n_i x n_i`` as six numbers; ``n_i`` are the columns of ``N``."""
    for s in range(6):
        p, q = s % 3, (s + (1 if s > 2 else 0)) % 3
        out[s] = 0.0
        for i in range(3):
            out[s] += values[i] * N[p, i] * N[q, i]


@njit(cache=True)
def push_forward(F, S, scratch, out, factor):  # type: ignore[no-untyped-def]
    """``out += factor * F S F^T`` for symmetric ``S`` and ``out`` (six numbers each)."""
    for i in range(3):
        scratch[i, 0] = F[i, 0] * S[0] + F[i, 1] * S[3] + F[i, 2] * S[5]
        scratch[i, 1] = F[i, 0] * S[3] + F[i, 1] * S[1] + F[i, 2] * S[4]
        scratch[i, 2] = F[i, 0] * S[5] + F[i, 1] * S[4] + F[i, 2] * S[2]
    for s in range(6):
        p, q = s % 3, (s + (1 if s > 2 else 0)) % 3
        out[s] += factor * (scratch[p, 0] * F[q, 0] + scratch[p, 1] * F[q, 1] + scratch[p, 2] * F[q, 2])


@njit(cache=True)
def mean_dilatation(grad, weights, u, F):  # type: ignore[no-untyped-def]
    """Volume ratio of an element, current over reference; -1 where a point is inverted."""
    current, reference = 0.0, 0.0
    for q in range(grad.shape[0]):
        J = deformation_gradient(grad[q], u, F)
        if J <= 0.0:
            return -1.0
        current += J * weights[q]
        reference += weights[q]
    return current / reference


@njit(forceinline=True, **COMPILED)
def deform(p, l, nodes, grad, u):  # type: ignore[no-untyped-def]
    """`deformation_gradient` of an element in a lane of a POINT: of its ``nodes (k,)`` in ``u (n, 3)``."""
    f00 = f11 = f22 = 1.0
    f01 = f02 = f10 = f12 = f20 = f21 = 0.0
    for a in range(len(nodes)):
        x, y, z = u[nodes[a], 0], u[nodes[a], 1], u[nodes[a], 2]
        gx, gy, gz = grad[0, a], grad[1, a], grad[2, a]
        f00 += x * gx
        f01 += x * gy
        f02 += x * gz
        f10 += y * gx
        f11 += y * gy
        f12 += y * gz
        f20 += z * gx
        f21 += z * gy
        f22 += z * gz
    p.F[0, 0, l], p.F[0, 1, l], p.F[0, 2, l] = f00, f01, f02
    p.F[1, 0, l], p.F[1, 1, l], p.F[1, 2, l] = f10, f11, f12
    p.F[2, 0, l], p.F[2, 1, l], p.F[2, 2, l] = f20, f21, f22


@njit(**COMPILED)
def invert(p):  # type: ignore[no-untyped-def]
    """Determinant, inverse transpose and ``b = F F^T`` of the deformation gradients of a POINT."""
    for l in range(LANES):
        x0, x1, x2 = p.F[0, 0, l], p.F[0, 1, l], p.F[0, 2, l]
        y0, y1, y2 = p.F[1, 0, l], p.F[1, 1, l], p.F[1, 2, l]
        z0, z1, z2 = p.F[2, 0, l], p.F[2, 1, l], p.F[2, 2, l]
        c0, c1, c2 = y1 * z2 - y2 * z1, y2 * z0 - y0 * z2, y0 * z1 - y1 * z0
        J = x0 * c0 + x1 * c1 + x2 * c2
        r = 1.0 / J
        p.J[l] = J
        p.inverse[0, 0, l], p.inverse[0, 1, l], p.inverse[0, 2, l] = r * c0, r * c1, r * c2
        p.inverse[1, 0, l] = r * (x2 * z1 - x1 * z2)
        p.inverse[1, 1, l] = r * (x0 * z2 - x2 * z0)
        p.inverse[1, 2, l] = r * (x1 * z0 - x0 * z1)
        p.inverse[2, 0, l] = r * (x1 * y2 - x2 * y1)
        p.inverse[2, 1, l] = r * (x2 * y0 - x0 * y2)
        p.inverse[2, 2, l] = r * (x0 * y1 - x1 * y0)
        p.b[0, l] = x0 * x0 + x1 * x1 + x2 * x2
        p.b[1, l] = y0 * y0 + y1 * y1 + y2 * y2
        p.b[2, l] = z0 * z0 + z1 * z1 + z2 * z2
        p.b[3, l] = x0 * y0 + x1 * y1 + x2 * y2
        p.b[4, l] = y0 * z0 + y1 * z1 + y2 * z2
        p.b[5, l] = z0 * x0 + z1 * x1 + z2 * x2


@njit(forceinline=True, **COMPILED)
def _rotate(p, i, j, ij, ki, kj):  # type: ignore[no-untyped-def]
    """One Jacobi rotation of ``b`` in the plane ij, in all lanes; where there is nothing to turn, by zero."""
    for l in range(LANES):
        x, d = p.b[ij, l], p.b[j, l] - p.b[i, l]
        t = 2.0 * x / (abs(d) + np.sqrt(d * d + 4.0 * x * x + 1e-300))
        t = t if d >= 0.0 else -t
        c = 1.0 / np.sqrt(t * t + 1.0)
        s = t * c
        p.b[i, l] -= t * x
        p.b[j, l] += t * x
        p.b[ij, l] = 0.0
        y, z = p.b[ki, l], p.b[kj, l]
        p.b[ki, l] = c * y - s * z
        p.b[kj, l] = s * y + c * z
        for r in range(3):
            y, z = p.n[r, i, l], p.n[r, j, l]
            p.n[r, i, l] = c * y - s * z
            p.n[r, j, l] = s * y + c * z


@njit(**COMPILED)
def principal_axes(p):  # type: ignore[no-untyped-def]
    """Make ``b`` of a POINT diagonal: squared stretches in ``b[:3]``, their directions columns of ``n``.

    By Jacobi rotations as in `principal`, sweep by sweep until every lane is done.
    """
    for l in range(LANES):
        for i in range(3):
            for j in range(3):
                p.n[i, j, l] = 1.0 if i == j else 0.0
    for _ in range(12):
        unfinished = 0
        for l in range(LANES):
            off = abs(p.b[3, l]) + abs(p.b[4, l]) + abs(p.b[5, l])
            unfinished += 1 if off > 1e-17 * (p.b[0, l] + p.b[1, l] + p.b[2, l]) else 0
        if unfinished == 0:
            break
        _rotate(p, 0, 1, 3, 5, 4)
        _rotate(p, 0, 2, 5, 3, 4)
        _rotate(p, 1, 2, 4, 3, 5)
