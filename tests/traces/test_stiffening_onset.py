"""Where a small ball meets the skin: its force starts straight, and stiffens over the bone."""

from __future__ import annotations

import numpy as np
import pytest

from limbfit.traces import Trace, find_touch_down


@pytest.mark.parametrize("speed", [0.96, 4.8])
def test_the_touch_down_of_a_small_ball_is_as_sure_as_it_says(speed: float) -> None:
    """3 mm into 8 mm of tissue by a ball of 12 mm: 1 N at noise of 0.05 N (as simulated, in short)."""
    clearance, depth = 0.45, 3.0
    off, stated = [], []
    for seed in range(12):
        rng = np.random.default_rng(seed)
        time = np.arange(0.0, 2 * (clearance + depth) / speed, 0.002)
        travel = speed * np.minimum(time, time[-1] - time)
        pressed = np.clip(travel - clearance, 0.0, None)
        force = 0.13 * pressed + 0.07 * pressed**2
        trace = Trace(
            time,
            travel + 0.01 * rng.standard_normal(time.size),
            force + 0.05 * rng.standard_normal(time.size),
        )
        found = find_touch_down(trace)
        off.append(found.displacement_mm - clearance)
        stated.append(found.uncertainty_mm)
    assert abs(np.mean(off)) < 0.17
    assert np.sqrt(np.mean(np.square(np.array(off) / stated))) < 1.6
