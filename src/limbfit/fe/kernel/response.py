"""The response of every point, for all kernels: stretches, elastic law, fibres, pressure, stress, moduli.

All of it is written once, for `LANES` elements side by side.  Symmetric tensors are six numbers in the order
xx, yy, zz, xy, yz, zx (tensor components, not engineering).  Of an elastic law the kernels know only its
derivatives in the principal stretches (`materials.elastic`).

Fibres add the energy of `materials.fibred` with ``I = J^(-2/3) |F a|^2`` of the fibre along ``a``.  With
``T = dW/de`` and ``T' = dT/de`` of ``e = ln(I)/2``, and the fibre's present direction ``m``, their Kirchhoff
stress is ``T D`` with ``D = m m - 1/3``, and their moduli are ``T' D D - 2 T m m m m + 2/3 T`` times the
symmetric identity.  An active stress is added to ``T``.  The parts along the identity are taken into the
principal stresses.  With ``F^-1 m`` in the place of ``m`` the same formulas give the material tensors.
"""

import numpy as np
from numba import njit

from ..lanes import COMPILED, LANES, call_with_three, call_with_two, exponential, logarithm
from ..materials.elastic import mean_exponential, volumetric


@njit(**COMPILED)
def elastic_response(elements, start, tables, u, points, law, numbers):  # type: ignore[no-untyped-def]
    """Fill F, principal axes and `evaluate_law` at the points of `LANES` elements from ``start`` on.

    Lanes beyond the last element repeat it.

    ``elements``: cells (m, k), gradients (m, q, 3, k), weights, regions (m,), fibres (m, 3) or none,
    pre-stretches (m, 3, 3) or none.
    Returns True if no element is inverted.
    """
    cells, grads, _, regions, fibres, prestretch = elements
    stated, addresses, fibre = tables[0], tables[3], tables[4]
    m = len(cells)
    for l in range(LANES):
        el = min(start + l, m - 1)
        region = regions[el]
        law.response[l], law.rates[l] = addresses[region, 0], addresses[region, 1]
        for k in range(numbers.shape[0]):
            numbers[k].v[l] = stated[region, k]
        if len(fibres):
            for i in range(3):
                law.fibre_direction[i, l] = fibres[el, i]
                law.fibre[i, l] = fibre[region, i]
        for q in range(points.shape[0]):
            deform(points[q], l, cells[el], grads[el, q], u)
            if len(prestretch):
                apply_prestretch(points[q], l, prestretch[el])
    for q in range(points.shape[0]):
        p = points[q]
        invert(p)
        for l in range(LANES):
            if p.J[l] <= 0.0:
                return False
        principal_axes(p)
        evaluate_law(p, law, numbers)
        if len(fibres):
            fibre_tension(p, law)
    return True


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
def apply_prestretch(p, l, G):  # type: ignore[no-untyped-def]
    """Replace the identity in the F of one lane of a POINT by a pre-stretch ``G (3, 3)``."""
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
def evaluate_law(p, law, numbers):  # type: ignore[no-untyped-def]
    """The elastic law at a POINT whose ``b`` is diagonal.

    ``energy``; ``beta``: deviatoric principal Kirchhoff stresses; ``slope``: ``d2W/de_i de_j``, not
    deviatoric; ``quotient``: ``(beta_i - beta_j)/(c2_i - c2_j)`` for ij = 12, 20, 01, with squared stretches.
    """
    for l in range(LANES):
        x, y, z = 0.5 * logarithm(p.b[0, l]), 0.5 * logarithm(p.b[1, l]), 0.5 * logarithm(p.b[2, l])
        mean = (x + y + z) / 3.0
        p.e[0, l], p.e[1, l], p.e[2, l] = x - mean, y - mean, z - mean
    call_with_two(law.response[0], p, numbers)
    others = 0
    for l in range(LANES):
        others += 1 if law.response[l] != law.response[0] else 0
    if others:
        _evaluate_mixed_laws(p, law, numbers)
    for l in range(LANES):
        e0, e1, e2 = p.e[0, l], p.e[1, l], p.e[2, l]
        x0, x1, x2 = p.b[0, l], p.b[1, l], p.b[2, l]
        mean = (p.beta[0, l] + p.beta[1, l] + p.beta[2, l]) / 3.0
        p.beta[0, l] -= mean
        p.beta[1, l] -= mean
        p.beta[2, l] -= mean
        p.quotient[0, l] /= 2.0 * mean_exponential(x1, x2, e1 - e2)
        p.quotient[1, l] /= 2.0 * mean_exponential(x2, x0, e2 - e0)
        p.quotient[2, l] /= 2.0 * mean_exponential(x0, x1, e0 - e1)


