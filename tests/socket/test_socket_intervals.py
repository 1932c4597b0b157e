"""Intervals of a socket's results: what they come from, against drawn parameters; doubts in its words."""

from __future__ import annotations

import numpy as np
import pytest

from limbfit.fe import Doubt
from limbfit.identify.uncertainty.uncertainty import NORMAL_95
from limbfit.pipeline.experiments.socket_intervals import Spread, spread_facts
from limbfit.pipeline.experiments.socket_limb import warning

NAMES = ("skin.c_kPa", "skin.tau_s", "liner.c_kPa")
SLOPES = np.array([3.0, -1.0, 2.0])
COVARIANCE = np.array([[0.04, -0.015], [-0.015, 0.09]])


def test_interval_and_shares_are_those_of_drawn_parameters():
    spread = Spread(NAMES, (0, 1), COVARIANCE)
    interval, shares, changes = spread.told(50.0, SLOPES)
    draws = np.random.default_rng(0).multivariate_normal(np.zeros(2), COVARIANCE, 200_000)
    values = 50.0 + draws @ SLOPES[:2]
    assert (interval[1] - interval[0]) / 2 == pytest.approx(NORMAL_95 * values.std(), rel=0.01)
    for i, name in enumerate(NAMES[:2]):
        left = values - np.polyval(np.polyfit(draws[:, i], values, 1), draws[:, i])
        assert shares[name] == pytest.approx(100.0 * (1.0 - left.var() / values.var()), abs=0.5)
    assert list(shares) == ["skin.c_kPa", "skin.tau_s"]  # largest first; the liner was not identified
    assert changes["liner.c_kPa"] == pytest.approx(2.0 * np.log(1.1))


def test_what_is_stored_has_the_same_keys_with_and_without_intervals():
    spread = Spread(NAMES, (0, 1), COVARIANCE)
    known = spread_facts(spread, "settling_", "mm", 5.0, SLOPES)
    assert known.keys() == spread_facts(None, "settling_", "mm", 5.0, None).keys()
    assert known["settling_interval_mm"][0] >= 0.0


def test_folded_elements_are_told_with_a_remedy_that_a_socket_has():
    found = warning(Doubt("folded", "27 elements are inside out: a rounded indenter", 27, 0.0, 0.0))
    assert found.startswith("27 elements of the limb")
    assert "socket.edge_mm" in found
    assert "indenter" not in found
    assert warning(Doubt("unsettled", "use more steps", 1, 0.0, 0.0)) == "use more steps"
