"""Relaxation as a power of time: fixed times spaced evenly in the logarithm, amplitudes of two parameters.

``G(t) = 1 + sum_i g_i exp(-t/tau_i)``, ``g_i = gamma (tau_i / 1 s)^(-slope)``.  Spread over all times, these
amplitudes make ``t^(-slope)``; with a slope of 0 and two ends they are Fung's spectrum (1993,
Biomechanics, chapter 7), which relaxes with the logarithm of time.  What would relax after the last time
does not: it is in the 1.
"""

import math

import numpy as np

from .arrays import Array
from .errors import InputError

MIN_TIMES, MAX_TIMES = 5, 6  # FEBio takes six terms
DEFAULT_SPAN_S = (0.03, 3000.0)  # a decade between times, from ramps of 0.3 s to loads of 300 s
MAX_SPAN = 1e7  # last time over first; with more, waves in a power of -0.2 exceed 4 %


def choose_relaxation_times(first_s: float, last_s: float) -> Array:
    """Return five or six relaxation times (n,), s, from ``first_s`` to ``last_s``, even in the logarithm.

    Five are a decade apart, or less, where the span is four decades or less; six cover a wider one. Raises
    `InputError` if the times do not grow from above zero, or the last is more than 1e7 times the first.
    """
    if not 0.0 < first_s < last_s < math.inf or last_s > MAX_SPAN * first_s:
        remedy = f"give two that are positive and grow, the second at most {MAX_SPAN:g} times the first"
        raise InputError(f"relaxation times from {first_s:g} to {last_s:g} s span no range", remedy=remedy)
    decades = math.log10(last_s / first_s)
    return np.geomspace(first_s, last_s, MIN_TIMES if decades <= MIN_TIMES - 1 + 1e-9 else MAX_TIMES)


def compute_power_law_terms(gamma: float, slope: float, times_s: Array) -> Array:
    """Return the amplitudes g_i (n,), dimensionless, of relaxation times (n,) in s.

    ``gamma``: amplitude of a term at 1 s.  It belongs to the spacing of the times: with the same relaxation,
    it is proportional to the step in ``ln tau``. ``slope``: minus the power of time.
    """
    return np.asarray(gamma * np.asarray(times_s, dtype=float) ** -slope)
