"""The limb's force: within 1 % of what was simulated, sound for any other history."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from in_process import SURROGATE, device, indentation

from limbfit.acquire.virtual import Surrogate, VirtualLimb, fit_surrogate
from limbfit.acquire.virtual.parts import TAUS_S, _split_depth
from limbfit.errors import TraceError
from limbfit.traces.touchdown import compute_memory


@pytest.mark.parametrize("power", [1.0, 1.5, 2.5])
@pytest.mark.parametrize("speed", [0.5, 3.0])
def test_within_one_percent_of_the_simulation(power: float, speed: float) -> None:
    time, displacement, force = indentation(power=power, speed=speed)
    fitted = fit_surrogate(time, displacement, force)
    assert fitted.error_percent < 1.0
    at = follow(fitted, time, displacement)
    assert np.abs(at - force).max() < 0.01 * force.max()


def follow(surrogate: Surrogate, time_s: np.ndarray, displacement_mm: np.ndarray) -> np.ndarray:
    """Forces (n,) N of a history (n,) that starts at rest, stepped as finely as it is given."""
    levels = _split_depth(displacement_mm, surrogate.depth_mm) @ np.diff(surrogate.values, axis=1).T
    memories = [compute_memory(time_s, levels[:, k], tau) for k, tau in enumerate(TAUS_S, 1)]
    return np.maximum(levels[:, 0] + np.sum(memories, axis=0), 0.0)


def test_another_speed_is_foretold() -> None:
    """The tissue was seen at 0.96 mm/s; at other speeds the surrogate must not be far from it."""
    for speed in (0.5, 2.0):
        time, displacement, force = indentation(speed=speed)
        scale = indentation()[2].max() / 6.0  # both are scaled to their own peak: compare shapes
        found = follow(SURROGATE, time, displacement)
        assert np.abs(found / found.max() - force / force.max()).max() < 0.05 * scale


@settings(max_examples=25, deadline=None, derandomize=True)
@given(st.lists(st.floats(-1, 7), min_size=3, max_size=8))
def test_any_history_gives_bounded_forces_that_relax(corners: list[float]) -> None:
    time = np.linspace(0, 3.0, 3001)
    way = np.interp(time, np.linspace(0, 2.0, len(corners)), corners)
    force = follow(SURROGATE, time, way)
    held = force[2100:]
    assert (force >= 0).all()
    assert force.max() < 60
    if min(corners) >= 0 and (np.diff(corners) > 0).all():
        assert (np.diff(held) <= 1e-9).all()  # relaxes
    if corners[-1] <= 0:
        assert held.max() < 1e-6


def test_the_stepped_limb_is_the_surrogate() -> None:
    limb = VirtualLimb({"1": SURROGATE}, np.random.default_rng(0), (4.0, 4.0))
    limb.place_site("1", 1)
    time, displacement, force = indentation()
    fine = np.arange(0.001, time[-1], 0.001)
    found = []
    for depth in np.interp(fine, time, displacement):
        head = np.zeros(14)
        head[0] = 4.0 + depth
        limb.step(head)
        found.append(limb.force_N[0])
    np.testing.assert_allclose(found, np.interp(fine, time, force), atol=0.01 * force.max())


def test_an_empty_simulation_is_refused() -> None:
    with pytest.raises(TraceError, match="no indentation"):
        fit_surrogate(np.arange(20.0), np.zeros(20), np.zeros(20))


def test_capacitance_tells_the_distance_and_seeds_differ() -> None:
    far, other = device(seed=1), device(seed=2)
    assert far.limb.gap_mm.tolist() != other.limb.gap_mm.tolist()
    gap = far.limb.gap_mm
    seen = [far.sensors.read(gap, gap - d, np.zeros(14), gap, (), ())[2][0] for d in (5.0, 1.0, 0.2, 0.0)]
    assert seen == sorted(seen)
    assert seen[2] < far.sensors.touch_fF < seen[3]
