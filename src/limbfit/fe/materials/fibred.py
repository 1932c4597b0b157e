"""A tissue with fibres in one direction: an isotropic ground and what the stretched fibres add.

``W = W_ground + k1/(2 k2) (exp(k2 (I - 1)^2) - 1)`` where the isochoric squared stretch ``I`` of the
fibre is above one, ``W_ground`` alone where it is not: the exponential fibre of Holzapfel, Gasser and Ogden
(2000, J. Elast. 61, 1), without dispersion; FEBio's ``fiber-exp-pow-uncoupled`` with ksi = k1,
alpha = k2, beta = 2.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from .material import LawTable, Uncoupled, check_not_negative, check_positive


@dataclass(frozen=True)
class Fibred:
    """A `Material` with fibres; their direction is the problem's (`Problem.fibres`).

    Parameters
    ----------
    ground : the isotropic law; its relaxation holds for the fibres too.
    k1 : stiffness of the fibres, MPa: their uniaxial modulus at small stretch is ``4 k1``; 0: none.
    k2 : how fast they stiffen, dimensionless.
    """

    ground: Uncoupled
    k1: float
    k2: float

    def __post_init__(self) -> None:
        check_not_negative("k1", self.k1)
        check_positive("k2", self.k2)

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """Those of the ground, k1, k2."""
        return *self.ground.parameter_names, "k1", "k2"

    @property
    def parameters(self) -> tuple[float, ...]:
        """Their values."""
        return *self.ground.parameters, self.k1, self.k2

    @property
    def instantaneous_modulus(self) -> float:
        """That of the ground, MPa: fibres bear nothing before they are stretched."""
        return self.ground.instantaneous_modulus

    @property
    def instantaneous_modulus_gradient(self) -> tuple[float, ...]:
        """Its derivative with respect to each parameter."""
        return *self.ground.instantaneous_modulus_gradient, 0.0, 0.0

    def table(self) -> LawTable:
        """The material as the kernels read it."""
        return replace(self.ground.table(), fibre=(self.k1, self.k2))

    def derivatives(self) -> tuple[LawTable, ...]:
        """Derivative of the table with respect to each parameter."""
        still = self.ground.table()
        rest = LawTable(np.zeros_like(still.numbers), 0.0, np.zeros_like(still.prony))
        units = ((1.0, 0.0), (0.0, 1.0))
        return *self.ground.derivatives(), *(replace(rest, fibre=unit) for unit in units)

    def with_parameters(self, values: Mapping[str, float]) -> Self:
        """The material with other values of some of its parameters, by name."""
        own = {name: value for name, value in values.items() if name in ("k1", "k2")}
        ground = {name: value for name, value in values.items() if name not in own}
        return replace(self, ground=self.ground.with_parameters(ground), **own)
