"""Strain inside a limb in its socket: how far each tissue is sheared and compressed, and where most."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

from ..arrays import Array
from ..fe import State, System
from ..fe.kernel.laws import Laws
from ..fe.observables import compute_element_fields

Mask = NDArray[np.bool_]

SHEAR_LEVELS = (0.25, 0.5, 0.75)  # of which the sheared volume is told
RARE = 0.01  # of a tissue's volume: strained by more than the strain that is told beside the largest


@dataclass(frozen=True)
class Strains:
    """Strains of a state's cells (m,), from their volume-averaged principal stretches l1 >= l2 >= l3.

    Parameters
    ----------
    shear : largest shear, (l1^2 - l3^2) / 4: half the difference of principal Green-Lagrange strains.
    compression : of the most compressed direction, (1 - l3^2) / 2: its Green-Lagrange strain, positive.
    energy_kPa : long-term elastic energy over the volume at rest.
    volume_mm3 : at rest.
    """

    shear: Array
    compression: Array
    energy_kPa: Array
    volume_mm3: Array

    @classmethod
    def of(cls, system: System, laws: Laws, state: State) -> Self:
        """Of a state that kept its memory."""
        fields = compute_element_fields(system, laws, state)
        most, least = fields.stretches[:, 0] ** 2, fields.stretches[:, 2] ** 2
        volume = system.weights.sum(axis=1)
        return cls((most - least) / 4.0, (1.0 - least) / 2.0, 1e3 * fields.energy, volume)

    @property
    def fields(self) -> dict[str, Array]:
        """As cell data of a file, by name and unit."""
        return {
            "shear_strain": self.shear,
            "compressive_strain": self.compression,
            "energy_density_kPa": self.energy_kPa,
        }

    def within(self, cells: Mask) -> TissueStrain:
        """What is told of the chosen cells (m,)."""
        volume, shear, compression = self.volume_mm3[cells], self.shear[cells], self.compression[cells]
        return TissueStrain(
            volume_mm3=float(volume.sum()),
            shear=float(shear.max()),
            shear_rare=_compute_exceeded(shear, volume),
            compression=float(compression.max()),
            compression_rare=_compute_exceeded(compression, volume),
            energy_kPa=float(self.energy_kPa[cells].max()),
            sheared_mm3={f"{level:g}": float(volume[shear > level].sum()) for level in SHEAR_LEVELS},
            cell=int(np.flatnonzero(cells)[np.argmax(shear)]),
        )


@dataclass(frozen=True)
class TissueStrain:
    """Strain of a tissue: the largest of one cell, and ``_rare`` what 1 % of the volume exceeds.

    ``sheared_mm3``: volume at rest that is sheared by more than each of ``SHEAR_LEVELS``; ``cell``: that of
    the largest shear. The largest values grow as cells get smaller.
    """

    volume_mm3: float
    shear: float
    shear_rare: float
    compression: float
    compression_rare: float
    energy_kPa: float
    sheared_mm3: Mapping[str, float]
    cell: int


def _compute_exceeded(values: Array, volume: Array) -> float:
    """The value that ``RARE`` of the volume exceeds."""
    order = np.argsort(values)[::-1]
    above = np.cumsum(volume[order])
    return float(values[order][np.searchsorted(above, RARE * above[-1])])
