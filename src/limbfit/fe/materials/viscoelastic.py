"""Quasi-linear viscoelasticity: the Prony factors of one time step and their derivatives.

The history of one Prony term ``g(t) = exp(-t/tau)`` follows
``H_new = decay H + ramp (Se_new - Se)`` with ``decay = exp(-x)``, ``ramp = (1 - exp(-x))/x``, ``x = dt/tau``:
exact for an elastic stress that is linear over the step (Puso and Weiss 1998; FEBio theory manual).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

Factors = tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]


def prony_factors(dt: float, tau: ArrayLike) -> Factors:
    """``decay, ramp, d decay/d tau, d ramp/d tau`` for relaxation times ``tau`` (s) and a step ``dt`` (s)."""
    tau = np.asarray(tau, dtype=float)
    x = dt / tau
    decay = np.exp(-x)
    ramp = -np.expm1(-x) / x
    small = x < 1e-3  # (exp(-x) - ramp)/x loses digits there
    safe = np.where(small, 1.0, x)
    d_ramp_dx = np.where(small, -0.5 + x / 3.0 - x**2 / 8.0, (decay - ramp) / safe)
    return decay, ramp, decay * x / tau, -d_ramp_dx * x / tau
