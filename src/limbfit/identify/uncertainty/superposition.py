"""Forces of a record for any relaxation, from one simulation with derivatives.

The force of a test that drives the indenter is the sum over tissues of their relaxation convolved with the
rate of an elastic share (correspondence principle; Christensen 1982, section 2.1). Forces are homogeneous of
degree one in the moduli, so a tissue's share of a simulated force is ``c dF/dc`` (Euler), and its elastic
share follows by taking the simulated relaxation out again. Then a convolution gives the force, and its
derivatives, for any other relaxation. The strains of that test are not exactly those of the simulated one;
docs/uncertainty.md states the error.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import solve_triangular
from scipy.special import gammainc

from ...arrays import Array
from ...relaxation import compute_power_law_terms
from ..fit.objective import SiteResponse
from ..fit.parameters import SearchSpace

_TAIL_BINS = np.geomspace(2.0**-14, 8.0, 18)  # edges, of T over the times of a tail
_DIFFERENCE = 1e-3
_FOREVER_S = 1e9  # of a term that does not relax


@dataclass(frozen=True)
class RelaxationTerms:
    """``G(t) = constant + sum amplitudes exp(-t / times)``."""

    constant: float
    amplitudes: Array
    times_s: Array

    def evaluate(self, time_s: float) -> float:
        return self.constant + float(self.amplitudes @ np.exp(-time_s / self.times_s))


@dataclass(frozen=True)
class TissueParameters:
    """Numbers of a tissue's parameters in the flat vector; ``is_given`` if its relaxation does not move.

    ``further`` are amplitude and time of a term that the model does not have, if there is one.
    """

    name: str
    moduli: tuple[int, ...]
    others: tuple[int, ...]
    amplitudes: tuple[int, ...]
    times: tuple[int, ...]
    is_given: bool
    further: tuple[int, int] | tuple[()] = ()

    def own_terms(self, p: Array) -> RelaxationTerms:
        """The model's relaxation at parameters p."""
        return RelaxationTerms(1.0, p[list(self.amplitudes)], p[list(self.times)])

    def modulus_log(self, p: Array, time_s: float) -> float:
        """Logarithm of the model's modulus so long after a step."""
        return float(np.log(p[self.moduli[0]] * self.own_terms(p).evaluate(time_s)))


def find_tissue_parameters(names: Sequence[str], space: SearchSpace) -> tuple[TissueParameters, ...]:
    """Group parameters ``<tissue>.<key>`` by what they do."""
    found = []
    for tissue in dict.fromkeys(name.rpartition(".")[0] for name in names):
        groups: dict[str, list[int]] = {"modulus": [], "other": [], "gamma": [], "tau": []}
        for i, name in enumerate(names):
            own, _, key = name.rpartition(".")
            kind = "modulus" if key.endswith("_kPa") else key.removesuffix("_s").rstrip("0123456789")
            if own == tissue:
                groups[kind if kind in groups else "other"].append(i)
        moduli, others, amplitudes, times = (tuple(group) for group in groups.values())
        is_given = not space.tie[list(amplitudes)].any()
        found.append(TissueParameters(tissue, moduli, others, amplitudes, times, is_given))
    return tuple(found)


@dataclass(frozen=True)
class RelaxationModel:
    """A relaxation that the records are fitted with: the model's terms, with or without a further term and a
    tail, or a spectrum.

    A spectrum's amplitudes are ``gamma tau_i^-slope exp(-tau_i / end)``, Fung's (1993) where the slope is 0.
    Its end takes the place of a tissue's first relaxation time and is in units of ``longest_s``. Beside a
    further term, terms slower than ``held_s`` do not relax.
    """

    slope: float = 0.0
    longest_s: float = 1.0
    spectrum_s: Array | None = None
    has_further: bool = False
    held_s: float = np.inf

    def terms(self, tissue: TissueParameters, p: Array) -> RelaxationTerms:
        """The relaxation of a tissue; the model's terms come first."""
        own = tissue.own_terms(p)
        if self.spectrum_s is not None and not tissue.is_given:
            power = compute_power_law_terms(own.amplitudes[0], self.slope, self.spectrum_s)
            ends = np.exp(-self.spectrum_s / (self.longest_s * own.times_s[0]))
            return RelaxationTerms(1.0, power * ends, self.spectrum_s)
        amplitudes, times = own.amplitudes, own.times_s
        if self.has_further and tissue.further:
            amplitude, time = p[list(tissue.further)]
            amplitudes, times = np.append(amplitudes, amplitude), np.append(times, time)
            times = np.where(times > self.held_s, _FOREVER_S, times)
        if self.spectrum_s is not None or self.slope == 0.0:
            return RelaxationTerms(1.0, amplitudes, times)
        # (1 + t/T)^-s is a mixture of exponentials whose rates times T have a gamma distribution.
        share, middle = gammainc(self.slope, _TAIL_BINS), np.sqrt(_TAIL_BINS[1:] * _TAIL_BINS[:-1])
        amplitudes, times = np.r_[amplitudes, np.diff(share)], np.r_[times, self.longest_s / middle]
        return RelaxationTerms(float(share[0]), amplitudes, times)


