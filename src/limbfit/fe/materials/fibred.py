"""Tissues with fibres in one direction: an isotropic ground and what its fibres add, passively and by
themselves.

Stretched fibres: ``W = W_ground + k1/(2 k2) (exp(k2 (I - 1)^2) - 1)`` where the isochoric squared stretch
``I`` of the fibre is above one, ``W_ground`` alone where it is not: the exponential fibre of Holzapfel,
Gasser and Ogden (2000, J. Elast. 61, 1), without dispersion; FEBio's ``fiber-exp-pow-uncoupled`` with ksi =
k1, alpha = k2, beta = 2.

Contracting fibres: the Kirchhoff stress ``s(t) T (m m - 1/3)`` with the fibre's present direction ``m``, the
stress ``T`` of full activation and the share ``s(t)`` of it that acts (`Problem.activation`).  Its potential
is ``s T ln(I)/2``: the stress does not depend on the stretch and does not relax.  A stress along the fibres
beside the passive one is the usual form (Blemker, Pinsky and Delp 2005, J. Biomech. 38, 657); how it depends
on length and speed is left to ``s``.
"""

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from typing import Any, Self, cast

import numpy as np

from .material import LawTable, Material, Uncoupled, check_not_negative, check_positive


@dataclass(frozen=True)
class _Extension(Material):
    """A `Material` that is another one, its first field, with parameters of its own, the other fields.

    These count for nothing in small, sudden strains.
    """

    @property
    def _base(self) -> Material:
        return cast("Material", getattr(self, fields(self)[0].name))

    @property
    def _own_names(self) -> tuple[str, ...]:
        return tuple(field.name for field in fields(self)[1:])

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """Those of the other material, then its own."""
        return *self._base.parameter_names, *self._own_names

    @property
    def parameters(self) -> tuple[float, ...]:
        return *self._base.parameters, *(getattr(self, name) for name in self._own_names)

    @property
    def instantaneous_modulus(self) -> float:
        """That of the other material, MPa: fibres bear nothing before they are stretched."""
        return self._base.instantaneous_modulus

    @property
    def instantaneous_modulus_gradient(self) -> tuple[float, ...]:
        return *self._base.instantaneous_modulus_gradient, *(0.0 for _ in self._own_names)

    def with_parameters(self, values: Mapping[str, float]) -> Self:
        changes: dict[str, Any] = {name: values[name] for name in self._own_names if name in values}
        of_base = {name: value for name, value in values.items() if name not in changes}
        changes[fields(self)[0].name] = self._base.with_parameters(of_base)
        return replace(self, **changes)


@dataclass(frozen=True)
class FibredMaterial(_Extension):
    """A `Material` with fibres; their direction is the problem's (`Problem.fibres`).

    ``ground``: the isotropic law; its relaxation holds for the fibres too. ``k1``: stiffness of the fibres,
    MPa: their uniaxial modulus at small stretch is ``4 k1``; 0: none. ``k2``: how fast they stiffen,
    dimensionless.
    """

    ground: Uncoupled
    k1: float
    k2: float

    def __post_init__(self) -> None:
        check_not_negative("k1", self.k1)
        check_positive("k2", self.k2)

    def table(self) -> LawTable:
        return replace(self.ground.table(), fibre=(self.k1, self.k2))

    def derivatives(self) -> tuple[LawTable, ...]:
        ground = self.ground.table()
        zero = LawTable(np.zeros_like(ground.numbers), 0.0, np.zeros_like(ground.prony))
        units = ((1.0, 0.0), (0.0, 1.0))
        return *self.ground.derivatives(), *(replace(zero, fibre=unit) for unit in units)


@dataclass(frozen=True)
class ContractileMaterial(_Extension):
    """A `Material` with fibres that contract; when and how much of it is the problem's `Problem.activation`.

    ``passive``: the tissue at rest; its fibres' ``k1`` may be 0. ``active``: true stress along the fibres of
    full activation, MPa, not negative.
    """

    passive: FibredMaterial
    active: float

    def __post_init__(self) -> None:
        check_not_negative("active", self.active)

    def table(self) -> LawTable:
        return replace(self.passive.table(), active=self.active)

    def derivatives(self) -> tuple[LawTable, ...]:
        passive = self.passive.derivatives()
        by_k2 = passive[-1]  # which holds nothing but fibres
        return *passive, replace(by_k2, fibre=(0.0, 0.0), active=1.0)
