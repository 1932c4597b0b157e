"""What fibres add at the points of the elements that have them: energy, stress, moduli, derivatives.

The energy is that of `materials.fibred` with ``I = J^(-2/3) |F a|^2`` of the fibre along ``a``.  With
``T = dW/de`` and ``T' = dT/de`` of ``e = ln(I)/2``, and the fibre's present direction ``m``, its Kirchhoff
stress is ``T D`` with ``D = m m - 1/3``, its moduli are ``T' D D - 2 T m m m m + 2/3 T`` times the symmetric
identity.  An active stress is added to ``T`` (`materials.contractile`).  The parts along the identity are
taken into the principal stresses, from which `response` makes stress and moduli; with ``F^-1 m`` in the place
of ``m`` the same are the material ones.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from ..lanes import COMPILED, LANES, exponential, logarithm

_PAIRS = ((0, 0), (1, 1), (2, 2), (0, 1), (1, 2), (2, 0))


@njit(**COMPILED)
def pull(p, law):  # type: ignore[no-untyped-def]
    """Direction and pull of the fibres at a POINT that has responded; adds to ``energy`` and ``beta``."""
    for l in range(LANES):
        a, b, c = law.along[0, l], law.along[1, l], law.along[2, l]
        x = p.F[0, 0, l] * a + p.F[0, 1, l] * b + p.F[0, 2, l] * c
        y = p.F[1, 0, l] * a + p.F[1, 1, l] * b + p.F[1, 2, l] * c
        z = p.F[2, 0, l] * a + p.F[2, 1, l] * b + p.F[2, 2, l] * c
        square = x * x + y * y + z * z
        r = 1.0 / np.sqrt(square)
        p.fibre[0, l], p.fibre[1, l], p.fibre[2, l] = r * x, r * y, r * z
        p.fibre_at_rest[0, l], p.fibre_at_rest[1, l], p.fibre_at_rest[2, l] = r * a, r * b, r * c
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
        p.pull[l] = k1 * more + active
        slope = 4.0 * k1 * isochoric * grown * (longer + isochoric * (1.0 + 2.0 * s))
        p.pull_slope[l] = slope if longer > 0.0 else 0.0
        p.pull_rates[0, l], p.pull_rates[1, l] = more, k1 * more * longer * longer
        third = p.pull[l] / 3.0
        p.beta[0, l] -= third
        p.beta[1, l] -= third
        p.beta[2, l] -= third


@njit(**COMPILED)
def add_stress(p):  # type: ignore[no-untyped-def]
    """Add the fibres' part of the Kirchhoff stress to ``tau`` of a POINT, scaled."""
    for l in range(LANES):
        T, x, y, z = p.scale[l] * p.pull[l], p.fibre[0, l], p.fibre[1, l], p.fibre[2, l]
        p.tau[0, l] += T * x * x
        p.tau[1, l] += T * y * y
        p.tau[2, l] += T * z * z
        p.tau[3, l] += T * x * y
        p.tau[4, l] += T * y * z
        p.tau[5, l] += T * z * x


@njit(**COMPILED)
def add_stress_at_rest(p):  # type: ignore[no-untyped-def]
    """Add the fibres' part of ``Se`` to ``tau`` of a POINT that is pulled back."""
    for l in range(LANES):
        T = p.pull[l]
        x, y, z = p.fibre_at_rest[0, l], p.fibre_at_rest[1, l], p.fibre_at_rest[2, l]
        p.tau[0, l] += T * x * x
        p.tau[1, l] += T * y * y
        p.tau[2, l] += T * z * z
        p.tau[3, l] += T * x * y
        p.tau[4, l] += T * y * z
        p.tau[5, l] += T * z * x


@njit(**COMPILED)
def add_weighted_moduli(p, element):  # type: ignore[no-untyped-def]
    """Add the fibres' part to the moduli of `response.weighted_moduli`."""
    for l in range(LANES):
        element.factor_of_fibre[l] = p.weight[l] * p.scale[l]
    _add_moduli(p, element, p.fibre)


@njit(**COMPILED)
def add_moduli_at_rest(p, element):  # type: ignore[no-untyped-def]
    """Add the fibres' part to the moduli of `response.moduli` of a POINT that is pulled back."""
    for l in range(LANES):
        element.factor_of_fibre[l] = 1.0
    _add_moduli(p, element, p.fibre_at_rest)


@njit(forceinline=True, **COMPILED)
def _add_moduli(p, element, m):  # type: ignore[no-untyped-def]
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
                p.D[r, s, l] += f * p.pull_slope[l] * across[r, l] * across[s, l]
                p.D[r, s, l] -= f * 2.0 * p.pull[l] * along[r, l] * along[s, l]
