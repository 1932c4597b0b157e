"""Noise of a record: what averaging leaves of it, and what a doubtful touch-down adds."""

import numpy as np
import pytest

from limbfit.autoregressive import compute_block_covariance
from limbfit.identify.fit.objective import MeasuredCurve, SiteResponse
from limbfit.identify.uncertainty.discrepancy import ResidualModel, compute_matern
from limbfit.identify.uncertainty.noise import (
    SKIN_CORRELATION_MM,
    SiteNoise,
    compute_depth_slope,
    compute_skin_similarity,
    estimate_curve_noise,
    estimate_record_noise,
)


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
    assert compute_block_covariance(1.0, lag, np.full(n, samples)) == pytest.approx(
        average @ full @ average.T
    )


def test_the_covariance_of_means_of_unequal_numbers():
    samples = np.array([3, 10, 1, 6])
    index = np.arange(samples.sum())
    full = 0.8 ** np.abs(index[:, None] - index[None, :])
    average = np.repeat(np.diag(1 / samples), samples, axis=1)
    assert compute_block_covariance(1.0, 0.8, samples) == pytest.approx(average @ full @ average.T)


def test_a_record_tells_its_noise():
    rng = np.random.default_rng(0)
    force, depth = np.linspace(0, 10, 40), np.linspace(0, 4, 40)
    found = estimate_record_noise("a", np.linspace(0, 4, 40), 0.05 * drift(rng, 4000, 0.6), force, depth)
    assert found.sd_N == pytest.approx(0.05, rel=0.1)
    assert found.autocorrelation == pytest.approx(0.6, abs=0.05)
    # Means of 100 samples, of which (1 - 0.6) / (1 + 0.6) count.
    assert np.sqrt(found.covariance[0, 0]) == pytest.approx(0.05 * np.sqrt(4 / 100), rel=0.1)


def test_a_doubtful_touch_down_moves_the_whole_curve():
    depth = np.r_[np.linspace(0, 4, 20), np.linspace(4, 0, 20)[1:]]
    force = depth**2
    slope = compute_depth_slope(np.arange(39.0), depth, force)
    assert slope == pytest.approx(2 * depth, abs=0.25)
    sure = estimate_record_noise("a", np.arange(39.0), np.zeros(400), force, depth)
    doubtful = estimate_record_noise("a", np.arange(39.0), np.zeros(400), force, depth, 0.05)
    assert doubtful.covariance - sure.covariance == pytest.approx(0.05**2 * np.outer(slope, slope))


def test_a_tissue_that_has_let_go_does_not_feel_the_touch_down():
    depth = np.r_[np.linspace(0, 4, 20), np.linspace(4, 0, 20)[1:]]
    relaxed = np.r_[np.linspace(0, 4, 20) ** 2, np.maximum(np.linspace(4, -2, 20)[1:], 0.0) ** 2]
    slope = compute_depth_slope(np.arange(39.0), depth, relaxed)
    assert (slope[relaxed == 0][1:] == 0).all()
    half = np.r_[relaxed[:20], relaxed[:19][::-1] / 2]
    assert compute_depth_slope(np.arange(39.0), depth, half)[20:-1] == pytest.approx(slope[1:19][::-1] / 2)


@pytest.mark.parametrize("creep_mm", [0.0, 0.006])
def test_a_creeping_hold_has_the_slope_of_its_depth(creep_mm):
    """Its own dF/dd is that of relaxation over micrometres: thousands of N/mm."""
    times = np.r_[np.linspace(0, 2, 20), np.linspace(2, 32, 60)[1:], np.linspace(32, 34, 20)[1:]]
    depth = np.interp(times, [0, 2, 32, 34], [0, 4, 4 + creep_mm, 0])
    force = depth**2 * np.where(times <= 2, 1.0, 0.5 + 0.5 * np.exp(-(times - 2)))
    slope = compute_depth_slope(times, depth, force)
    held = (times > 2) & (times <= 32)
    assert slope[held] == pytest.approx(8.0 * force[held] / 16.0, rel=0.06)
    assert slope[times < 2] == pytest.approx(2 * depth[times < 2], abs=0.25)


def test_later_cycles_have_the_slope_of_what_was_new():
    times = np.linspace(0, 6, 121)
    depth = np.interp(times, np.arange(7.0), [0, 4, 1, 4, 1, 5, 0])
    share = np.where(times <= 1, 1.0, 0.8)
    slope = compute_depth_slope(times, depth, share * depth**2)
    old = (times > 1) & (depth <= 4)
    assert slope[old] == pytest.approx(share[old] * 2 * depth[old], abs=0.4)
    new = (depth > 4.2) & (times < 5)
    assert slope[new] == pytest.approx(0.8 * 2 * depth[new], rel=0.02)


def test_points_that_are_close_share_the_samples():
    """Half of the points in a tenth of the time have a tenth of the samples."""
    times = np.r_[np.linspace(0, 1, 20), np.linspace(1, 10, 21)[1:]]
    depth = np.interp(times, [0, 1, 10], [0, 4, 4])
    noise = np.random.default_rng(2).standard_normal(5000)
    sd = np.sqrt(np.diag(estimate_record_noise("a", times, noise, depth, depth).covariance))
    assert sd[5] == pytest.approx(1 / np.sqrt(500 / 19), rel=0.1)
    assert sd[30] == pytest.approx(1 / np.sqrt(4500 / 20), rel=0.1)


def test_scatter_of_a_curve_is_told_from_its_bend():
    rng = np.random.default_rng(1)
    bend = np.sin(np.linspace(0, 3, 400))
    measured = MeasuredCurve("a", 10 + bend)
    response = SiteResponse(10 + 2 * bend + 0.01 * rng.standard_normal(400), np.zeros((400, 0)))
    (found,) = estimate_curve_noise([response], [measured])
    assert found.sd_N == pytest.approx(0.01, rel=0.15)


def test_a_misfit_is_alike_at_points_that_are_near_and_of_its_own_along_each_component() -> None:
    points = np.array([[0.0, 0.0, 0.0], [SKIN_CORRELATION_MM, 0.0, 0.0], [0.0, 0.0, 0.0]])
    alike = compute_skin_similarity(points, np.array([0, 0, 2]))
    near = np.exp(-1.0)
    assert alike == pytest.approx(np.array([[1.0, near, 0.0], [near, 1.0, 0.0], [0.0, 0.0, 1.0]]))
    for times in (np.full(3, 2.0), np.array([0.0, 1.0, 4.0])):  # one scan, and several times
        noise = SiteNoise("a+surface", times, np.eye(3), 1.0, 0.0, unit="mm", similarity=alike)
        model = ResidualModel((noise,), np.array([2.0]), np.array([0.1]), 0.35, 1.0)
        shape = np.ones((3, 3)) if np.ptp(times) == 0.0 else compute_matern(times, 0.35)
        assert model.misfit_covariance(0) == pytest.approx(0.04 * shape * alike)
