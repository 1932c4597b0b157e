"""Compiled kinematics of one point: deformation gradient, principal stretches, push-forward.

Symmetric tensors are six numbers in the order xx, yy, zz, xy, yz, zx (tensor components, not engineering).
"""

from __future__ import annotations

import numpy as np
from numba import njit


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
def inverse_transpose(F, J, out):  # type: ignore[no-untyped-def]
    """``F^-T`` of a 3 x 3 matrix whose determinant is ``J``."""
    for i in range(3):
        i1, i2 = (i + 1) % 3, (i + 2) % 3
        for j in range(3):
            j1, j2 = (j + 1) % 3, (j + 2) % 3
            out[i, j] = (F[i1, j1] * F[i2, j2] - F[i1, j2] * F[i2, j1]) / J


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
