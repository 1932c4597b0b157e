"""Compiled kinematics of points side by side (`lanes`): F, its inverse, principal stretches and axes.

Symmetric tensors are six numbers in the order xx, yy, zz, xy, yz, zx (tensor components, not engineering).
"""

from __future__ import annotations

import numpy as np
from numba import njit

from ..lanes import COMPILED, LANES


@njit(forceinline=True, **COMPILED)
def deform(p, l, nodes, grad, u):  # type: ignore[no-untyped-def]
    """``F = I + sum_a u_a x grad N_a`` of an element in a lane of a POINT.

    Of its ``nodes (k,)`` in ``u (n, 3)``, with ``grad (3, k)``.
    """
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


@njit(forceinline=True, **COMPILED)
def strain(p, l, G):  # type: ignore[no-untyped-def]
    """Put a pre-stretch ``G (3, 3)`` in the place of the identity in the F of a lane of a POINT."""
    for i in range(3):
        for j in range(3):
            p.F[i, j, l] += G[i, j] - (1.0 if i == j else 0.0)


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

    By Jacobi rotations, sweep by sweep until every lane is done: they keep full relative accuracy where
    eigenvalues repeat, which closed forms lose.
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
