"""Tissue laws by name: what a study may ask for, and what is known of their parameters beforehand.

Your own law is registered by `register_law`; see docs/extending.md.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from .arrays import Array
from .errors import InputError
from .extensions import Registry

Parameters = dict[str, dict[str, float]]  # by tissue and key

KPA = 1e-3  # MPa
UNITS = {"kPa": KPA, "s": 1.0}  # of parameters, in the solver's
OGDEN, OGDEN_WORDS = "ogden", "second-order Ogden"  # the law of a study that names none
FIBRED = "ogden-fibres"  # the law whose tissues may have fibres
ACTIVE = "ogden-active"  # the law whose fibres may pull by themselves
POWER = "ogden-power"  # the law that relaxes as a power of time
FUNG = "fung"  # the law that stiffens exponentially
MAX_RELAXATION_TERMS = 6  # terms, as FEBio


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
        ``kappa_ratio``, the bulk modulus over the long-term shear modulus.  None: limbfit's own, `OgdenQLV`,
        with as many relaxation terms as there are pairs of parameters after the first two, fibres where
        there are k1 and k2, and their contraction where there is active; `OgdenPower` where there is slope,
        `FungQLV` where there is b.
    relaxation_times_s : those of relaxation as a power of time, which are the study's.
    """

    name: str
    words: str
    energy: str
    parameters: tuple[Parameter, ...]
    material: Any = None
    relaxation_times_s: tuple[float, ...] = ()

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
        return {key: value for key, value in asdict(self).items() if key != "material" and value != ()}

    @classmethod
    def of_record(cls, record: Mapping[str, Any]) -> TissueLaw:
        """What `record` said, without the material; results older than that are of Ogden's law."""
        if not record:
            return LAWS[OGDEN]
        parameters = tuple(Parameter(**one) for one in record["parameters"])
        times = tuple(record.get("relaxation_times_s", ()))
        return cls(record["name"], record["words"], record["energy"], parameters, relaxation_times_s=times)


# Start and bounds are the paper's (section 2.3, table 1).
_MODULUS = Parameter("c", 4.7, 0.047, 47.0, "kPa", "long-term shear modulus")
_EXPONENT = Parameter("m", 3.0, 2.0, 20.0, "", "strain-stiffening exponent")
_AMPLITUDE = Parameter("gamma", 1.2, 0.01, 10.0, "", "relaxation amplitude")
_TIME = Parameter("tau", 2.0, 0.01, 10.0, "s", "relaxation time")


def _describe_energy(series: str) -> str:
    """The energy of the paper's law with so written a relaxation."""
    return (
        "the strain energy Ψ = c/m² Σ(λ̃ᵢᵐ + λ̃ᵢ⁻ᵐ − 2) + κ/2 (ln J)² with quasi-linear viscoelasticity, "
        f"G(t) = 1 + {series} acting on the deviatoric stress"
    )


_PLAIN = TissueLaw(
    OGDEN, OGDEN_WORDS, _describe_energy("γ exp(−t/τ)"), (_MODULUS, _EXPONENT, _AMPLITUDE, _TIME)
)


def _build_ogden(terms: int) -> TissueLaw:
    """The paper's law with several relaxation terms.

    They share out the bounds of the one time in equal ratios, so that none can change places with another,
    and the start of the one amplitude.
    """
    ratio = (_TIME.upper / _TIME.lower) ** (1.0 / terms)
    relaxation: list[Parameter] = []
    for k in range(terms):
        lower, start, upper = (float(f"{_TIME.lower * ratio**x:.3g}") for x in (k, k + 0.5, k + 1))
        relaxation.append(replace(_AMPLITUDE, name=f"gamma{k + 1}", start=round(_AMPLITUDE.start / terms, 2)))
        relaxation.append(replace(_TIME, name=f"tau{k + 1}", start=start, lower=lower, upper=upper))
    name, words = f"{OGDEN}-prony{terms}", f"{OGDEN_WORDS} with {terms} relaxation terms"
    energy = _describe_energy("Σ γᵢ exp(−t/τᵢ)")
    return TissueLaw(name, words, energy, (_MODULUS, _EXPONENT, *relaxation))


