"""Energy, residual and symmetric tangent of all elements in one compiled pass, `LANES` elements side by side.

One step minimises the incremental potential
``s W(C) + U(J) + 1/2 K : C`` with ``s = 1 + sum_l gamma_l ramp_l`` and the constant history tensor ``K``.
Its Kirchhoff stress is ``tau = s tau_e + J U' I + F K F^T``; the tangent is spatial:
``k_ab = int g_a . c . g_b + (g_a . tau g_b) I`` with ``g_a = F^-T grad N_a`` (Simo and Hughes 1998, ch. 7).
"""

from pathlib import Path

import numpy as np
from numba import njit

from ...arrays import Array, Index
from ..lanes import COMPILED, LANES, block_places, prefetch, workspace
from .laws import Tables
from .response import elastic_response, kirchhoff_stress, pressures, weighted_moduli

Elements = tuple[Index, Array, Array, Index, Array, Array]


def assemble(
    elements: Elements,
    mean: bool,
    tables: Tables,
    scale: Array,
    history: Array,
    u: Array,
    tangent: bool,
    positions: Index,
    residual: Array,
    data: Array,
) -> float:
    """Add every element to ``residual`` and, with ``tangent``, to ``data``; return the potential, N mm.

    Parameters
    ----------
    elements : cells (m, k), gradients (m, q, 3, k) 1/mm, weights (m, q) mm^3, regions (m,), directions of
        fibres (m, 3), or (0, 3) without, and pre-stretches (m, 3, 3), or (0, 3, 3) without.
    mean : one volume ratio and pressure per element.
    tables : `Laws.tables`; scale (r,) : s.
    history (m, q, 6) : K, MPa.
    u (n, 3) : displacement, mm.
    positions (m, .) : where each entry of an element's upper triangle goes in ``data``; -1: nowhere.

    Returns infinity where an element is inverted; residual and data are then not to be used.
    """
    cells, _, weights, *_ = elements
    nodes = cells.shape[1]
    *records, _ = workspace(nodes, weights.shape[1], tables[0].shape[1])
    places, past = (block_places(nodes), positions), (scale, history)
    return float(_assemble(elements, mean, tables, past, u, tangent, places, residual, data, tuple(records)))


def is_compiled() -> bool:
    """True if the costliest kernel is at hand, in this process or stored on this machine."""
    stored = Path(_assemble.stats.cache_path or ".").glob(f"assembly.{_assemble.py_func.__name__}-*.nbi")
    return bool(_assemble.signatures) or any(stored)


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"})
def _assemble(  # type: ignore[no-untyped-def]
    elements, mean, tables, past, u, tangent, places, residual, data, records
):
    """The kernel of `assemble`."""
    cells, _, weights, regions, fibres, _ = elements
    entries, positions = places
    points, law, numbers, at_points, forces, element, blocks = records
    stiffness = blocks.view(np.float64)
    m, k = cells.shape
    q = weights.shape[1]
    energy = 0.0
    for start in range(0, m, LANES):
        count = min(LANES, m - start)
        if not elastic_response(elements, start, tables, u, points, law[0], numbers):
            return np.inf
        _load_lanes(elements, start, past, points, at_points)
        pressures(weights, regions, tables, mean, start, points, element[0])
        for a in range(k):
            _clear_force(forces[a])
        for t in range(q):
            kirchhoff_stress(points[t], len(fibres) > 0)
            for l in range(LANES):
                energy += points[t].energy[l]
            for a in range(k):
                _add_force(points[t], at_points[t * k + a], forces[a])
        for a in range(k):
            for l in range(count):
                for i in range(3):
                    residual[cells[start + l, a], i] += forces[a].f[i, l]
        if not tangent:
            continue
        _prefetch_entries(positions[start], k, data)
        for t in range(q):
            weighted_moduli(points[t], element[0], len(fibres) > 0)
        _fill_blocks(points, at_points, forces, element[0], blocks)
        for l in range(count):
            if start + l + 1 < m:
                _prefetch_entries(positions[start + l + 1], k, data)
            for j in range(entries.shape[0]):
                to = positions[start + l, j]
                if to >= 0:
                    data[to] += stiffness[entries[j] + l]
    return energy


@njit(**COMPILED)
def _load_lanes(elements, start, past, points, at_points):  # type: ignore[no-untyped-def]
    """Read weights, what is past and gradients of the elements from ``start`` on into lanes."""
    cells, grads, weights, regions, _, _ = elements
    scale, history = past
    m, k = cells.shape
    for l in range(LANES):
        el = min(start + l, m - 1)
        for q in range(weights.shape[1]):
            p = points[q]
            for a in range(k):
                to = at_points[q * k + a]
                for i in range(3):
                    to.g[i, l] = grads[el, q, i, a]
            p.weight[l] = weights[el, q] if start + l < m else 0.0
            p.scale[l] = scale[regions[el]]
            for i in range(6):
                p.history[i, l] = history[el, q, i]


@njit(**COMPILED)
def _clear_force(force):  # type: ignore[no-untyped-def]
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


@njit(**COMPILED)
def _fill_blocks(points, at_points, forces, element, blocks):  # type: ignore[no-untyped-def]
    """Fill the BLOCKs of all pairs of nodes, column by column."""
    k = forces.shape[0]
    for b in range(k):
        first = b * (b + 1) // 2
        for a in range(b + 1):
            _begin_block(forces[a], forces[b], element, blocks[first + a])
        for q in range(points.shape[0]):
            _apply_moduli(points[q], at_points[q * k + b], element)
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
def _apply_moduli(p, node, element):  # type: ignore[no-untyped-def]
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
def _prefetch_entries(positions, k, data):  # type: ignore[no-untyped-def]
    """Prefetch where an element goes in ``data``: three rows for each pair of nodes."""
    for i in range(3):
        for a in range(k):
            r = i * k + a
            first = r * 3 * k - r * (r - 1) // 2
            for j in range(first, first + k - a):
                prefetch(data, np.int64(max(positions[j], 0)))
