"""Points at which an emulator learns what fits to other records will ask of it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..fit.parameters import Unknowns

Array = NDArray[np.float64]

_CANDIDATES = 600
# Standard deviations of log(parameters) along the axes of the covariance: what fits scatter by at least, at
# most.
_LEAST, _MOST = 0.08, 0.45
_WIDER = 2.0  # than the fit's own covariance: fewer records, or others, tell less


def spread_points(centre: Array, covariance_log: Array, unknowns: Unknowns, count: int, seed: int) -> Array:
    """``count`` points (count, p) around a fit's answer, far from one another and inside the bounds.

    Parameters
    ----------
    centre : (p,) the answer.
    covariance_log : (p, p) of the logarithms of the parameters.
    """
    rng = np.random.default_rng(seed)
    values, axes = np.linalg.eigh(covariance_log)
    sd = np.clip(_WIDER * np.sqrt(np.maximum(values, 0.0)), _LEAST, _MOST)
    unit = rng.standard_normal((_CANDIDATES, len(centre)))
    unit /= np.maximum(np.linalg.norm(unit, axis=1, keepdims=True) / np.sqrt(len(centre)), 1.0)
    found: list[int] = []
    distance = np.linalg.norm(unit, axis=1)  # to the answer, which is simulated too
    for _ in range(count):
        found.append(int(np.argmax(distance)))
        distance = np.minimum(distance, np.linalg.norm(unit - unit[found[-1]], axis=1))
    points = centre * np.exp((unit[found] * sd) @ axes.T)
    return np.clip(points, unknowns.lower, unknowns.upper)
