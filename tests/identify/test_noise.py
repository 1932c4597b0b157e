"""Noise of a record: what averaging leaves of it, and what a doubtful touch-down adds."""

from __future__ import annotations

import numpy as np
import pytest

from limbfit.identify.noise import block_covariance, curve_noise, depth_slope, record_noise


def drift(rng, n, lag):
    x = np.empty(n)
    x[0] = rng.standard_normal()
    for k in range(1, n):
        x[k] = lag * x[k - 1] + np.sqrt(1 - lag**2) * rng.standard_normal()
    return x


@pytest.mark.parametrize("lag", [0.0, 0.7, 0.95])
def test_the_covariance_of_means_is_that_of_sampled_means(lag):
    n, samples = 4, 6
    index = np.arange(n * samples)
    full = lag ** np.abs(index[:, None] - index[None, :])
    average = np.kron(np.eye(n), np.full((1, samples), 1 / samples))
    assert block_covariance(1.0, lag, samples, n) == pytest.approx(average @ full @ average.T)


def test_a_record_tells_its_noise():
    rng = np.random.default_rng(0)
    force, depth = np.linspace(0, 10, 40), np.linspace(0, 4, 40)
    found = record_noise("a", np.linspace(0, 4, 40), 0.05 * drift(rng, 4000, 0.6), force, depth)
    assert found.sd_N == pytest.approx(0.05, rel=0.1)
    assert found.autocorrelation == pytest.approx(0.6, abs=0.05)
    # Means of 100 samples, of which (1 - 0.6) / (1 + 0.6) count.
    assert np.sqrt(found.covariance[0, 0]) == pytest.approx(0.05 * np.sqrt(4 / 100), rel=0.1)


def test_a_doubtful_touch_down_moves_the_whole_curve():
    depth = np.r_[np.linspace(0, 4, 20), np.linspace(4, 0, 20)[1:]]
    force = depth**2
    slope = depth_slope(depth, force)
    assert slope == pytest.approx(2 * depth, abs=0.25)
    sure = record_noise("a", np.arange(39.0), np.zeros(400), force, depth)
    doubtful = record_noise("a", np.arange(39.0), np.zeros(400), force, depth, 0.05)
    assert doubtful.covariance - sure.covariance == pytest.approx(0.05**2 * np.outer(slope, slope))


def test_a_tissue_that_has_let_go_does_not_feel_the_touch_down():
    depth = np.r_[np.linspace(0, 4, 20), np.linspace(4, 0, 20)[1:]]
    relaxed = np.r_[np.linspace(0, 4, 20) ** 2, np.maximum(np.linspace(4, -2, 20)[1:], 0.0) ** 2]
    slope = depth_slope(depth, relaxed)
    assert (slope[relaxed == 0][1:] == 0).all()
    half = np.r_[relaxed[:20], relaxed[:19][::-1] / 2]
    assert depth_slope(depth, half)[20:-1] == pytest.approx(slope[1:19][::-1] / 2)


def test_scatter_of_a_curve_is_told_from_its_bend():
    rng = np.random.default_rng(1)
    bend = np.sin(np.linspace(0, 3, 400))
    found = curve_noise("a", np.arange(400.0), bend + 0.01 * rng.standard_normal(400), 10 + bend)
    assert found.sd_N == pytest.approx(0.01, rel=0.15)
