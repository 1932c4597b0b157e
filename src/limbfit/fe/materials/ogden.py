"""Ogden hyperelasticity in principal logarithmic stretches: the elastic law of every material of this room.

``W = sum_k c_k/m_k^2 sum_i (exp(m_k e_i) - 1)``; its numbers are c_1 (MPa), m_1, c_2, ...  Differences of
principal values are divided differences of exponentials, so that the tangent is exact where stretches
repeat.  Neo-Hookean (m = 2) and Mooney-Rivlin (m = 2, -2) are terms of the same law.
"""

from __future__ import annotations

from ..lanes import LANES, exponential
from .elastic import ElasticLaw, lane_function, mean_exponential


@lane_function
def ogden(p, numbers):  # type: ignore[no-untyped-def]
    """Energy and its derivatives; see `elastic`."""
    for l in range(LANES):
        p.energy[l] = 0.0
        for i in range(3):
            p.beta[i, l] = p.slope[i, l] = p.slope[3 + i, l] = p.quotient[i, l] = 0.0
    for k in range(numbers.shape[0] // 2):
        modulus, exponent = numbers[2 * k], numbers[2 * k + 1]
        for l in range(LANES):
            c, m = modulus.v[l], exponent.v[l]
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
            p.quotient[0, l] += c * mean_exponential(x1, x2, half * (e1 - e2))
            p.quotient[1, l] += c * mean_exponential(x2, x0, half * (e2 - e0))
            p.quotient[2, l] += c * mean_exponential(x0, x1, half * (e0 - e1))


@lane_function
def ogden_rates(p, numbers, rates):  # type: ignore[no-untyped-def]
    """Derivatives with respect to moduli and exponents; see `elastic`."""
    for k in range(numbers.shape[0] // 2):
        modulus, exponent = numbers[2 * k], numbers[2 * k + 1]
        by_c, by_m = rates[2 * k], rates[2 * k + 1]
        for i in range(3):
            for l in range(LANES):
                c, m, e = modulus.v[l], exponent.v[l], p.e[i, l]
                x = exponential(m * e) / m
                by_c.beta[i, l], by_m.beta[i, l] = x, c * x * (e - 1.0 / m)


OGDEN = ElasticLaw(ogden, ogden_rates)
