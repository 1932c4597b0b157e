"""Records that are over in a second and held for half a minute."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from limbfit.errors import TraceError
from limbfit.traces import Trace, find_touch_down, regularise
from limbfit.traces.record import check_trace


def fast_and_held() -> Trace:
    """5 mm in a second, held for 30 s; half of the force relaxes within a second."""
    rng = np.random.default_rng(0)
    time = np.arange(0.0, 32.6, 0.002)
    depth = np.interp(time, [0.0, 1.1, 31.1, 32.2], [-0.4, 5.0, 5.0, -0.4])
    held = np.clip(time - 1.1, 0.0, None)
    force = 0.02 * np.clip(depth, 0.0, None) ** 2 * (1.0 + np.exp(-held / 0.3)) * (time < 31.2)
    noise = 0.05 * rng.standard_normal(time.size), 0.01 * rng.standard_normal(time.size)
    return Trace(time, depth + 0.4 + noise[1], force + noise[0])


def test_a_fast_ramp_with_a_long_hold_is_read() -> None:
    """Half of the first means are of a force that is there already."""
    trace = fast_and_held()
    check_trace(trace)
    curve = regularise(trace, find_touch_down(trace))
    assert [phase.kind for phase in curve.phases] == ["load", "hold", "unload"]
    assert curve.peak_force_N == pytest.approx(1.0, abs=0.06)


def test_its_sign_is_still_looked_at() -> None:
    trace = fast_and_held()
    with pytest.raises(TraceError, match="pushing must be positive: change the sign"):
        check_trace(dataclasses.replace(trace, force_N=-trace.force_N))
