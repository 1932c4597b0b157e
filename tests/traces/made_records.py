"""Records of a known truth, and where those of others lie.

The synthetic record is a power-law solid with quasi-linear relaxation, F = a d^p filtered by
G(t) = 1 + gamma exp(-t / tau): it starts with slack, is pushed in at constant speed and drawn back.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from limbfit.traces import Trace

SHARED = Path(__file__).parents[2] / ".." / "shared"
OPENLIMB = SHARED / "reference" / "openlimb-study"
RELAXATION = SHARED / "data" / "relaxation"
needs_openlimb = pytest.mark.skipif(not OPENLIMB.is_dir(), reason="shared/reference is not here")
needs_relaxation = pytest.mark.skipif(not RELAXATION.is_dir(), reason="shared/data is not here")


def relaxing(time, depth, p=1.3, stiffness=0.5, gamma=2.0, tau=0.4):
    """Force in N of the power-law solid, by the exact recursion for piecewise linear elastic force."""
    elastic = stiffness * np.maximum(depth, 0.0) ** p
    history = np.zeros_like(elastic)
    for k in range(1, len(time)):
        dt = time[k] - time[k - 1]
        decay = np.exp(-dt / tau)
        history[k] = decay * history[k - 1] + (1 - decay) / (dt / tau) * (elastic[k] - elastic[k - 1])
    return np.maximum(elastic + gamma * history, 0.0)


def record(
    slack=0.4,
    depth=5.0,
    speed=0.96,
    rate=500.0,
    p=1.3,
    noise_N=0.03,
    noise_mm=0.005,
    offset=0.0,
    wait=0.0,
    seed=0,
):
    """A record in and out, and its force without noise as a function of time."""
    travel = slack + depth
    corners_s = [0.0, wait, wait + travel / speed, wait + 2 * travel / speed]
    how = {"p": p, "rate": rate, "noise_N": noise_N, "noise_mm": noise_mm, "seed": seed}
    trace, truth = path_record(corners_s, [0.0, 0.0, travel, 0.0], slack, **how)
    return replace(trace, force_N=trace.force_N + offset), truth


def path_record(corners_s, corners_mm, slack=0.4, p=1.3, rate=500.0, noise_N=0.03, noise_mm=0.005, seed=0):
    """A record along a broken line of displacement, and its force without noise as a function of time."""
    fine = np.arange(0, corners_s[-1], 1e-3)
    path = np.interp(fine, corners_s, corners_mm)
    force = relaxing(fine, path - slack, p)
    time = np.arange(0, fine[-1], 1 / rate)
    rng = np.random.default_rng(seed)
    displacement = np.interp(time, fine, path) + noise_mm * rng.standard_normal(time.size)
    noisy = np.interp(time, fine, force) + noise_N * rng.standard_normal(time.size)
    return Trace(time, displacement, noisy), lambda t: np.interp(t, fine, force)