# The thigh muscle of seven people has a slope of 0.25 at 25 to 62.5 Hz (Klatt et al. 2010, Phys. Med. Biol.
# 55:6445), what relaxes with the logarithm of time one of 0 (Fung 1993, Biomechanics, chapter 7). The upper
# bound is twice the first. G falls from 2.5 at the start of both, with the paper's single term from 2.2.
_POWER = TissueLaw(
    POWER,
    f"{OGDEN_WORDS} with relaxation as a power of time",
    _describe_energy("γ Σ (τᵢ/1 s)^(−slope) exp(−t/τᵢ)"),
    (
        _MODULUS,
        _EXPONENT,
        replace(_AMPLITUDE, start=0.3),
        Parameter("slope", 0.2, 0.01, 0.5, "", "slope of relaxation"),
    ),
)
# Forces of a deep indentation grow by some 40 % from b = 0 to 1; under 0.02 the law is neo-Hookean.
_STIFFENING = Parameter("b", 1.0, 0.02, 20.0, "", "exponential stiffening")
_FUNG = TissueLaw(
    FUNG,
    "exponential law of Fung",
    "the strain energy Ψ = c/(2b) (exp(b (Ĩ₁ − 3)) − 1) + κ/2 (ln J)² with quasi-linear viscoelasticity, "
    "G(t) = 1 + γ exp(−t/τ) acting on the deviatoric stress",
    (_MODULUS, _STIFFENING, _AMPLITUDE, _TIME),
)
# Bounds are wide, for nobody has identified fibres so: passive muscle is near its ground along them or some
# ten times as stiff; the fibres' modulus of small stretch is 4 k1.
_FIBRES = (
    Parameter("k1", 5.0, 0.05, 500.0, "kPa", "stiffness of the fibres"),
    Parameter("k2", 1.0, 0.01, 100.0, "", "stiffening of the fibres"),
)
_FIBRED = TissueLaw(
    FIBRED,
    f"{OGDEN_WORDS} with fibres",
    f"{_PLAIN.energy}; where fibres are stretched (I₄ > 1), "
    "k₁/(2 k₂) (exp(k₂ (I₄ − 1)²) − 1) is added to Ψ, I₄ the isochoric squared stretch along them",
    (*_PLAIN.parameters, *_FIBRES),
)
# Living muscle tenses up to some 300 kPa; a limb that is indented is held as loose as can be.
_TENSION = Parameter("active", 5.0, 0.05, 200.0, "kPa", "active stress along the fibres")
_ACTIVE = TissueLaw(
    ACTIVE,
    f"{_FIBRED.words} that contract",
    f"{_FIBRED.energy}; along them acts the active stress times the share s(t) of its activation",
    (*_FIBRED.parameters, _TENSION),
)

FIBRE_KEYS = tuple(parameter.key for parameter in (*_FIBRES, _TENSION))
_OGDEN_LAWS = {law.name: law for law in (_PLAIN, *map(_build_ogden, range(2, MAX_RELAXATION_TERMS + 1)))}
LAWS = Registry("tissue law", _OGDEN_LAWS | {law.name: law for law in (_POWER, _FUNG, _FIBRED, _ACTIVE)})


def is_ogden(name: str) -> bool:
    """Whether a law is the paper's, with however many relaxation terms."""
    return name in _OGDEN_LAWS


def has_fibres(name: str) -> bool:
    """Whether tissues of a law may have fibres."""
    return name in (FIBRED, ACTIVE)


def register_law(law: TissueLaw) -> None:
    """Make a law known by its name, in the file that a study names in ``study.extensions``.

    Raises `InputError` where the name is taken, or a start is not within its bounds.
    """
    if not law.moduli:
        raise InputError("has no modulus", place=law.name, remedy='give a parameter the unit "kPa"')
    for p in law.parameters:
        if p.unit and p.unit not in UNITS:
            what = f"parameter {p.name} is in {p.unit}"
            raise InputError(what, place=law.name, remedy="use kPa, s or none")
        if not 0.0 < p.lower <= p.start <= p.upper or p.lower == p.upper:
            what = f"parameter {p.name} needs 0 < lower <= start <= upper, lower < upper"
            raise InputError(what, place=law.name)
    LAWS.add(law.name, law)


def split_key(key: str) -> tuple[str, str]:
    """A parameter's name and its unit (or none) from its key: ``tau_s`` is tau, s."""
    name, _, unit = key.rpartition("_")
    return (name, unit) if unit in UNITS else (key, "")


def list_flat_names(tissues: Sequence[str], law: str = OGDEN) -> tuple[tuple[str, str], ...]:
    """(tissue, parameter) in the order of every flat vector: all of one tissue, then of the next one."""
    return tuple((tissue, name) for tissue in tissues for name in LAWS[law].keys)


def to_vector(parameters: Parameters, tissues: Sequence[str], law: str = OGDEN) -> Array:
    """The numbers of each tissue in flat order (moduli in kPa)."""
    return np.array([parameters[tissue][name] for tissue, name in list_flat_names(tissues, law)])


def to_parameters(vector: Iterable[float], tissues: Sequence[str], law: str = OGDEN) -> Parameters:
    """The flat vector as ``{tissue: {name: value}}``, tissues in their order."""
    result: Parameters = {tissue: {} for tissue in tissues}
    for (tissue, name), value in zip(list_flat_names(tissues, law), vector, strict=True):
        result[tissue][name] = float(value)
    return result
