"""The material laws, each with its parameters; their moduli follow FEBio's conventions.

==================  ===================================================================================
`OgdenQLV`          ``c/m^2 sum_i (lt_i^m + lt_i^-m - 2)``: the paper's tissue
`OgdenPower`        the same, relaxing as a power of time
`Ogden`             ``sum_k c_k/m_k^2 (lt_1^m_k + lt_2^m_k + lt_3^m_k - 3)``, up to six terms
`NeoHookean`        ``mu/2 (I1 - 3)``
`MooneyRivlin`      ``c1 (I1 - 3) + c2 (I2 - 3)``
`FungQLV`           ``c/(2 b) (exp(b (I1 - 3)) - 1)``
==================  ===================================================================================

``I1, I2`` are the invariants of the isochoric stretches: ``I1 = sum lt_i^2``, ``I2 = sum lt_i^-2``.
Sources: FEBio user manual, uncoupled materials; Fung's exponential law: Demiray, H. (1972). A note on the
elasticity of soft biological tissues. J. Biomech. 5, 309.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Self, cast

import numpy as np

from ...errors import ProblemError
from ...relaxation import DEFAULT_SPAN_S, choose_relaxation_times, compute_power_law_terms
from ..lanes import LANES, exponential
from .elastic import VOLUMETRIC_LAWS, ElasticLaw, lane_function, mean_exponential
from .material import Array, PronyTerms, Uncoupled, check_finite, check_not_negative, check_positive

MAX_OGDEN_TERMS = 6  # as FEBio


class OgdenSum(Uncoupled):
    """A sum of Ogden terms, moduli c_k (MPa) and exponents m_k, that are linear in its elastic parameters.

    ``fixed_terms (k, 2)`` are the terms where the parameters are zero, ``term_slopes (p, k, 2)`` their
    derivatives.
    """

    elastic_names: ClassVar[tuple[str, ...]]
    fixed_terms: ClassVar[Array]
    term_slopes: ClassVar[Array]

    def __post_init__(self) -> None:
        object.__setattr__(self, "prony", _to_pairs("the Prony terms", self.prony))
        for name, value in zip(self.parameter_names, self.elastic_parameters):
            check_finite(name, value)
        check_positive("kappa_ratio", self.kappa_ratio)
        if self.volumetric not in VOLUMETRIC_LAWS:
            known = ", ".join(VOLUMETRIC_LAWS)
            raise ProblemError(f"unknown volumetric law {self.volumetric!r}", remedy=f"use one of {known}")
        for l, (g, tau) in enumerate(self.prony, 1):
            check_not_negative(f"g{l}", g)
            check_positive(f"tau{l}", tau)
        if not self.shear_modulus > 0:
            what = f"the shear modulus of small strains is {self.shear_modulus:.4g} MPa, not positive"
            raise ProblemError(what, remedy="check the signs of the moduli")

    @property
    def parameter_names(self) -> tuple[str, ...]:
        return *self.elastic_names, *_number_names(("g", "tau"), len(self.prony))

    @property
    def elastic_parameters(self) -> tuple[float, ...]:
        return tuple(getattr(self, name) for name in self.elastic_names)

    def numbers(self) -> Array:
        """c_1, m_1, c_2, ..."""
        return (self.fixed_terms + np.tensordot(self.elastic_parameters, self.term_slopes, 1)).ravel()

    def number_derivatives(self) -> Array:
        return self.term_slopes.reshape(len(self.term_slopes), -1)

    @property
    def shear_modulus(self) -> float:
        """``sum c_k / 2``, MPa."""
        return float(self.numbers()[::2].sum() / 2.0)

    @property
    def shear_modulus_gradient(self) -> Array:
        return np.asarray(self.term_slopes[:, :, 0].sum(axis=1) / 2.0)

    def with_parameters(self, values: Mapping[str, float]) -> Self:
        """That of `Material`. Raises `ProblemError` for a name that it does not have."""
        if unknown := sorted(set(values) - set(self.parameter_names)):
            known = ", ".join(self.parameter_names)
            raise ProblemError(f"the material has no parameter {unknown[0]!r}", remedy=f"use one of {known}")
        named = dict(zip(self.parameter_names, self.parameters, strict=True)) | dict(values)
        every = tuple(map(float, named.values()))
        elastic = len(self.elastic_parameters)
        prony = tuple(zip(every[elastic::2], every[elastic + 1 :: 2], strict=True))
        return cast("Self", replace(cast("Any", self), **self._fields(every[:elastic], prony)))

    def _fields(self, elastic: tuple[float, ...], prony: PronyTerms) -> dict[str, Any]:
        """The fields of the class that hold these parameters."""
        return {**dict(zip(self.elastic_names, elastic, strict=True)), "prony": prony}


class SymmetricOgden(OgdenSum):
    """The elastic law of the paper's tissue, with a modulus ``c`` (MPa) and an exponent ``m``."""

    volumetric = "log"
    elastic_names = ("c", "m")
    fixed_terms = np.zeros((2, 2))
    term_slopes = np.array([[[1.0, 0.0], [1.0, 0.0]], [[0.0, 1.0], [0.0, -1.0]]])


