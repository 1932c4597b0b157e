"""Tissue laws by name: what a study may ask for, and what is known of their parameters beforehand.

A law of one's own is registered by `register_law`; see docs/extending.md.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .errors import InputError
from .extensions import Registry

Array = NDArray[np.float64]
Parameters = dict[str, dict[str, float]]  # by tissue and key

KPA = 1e-3  # MPa
UNITS = {"kPa": KPA, "s": 1.0}  # of parameters, in the solver's
OGDEN = "ogden"  # the law of a study that names none


@dataclass(frozen=True)
class Parameter:
    """A parameter of a law, as a study knows it.

    Parameters
    ----------
    name : that of the material's parameter.
    unit : ``kPa``, ``s`` or none; the study's key is ``name_unit``.
    start, lower, upper : where the identification starts, and its bounds; all positive, in ``unit``.
    words : what reports call it; its symbol is its name.
    """

    name: str
    start: float
    lower: float
    upper: float
    unit: str = ""
    words: str = ""

    @property
    def key(self) -> str:
        """Its name in studies and results: with its unit."""
        return f"{self.name}_{self.unit}" if self.unit else self.name

    @property
    def scale(self) -> float:
        """What a value is multiplied by to be in the solver's unit (MPa, s)."""
        return UNITS.get(self.unit, 1.0)


@dataclass(frozen=True)
class TissueLaw:
    """A law that a study can name.

    Parameters
    ----------
    name : what the study says in ``material.law``.
    words : what it is called in prose.
    energy : its strain energy and relaxation, as the report's methods write it.
    parameters : in the order of every flat vector.
    material : the class that the solver takes (`fe.Material`); its fields are the parameters' names and
        ``kappa_ratio``, the bulk modulus over the long-term shear modulus.  None: limbfit's own, `OgdenQLV`.
    """

    name: str
    words: str
    energy: str
    parameters: tuple[Parameter, ...]
    material: Any = None

    @property
    def keys(self) -> tuple[str, ...]:
        """The parameters' names in studies and results."""
        return tuple(parameter.key for parameter in self.parameters)

    @property
    def moduli(self) -> tuple[str, ...]:
        """The keys of those that are moduli: stress is proportional to all of them together."""
        return tuple(parameter.key for parameter in self.parameters if parameter.unit == "kPa")

    def in_solver_units(self, values: Mapping[str, float]) -> dict[str, float]:
        """``values`` by key as what the material takes, in MPa and s."""
        return {p.name: values[p.key] * p.scale for p in self.parameters}

    def record(self) -> dict[str, Any]:
        """As it is stored beside results."""
        return {
            "name": self.name,
            "words": self.words,
            "energy": self.energy,
            "parameters": [asdict(parameter) for parameter in self.parameters],
        }

    @classmethod
    def of_record(cls, record: Mapping[str, Any]) -> TissueLaw:
        """What `record` said, without the material; results older than that are of Ogden's law."""
        if not record:
            return LAWS[OGDEN]
        parameters = tuple(Parameter(**one) for one in record["parameters"])
        return cls(record["name"], record["words"], record["energy"], parameters)


# Start and bounds are the paper's (section 2.3, table 1).
LAWS = Registry(
    "tissue law",
    {
        OGDEN: TissueLaw(
            OGDEN,
            "second-order Ogden",
            "the strain energy Ψ = c/m² Σ(λ̃ᵢᵐ + λ̃ᵢ⁻ᵐ − 2) + κ/2 (ln J)² with quasi-linear viscoelasticity, "
            "G(t) = 1 + γ exp(−t/τ) acting on the deviatoric stress",
            (
                Parameter("c", 4.7, 0.047, 47.0, "kPa", "long-term shear modulus"),
                Parameter("m", 3.0, 2.0, 20.0, "", "strain-stiffening exponent"),
                Parameter("gamma", 1.2, 0.01, 10.0, "", "relaxation amplitude"),
                Parameter("tau", 2.0, 0.01, 10.0, "s", "relaxation time"),
            ),
        )
    },
)


def register_law(law: TissueLaw) -> None:
    """Make a law known by its name, in the file that a study names in ``study.extensions``.

    Raises
    ------
    InputError
        Where the name is taken, or a start is not within its bounds.
    """
    if not law.moduli:
        raise InputError("has no modulus", place=law.name, remedy='give a parameter the unit "kPa"')
    for p in law.parameters:
        if p.unit and p.unit not in UNITS:
            raise InputError(
                f"parameter {p.name} is in {p.unit}", place=law.name, remedy="use kPa, s or none"
            )
        if not 0.0 < p.lower <= p.start <= p.upper or p.lower == p.upper:
            raise InputError(
                f"parameter {p.name} needs 0 < lower <= start <= upper, lower < upper",
                place=law.name,
            )
    LAWS.add(law.name, law)


def split_key(key: str) -> tuple[str, str]:
    """A parameter's name and its unit (or none) from its key: ``tau_s`` is tau, s."""
    name, _, unit = key.rpartition("_")
    return (name, unit) if unit in UNITS else (key, "")


def flat_names(tissues: Sequence[str], law: str = OGDEN) -> tuple[tuple[str, str], ...]:
    """(tissue, parameter) in the order of every flat vector: all of one tissue, then of the next one."""
    return tuple((tissue, name) for tissue in tissues for name in LAWS[law].keys)


def to_vector(parameters: Parameters, tissues: Sequence[str], law: str = OGDEN) -> Array:
    """The numbers of each tissue in flat order (moduli in kPa)."""
    return np.array([parameters[tissue][name] for tissue, name in flat_names(tissues, law)])


def to_parameters(vector: Iterable[float], tissues: Sequence[str], law: str = OGDEN) -> Parameters:
    """The flat vector as ``{tissue: {name: value}}``, tissues in their order."""
    result: Parameters = {tissue: {} for tissue in tissues}
    for (tissue, name), value in zip(flat_names(tissues, law), vector, strict=True):
        result[tissue][name] = float(value)
    return result