@njit(**COMPILED)
def _evaluate_mixed_laws(p, law, numbers):  # type: ignore[no-untyped-def]
    """Call every law that occurs in the lanes; each lane keeps the answer of its own law."""
    for first in range(LANES):
        if not _is_first(law.response, first):
            continue
        call_with_two(law.response[first], p, numbers)
        for l in range(first, LANES):
            if law.response[l] == law.response[first]:
                law.energy[l] = p.energy[l]
                for i in range(3):
                    law.beta[i, l], law.quotient[i, l] = p.beta[i, l], p.quotient[i, l]
                    law.slope[i, l], law.slope[3 + i, l] = p.slope[i, l], p.slope[3 + i, l]
    for l in range(LANES):
        p.energy[l] = law.energy[l]
        for i in range(3):
            p.beta[i, l], p.quotient[i, l] = law.beta[i, l], law.quotient[i, l]
            p.slope[i, l], p.slope[3 + i, l] = law.slope[i, l], law.slope[3 + i, l]


@njit(**COMPILED)
def _is_first(functions, lane):  # type: ignore[no-untyped-def]
    """True if no earlier lane has the same function."""
    known = 0
    for l in range(lane):
        known += 1 if functions[l] == functions[lane] else 0
    return known == 0


@njit(**COMPILED)
def fibre_tension(p, law):  # type: ignore[no-untyped-def]
    """Direction and tension of fibres at a POINT after `evaluate_law`; adds to ``energy`` and ``beta``."""
    for l in range(LANES):
        a, b, c = law.fibre_direction[0, l], law.fibre_direction[1, l], law.fibre_direction[2, l]
        x = p.F[0, 0, l] * a + p.F[0, 1, l] * b + p.F[0, 2, l] * c
        y = p.F[1, 0, l] * a + p.F[1, 1, l] * b + p.F[1, 2, l] * c
        z = p.F[2, 0, l] * a + p.F[2, 1, l] * b + p.F[2, 2, l] * c
        square = x * x + y * y + z * z
        r = 1.0 / np.sqrt(square)
        p.fibre[0, l], p.fibre[1, l], p.fibre[2, l] = r * x, r * y, r * z
        p.material_fibre[0, l], p.material_fibre[1, l], p.material_fibre[2, l] = r * a, r * b, r * c
        # J^(-2/3) from the logarithms at hand: ln(c2_i)/2 = e_i + ln(J)/3.
        isochoric = square * exponential(2.0 * p.e[0, l]) / p.b[0, l]
        longer = max(isochoric - 1.0, 0.0)
        k1, k2 = law.fibre[0, l], law.fibre[1, l]
        s = k2 * longer * longer
        grown = exponential(s)
        more = 2.0 * isochoric * longer * grown
        p.energy[l] += 0.5 * k1 * ((grown - 1.0) / k2 if s > 1e-8 else longer * longer * (1.0 + 0.5 * s))
        active = law.fibre[2, l]
        p.energy[l] += active * 0.5 * logarithm(isochoric)
        p.fibre_tension[l] = k1 * more + active
        slope = 4.0 * k1 * isochoric * grown * (longer + isochoric * (1.0 + 2.0 * s))
        p.fibre_stiffness[l] = slope if longer > 0.0 else 0.0
        p.fibre_tension_rates[0, l], p.fibre_tension_rates[1, l] = more, k1 * more * longer * longer
        third = p.fibre_tension[l] / 3.0
        p.beta[0, l] -= third
        p.beta[1, l] -= third
        p.beta[2, l] -= third