@dataclass(frozen=True)
class OgdenQLV(SymmetricOgden):
    """The paper's tissue: symmetric second-order Ogden with relaxation.

    ``W = c/m^2 sum_i (lt_i^m + lt_i^-m - 2) + kappa/2 (ln J)^2``, ``G(t) = 1 + gamma exp(-t/tau)``, or with
    several terms ``1 + sum_l gamma_l exp(-t/tau_l)``. The parameters are ``c, m, gamma, tau``, or
    ``c, m, gamma1, tau1, gamma2, ...``.

    Parameters
    ----------
    c : long-term shear modulus of small strains, MPa.
    m : exponent.
    gamma : relaxation amplitude, dimensionless (0: elastic); one for each term where there are several.
    tau : relaxation time, s; as many.
    kappa_ratio : bulk modulus over ``c``; the bulk modulus moves with ``c``.
    """

    c: float
    m: float
    gamma: float | Sequence[float]
    tau: float | Sequence[float]
    kappa_ratio: float = 100.0

    def __post_init__(self) -> None:
        for name in ("gamma", "tau"):
            object.__setattr__(self, name, _to_one_or_several(name, getattr(self, name)))
        if np.shape(self.gamma) != np.shape(self.tau):
            what = f"{np.size(self.gamma)} gamma and {np.size(self.tau)} tau"
            raise ProblemError(what, remedy="give as many of each")
        for name in ("c", "m", "kappa_ratio"):
            check_positive(name, getattr(self, name))
        for name, value in zip(self.parameter_names[2:], self.parameters[2:], strict=True):
            (check_not_negative if name.startswith("gamma") else check_positive)(name, value)

    @property
    def parameter_names(self) -> tuple[str, ...]:
        if np.ndim(self.gamma) == 0:
            return "c", "m", "gamma", "tau"
        return "c", "m", *_number_names(("gamma", "tau"), np.size(self.gamma))

    @property
    def prony(self) -> PronyTerms:
        gamma, tau = np.atleast_1d(self.gamma), np.atleast_1d(self.tau)
        return tuple(zip(gamma.tolist(), tau.tolist(), strict=True))

    def _fields(self, elastic: tuple[float, ...], prony: PronyTerms) -> dict[str, Any]:
        gamma, tau = zip(*prony, strict=True)
        return {"c": elastic[0], "m": elastic[1], "gamma": gamma, "tau": tau}


@dataclass(frozen=True)
class OgdenPower(SymmetricOgden):
    """The paper's tissue with relaxation as a power of time (`limbfit.relaxation`).

    ``G(t) = 1 + sum_i gamma (tau_i / 1 s)^(-slope) exp(-t/tau_i)`` with fixed times. The parameters are
    ``c, m, gamma, slope``.

    Parameters
    ----------
    c : shear modulus of small strains after the last of the times, MPa.
    m : exponent.
    gamma : relaxation amplitude of a time of 1 s, dimensionless; it belongs to the spacing of the times.
    slope : minus the power of time, dimensionless; 0: the logarithm of time.
    times_s : relaxation times, s.
    kappa_ratio : bulk modulus over ``c``; the bulk modulus moves with ``c``.
    """

    c: float
    m: float
    gamma: float
    slope: float
    times_s: Sequence[float] = tuple(choose_relaxation_times(*DEFAULT_SPAN_S).tolist())
    kappa_ratio: float = 100.0

    def __post_init__(self) -> None:
        for name in ("c", "m", "kappa_ratio"):
            check_positive(name, getattr(self, name))
        check_not_negative("gamma", self.gamma)
        check_not_negative("slope", self.slope)
        times = np.atleast_1d(_to_one_or_several("times_s", self.times_s)).tolist()
        for l, time in enumerate(times, 1):
            check_positive(f"tau{l}", time)
        object.__setattr__(self, "times_s", tuple(times))

    @property
    def parameter_names(self) -> tuple[str, ...]:
        return "c", "m", "gamma", "slope"

    @property
    def relaxation_parameters(self) -> tuple[float, ...]:
        return self.gamma, self.slope

    @property
    def prony(self) -> PronyTerms:
        terms = compute_power_law_terms(self.gamma, self.slope, np.array(self.times_s))
        return tuple(zip(terms.tolist(), self.times_s, strict=True))

    def prony_derivatives(self) -> Array:
        times = np.array(self.times_s)
        unit = compute_power_law_terms(1.0, self.slope, times)
        amplitudes = np.array([unit, -self.gamma * unit * np.log(times)])
        return np.stack([amplitudes, np.zeros_like(amplitudes)], axis=-1)

    def with_parameters(self, values: Mapping[str, float]) -> Self:
        return Uncoupled.with_parameters(self, values)


