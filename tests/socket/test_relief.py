"""The search for depths: synthetic limbs whose pressures are known functions of the depths."""

from collections.abc import Callable

import numpy as np
import pytest

from limbfit.donning.relief import Relief

NAMES = ("crest", "head", "tendon", "calf")
START = np.array([150.0, 120.0, 90.0, 60.0])


def limb(curvature: float = 0.0) -> Callable[[np.ndarray], np.ndarray]:
    """Pressures of depths over crest and head; relief there loads tendon and calf."""
    slopes = np.array([[0.2, 0.03], [0.02, 0.1], [-0.06, -0.04], [-0.02, -0.05]])
    return lambda depths: START * np.exp(slopes @ depths + curvature * (depths**2).sum())


def searched(search: Relief, pressures: Callable[[np.ndarray], np.ndarray], count: int) -> int:
    for number in range(count):
        depths = search.propose()
        if depths is None:
            return number
        search.tell(depths, pressures(depths))
    return count


def test_named_peaks_fall_within_few_simulations() -> None:
    pressures = limb(curvature=0.01)
    search = Relief((0, 1), START, np.full(4, 150.0), START)
    searched(search, pressures, 6)
    best = search.best
    assert best.pressures is not None
    np.testing.assert_allclose(best.pressures, pressures(best.depths))
    assert (best.pressures[:2] < 0.8 * START[:2]).all()
    assert (best.pressures[2:] < 150.0).all()


def test_the_others_stay_below_their_limits() -> None:
    """Relief of crest and head would load the tendon by half: 5 % are allowed."""
    limits = np.array([np.inf, np.inf, 1.05 * START[2], 1e3])
    search = Relief((0, 1), START, limits, START)
    searched(search, limb(), 8)
    free = Relief((0, 1), START, np.full(4, 1e3), START)
    searched(free, limb(), 8)
    for found, most in ((search, 1.051), (free, 10.0)):
        assert found.best.pressures is not None
        assert found.best.pressures[2] < most * START[2]
        assert (found.best.pressures[:2] < START[:2]).all()
    assert free.best.merit < search.best.merit
    assert free.best.pressures is not None
    assert free.best.pressures[2] > 1.1 * START[2]  # the limit did hold the other one back


def test_a_design_that_cannot_be_made_is_a_step_back() -> None:
    search = Relief((0,), START, np.full(4, 1e3), START)
    first = search.propose()
    assert first is not None
    search.tell(first, None)
    second = search.propose()
    assert second is not None
    assert abs(second[0]) == pytest.approx(abs(first[0]) / 2)
    assert search.best is search.trials[0]


def test_it_ends_where_nothing_is_to_be_gained() -> None:
    """Depth makes no difference: after one look the factors are none."""
    search = Relief((0, 1), START, np.full(4, 1e3), START)
    assert searched(search, lambda depths: START, 6) < 6
    assert search.best is search.trials[0]


def test_depths_stay_in_bounds() -> None:
    search = Relief((0,), START, np.full(4, 1e3), START)
    searched(search, lambda d: START * np.exp(np.array([0.2, 0.0, 0.0, 0.0]) * d[0]), 20)
    assert search.best.depths[0] == pytest.approx(-8.0)
