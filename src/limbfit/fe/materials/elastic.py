"""What the kernels ask of an elastic law: the derivatives of its energy in the principal stretches.

A law is two compiled functions, `LANES` elements side by side (`lanes`), of the isochoric logarithmic
stretches ``e_i = ln(lambda_i) - ln(J)/3`` and of the numbers that a material gives to its law (`LawTable`)::

    response(p, numbers)      fills, from p.e (3, lanes) and numbers[k].v (lanes),
        p.energy              W, MPa
        p.beta (3,)           dW/de_i
        p.slope (6,)          d2W/de_i de_j, as 00, 11, 22, 01, 12, 20
        p.quotient (3,)       (dW/de_i - dW/de_j)/(e_i - e_j), as 12, 20, 01, with its limit where they meet
    rates(p, numbers, rates)  fills
        rates[k].beta (3,)    the derivative of dW/de_i with respect to number k

All else is the kernels' own: that only the deviatoric part of the stress counts, the tangent, the history.
They reach a law by its address, so that they are compiled once, whatever laws there are, and a law is
compiled alone.  `mean_exponential` makes quotients of exponentials.

`OGDEN` is the law of every material of this room but the user's own: ``W = sum_k c_k/m_k^2 sum_i (exp(m_k
e_i) - 1)``; its numbers are c_1 (MPa), m_1, c_2, ...  Neo-Hookean (m = 2) and Mooney-Rivlin (m = 2, -2) are
terms of it.  Differences of principal values are divided differences of exponentials, so that the tangent is
exact where stretches repeat.

The volumetric laws ``U(J)`` are named by code in the kernels.  Source: FEBio theory and user manuals,
"uncoupled materials", ``pressure_model``.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numba import from_dtype, njit, types

from ..lanes import COMPILED, LANES, NUMBER, POINT, RATE, address, exponential

_NUMBERS = types.Array(from_dtype(NUMBER), 1, "C")
_RESPONSE = types.void(from_dtype(POINT), _NUMBERS)
_RATES = types.void(from_dtype(POINT), _NUMBERS, types.Array(from_dtype(RATE), 1, "C"))


def lane_function(function: Any) -> Any:
    """Decorates both functions of a law; what is compiled is stored beside the file that they stand in."""
    return njit(cache=Path(function.__code__.co_filename).is_file(), **COMPILED)(function)


@dataclass(frozen=True)
class ElasticLaw:
    """The two functions of a law, decorated by `lane_function`; see the module's docstring."""

    response: Any
    rates: Any

    @property
    def addresses(self) -> tuple[int, int]:
        """Where both are in this process; compiled, or read from where that is stored, when first asked."""
        return address(self.response, _RESPONSE), address(self.rates, _RATES)


@njit(forceinline=True, **COMPILED)
def mean_exponential(xi, xj, half):  # type: ignore[no-untyped-def]
    """``(x_i - x_j)/(ln x_i - ln x_j)`` from ``half = (ln x_i - ln x_j)/2``; a series where that is lost."""
    y = half * half
    near = y < 0.01
    series = 1.0 + y * (1.0 / 42.0) * (1.0 + y * (1.0 / 72.0))
    series = 1.0 + y * (1.0 / 6.0) * (1.0 + y * (1.0 / 20.0) * series)
    return np.sqrt(xi * xj) * series if near else 0.5 * (xi - xj) / (1.0 if near else half)


@lane_function
def ogden(p, numbers):  # type: ignore[no-untyped-def]
    """Energy and its derivatives; see the module's docstring."""
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
    """Derivatives with respect to moduli and exponents; see the module's docstring."""
    for k in range(numbers.shape[0] // 2):
        modulus, exponent = numbers[2 * k], numbers[2 * k + 1]
        by_c, by_m = rates[2 * k], rates[2 * k + 1]
        for i in range(3):
            for l in range(LANES):
                c, m, e = modulus.v[l], exponent.v[l], p.e[i, l]
                x = exponential(m * e) / m
                by_c.beta[i, l], by_m.beta[i, l] = x, c * x * (e - 1.0 / m)


OGDEN = ElasticLaw(ogden, ogden_rates)


# FEBio's default, NIKE3D, Abaqus and Abaqus-GOH; the last, kappa/2 ((J^2 - 1)/2 - ln J), is the second.
VOLUMETRIC_LAWS = {"log": 0, "nike3d": 1, "abaqus": 2, "abaqus-goh": 1}


@njit(cache=True)
def volumetric(law: int, kappa: float, J: float) -> tuple[float, float, float]:
    """``U(J)``, ``J U'(J)`` and ``d(J U')/d(ln J)`` of a law of `VOLUMETRIC_LAWS`, in MPa.

    log: kappa/2 (ln J)^2; nike3d: kappa/4 (J^2 - 2 ln J - 1); abaqus: kappa/2 (J - 1)^2.
    """
    if law == 0:
        log_j = np.log(J)
        return 0.5 * kappa * log_j * log_j, kappa * log_j, kappa
    if law == 1:
        return 0.25 * kappa * (J * J - 2.0 * np.log(J) - 1.0), 0.5 * kappa * (J * J - 1.0), kappa * J * J
    return 0.5 * kappa * (J - 1.0) ** 2, kappa * (J - 1.0) * J, kappa * (2.0 * J - 1.0) * J