def _convolve(elastic: Array, times_s: Array, taus: Array) -> Array:
    """Return the histories (terms, n, q) of elastic columns (n, q), linear between the times (n,)."""
    x = np.diff(times_s)[:, None] / taus
    decay, ramp = np.exp(-x)[..., None], (-np.expm1(-x) / x)[..., None]
    found = np.empty((len(taus), *elastic.shape))
    found[:, 0] = elastic[0]
    for i, step in enumerate(np.diff(elastic, axis=0)):
        found[:, i + 1] = decay[i] * found[:, i] + ramp[i] * step
    return found


class Superposition:
    """Forces of a record for any relaxation, from its simulation at ``parameters`` (p,)."""

    def __init__(
        self, times_s: Array, response: SiteResponse, parameters: Array, tissues: Sequence[TissueParameters]
    ) -> None:
        self.times_s, self.parameters, self.tissues = times_s, parameters, tissues
        self.in_contact = (response.force_N > 0)[:, None]
        scaled, steps = response.jacobian * parameters, np.eye(len(times_s))
        self.elastic = []  # columns (n, q) of each tissue, whose relaxation gives what was simulated
        for one in tissues:
            terms, relaxed = one.own_terms(parameters), scaled[:, [*one.moduli, *one.others]]
            histories = _convolve(steps, times_s, terms.times_s)
            relaxation = terms.constant * steps + np.tensordot(terms.amplitudes, histories, 1)
            self.elastic.append(np.asarray(solve_triangular(relaxation, relaxed, lower=True)))

    def respond(self, relaxation: RelaxationModel, p: Array) -> SiteResponse:
        """Force (n,) and derivatives (n, p) with a relaxation at parameters p, further terms among them."""
        change = np.log(p[: len(self.parameters)] / self.parameters)
        total, slopes = np.zeros(len(self.times_s)), np.zeros((len(self.times_s), len(p)))
        for elastic, tissue in zip(self.elastic, self.tissues, strict=True):
            terms, n = relaxation.terms(tissue, p), len(tissue.moduli)
            histories = _convolve(elastic, self.times_s, terms.times_s)
            relaxed = terms.constant * elastic + np.tensordot(terms.amplitudes, histories, 1)
            factors = np.r_[np.exp(change[list(tissue.moduli)]), change[list(tissue.others)]]
            factors[n:] *= factors[0]
            total += relaxed @ factors
            slopes[:, tissue.moduli] = relaxed[:, :n] * factors[:n]
            slopes[:, tissue.moduli[0]] += relaxed[:, n:] @ factors[n:]
            slopes[:, tissue.others] = relaxed[:, n:] * factors[0]
            if relaxation.spectrum_s is not None and not tissue.is_given:
                slopes[:, tissue.amplitudes[0]] = (relaxed - elastic) @ factors
                over_end = terms.amplitudes * terms.times_s / (relaxation.longest_s * p[tissue.times[0]])
                slopes[:, tissue.times[0]] = np.tensordot(over_end, histories, 1) @ factors
                continue
            of_terms = [*zip(tissue.amplitudes, tissue.times, strict=True)]
            if relaxation.has_further and tissue.further:
                of_terms.append(tissue.further)
            for k, (amplitude, time) in enumerate(of_terms):
                slopes[:, amplitude] = terms.amplitudes[k] * (histories[k] @ factors)
                around = p[time] * np.exp([-_DIFFERENCE, _DIFFERENCE])
                low, high = _convolve(elastic, self.times_s, around) @ factors
                slopes[:, time] = terms.amplitudes[k] * (high - low) / (2 * _DIFFERENCE)
        touching = self.in_contact & (total > 0)[:, None]  # what relaxes more loses contact earlier
        return SiteResponse(total * touching[:, 0], slopes * touching / p)
