"""Energy, residual and symmetric tangent of all elements in one compiled pass, `LANES` elements side by side.

One step minimises the incremental potential
``s W(C) + U(J) + 1/2 K : C`` with ``s = 1 + sum_l gamma_l ramp_l`` and the constant history tensor ``K``.
Its Kirchhoff stress is ``tau = s tau_e + J U' I + F K F^T``; the tangent is spatial:
``k_ab = int g_a . c . g_b + (g_a . tau g_b) I`` with ``g_a = F^-T grad N_a`` (Simo and Hughes 1998, ch. 7).
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numba import njit
from numpy.typing import NDArray

from ..lanes import COMPILED, LANES, block_places, prefetch, workspace
from ..materials.ogden import ogden_lanes, set_terms
from ..materials.volumetric import volumetric
from .kinematics import deform, invert, principal_axes

Array = NDArray[np.float64]
Indices = NDArray[np.int32]


def assemble(
    cells: Indices,
    grads: Array,
    weights: Array,
    mean: bool,
    regions: Indices,
    tables: tuple[Array, Array, NDArray[np.int64]],
    scale: Array,
    history: Array,
    u: Array,
    tangent: bool,
    positions: Indices,
    residual: Array,
    data: Array,
) -> float:
    """Add every element to ``residual`` and, with ``tangent``, to ``data``; return the potential, N mm.

    Parameters
    ----------
    cells (m, k), grads (m, q, 3, k), weights (m, q), regions (m,) : the elements; 1/mm, mm^3.
    mean : one volume ratio and pressure per element.
    tables : ``terms (r, n, 2), kappa (r,), law (r,)`` by region; scale (r,) : s.
    history (m, q, 6) : K, MPa.
    u (n, 3) : displacement, mm.
    positions (m, .) : where each entry of an element's upper triangle goes in ``data``; -1: nowhere.

    Returns infinity where an element is inverted; residual and data are then not to be used.
    """
    nodes = cells.shape[1]
    records = workspace(nodes, grads.shape[1], tables[0].shape[1])
    elements = cells, grads, weights, regions, history
    places = block_places(nodes), positions
    return float(_assemble(elements, mean, tables, scale, u, tangent, places, residual, data, records))


def is_compiled() -> bool:
    """Whether the costliest kernel is at hand, in this process or stored on this machine."""
    stored = Path(_assemble.stats.cache_path or ".").glob(f"assembly.{_assemble.py_func.__name__}-*.nbi")
    return bool(_assemble.signatures) or any(stored)


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"})
def _assemble(  # type: ignore[no-untyped-def]
    elements, mean, tables, scale, u, tangent, places, residual, data, records
):
    """The kernel of `assemble`."""
    cells, _, weights, regions, _ = elements
    terms, kappa, law = tables
    entries, positions = places
    points, term, at_points, forces, element, blocks = records
    numbers = blocks.view(np.float64)
    m, k = cells.shape
    q = weights.shape[1]
    energy = 0.0
    for start in range(0, m, LANES):
        count = min(LANES, m - start)
        _gather(elements, start, terms, scale, u, points, term, at_points)
        for t in range(q):
            invert(points[t])
            for l in range(LANES):
                if points[t].J[l] <= 0.0:
                    return np.inf
            principal_axes(points[t])
            ogden_lanes(points[t], term)
        _pressures(weights, regions, law, kappa, mean, start, points, element[0])
        for a in range(k):
            _no_force(forces[a])
        for t in range(q):
            energy += _stress(points[t])
            for a in range(k):
                _add_force(points[t], at_points[t * k + a], forces[a])
        for a in range(k):
            for l in range(count):
                for i in range(3):
                    residual[cells[start + l, a], i] += forces[a].f[i, l]
        if not tangent:
            continue
        _ask_for(positions[start], k, data)
        for t in range(q):
            _spatial_moduli(points[t])
        _stiffness(points, at_points, forces, element[0], blocks)
        for l in range(count):
            if start + l + 1 < m:
                _ask_for(positions[start + l + 1], k, data)
            for j in range(entries.shape[0]):
                to = positions[start + l, j]
                if to >= 0:
                    data[to] += numbers[entries[j] + l]
    return energy


@njit(**COMPILED)
def _gather(elements, start, terms, scale, u, points, term, at_points):  # type: ignore[no-untyped-def]
    """Read the elements from ``start`` on into lanes, with F; the last one again where there are no more."""
    cells, grads, weights, regions, history = elements
    m, k = cells.shape
    for l in range(LANES):
        el = min(start + l, m - 1)
        region = regions[el]
        set_terms(term, l, terms[region])
        for q in range(weights.shape[1]):
            p = points[q]
            deform(p, l, cells[el], grads[el, q], u)
            for a in range(k):
                to = at_points[q * k + a]
                to.g[0, l], to.g[1, l], to.g[2, l] = (
                    grads[el, q, 0, a],
                    grads[el, q, 1, a],
                    grads[el, q, 2, a],
                )
            p.weight[l] = weights[el, q] if start + l < m else 0.0
            p.scale[l] = scale[region]
            for i in range(6):
                p.history[i, l] = history[el, q, i]


@njit(**COMPILED)
def _pressures(weights, regions, law, kappa, mean, start, points, element):  # type: ignore[no-untyped-def]
    """Volumetric energy, pressure and stiffening of every point, from its own volume ratio or the element's.

    ``factor`` of the element is ``d(p)/d(theta) / V = (d(theta U')/d(ln theta) - theta U')/(theta^2 V)``.
    """
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
def _stress(p):  # type: ignore[no-untyped-def]
    """Kirchhoff stress of a POINT; returns the potential of all lanes, N mm."""
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
    energy = 0.0
    for l in range(LANES):
        energy += p.energy[l]
    return energy


@njit(**COMPILED)
def _no_force(force):  # type: ignore[no-untyped-def]
    for l in range(LANES):
        force.f[0, l], force.f[1, l], force.f[2, l] = 0.0, 0.0, 0.0
        force.volume[0, l], force.volume[1, l], force.volume[2, l] = 0.0, 0.0, 0.0


@njit(**COMPILED)
def _add_force(p, node, force):  # type: ignore[no-untyped-def]
    """Make a NODE's gradient spatial; add its traction ``w tau g`` and ``w J g`` to a FORCE."""
    for l in range(LANES):
        x, y, z = node.g[0, l], node.g[1, l], node.g[2, l]
        gx = p.inverse[0, 0, l] * x + p.inverse[0, 1, l] * y + p.inverse[0, 2, l] * z
        gy = p.inverse[1, 0, l] * x + p.inverse[1, 1, l] * y + p.inverse[1, 2, l] * z
        gz = p.inverse[2, 0, l] * x + p.inverse[2, 1, l] * y + p.inverse[2, 2, l] * z
        w = p.weight[l]
        tx = w * (p.tau[0, l] * gx + p.tau[3, l] * gy + p.tau[5, l] * gz)
        ty = w * (p.tau[3, l] * gx + p.tau[1, l] * gy + p.tau[4, l] * gz)
        tz = w * (p.tau[5, l] * gx + p.tau[4, l] * gy + p.tau[2, l] * gz)
        node.g[0, l], node.g[1, l], node.g[2, l] = gx, gy, gz
        node.traction[0, l], node.traction[1, l], node.traction[2, l] = tx, ty, tz
        force.f[0, l] += tx
        force.f[1, l] += ty
        force.f[2, l] += tz
        w *= p.J[l]
        force.volume[0, l] += w * gx
        force.volume[1, l] += w * gy
        force.volume[2, l] += w * gz


@njit(forceinline=True, **COMPILED)
def _dyads(p, s, i, j):  # type: ignore[no-untyped-def]
    """Component ij, number ``s``, of the dyads of the principal directions."""
    for l in range(LANES):
        x0, x1, x2 = p.n[i, 0, l], p.n[i, 1, l], p.n[i, 2, l]
        y0, y1, y2 = p.n[j, 0, l], p.n[j, 1, l], p.n[j, 2, l]
        p.axes[0, s, l], p.axes[1, s, l], p.axes[2, s, l] = x0 * y0, x1 * y1, x2 * y2
        p.axes[3, s, l] = x1 * y2 + x2 * y1
        p.axes[4, s, l] = x2 * y0 + x0 * y2
        p.axes[5, s, l] = x0 * y1 + x1 * y0


@njit(**COMPILED)
def _spatial_moduli(p):  # type: ignore[no-untyped-def]
    """Weighted spatial moduli ``D`` (Kirchhoff, 6 x 6) of a POINT.

    ``sum_ij (d beta_i/d ln lambda_j - 2 beta_i delta_ij) n_i n_i n_j n_j``, the shear terms
    ``(beta_i c2_j - beta_j c2_i)/(c2_i - c2_j)``, and those of the pressure.
    """
    _dyads(p, 0, 0, 0)
    _dyads(p, 1, 1, 1)
    _dyads(p, 2, 2, 2)
    _dyads(p, 3, 0, 1)
    _dyads(p, 4, 1, 2)
    _dyads(p, 5, 2, 0)
    for l in range(LANES):
        w = p.weight[l] * p.scale[l]
        for i in range(3):
            j, k = (i + 1) % 3, (i + 2) % 3
            p.along[i, l] = w * (p.slope[i, l] - 2.0 * p.beta[i, l])
            shear = (p.b[j, l] + p.b[k, l]) * p.quotient[i, l] - p.beta[j, l] - p.beta[k, l]
            p.along[3 + i, l] = 0.5 * w * shear
    for r in range(6):
        for s in range(r, 6):
            for l in range(LANES):
                total = p.along[0, l] * p.axes[0, r, l] * p.axes[0, s, l]
                total += p.along[1, l] * p.axes[1, r, l] * p.axes[1, s, l]
                total += p.along[2, l] * p.axes[2, r, l] * p.axes[2, s, l]
                total += p.along[3, l] * p.axes[3, r, l] * p.axes[3, s, l]
                total += p.along[4, l] * p.axes[4, r, l] * p.axes[4, s, l]
                total += p.along[5, l] * p.axes[5, r, l] * p.axes[5, s, l]
                p.D[r, s, l] = total
    _add_isotropic(p)
    for r in range(6):
        for s in range(r):
            for l in range(LANES):
                p.D[r, s, l] = p.D[s, r, l]


@njit(**COMPILED)
def _add_isotropic(p):  # type: ignore[no-untyped-def]
    """Add to the upper triangle of ``D`` what acts on volume, and ``-2 p`` times the identity.

    The rest of ``d beta_i/d ln lambda_j``: sum_i n_i n_i is the identity.
    """
    for l in range(LANES):
        w, pressure = p.weight[l], p.weight[l] * p.pressure[l]
        x = w * p.scale[l] / 3.0
        x, y, z = x * p.slope[0, l], x * p.slope[1, l], x * p.slope[2, l]
        whole = (x + y + z) / 3.0 + w * p.stiffening[l]
        h0 = x * p.axes[0, 0, l] + y * p.axes[1, 0, l] + z * p.axes[2, 0, l]
        h1 = x * p.axes[0, 1, l] + y * p.axes[1, 1, l] + z * p.axes[2, 1, l]
        h2 = x * p.axes[0, 2, l] + y * p.axes[1, 2, l] + z * p.axes[2, 2, l]
        h3 = x * p.axes[0, 3, l] + y * p.axes[1, 3, l] + z * p.axes[2, 3, l]
        h4 = x * p.axes[0, 4, l] + y * p.axes[1, 4, l] + z * p.axes[2, 4, l]
        h5 = x * p.axes[0, 5, l] + y * p.axes[1, 5, l] + z * p.axes[2, 5, l]
        p.D[0, 0, l] += whole - 2.0 * (h0 + pressure)
        p.D[1, 1, l] += whole - 2.0 * (h1 + pressure)
        p.D[2, 2, l] += whole - 2.0 * (h2 + pressure)
        p.D[0, 1, l] += whole - h0 - h1
        p.D[0, 2, l] += whole - h0 - h2
        p.D[1, 2, l] += whole - h1 - h2
        for r in range(3):
            p.D[r, 3, l] -= h3
            p.D[r, 4, l] -= h4
            p.D[r, 5, l] -= h5
            p.D[3 + r, 3 + r, l] -= pressure


@njit(**COMPILED)
def _stiffness(points, at_points, forces, element, blocks):  # type: ignore[no-untyped-def]
    """Fill the BLOCKs of all pairs of nodes, column by column."""
    k = forces.shape[0]
    for b in range(k):
        first = b * (b + 1) // 2
        for a in range(b + 1):
            _begin_block(forces[a], forces[b], element, blocks[first + a])
        for q in range(points.shape[0]):
            _strain(points[q], at_points[q * k + b], element)
            for a in range(b + 1):
                _add_block(at_points[q * k + a], at_points[q * k + b], element, blocks[first + a])


@njit(**COMPILED)
def _begin_block(a, b, element, block):  # type: ignore[no-untyped-def]
    """What the element's one pressure adds between two nodes; nothing where each point has its own."""
    for l in range(LANES):
        f = element.factor[l]
        x, y, z = f * a.volume[0, l], f * a.volume[1, l], f * a.volume[2, l]
        p, q, r = b.volume[0, l], b.volume[1, l], b.volume[2, l]
        block.K[0, l], block.K[1, l], block.K[2, l] = x * p, x * q, x * r
        block.K[3, l], block.K[4, l], block.K[5, l] = y * p, y * q, y * r
        block.K[6, l], block.K[7, l], block.K[8, l] = z * p, z * q, z * r


@njit(**COMPILED)
def _strain(p, node, element):  # type: ignore[no-untyped-def]
    """``D B`` of one node: weighted stresses (6, 3) for its displacement along each axis."""
    for l in range(LANES):
        x, y, z = node.g[0, l], node.g[1, l], node.g[2, l]
        for s in range(6):
            d3, d4, d5 = p.D[s, 3, l], p.D[s, 4, l], p.D[s, 5, l]
            element.DB[s, 0, l] = p.D[s, 0, l] * x + d3 * y + d5 * z
            element.DB[s, 1, l] = d3 * x + p.D[s, 1, l] * y + d4 * z
            element.DB[s, 2, l] = d5 * x + d4 * y + p.D[s, 2, l] * z


@njit(**COMPILED)
def _add_block(a, b, element, block):  # type: ignore[no-untyped-def]
    """Material and geometric stiffness of two nodes at one point: ``B_a^T (D B_b) + (g_a . tau g_b) I``."""
    DB, K = element.DB, block.K
    for l in range(LANES):
        x, y, z = a.g[0, l], a.g[1, l], a.g[2, l]
        stress = x * b.traction[0, l] + y * b.traction[1, l] + z * b.traction[2, l]
        p, q, r = DB[3, 0, l], DB[4, 0, l], DB[5, 0, l]
        K[0, l] += x * DB[0, 0, l] + y * p + z * r + stress
        K[3, l] += x * p + y * DB[1, 0, l] + z * q
        K[6, l] += x * r + y * q + z * DB[2, 0, l]
        p, q, r = DB[3, 1, l], DB[4, 1, l], DB[5, 1, l]
        K[1, l] += x * DB[0, 1, l] + y * p + z * r
        K[4, l] += x * p + y * DB[1, 1, l] + z * q + stress
        K[7, l] += x * r + y * q + z * DB[2, 1, l]
        p, q, r = DB[3, 2, l], DB[4, 2, l], DB[5, 2, l]
        K[2, l] += x * DB[0, 2, l] + y * p + z * r
        K[5, l] += x * p + y * DB[1, 2, l] + z * q
        K[8, l] += x * r + y * q + z * DB[2, 2, l] + stress


@njit(**COMPILED)
def _ask_for(positions, k, data):  # type: ignore[no-untyped-def]
    """Prefetch where an element goes in ``data``: three rows for each pair of nodes."""
    for i in range(3):
        for a in range(k):
            r = i * k + a
            first = r * 3 * k - r * (r - 1) // 2
            for j in range(first, first + k - a):
                prefetch(data, np.int64(max(positions[j], 0)))