@njit(**COMPILED)
def pressures(weights, regions, tables, mean, start, points, element):  # type: ignore[no-untyped-def]
    """Volumetric energy, pressure and stiffening of every point, from its own volume ratio or the element's.

    ``factor`` of the element is ``d(p)/d(theta) / V = (d(theta U')/d(ln theta) - theta U')/(theta^2 V)``.
    """
    _, kappa, law, _, _ = tables
    m, q = weights.shape
    for l in range(LANES):
        el = min(start + l, m - 1)
        code, modulus = law[regions[el]], kappa[regions[el]]
        element.factor[l] = 0.0
        if not mean:
            for t in range(q):
                p = points[t]
                p.volumetric[l], p.pressure[l], p.stiffening[l] = volumetric(code, modulus, p.J[l])
            continue
        current = volume = 0.0
        for t in range(q):
            current += points[t].J[l] * weights[el, t]
            volume += weights[el, t]
        ratio = current / volume
        U, JU, UU = volumetric(code, modulus, ratio)
        element.factor[l] = (UU - JU) / (ratio * ratio * volume)
        for t in range(q):
            pressure = JU * points[t].J[l] / ratio
            points[t].volumetric[l] = U
            points[t].pressure[l] = points[t].stiffening[l] = pressure


@njit(**COMPILED)
def kirchhoff_stress(p, has_fibres):  # type: ignore[no-untyped-def]
    """Kirchhoff stress ``tau`` of a POINT; its ``energy`` becomes the potential, N mm."""
    for l in range(LANES):
        s, pressure = p.scale[l], p.pressure[l]
        b0, b1, b2 = s * p.beta[0, l], s * p.beta[1, l], s * p.beta[2, l]
        K0, K1, K2 = p.history[0, l], p.history[1, l], p.history[2, l]
        K3, K4, K5 = p.history[3, l], p.history[4, l], p.history[5, l]
        x0, x1, x2 = p.F[0, 0, l], p.F[0, 1, l], p.F[0, 2, l]
        y0, y1, y2 = p.F[1, 0, l], p.F[1, 1, l], p.F[1, 2, l]
        z0, z1, z2 = p.F[2, 0, l], p.F[2, 1, l], p.F[2, 2, l]
        # F K, row by row, and the normal components of F K F^T.
        u0, u1, u2 = x0 * K0 + x1 * K3 + x2 * K5, x0 * K3 + x1 * K1 + x2 * K4, x0 * K5 + x1 * K4 + x2 * K2
        v0, v1, v2 = y0 * K0 + y1 * K3 + y2 * K5, y0 * K3 + y1 * K1 + y2 * K4, y0 * K5 + y1 * K4 + y2 * K2
        w0, w1, w2 = z0 * K0 + z1 * K3 + z2 * K5, z0 * K3 + z1 * K1 + z2 * K4, z0 * K5 + z1 * K4 + z2 * K2
        hx, hy, hz = u0 * x0 + u1 * x1 + u2 * x2, v0 * y0 + v1 * y1 + v2 * y2, w0 * z0 + w1 * z1 + w2 * z2
        p.energy[l] = p.weight[l] * (s * p.energy[l] + p.volumetric[l] + 0.5 * (hx + hy + hz))
        X0, X1, X2 = p.n[0, 0, l], p.n[0, 1, l], p.n[0, 2, l]
        Y0, Y1, Y2 = p.n[1, 0, l], p.n[1, 1, l], p.n[1, 2, l]
        Z0, Z1, Z2 = p.n[2, 0, l], p.n[2, 1, l], p.n[2, 2, l]
        p.tau[0, l] = b0 * X0 * X0 + b1 * X1 * X1 + b2 * X2 * X2 + pressure + hx
        p.tau[1, l] = b0 * Y0 * Y0 + b1 * Y1 * Y1 + b2 * Y2 * Y2 + pressure + hy
        p.tau[2, l] = b0 * Z0 * Z0 + b1 * Z1 * Z1 + b2 * Z2 * Z2 + pressure + hz
        p.tau[3, l] = b0 * X0 * Y0 + b1 * X1 * Y1 + b2 * X2 * Y2 + u0 * y0 + u1 * y1 + u2 * y2
        p.tau[4, l] = b0 * Y0 * Z0 + b1 * Y1 * Z1 + b2 * Y2 * Z2 + v0 * z0 + v1 * z1 + v2 * z2
        p.tau[5, l] = b0 * Z0 * X0 + b1 * Z1 * X1 + b2 * Z2 * X2 + w0 * x0 + w1 * x1 + w2 * x2
    if has_fibres:
        _add_fibre_stress(p, p.fibre, True)


