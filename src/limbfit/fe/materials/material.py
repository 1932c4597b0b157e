"""What the solver asks of a material, and what the laws of this room share.

Every law here is *uncoupled*: ``W = W_dev(lt_1, lt_2, lt_3) + U(J)`` with ``lt_i = J^(-1/3) lambda_i``, and a
relaxation function ``G(t) = 1 + sum_l g_l exp(-t/tau_l)`` on the deviatoric stress (FEBio's "uncoupled
viscoelastic", g0 = 1).  The deviatoric part is an `ElasticLaw` with numbers of its own, for most a sum of
Ogden terms, ``W_dev = sum_k c_k/m_k^2 (lt_1^m_k + lt_2^m_k + lt_3^m_k - 3)``.
"""

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar, NamedTuple, Self, cast

import numpy as np
from numpy.polynomial.polynomial import polyval
from numpy.typing import ArrayLike

from ...arrays import Array
from ...errors import ProblemError
from .elastic import OGDEN, VOLUMETRIC_LAWS, ElasticLaw

PronyTerms = Sequence[tuple[float, float]]
ORDER_IN_TIME = 3.0  # of the error of a force, against the length of the steps
_SMALL = 0.02  # of the step over the relaxation time: closed forms of Prony factors lose digits below


@dataclass(frozen=True)
class LawTable:
    """What the kernels know of a material, or a derivative of it.

    ``numbers (k,)``: what the ``elastic`` law is given; ``kappa``: bulk modulus (MPa);
    ``prony (l, 2)``: amplitudes and relaxation times (s); ``volumetric``: code of the law; ``fibre``: k1
    (MPa) and k2 of its fibres, k1 = 0 without; ``active``: their stress at full activation (MPa).
    """

    numbers: Array
    kappa: float
    prony: Array
    volumetric: int = 0
    elastic: ElasticLaw = OGDEN
    fibre: tuple[float, float] = (0.0, 1.0)
    active: float = 0.0

    @property
    def has_fibres(self) -> bool:
        """True if the direction of its fibres matters."""
        return self.fibre[0] > 0.0 or self.active > 0.0

    @property
    def has_terms(self) -> bool:
        """True if the law is a sum of Ogden terms."""
        return self.elastic is OGDEN

    @property
    def terms(self) -> Array:
        """Ogden moduli c_k (MPa) and exponents m_k (k, 2). Raises `ProblemError` where the law is none of
        Ogden terms.
        """
        if not self.has_terms:
            what = "the tissue's law is not a sum of Ogden terms, and other programs know no other"
            raise ProblemError(what, remedy="use one of Ogden terms there")
        return self.numbers.reshape(-1, 2)


class Material(ABC):
    """A material of a `Problem`.

    Sensitivities are with respect to ``parameters``, in their order; units mm, N, s, MPa.
    """

    @property
    @abstractmethod
    def parameter_names(self) -> tuple[str, ...]:
        """Names of the parameters, unique within the material."""

    @property
    @abstractmethod
    def parameters(self) -> tuple[float, ...]:
        """Their values."""

    @property
    @abstractmethod
    def instantaneous_modulus(self) -> float:
        """Shear modulus of small, sudden strains, MPa."""

    @property
    @abstractmethod
    def instantaneous_modulus_gradient(self) -> tuple[float, ...]:
        """Derivative of `instantaneous_modulus` with respect to each parameter."""

    @abstractmethod
    def table(self) -> LawTable:
        """The material as the kernels read it."""

    @abstractmethod
    def derivatives(self) -> tuple[LawTable, ...]:
        """Derivative of the table with respect to each parameter."""

    @abstractmethod
    def with_parameters(self, values: Mapping[str, float]) -> Self:
        """The material with other values of some of its parameters, by name."""


