"""Volumetric laws U(J), named by code in the compiled kernels.

Source: FEBio theory and user manuals, "uncoupled materials", ``pressure_model``.
"""

from __future__ import annotations

import numpy as np
from numba import njit

# FEBio's default, NIKE3D, Abaqus and Abaqus-GOH; the last, kappa/2 ((J^2 - 1)/2 - ln J), is the second.
VOLUMETRIC_LAWS = {"log": 0, "nike3d": 1, "abaqus": 2, "abaqus-goh": 1}


@njit(cache=True)
def volumetric(law: int, kappa: float, J: float) -> tuple[float, float, float]:
    """``U(J)``, ``J U'(J)`` and ``d(J U')/d(ln J)`` of a law of `VOLUMETRIC_LAWS`, in MPa.

    log: kappa/2 (ln J)^2; nike3d: kappa/4 (J^2 - 2 ln J - 1); abaqus: kappa/2 (J - 1)^2.
    """
    if law == 0:
        log_j = np.log(J)
        return 0.5 * kappa * log_j * log_j, kappa * log_j, kappa
    if law == 1:
        return 0.25 * kappa * (J * J - 2.0 * np.log(J) - 1.0), 0.5 * kappa * (J * J - 1.0), kappa * J * J
    return 0.5 * kappa * (J - 1.0) ** 2, kappa * (J - 1.0) * J, kappa * (2.0 * J - 1.0) * J
