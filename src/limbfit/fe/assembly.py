"""Energy, residual and symmetric tangent of all elements in one compiled pass.

One step minimises the incremental potential
``s W(C) + U(J) + 1/2 K : C`` with ``s = 1 + sum_l gamma_l ramp_l`` and the constant history tensor ``K``.
Its Kirchhoff stress is ``tau = s tau_e + J U' I + F K F^T``; the tangent is spatial:
``k_ab = int g_a . c . g_b + (g_a . tau g_b) I`` with ``g_a = F^-T grad N_a`` (Simo and Hughes 1998, ch. 7).
"""

from __future__ import annotations

import numpy as np
from numba import njit

from .kinematics import (
    deformation_gradient,
    from_principal,
    inverse_transpose,
    logarithmic_stretches,
    mean_dilatation,
    principal,
    push_forward,
)
from .materials.ogden import ogden
from .materials.volumetric import volumetric

_VOIGT = ((0, 3, 5), (3, 1, 4), (5, 4, 2))  # row i of the strain operator: which strain each gradient feeds


@njit(cache=True, fastmath={"contract"})
def spatial_moduli(beta, slope, quotient, c2, n, scale, v, D):  # type: ignore[no-untyped-def]
    """Add ``scale`` times the deviatoric spatial moduli (Kirchhoff, 6 x 6) to ``D``.

    ``sum_ij (d beta_i/d ln lambda_j - 2 beta_i delta_ij) n_i n_i n_j n_j`` and the shear terms
    ``(beta_i c2_j - beta_j c2_i)/(c2_i - c2_j)``; columns of ``n`` are the spatial principal directions;
    ``v (6, 6)`` is scratch.
    """
    total = (slope[0] + slope[1] + slope[2]) / 9.0
    for s in range(6):
        p, q = s % 3, (s + (1 if s > 2 else 0)) % 3
        for i in range(3):
            j, k = (i + 1) % 3, (i + 2) % 3
            v[i, s] = n[p, i] * n[q, i]
            v[3 + i, s] = n[p, j] * n[q, k] + n[p, k] * n[q, j]
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        axial = scale * (slope[i] - 2.0 * beta[i])
        shear = scale * 0.5 * ((c2[j] + c2[k]) * quotient[i] - beta[j] - beta[k])
        for r in range(6):
            x, y = axial * v[i, r], shear * v[3 + i, r]
            for s in range(6):
                D[r, s] += x * v[i, s] + y * v[3 + i, s]
    # The rest of d beta_i/d ln lambda_j acts on volume: sum_i n_i n_i is the identity.
    for i in range(3):
        for r in range(6):
            x = scale * v[i, r] * slope[i] / 3.0
            for s in range(3):
                D[r, s] -= x
                D[s, r] -= x
    for r in range(3):
        for s in range(3):
            D[r, s] += scale * total


@njit(cache=True, fastmath={"contract"})
def _add_stiffness(D, tau, g, weight, DB, Ke, geometric):  # type: ignore[no-untyped-def]
    """Material and geometric stiffness of one quadrature point: ``Ke (3 k, w)``, ``DB (6, w)``, ``w >= 3 k``.

    Rows are padded to whole vectors and loops run over all of a row: no remainder is left to the compiler.
    """
    k = g.shape[1]
    for s in range(6):
        for i in range(3):
            p, q, r = weight * D[s, _VOIGT[i][0]], weight * D[s, _VOIGT[i][1]], weight * D[s, _VOIGT[i][2]]
            for b in range(k):
                DB[s, i * k + b] = p * g[0, b] + q * g[1, b] + r * g[2, b]
    for a in range(k):
        x, y, z = g[0, a], g[1, a], g[2, a]
        for c in range(DB.shape[1]):
            p, q, r = DB[3, c], DB[4, c], DB[5, c]
            Ke[a, c] += x * DB[0, c] + y * p + z * r
            Ke[k + a, c] += x * p + y * DB[1, c] + z * q
            Ke[2 * k + a, c] += x * r + y * q + z * DB[2, c]
    for a in range(k):
        x = weight * (tau[0] * g[0, a] + tau[3] * g[1, a] + tau[5] * g[2, a])
        y = weight * (tau[3] * g[0, a] + tau[1] * g[1, a] + tau[4] * g[2, a])
        z = weight * (tau[5] * g[0, a] + tau[4] * g[1, a] + tau[2] * g[2, a])
        for b in range(k):
            geometric[a, b] += x * g[0, b] + y * g[1, b] + z * g[2, b]


@njit(cache=True)
def scatter_upper(Ke, positions, data):  # type: ignore[no-untyped-def]
    """Add the upper triangle of an element matrix to the sparse data; negative positions are dropped."""
    n = Ke.shape[0]
    at = 0
    for r in range(n):
        for c in range(r, n):
            if positions[at] >= 0:
                data[positions[at]] += Ke[r, c]
            at += 1


