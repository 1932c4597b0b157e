"""A tissue whose fibres pull by themselves: a stated active stress beside what the tissue bears passively.

Its Kirchhoff stress is ``s(t) T (m m - 1/3)`` with the fibre's present direction ``m``, the stress ``T`` of
full activation and the share ``s(t)`` of it that acts (`Problem.activation`).  Its potential is
``s T ln(I)/2`` of the fibre's isochoric squared stretch ``I``: it does not depend on the stretch and does not
relax, but is what is stated.  A stress along the fibres beside the passive one is the usual form (Blemker,
Pinsky and Delp 2005, J. Biomech. 38, 657); how it depends on length and speed is left to ``s``.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Self

from .fibred import Fibred
from .material import LawTable, check_not_negative


@dataclass(frozen=True)
class Contractile:
    """A `Material` with fibres that contract; when and how much of it is the problem's `Problem.activation`.

    Parameters
    ----------
    passive : the tissue at rest; its fibres' ``k1`` may be 0.
    active : true stress along the fibres of full activation, MPa, not negative.
    """

    passive: Fibred
    active: float

    def __post_init__(self) -> None:
        check_not_negative("active", self.active)

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """Those of the passive tissue, active."""
        return *self.passive.parameter_names, "active"

    @property
    def parameters(self) -> tuple[float, ...]:
        """Their values."""
        return *self.passive.parameters, self.active

    @property
    def instantaneous_modulus(self) -> float:
        """That of the passive tissue, MPa."""
        return self.passive.instantaneous_modulus

    @property
    def instantaneous_modulus_gradient(self) -> tuple[float, ...]:
        """Its derivative with respect to each parameter."""
        return *self.passive.instantaneous_modulus_gradient, 0.0

    def table(self) -> LawTable:
        """The material as the kernels read it."""
        return replace(self.passive.table(), active=self.active)

    def derivatives(self) -> tuple[LawTable, ...]:
        """Derivative of the table with respect to each parameter."""
        passive = self.passive.derivatives()
        still = passive[-1]  # that of k2: nothing but of fibres
        return *passive, replace(still, fibre=(0.0, 0.0), active=1.0)

    def with_parameters(self, values: Mapping[str, float]) -> Self:
        """The material with other values of some of its parameters, by name."""
        passive = {name: value for name, value in values.items() if name != "active"}
        return replace(
            self,
            passive=self.passive.with_parameters(passive),
            active=values.get("active", self.active),
        )
