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
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numba import from_dtype, njit, types

from ..lanes import COMPILED, NUMBER, POINT, RATE, address

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