class Uncoupled(Material):
    """The tables of a law that says which numbers its `ElasticLaw` has, and its shear modulus.

    ``kappa_ratio`` is the bulk modulus over the long-term shear modulus of small strains: a law given by its
    bulk modulus ``k`` has ``kappa_ratio = k / shear_modulus``.  The bulk modulus moves with the shear
    modulus, so that an identified material keeps its compressibility.
    """

    elastic: ClassVar[ElasticLaw] = OGDEN

    @property
    @abstractmethod
    def kappa_ratio(self) -> float:
        """Bulk modulus over `shear_modulus`."""

    @property
    @abstractmethod
    def volumetric(self) -> str:
        """Name in `VOLUMETRIC_LAWS`."""

    @property
    @abstractmethod
    def prony(self) -> PronyTerms:
        """Amplitude g_l and relaxation time tau_l (s) of each relaxation term."""

    @property
    @abstractmethod
    def elastic_parameters(self) -> tuple[float, ...]:
        """The parameters before those of relaxation."""

    def numbers(self) -> Array:
        """What `elastic` is given (k,), moduli in MPa: its parameters, unless a law says otherwise."""
        return np.array(self.elastic_parameters)

    def number_derivatives(self) -> Array:
        """Derivative (p, k) of `numbers` with respect to each elastic parameter."""
        return np.eye(len(self.elastic_parameters))

    @property
    @abstractmethod
    def shear_modulus(self) -> float:
        """Long-term shear modulus of small strains, MPa."""

    @property
    @abstractmethod
    def shear_modulus_gradient(self) -> Array:
        """Its derivative (p,) with respect to each elastic parameter."""

    @property
    def parameters(self) -> tuple[float, ...]:
        """Those of the elastic law, then of the relaxation."""
        return *self.elastic_parameters, *self.relaxation_parameters

    @property
    def relaxation_parameters(self) -> tuple[float, ...]:
        """What `prony` follows from: itself, g_1, tau_1, g_2, ..., unless a law says otherwise."""
        return tuple(value for term in self.prony for value in term)

    def prony_derivatives(self) -> Array:
        """Derivative (p, l, 2) of `prony` with respect to each of `relaxation_parameters`."""
        count = len(self.prony)
        return np.eye(2 * count).reshape(2 * count, count, 2)

    @property
    def instantaneous_modulus(self) -> float:
        """``shear_modulus (1 + sum g_l)``, MPa."""
        return self.shear_modulus * self._relaxation

    @property
    def instantaneous_modulus_gradient(self) -> tuple[float, ...]:
        elastic = [float(d) * self._relaxation for d in self.shear_modulus_gradient]
        amplitudes = self.prony_derivatives()[..., 0].sum(axis=1)
        return *elastic, *(self.shear_modulus * float(d) for d in amplitudes)

    @property
    def _relaxation(self) -> float:
        return 1.0 + sum(g for g, _ in self.prony)

    def table(self) -> LawTable:
        prony = np.array(self.prony, dtype=float).reshape(-1, 2)
        law, kappa = VOLUMETRIC_LAWS[self.volumetric], self.kappa_ratio * self.shear_modulus
        return LawTable(self.numbers(), kappa, prony, law, self.elastic)

    def derivatives(self) -> tuple[LawTable, ...]:
        still, slopes = np.zeros((len(self.prony), 2)), self.shear_modulus_gradient
        elastic = [
            LawTable(numbers, float(self.kappa_ratio * slope), still, fibre=(0.0, 0.0))
            for numbers, slope in zip(self.number_derivatives(), slopes, strict=True)
        ]
        rest, relaxation = np.zeros_like(self.numbers()), self.prony_derivatives()
        return *elastic, *(LawTable(rest, 0.0, prony, fibre=(0.0, 0.0)) for prony in relaxation)

    def with_parameters(self, values: Mapping[str, float]) -> Self:
        return cast("Self", replace(cast("Any", self), **values))


def check_finite(name: str, value: float) -> None:
    """Raise `ProblemError` unless ``value`` is a finite number."""
    if not math.isfinite(value):
        raise ProblemError(f"material parameter {name} = {value} is not finite")


def check_positive(name: str, value: float) -> None:
    """Raise `ProblemError` unless ``value`` is finite and above zero."""
    check_finite(name, value)
    if not value > 0:
        raise ProblemError(f"material parameter {name} = {value} is not positive")


def check_not_negative(name: str, value: float) -> None:
    """Raise `ProblemError` unless ``value`` is finite and zero or above."""
    check_finite(name, value)
    if value < 0:
        raise ProblemError(f"material parameter {name} = {value} is negative")


class Factors(NamedTuple):
    """Weights of the history, of the change of elastic stress in this step and in the one before; and
    their derivatives with respect to the relaxation time, 1/s."""

    decay: Array
    ramp: Array
    back: Array
    d_decay: Array
    d_ramp: Array
    d_back: Array


def compute_prony_factors(dt: float, tau: ArrayLike, before: float = np.inf) -> Factors:
    """Factors for relaxation times ``tau`` and a step of ``dt`` after one of ``before`` (s).

    The history of one Prony term ``g(t) = exp(-t/tau)`` over the step follows, with ``x = dt/tau`` and
    ``decay = exp(-x)``, ``H_new = decay H + ramp (Se_new - Se) + back (Se - Se_before)``.  Where the elastic
    stress is taken as linear over the step, ``before`` infinite, ``ramp`` is ``a = (1 - exp(-x))/x`` and
    ``back`` 0 (Puso and Weiss 1998; FEBio theory manual).  Where it is a quadratic through the last three
    steps, the one before having lasted ``q dt``, its change of slope adds
    ``b = int_0^1 (1 - 2w) exp(-x w) dw = a - 2 (a - decay)/x``: ``ramp = a + b/(1 + q)``,
    ``back = -b/(q (1 + q))``.  Each is exact for a stress of that kind; what is left of a smooth stress is of
    second and of third order in the step.
    """
    tau = np.asarray(tau, dtype=float)
    x = dt / tau
    decay = np.exp(-x)
    a = -np.expm1(-x) / x
    safe = np.where(x < _SMALL, 1.0, x)
    da = np.where(x < _SMALL, polyval(x, (-1 / 2, 1 / 3, -1 / 8, 1 / 30, -1 / 144)), (decay - a) / safe)
    bent = (a - decay) / safe
    b = np.where(x < _SMALL, x * polyval(x, (1 / 6, -1 / 12, 1 / 40, -1 / 180, 1 / 1008)), a - 2.0 * bent)
    closed = da - 2.0 * (da + decay - bent) / safe
    db = np.where(x < _SMALL, polyval(x, (1 / 6, -1 / 6, 3 / 40, -1 / 45, 5 / 1008)), closed)
    now, past = dt / (dt + before), dt / before * (dt / (dt + before))
    turn = -x / tau  # dx/d tau
    return Factors(
        decay, a + now * b, -past * b, -turn * decay, turn * (da + now * db), -turn * past * db
    )  # fmt: skip
