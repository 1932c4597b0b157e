"""Quasi-linear viscoelasticity: the Prony factors of one time step and their derivatives.

The history of one Prony term ``g(t) = exp(-t/tau)`` over a step of ``dt``, with ``x = dt/tau``, follows

    H_new = decay H + ramp (Se_new - Se) + back (Se - Se_before)

with ``decay = exp(-x)``.  Where the elastic stress is taken as linear over the step, ``ramp`` is
``a = (1 - exp(-x))/x`` and ``back`` 0 (Puso and Weiss 1998; FEBio theory manual).  Where it is a quadratic
through the last three steps, the one before having lasted ``q dt``, its change of slope adds
``b = int_0^1 (1 - 2w) exp(-x w) dw = a - 2 (a - decay)/x``: ``ramp = a + b/(1 + q)``,
``back = -b/(q (1 + q))``.  Each is exact for a stress of that kind; what is left of a smooth stress is of
second and of third order in the step.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from ...arrays import Array

ORDER_IN_TIME = 3.0  # of the error of a force, against the length of the steps
_SMALL = 0.02  # of x: closed forms lose digits below


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

    ``before`` is infinite where the stress is linear over the step.
    """
    tau = np.asarray(tau, dtype=float)
    x = dt / tau
    decay = np.exp(-x)
    a = -np.expm1(-x) / x
    safe = np.where(x < _SMALL, 1.0, x)
    da = np.where(x < _SMALL, _series(x, (-1 / 2, 1 / 3, -1 / 8, 1 / 30, -1 / 144)), (decay - a) / safe)
    bent = (a - decay) / safe
    b = np.where(x < _SMALL, x * _series(x, (1 / 6, -1 / 12, 1 / 40, -1 / 180, 1 / 1008)), a - 2.0 * bent)
    closed = da - 2.0 * (da + decay - bent) / safe
    db = np.where(x < _SMALL, _series(x, (1 / 6, -1 / 6, 3 / 40, -1 / 45, 5 / 1008)), closed)
    now, past = dt / (dt + before), dt / before * (dt / (dt + before))
    turn = -x / tau  # dx/d tau
    return Factors(
        decay, a + now * b, -past * b, -turn * decay, turn * (da + now * db), -turn * past * db
    )  # fmt: skip


def _series(x: Array, terms: tuple[float, ...]) -> Array:
    return np.asarray(np.polynomial.polynomial.polyval(x, terms), dtype=np.float64)
