"""The material laws, each with its parameters; their moduli follow FEBio's conventions.

==================  ===================================================================================
`OgdenQLV`          ``c/m^2 sum_i (lt_i^m + lt_i^-m - 2)``: the paper's tissue
`OgdenPower`        the same, relaxing as a power of time
`Ogden`             ``sum_k c_k/m_k^2 (lt_1^m_k + lt_2^m_k + lt_3^m_k - 3)``, up to six terms
`NeoHookean`        ``mu/2 (I1 - 3)``
`MooneyRivlin`      ``c1 (I1 - 3) + c2 (I2 - 3)``
==================  ===================================================================================

``I1, I2`` are the invariants of the isochoric stretches: ``I1 = sum lt_i^2``, ``I2 = sum lt_i^-2``.
Source: FEBio user manual, uncoupled materials.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Self, cast

import numpy as np

from ...errors import ProblemError
from ...relaxation import DEFAULT_SPAN_S, choose_relaxation_times, compute_power_law_terms
from .material import Array, PronyTerms, Uncoupled, check_finite, check_not_negative, check_positive, to_pairs

MAX_OGDEN_TERMS = 6  # as FEBio


class OgdenSum(Uncoupled):
    """A law that says which Ogden terms it is made of."""

    @abstractmethod
    def ogden_terms(self) -> Array:
        """Moduli c_k (MPa) and exponents m_k (k, 2)."""

    @abstractmethod
    def ogden_term_derivatives(self) -> Array:
        """Derivative (p, k, 2) of `ogden_terms` with respect to each elastic parameter."""

    def numbers(self) -> Array:
        """c_1, m_1, c_2, ..."""
        return self.ogden_terms().ravel()

    def number_derivatives(self) -> Array:
        slopes = self.ogden_term_derivatives()
        return slopes.reshape(len(slopes), -1)

    @property
    def shear_modulus(self) -> float:
        """``sum c_k / 2``, MPa."""
        return float(self.ogden_terms()[:, 0].sum() / 2.0)

    @property
    def shear_modulus_gradient(self) -> Array:
        return np.asarray(self.ogden_term_derivatives()[:, :, 0].sum(axis=1) / 2.0)

    def with_parameters(self, values: Mapping[str, float]) -> Self:
        named = dict(zip(self.parameter_names, self.parameters, strict=True)) | dict(values)
        every = tuple(map(float, named.values()))
        elastic = len(self.elastic_parameters)
        prony = tuple(zip(every[elastic::2], every[elastic + 1 :: 2], strict=True))
        return cast("Self", replace(cast("Any", self), **self._fields(every[:elastic], prony)))

    def _fields(self, elastic: tuple[float, ...], prony: PronyTerms) -> dict[str, Any]:
        """The fields of the class that hold these parameters."""
        return {**dict(zip(self.parameter_names, elastic, strict=False)), "prony": prony}


class SymmetricOgden(OgdenSum):
    """The elastic law of the paper's tissue, with a modulus ``c`` (MPa) and an exponent ``m``."""

    c: float
    m: float
    volumetric = "log"

    @property
    def elastic_parameters(self) -> tuple[float, ...]:
        return self.c, self.m

    def ogden_terms(self) -> Array:
        return np.array([[self.c, self.m], [self.c, -self.m]])

    def ogden_term_derivatives(self) -> Array:
        return np.array([[[1.0, 0.0], [1.0, 0.0]], [[0.0, 1.0], [0.0, -1.0]]])


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
            raise ProblemError(
                f"{np.size(self.gamma)} gamma and {np.size(self.tau)} tau", remedy="give as many of each"
            )
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

    Parameters
    ----------
    terms : one to six (c_k, m_k): modulus in MPa, exponent.  Single moduli may be negative, their sum, twice
        the shear modulus of small strains, may not.
    prony : (g_l, tau_l): amplitude, relaxation time in s; any number.
    kappa_ratio : bulk modulus over the long-term shear modulus ``sum c_k / 2``.
    volumetric : name in `VOLUMETRIC_LAWS`.

    Raises
    ------
    ProblemError
        Where no material has such parameters.
    """

    terms: PronyTerms
    prony: PronyTerms = ()
    kappa_ratio: float = 100.0
    volumetric: str = "log"

    def __post_init__(self) -> None:
        object.__setattr__(self, "terms", to_pairs("the terms", self.terms))
        object.__setattr__(self, "prony", to_pairs("the Prony terms", self.prony))
        if not 1 <= len(self.terms) <= MAX_OGDEN_TERMS:
            raise ProblemError(f"an Ogden material has 1 to {MAX_OGDEN_TERMS} terms, not {len(self.terms)}")
        for k, (c, m) in enumerate(self.terms, 1):
            check_finite(f"c{k}", c)
            check_finite(f"m{k}", m)
            if m == 0.0:
                raise ProblemError(f"material parameter m{k} is zero")
        self._check_shared()

    @property
    def parameter_names(self) -> tuple[str, ...]:
        return *_number_names(("c", "m"), len(self.terms)), *_list_prony_names(self)

    @property
    def elastic_parameters(self) -> tuple[float, ...]:
        return tuple(value for term in self.terms for value in term)

    def ogden_terms(self) -> Array:
        return np.array(self.terms, dtype=float)

    def ogden_term_derivatives(self) -> Array:
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

    def __post_init__(self) -> None:
        object.__setattr__(self, "prony", to_pairs("the Prony terms", self.prony))
        check_positive("mu", self.mu)
        self._check_shared()

    @property
    def parameter_names(self) -> tuple[str, ...]:
        return "mu", *_list_prony_names(self)

    @property
    def elastic_parameters(self) -> tuple[float, ...]:
        return (self.mu,)

    def ogden_terms(self) -> Array:
        return np.array([[2.0 * self.mu, 2.0]])

    def ogden_term_derivatives(self) -> Array:
        return np.array([[[2.0, 0.0]]])


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

    def __post_init__(self) -> None:
        object.__setattr__(self, "prony", to_pairs("the Prony terms", self.prony))
        check_finite("c1", self.c1)
        check_finite("c2", self.c2)
        self._check_shared()

    @property
    def parameter_names(self) -> tuple[str, ...]:
        return "c1", "c2", *_list_prony_names(self)

    @property
    def elastic_parameters(self) -> tuple[float, ...]:
        return self.c1, self.c2

    def ogden_terms(self) -> Array:
        return np.array([[4.0 * self.c1, 2.0], [4.0 * self.c2, -2.0]])

    def ogden_term_derivatives(self) -> Array:
        return np.array([[[4.0, 0.0], [0.0, 0.0]], [[0.0, 0.0], [4.0, 0.0]]])


def _to_one_or_several(name: str, values: float | Sequence[float]) -> float | tuple[float, ...]:
    """A number, or several as a tuple."""
    try:
        found = np.asarray(values, dtype=float)
    except (TypeError, ValueError):
        found = np.zeros(0)
    if found.ndim > 1 or not found.size:
        raise ProblemError(f"material parameter {name} = {values} is no number, nor several")
    return float(found.reshape(-1)[0]) if found.size == 1 else tuple(found.tolist())


def _list_prony_names(material: Uncoupled) -> tuple[str, ...]:
    return _number_names(("g", "tau"), len(material.prony))


def _number_names(names: tuple[str, ...], count: int) -> tuple[str, ...]:
    return tuple(f"{name}{k}" for k in range(1, count + 1) for name in names)