@njit(**COMPILED)
def pull_back(p, has_fibres):  # type: ignore[no-untyped-def]
    """Pull a POINT back: ``v_i = F^-1 n_i`` in the place of ``n``, ``Se = sum_i beta_i v_i x v_i``, and what
    fibres add to it, in that of ``tau``."""
    for l in range(LANES):
        f00, f10, f20 = p.inverse[0, 0, l], p.inverse[1, 0, l], p.inverse[2, 0, l]
        f01, f11, f21 = p.inverse[0, 1, l], p.inverse[1, 1, l], p.inverse[2, 1, l]
        f02, f12, f22 = p.inverse[0, 2, l], p.inverse[1, 2, l], p.inverse[2, 2, l]
        for i in range(3):
            x, y, z = p.n[0, i, l], p.n[1, i, l], p.n[2, i, l]
            p.n[0, i, l] = f00 * x + f10 * y + f20 * z
            p.n[1, i, l] = f01 * x + f11 * y + f21 * z
            p.n[2, i, l] = f02 * x + f12 * y + f22 * z
    _sum_dyads(p, p.beta, p.tau)
    if has_fibres:
        _add_fibre_stress(p, p.material_fibre, False)


@njit(forceinline=True, **COMPILED)
def _add_fibre_stress(p, m, scaled):  # type: ignore[no-untyped-def]
    """Add the stress of fibres along ``m (3, lanes)`` to ``tau`` of a POINT, ``scaled`` or as it is."""
    for l in range(LANES):
        T = p.scale[l] * p.fibre_tension[l] if scaled else p.fibre_tension[l]
        x, y, z = m[0, l], m[1, l], m[2, l]
        p.tau[0, l] += T * x * x
        p.tau[1, l] += T * y * y
        p.tau[2, l] += T * z * z
        p.tau[3, l] += T * x * y
        p.tau[4, l] += T * y * z
        p.tau[5, l] += T * z * x


@njit(forceinline=True, **COMPILED)
def _sum_dyads(p, values, out):  # type: ignore[no-untyped-def]
    """``sum_i values_i n_i x n_i`` in ``out (6, lanes)``."""
    for l in range(LANES):
        b0, b1, b2 = values[0, l], values[1, l], values[2, l]
        X0, X1, X2 = p.n[0, 0, l], p.n[0, 1, l], p.n[0, 2, l]
        Y0, Y1, Y2 = p.n[1, 0, l], p.n[1, 1, l], p.n[1, 2, l]
        Z0, Z1, Z2 = p.n[2, 0, l], p.n[2, 1, l], p.n[2, 2, l]
        out[0, l] = b0 * X0 * X0 + b1 * X1 * X1 + b2 * X2 * X2
        out[1, l] = b0 * Y0 * Y0 + b1 * Y1 * Y1 + b2 * Y2 * Y2
        out[2, l] = b0 * Z0 * Z0 + b1 * Z1 * Z1 + b2 * Z2 * Z2
        out[3, l] = b0 * X0 * Y0 + b1 * X1 * Y1 + b2 * X2 * Y2
        out[4, l] = b0 * Y0 * Z0 + b1 * Y1 * Z1 + b2 * Y2 * Z2
        out[5, l] = b0 * Z0 * X0 + b1 * Z1 * X1 + b2 * Z2 * X2