@njit(cache=True, nogil=True, fastmath={"contract"})
def assemble(  # type: ignore[no-untyped-def]
    cells, grads, weights, mean, regions, tables, scale, history, u, tangent, positions, residual, data
):
    """Add every element to ``residual`` and, with ``tangent``, to ``data``; return the potential, N mm.

    Parameters
    ----------
    cells (m, k), grads (m, q, 3, k), weights (m, q), regions (m,) : the elements.
    mean : one volume ratio and pressure per element.
    tables : ``terms (r, n, 2), kappa (r,), law (r,)`` by region; scale (r,) : s.
    history (m, q, 6) : K, MPa.
    u (n, 3) : displacement, mm.
    positions (m, .) : where each entry of an element's upper triangle goes in ``data``.

    Returns infinity where an element is inverted; residual and data are then not to be used.
    """
    terms, kappa, law = tables
    m, k = cells.shape
    ue, matrix, vector = np.empty((3, k)), np.empty((5, 3, 3)), np.empty((5, 3))
    F, G, A, N, n = matrix[0], matrix[1], matrix[2], matrix[3], matrix[4]
    row = 8 * ((3 * k + 7) // 8)
    g, bar, DB = np.empty((3, k)), np.empty((3, k)), np.zeros((6, row))
    Ke, geometric, fe = np.empty((3 * k, row)), np.empty((k, k)), np.empty((3, k))
    flat = bar.reshape(3 * k)
    c2, e, beta, slope, quotient = vector[0], vector[1], vector[2], vector[3], vector[4]
    tau, D, v = np.empty(6), np.empty((6, 6)), np.empty((6, 6))
    energy = 0.0
    for el in range(m):
        for a in range(k):
            for i in range(3):
                ue[i, a] = u[cells[el, a], i]
        region = regions[el]
        s = scale[region]
        fe[:] = 0.0
        Ke[:] = 0.0
        geometric[:] = 0.0
        bar[:] = 0.0
        U = JU = UU = ratio = 0.0
        if mean:
            ratio = mean_dilatation(grads[el], weights[el], ue, F)
            if ratio <= 0.0:
                return np.inf
            U, JU, UU = volumetric(law[region], kappa[region], ratio)
        for q in range(grads.shape[1]):
            w = weights[el, q]
            J = deformation_gradient(grads[el, q], ue, F)
            if J <= 0.0:
                return np.inf
            if not mean:
                U, JU, UU = volumetric(law[region], kappa[region], J)
            principal(F, A, c2, N)
            logarithmic_stretches(c2, e)
            W = ogden(terms[region], c2, e, beta, slope, quotient)
            inverse_transpose(F, J, G)
            for a in range(k):
                for i in range(3):
                    g[i, a] = (
                        G[i, 0] * grads[el, q, 0, a]
                        + G[i, 1] * grads[el, q, 1, a]
                        + G[i, 2] * grads[el, q, 2, a]
                    )
            for i in range(3):
                root = np.sqrt(c2[i])
                for p in range(3):
                    n[p, i] = (F[p, 0] * N[0, i] + F[p, 1] * N[1, i] + F[p, 2] * N[2, i]) / root
            pressure = JU * J / ratio if mean else JU
            from_principal(beta, n, tau)
            for p in range(6):
                tau[p] = s * tau[p] + (pressure if p < 3 else 0.0)
            K = history[el, q]
            push_forward(F, K, A, tau, 1.0)
            kc = 0.0
            for p in range(3):
                kc += K[0] * F[p, 0] ** 2 + K[1] * F[p, 1] ** 2 + K[2] * F[p, 2] ** 2
                kc += 2.0 * (K[3] * F[p, 0] * F[p, 1] + K[4] * F[p, 1] * F[p, 2] + K[5] * F[p, 2] * F[p, 0])
            energy += w * (s * W + U + 0.5 * kc)
            for a in range(k):
                fe[0, a] += w * (tau[0] * g[0, a] + tau[3] * g[1, a] + tau[5] * g[2, a])
                fe[1, a] += w * (tau[3] * g[0, a] + tau[1] * g[1, a] + tau[4] * g[2, a])
                fe[2, a] += w * (tau[5] * g[0, a] + tau[4] * g[1, a] + tau[2] * g[2, a])
            if tangent:
                rank = pressure if mean else UU
                for p in range(6):
                    for r in range(6):
                        D[p, r] = rank if p < 3 and r < 3 else 0.0
                    D[p, p] -= 2.0 * pressure if p < 3 else pressure
                spatial_moduli(beta, slope, quotient, c2, n, s, v, D)
                _add_stiffness(D, tau, g, w, DB, Ke, geometric)
                if mean:
                    for i in range(3):
                        for a in range(k):
                            bar[i, a] += w * J * g[i, a]
        for a in range(k):
            for i in range(3):
                residual[cells[el, a], i] += fe[i, a]
        if tangent:
            if mean:  # d(p)/d(theta) of the whole element: U'' / V
                volume = weights[el].sum()
                factor = (UU - JU) / (ratio * ratio * volume)
                for r in range(3 * k):
                    for c in range(r, 3 * k):
                        Ke[r, c] += factor * flat[r] * flat[c]
            for i in range(3):
                for a in range(k):
                    for b in range(k):
                        Ke[i * k + a, i * k + b] += geometric[a, b]
            scatter_upper(Ke, positions[el], data)
    return energy