@dataclass(frozen=True)
class Ogden(OgdenSum):
    """Ogden's law: ``W = sum_k c_k/m_k^2 (lt_1^m_k + lt_2^m_k + lt_3^m_k - 3) + U(J)``.

    Raises `ProblemError` where no material has such parameters.

    Parameters
    ----------
    terms : one to six (c_k, m_k): modulus in MPa, exponent.  Single moduli may be negative, their sum, twice
        the shear modulus of small strains, may not.
    prony : (g_l, tau_l): amplitude, relaxation time in s; any number.
    kappa_ratio : bulk modulus over the long-term shear modulus ``sum c_k / 2``.
    volumetric : name in `VOLUMETRIC_LAWS`.
    """

    terms: PronyTerms
    prony: PronyTerms = ()
    kappa_ratio: float = 100.0
    volumetric: str = "log"

    def __post_init__(self) -> None:
        object.__setattr__(self, "terms", _to_pairs("the terms", self.terms))
        if not 1 <= len(self.terms) <= MAX_OGDEN_TERMS:
            raise ProblemError(f"an Ogden material has 1 to {MAX_OGDEN_TERMS} terms, not {len(self.terms)}")
        super().__post_init__()
        for k, (_, m) in enumerate(self.terms, 1):
            if m == 0.0:
                raise ProblemError(f"material parameter m{k} is zero")

    @property
    def elastic_names(self) -> tuple[str, ...]:  # type: ignore[override]
        return _number_names(("c", "m"), len(self.terms))

    @property
    def elastic_parameters(self) -> tuple[float, ...]:
        return tuple(value for term in self.terms for value in term)

    @property
    def fixed_terms(self) -> Array:  # type: ignore[override]
        return np.zeros((len(self.terms), 2))

    @property
    def term_slopes(self) -> Array:  # type: ignore[override]
        count = 2 * len(self.terms)
        return np.eye(count).reshape(count, -1, 2)

    def _fields(self, elastic: tuple[float, ...], prony: PronyTerms) -> dict[str, Any]:
        return {"terms": tuple(zip(elastic[::2], elastic[1::2], strict=True)), "prony": prony}


@dataclass(frozen=True)
class NeoHookean(OgdenSum):
    """The uncoupled neo-Hookean law: ``W = mu/2 (I1 - 3) + U(J)``.

    Parameters
    ----------
    mu : long-term shear modulus, MPa.
    prony, kappa_ratio, volumetric : as `Ogden`.
    """

    mu: float
    prony: PronyTerms = ()
    kappa_ratio: float = 100.0
    volumetric: str = "log"

    elastic_names: ClassVar = ("mu",)
    fixed_terms: ClassVar = np.array([[0.0, 2.0]])
    term_slopes: ClassVar = np.array([[[2.0, 0.0]]])

    def __post_init__(self) -> None:
        check_positive("mu", self.mu)
        super().__post_init__()


@dataclass(frozen=True)
class MooneyRivlin(OgdenSum):
    """The Mooney-Rivlin law: ``W = c1 (I1 - 3) + c2 (I2 - 3) + U(J)``.

    Parameters
    ----------
    c1, c2 : moduli, MPa; the shear modulus of small strains, ``2 (c1 + c2)``, is positive.
    prony, kappa_ratio, volumetric : as `Ogden`.
    """

    c1: float
    c2: float
    prony: PronyTerms = ()
    kappa_ratio: float = 100.0
    volumetric: str = "log"

    elastic_names: ClassVar = ("c1", "c2")
    fixed_terms: ClassVar = np.array([[0.0, 2.0], [0.0, -2.0]])
    term_slopes: ClassVar = np.array([[[4.0, 0.0], [0.0, 0.0]], [[0.0, 0.0], [4.0, 0.0]]])


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


def _to_one_or_several(name: str, values: float | Sequence[float]) -> float | tuple[float, ...]:
    """A number, or several as a tuple."""
    try:
        found = np.asarray(values, dtype=float)
    except (TypeError, ValueError):
        found = np.zeros(0)
    if found.ndim > 1 or not found.size:
        raise ProblemError(f"material parameter {name} = {values} is no number, nor several")
    return float(found.reshape(-1)[0]) if found.size == 1 else tuple(found.tolist())


def _number_names(names: tuple[str, ...], count: int) -> tuple[str, ...]:
    return tuple(f"{name}{k}" for k in range(1, count + 1) for name in names)


def _to_pairs(name: str, values: Sequence[Sequence[float]]) -> tuple[tuple[float, float], ...]:
    """``values`` as a tuple of pairs of numbers."""
    try:
        return tuple((float(a), float(b)) for a, b in values)
    except (TypeError, ValueError):
        raise ProblemError(f"{name} of a material are not pairs of numbers") from None