@njit(**COMPILED)
def stress_rates(p, law, numbers, rates):  # type: ignore[no-untyped-def]
    """Derivative ``S`` of the elastic stress at a POINT that is pulled back, by each of the law's numbers."""
    for first in range(LANES):
        if not _is_first(law.rates, first):
            continue
        call_with_three(law.rates[first], p, numbers, rates)
        for k in range(rates.shape[0]):
            for l in range(LANES):
                if law.rates[l] == law.rates[first]:
                    for i in range(3):
                        rates[k].kept[i, l] = rates[k].beta[i, l]
    for k in range(rates.shape[0]):
        rate = rates[k]
        for l in range(LANES):
            mean = (rate.kept[0, l] + rate.kept[1, l] + rate.kept[2, l]) / 3.0
            rate.kept[0, l] -= mean
            rate.kept[1, l] -= mean
            rate.kept[2, l] -= mean
        _sum_dyads(p, rate.kept, rate.S)


@njit(**COMPILED)
def elastic_moduli(p, element, has_fibres):  # type: ignore[no-untyped-def]
    """Elastic moduli ``D`` (6 x 6) of a POINT that is pulled back, ``dSe/dE``, those of fibres among them.

    ``sum_ij (d beta_i/de_j - 2 beta_i delta_ij) n_i n_i n_j n_j`` and the shear terms
    ``(beta_i c2_j - beta_j c2_i)/(c2_i - c2_j)``.
    """
    _principal_moduli(p, element)
    _combine_moduli(p, element)
    if has_fibres:
        for l in range(LANES):
            element.factor_of_fibre[l] = 1.0
        _add_fibre_moduli(p, element, p.material_fibre)


@njit(**COMPILED)
def weighted_moduli(p, element, has_fibres):  # type: ignore[no-untyped-def]
    """All spatial moduli ``D`` (6 x 6) of a POINT, times its weight: scaled elastic ones and the pressure's.

    These are ``stiffening I x I - 2 p`` times the symmetric identity: sum_i n_i n_i is the identity.
    """
    _principal_moduli(p, element)
    for l in range(LANES):
        w, s = p.weight[l], p.weight[l] * p.scale[l]
        stiffening, pressure = w * p.stiffening[l], w * p.pressure[l]
        for i in range(3):
            element.along[i, l] = s * element.along[i, l] + stiffening - 2.0 * pressure
            element.along[3 + i, l] = s * element.along[3 + i, l] + stiffening
            element.along[6 + i, l] = s * element.along[6 + i, l] - pressure
    _combine_moduli(p, element)
    if has_fibres:
        for l in range(LANES):
            element.factor_of_fibre[l] = p.weight[l] * p.scale[l]
        _add_fibre_moduli(p, element, p.fibre)


@njit(forceinline=True, **COMPILED)
def _principal_moduli(p, element):  # type: ignore[no-untyped-def]
    """Elastic moduli along pairs of principal axes (ii, ij = 01, 12, 20) and of shear (12, 20, 01)."""
    for l in range(LANES):
        h3, h4, h5 = p.slope[3, l], p.slope[4, l], p.slope[5, l]
        r0 = (p.slope[0, l] + h3 + h5) / 3.0
        r1 = (p.slope[1, l] + h3 + h4) / 3.0
        r2 = (p.slope[2, l] + h4 + h5) / 3.0
        mean = (r0 + r1 + r2) / 3.0
        element.along[0, l] = p.slope[0, l] - 2.0 * (r0 + p.beta[0, l]) + mean
        element.along[1, l] = p.slope[1, l] - 2.0 * (r1 + p.beta[1, l]) + mean
        element.along[2, l] = p.slope[2, l] - 2.0 * (r2 + p.beta[2, l]) + mean
        element.along[3, l] = h3 - r0 - r1 + mean
        element.along[4, l] = h4 - r1 - r2 + mean
        element.along[5, l] = h5 - r2 - r0 + mean
        for i in range(3):
            j, k = (i + 1) % 3, (i + 2) % 3
            shear = (p.b[j, l] + p.b[k, l]) * p.quotient[i, l] - p.beta[j, l] - p.beta[k, l]
            element.along[6 + i, l] = 0.5 * shear


