"""Fung's exponential law, isotropic in the principal stretches.

``W = c/(2 b) (exp(b (I1 - 3)) - 1)`` with ``I1 = sum_i exp(2 e_i)`` of the isochoric stretches.
Source: Demiray, H. (1972). A note on the elasticity of soft biological tissues. J. Biomech. 5, 309.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from ..lanes import LANES, exponential
from .elastic import ElasticLaw, lane_function, mean_exponential
from .material import Array, PronyTerms, Uncoupled, check_not_negative, check_positive


@lane_function
def fung(p, numbers):  # type: ignore[no-untyped-def]
    """Energy and its derivatives; see `elastic`."""
    for l in range(LANES):
        c, b = numbers[0].v[l], numbers[1].v[l]
        x0, x1, x2 = exponential(2.0 * p.e[0, l]), exponential(2.0 * p.e[1, l]), exponential(2.0 * p.e[2, l])
        grown = c * exponential(b * (x0 + x1 + x2 - 3.0))
        p.energy[l] = 0.5 * (grown - c) / b
        p.beta[0, l], p.beta[1, l], p.beta[2, l] = grown * x0, grown * x1, grown * x2
        p.slope[0, l] = 2.0 * grown * x0 * (1.0 + b * x0)
        p.slope[1, l] = 2.0 * grown * x1 * (1.0 + b * x1)
        p.slope[2, l] = 2.0 * grown * x2 * (1.0 + b * x2)
        p.slope[3, l] = 2.0 * grown * b * x0 * x1
        p.slope[4, l] = 2.0 * grown * b * x1 * x2
        p.slope[5, l] = 2.0 * grown * b * x2 * x0
        p.quotient[0, l] = 2.0 * grown * mean_exponential(x1, x2, p.e[1, l] - p.e[2, l])
        p.quotient[1, l] = 2.0 * grown * mean_exponential(x2, x0, p.e[2, l] - p.e[0, l])
        p.quotient[2, l] = 2.0 * grown * mean_exponential(x0, x1, p.e[0, l] - p.e[1, l])


@lane_function
def fung_rates(p, numbers, rates):  # type: ignore[no-untyped-def]
    """Derivatives of the stress with respect to ``c`` and ``b``; see `elastic`."""
    for l in range(LANES):
        c, b = numbers[0].v[l], numbers[1].v[l]
        x0, x1, x2 = exponential(2.0 * p.e[0, l]), exponential(2.0 * p.e[1, l]), exponential(2.0 * p.e[2, l])
        more = x0 + x1 + x2 - 3.0
        grown = exponential(b * more)
        by_b = c * more * grown
        rates[0].beta[0, l], rates[0].beta[1, l], rates[0].beta[2, l] = grown * x0, grown * x1, grown * x2
        rates[1].beta[0, l], rates[1].beta[1, l], rates[1].beta[2, l] = by_b * x0, by_b * x1, by_b * x2


@dataclass(frozen=True)
class FungQLV(Uncoupled):
    """A tissue that stiffens exponentially, with relaxation ``G(t) = 1 + gamma exp(-t/tau)``.

    Parameters
    ----------
    c : long-term shear modulus of small strains, MPa.
    b : stiffening, dimensionless.
    gamma : relaxation amplitude, dimensionless (0: elastic).
    tau : relaxation time, s.
    kappa_ratio : bulk modulus over ``c``.
    """

    c: float
    b: float
    gamma: float
    tau: float
    kappa_ratio: float = 100.0

    elastic: ClassVar[ElasticLaw] = ElasticLaw(fung, fung_rates)
    parameter_names: ClassVar[tuple[str, ...]] = ("c", "b", "gamma", "tau")
    volumetric: ClassVar[str] = "log"

    def __post_init__(self) -> None:
        for name in ("c", "b", "tau", "kappa_ratio"):
            check_positive(name, getattr(self, name))
        check_not_negative("gamma", self.gamma)

    @property
    def prony(self) -> PronyTerms:
        return ((self.gamma, self.tau),)

    @property
    def elastic_parameters(self) -> tuple[float, ...]:
        return self.c, self.b

    @property
    def shear_modulus(self) -> float:
        return self.c

    @property
    def shear_modulus_gradient(self) -> Array:
        return np.array([1.0, 0.0])
