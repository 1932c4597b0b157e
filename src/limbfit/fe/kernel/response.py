"""The response of every point, for all kernels: stretches, elastic law, pressure, Kirchhoff stress, moduli.

Of an elastic law the kernels know its derivatives in the principal stretches alone (`materials.elastic`).
What follows from them is written here, once, `LANES` elements side by side.
"""

from __future__ import annotations

from numba import njit

from ..lanes import COMPILED, LANES, call_with_three, call_with_two, logarithm
from ..materials.elastic import mean_exponential
from ..materials.volumetric import volumetric
from .fibres import pull
from .kinematics import deform, invert, principal_axes, strain


@njit(**COMPILED)
def elastic_response(elements, start, tables, u, points, law, numbers):  # type: ignore[no-untyped-def]
    """F, principal axes and `respond` at the points of the elements from ``start`` on; the last one again
    where there are no more.

    ``elements``: cells (m, k), gradients (m, q, 3, k), weights, regions (m,), fibres (m, 3) or none,
    pre-stretches (m, 3, 3) or none.
    Returns whether none is inverted.
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
                law.along[i, l] = fibres[el, i]
                law.fibre[i, l] = fibre[region, i]
        for q in range(points.shape[0]):
            deform(points[q], l, cells[el], grads[el, q], u)
            if len(prestretch):
                strain(points[q], l, prestretch[el])
    for q in range(points.shape[0]):
        p = points[q]
        invert(p)
        for l in range(LANES):
            if p.J[l] <= 0.0:
                return False
        principal_axes(p)
        respond(p, law, numbers)
        if len(fibres):
            pull(p, law)
    return True


@njit(**COMPILED)
def respond(p, law, numbers):  # type: ignore[no-untyped-def]
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
        _respond_apart(p, law, numbers)
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
def _respond_apart(p, law, numbers):  # type: ignore[no-untyped-def]
    """Every law that is among the lanes, of which each keeps the answer of its own."""
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
    """Whether no lane before has the same function."""
    known = 0
    for l in range(lane):
        known += 1 if functions[l] == functions[lane] else 0
    return known == 0


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
        _along_axes(p, rate.kept, rate.S)


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
def kirchhoff(p):  # type: ignore[no-untyped-def]
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


@njit(**COMPILED)
def elastic_stress(p):  # type: ignore[no-untyped-def]
    """Pull a POINT back: ``v_i = F^-1 n_i`` in the place of ``n``, ``Se = sum_i beta_i v_i x v_i`` in that of
    ``tau``."""
    for l in range(LANES):
        f00, f10, f20 = p.inverse[0, 0, l], p.inverse[1, 0, l], p.inverse[2, 0, l]
        f01, f11, f21 = p.inverse[0, 1, l], p.inverse[1, 1, l], p.inverse[2, 1, l]
        f02, f12, f22 = p.inverse[0, 2, l], p.inverse[1, 2, l], p.inverse[2, 2, l]
        for i in range(3):
            x, y, z = p.n[0, i, l], p.n[1, i, l], p.n[2, i, l]
            p.n[0, i, l] = f00 * x + f10 * y + f20 * z
            p.n[1, i, l] = f01 * x + f11 * y + f21 * z
            p.n[2, i, l] = f02 * x + f12 * y + f22 * z
    _along_axes(p, p.beta, p.tau)


@njit(forceinline=True, **COMPILED)
def _along_axes(p, values, out):  # type: ignore[no-untyped-def]
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
def moduli(p, element):  # type: ignore[no-untyped-def]
    """Elastic moduli ``D`` (6 x 6) of a POINT: spatial ones; material ones ``dSe/dE`` once it is pulled back.

    ``sum_ij (d beta_i/de_j - 2 beta_i delta_ij) n_i n_i n_j n_j`` and the shear terms
    ``(beta_i c2_j - beta_j c2_i)/(c2_i - c2_j)``.
    """
    _principal_moduli(p, element)
    _moduli_along(p, element)


@njit(**COMPILED)
def weighted_moduli(p, element):  # type: ignore[no-untyped-def]
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
    _moduli_along(p, element)


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
def _moduli_along(p, element):  # type: ignore[no-untyped-def]
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