@njit(forceinline=True, **COMPILED)
def _combine_moduli(p, element):  # type: ignore[no-untyped-def]
    """``D`` of a POINT from the moduli along pairs of its principal axes."""
    axes, along, across = element.axes, element.along, element.across
    _dyads(p, axes, 0, 0, 0)
    _dyads(p, axes, 1, 1, 1)
    _dyads(p, axes, 2, 2, 2)
    _dyads(p, axes, 3, 0, 1)
    _dyads(p, axes, 4, 1, 2)
    _dyads(p, axes, 5, 2, 0)
    for s in range(6):
        for l in range(LANES):
            x, y, z = axes[0, s, l], axes[1, s, l], axes[2, s, l]
            across[0, s, l] = along[0, l] * x + along[3, l] * y + along[5, l] * z
            across[1, s, l] = along[3, l] * x + along[1, l] * y + along[4, l] * z
            across[2, s, l] = along[5, l] * x + along[4, l] * y + along[2, l] * z
            across[3, s, l] = along[6, l] * axes[3, s, l]
            across[4, s, l] = along[7, l] * axes[4, s, l]
            across[5, s, l] = along[8, l] * axes[5, s, l]
    for r in range(6):
        for s in range(r, 6):
            for l in range(LANES):
                total = axes[0, r, l] * across[0, s, l]
                total += axes[1, r, l] * across[1, s, l]
                total += axes[2, r, l] * across[2, s, l]
                total += axes[3, r, l] * across[3, s, l]
                total += axes[4, r, l] * across[4, s, l]
                total += axes[5, r, l] * across[5, s, l]
                p.D[r, s, l] = total
    for r in range(6):
        for s in range(r):
            for l in range(LANES):
                p.D[r, s, l] = p.D[s, r, l]


@njit(forceinline=True, **COMPILED)
def _dyads(p, axes, s, i, j):  # type: ignore[no-untyped-def]
    """Component ij, number ``s``, of the dyads of the principal directions."""
    for l in range(LANES):
        x0, x1, x2 = p.n[i, 0, l], p.n[i, 1, l], p.n[i, 2, l]
        y0, y1, y2 = p.n[j, 0, l], p.n[j, 1, l], p.n[j, 2, l]
        axes[0, s, l], axes[1, s, l], axes[2, s, l] = x0 * y0, x1 * y1, x2 * y2
        axes[3, s, l] = x1 * y2 + x2 * y1
        axes[4, s, l] = x2 * y0 + x0 * y2
        axes[5, s, l] = x0 * y1 + x1 * y0


_PAIRS = ((0, 0), (1, 1), (2, 2), (0, 1), (1, 2), (2, 0))


@njit(forceinline=True, **COMPILED)
def _add_fibre_moduli(p, element, m):  # type: ignore[no-untyped-def]
    """``T' D D - 2 T m m m m`` with ``D = m m - 1/3``; the identity is the sum of the principal dyads."""
    axes, along, across = element.axes, element.dyad, element.deviator
    for s in range(6):
        i, j = _PAIRS[s]
        for l in range(LANES):
            along[s, l] = m[i, l] * m[j, l]
            across[s, l] = along[s, l] - (axes[0, s, l] + axes[1, s, l] + axes[2, s, l]) / 3.0
    for r in range(6):
        for s in range(6):
            for l in range(LANES):
                f = element.factor_of_fibre[l]
                p.D[r, s, l] += f * p.fibre_stiffness[l] * across[r, l] * across[s, l]
                p.D[r, s, l] -= f * 2.0 * p.fibre_tension[l] * along[r, l] * along[s, l]
