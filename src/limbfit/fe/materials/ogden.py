"""Ogden hyperelasticity in principal logarithmic stretches: the kernels of every law of this room.

``W = sum_k c_k/m_k^2 sum_i (exp(m_k e_i) - 1)`` with ``e_i = ln(lambda_i) - ln(J)/3``.  All differences of
principal values are divided differences of exponentials, so that the tangent is exact where stretches
repeat.  Neo-Hookean (m = 2) and Mooney-Rivlin (m = 2, -2) are tables of terms of the same law.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from ..lanes import COMPILED, LANES, exponential, logarithm


@njit(cache=True)
def sinhc(x: float) -> float:
    """``sinh(x)/x``, by its series where the quotient is lost."""
    if abs(x) < 0.1:
        y = x * x
        return 1.0 + y / 6.0 * (1.0 + y / 20.0 * (1.0 + y / 42.0 * (1.0 + y / 72.0)))
    return np.sinh(x) / x


@njit(cache=True)
def ogden(terms, c2, e, beta, slope, quotient):  # type: ignore[no-untyped-def]
    """Energy and principal derivatives of the deviatoric law at one point.

    Parameters
    ----------
    terms : (k, 2) moduli and exponents.
    c2 : (3,) eigenvalues of C, that is squared stretches.
    e : (3,) logarithmic isochoric stretches.
    beta, slope, quotient : (3,) results: deviatoric principal Kirchhoff stresses; ``dw/de`` of the
        undeviated stresses; ``(beta_i - beta_j)/(c2_i - c2_j)`` for ij = 12, 20, 01.

    Returns the energy density.
    """
    energy = 0.0
    for i in range(3):
        beta[i] = 0.0
        slope[i] = 0.0
        quotient[i] = 0.0
    for k in range(terms.shape[0]):
        c, m = terms[k, 0], terms[k, 1]
        x0, x1, x2 = np.exp(m * e[0]), np.exp(m * e[1]), np.exp(m * e[2])
        energy += c / (m * m) * (x0 + x1 + x2 - 3.0)
        beta[0] += c / m * x0
        beta[1] += c / m * x1
        beta[2] += c / m * x2
        slope[0] += c * x0
        slope[1] += c * x1
        slope[2] += c * x2
        quotient[0] += c * np.sqrt(x1 * x2) * sinhc(0.5 * m * (e[1] - e[2]))
        quotient[1] += c * np.sqrt(x2 * x0) * sinhc(0.5 * m * (e[2] - e[0]))
        quotient[2] += c * np.sqrt(x0 * x1) * sinhc(0.5 * m * (e[0] - e[1]))
    mean = (beta[0] + beta[1] + beta[2]) / 3.0
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        beta[i] -= mean
        # (c2_j - c2_k) = 2 (e_j - e_k) sqrt(c2_j c2_k) sinhc(e_j - e_k)
        quotient[i] /= 2.0 * np.sqrt(c2[j] * c2[k]) * sinhc(e[j] - e[k])
    return energy


@njit(forceinline=True, **COMPILED)
def _mean_exponential(xi, xj, half):  # type: ignore[no-untyped-def]
    """``(x_i - x_j)/(ln x_i - ln x_j)`` from ``half = (ln x_i - ln x_j)/2``; its series as in `sinhc`."""
    y = half * half
    near = y < 0.01
    series = 1.0 + y * (1.0 / 42.0) * (1.0 + y * (1.0 / 72.0))
    series = 1.0 + y * (1.0 / 6.0) * (1.0 + y * (1.0 / 20.0) * series)
    return np.sqrt(xi * xj) * series if near else 0.5 * (xi - xj) / (1.0 if near else half)


@njit(forceinline=True, **COMPILED)
def set_terms(law, l, terms):  # type: ignore[no-untyped-def]
    """Put the ``terms (k, 2)`` of an element's law in a lane of its TERMs."""
    for k in range(len(terms)):
        law[k].c[l], law[k].m[l] = terms[k, 0], terms[k, 1]


@njit(**COMPILED)
def ogden_lanes(p, terms):  # type: ignore[no-untyped-def]
    """`ogden` in all lanes of a POINT whose ``b`` is diagonal, with a TERM for each of the law's.

    Fills ``e, energy, beta, slope, quotient``.
    """
    for l in range(LANES):
        x, y, z = 0.5 * logarithm(p.b[0, l]), 0.5 * logarithm(p.b[1, l]), 0.5 * logarithm(p.b[2, l])
        mean = (x + y + z) / 3.0
        p.e[0, l], p.e[1, l], p.e[2, l] = x - mean, y - mean, z - mean
        p.energy[l] = 0.0
        for i in range(3):
            p.beta[i, l] = p.slope[i, l] = p.quotient[i, l] = 0.0
    for k in range(terms.shape[0]):
        term = terms[k]
        for l in range(LANES):
            c, m = term.c[l], term.m[l]
            e0, e1, e2 = p.e[0, l], p.e[1, l], p.e[2, l]
            x0, x1, x2 = exponential(m * e0), exponential(m * e1), exponential(m * e2)
            cm, half = c / m, 0.5 * m
            p.energy[l] += cm / m * (x0 + x1 + x2 - 3.0)
            p.beta[0, l] += cm * x0
            p.beta[1, l] += cm * x1
            p.beta[2, l] += cm * x2
            p.slope[0, l] += c * x0
            p.slope[1, l] += c * x1
            p.slope[2, l] += c * x2
            p.quotient[0, l] += c * _mean_exponential(x1, x2, half * (e1 - e2))
            p.quotient[1, l] += c * _mean_exponential(x2, x0, half * (e2 - e0))
            p.quotient[2, l] += c * _mean_exponential(x0, x1, half * (e0 - e1))
    for l in range(LANES):
        e0, e1, e2 = p.e[0, l], p.e[1, l], p.e[2, l]
        x0, x1, x2 = p.b[0, l], p.b[1, l], p.b[2, l]
        mean = (p.beta[0, l] + p.beta[1, l] + p.beta[2, l]) / 3.0
        p.beta[0, l] -= mean
        p.beta[1, l] -= mean
        p.beta[2, l] -= mean
        p.quotient[0, l] /= 2.0 * _mean_exponential(x1, x2, e1 - e2)
        p.quotient[1, l] /= 2.0 * _mean_exponential(x2, x0, e2 - e0)
        p.quotient[2, l] /= 2.0 * _mean_exponential(x0, x1, e0 - e1)


@njit(cache=True)
def ogden_derivative(terms, d_terms, e, d_beta):  # type: ignore[no-untyped-def]
    """Derivative of the deviatoric principal Kirchhoff stresses along ``d_terms`` at fixed stretches."""
    for i in range(3):
        d_beta[i] = 0.0
        for k in range(terms.shape[0]):
            c, m = terms[k, 0], terms[k, 1]
            dc, dm = d_terms[k, 0], d_terms[k, 1]
            d_beta[i] += np.exp(m * e[i]) * (dc / m + dm * c / m * (e[i] - 1.0 / m))
    mean = (d_beta[0] + d_beta[1] + d_beta[2]) / 3.0
    for i in range(3):
        d_beta[i] -= mean
