"""Curves made of records keep the peak and lose the noise."""

import dataclasses
import json

import numpy as np
import pytest
from made_records import OPENLIMB, needs_openlimb, path_record, record
from scipy.interpolate import make_smoothing_spline

from limbfit.traces import find_touch_down, read_trace, regularise
from limbfit.traces.regularise import _fit_spline


@pytest.mark.parametrize("seed", range(2))
def test_the_peak_is_kept_and_the_noise_is_gone(seed):
    trace, truth = record(seed=seed)
    touch = find_touch_down(trace)
    curve = regularise(trace, touch)
    assert curve.peak_force_N == pytest.approx(truth(5.4 / 0.96), abs=0.03)
    assert curve.time_s[curve.peak_index] + touch.time_s == pytest.approx(5.4 / 0.96, abs=0.005)
    error = curve.force_N - truth(curve.time_s + touch.time_s)
    assert np.sqrt(np.mean(error**2)) < 0.015
    assert curve.noise_N == pytest.approx(0.03, rel=0.1)
    since = trace.time_s - touch.time_s
    line = np.interp(since, curve.knots_s, curve.knots_mm) + touch.displacement_mm
    left = (trace.displacement_mm - line)[(since >= 0.0) & (since <= curve.knots_s[-1])]
    assert np.std(left) == pytest.approx(0.005, rel=0.1)


def test_displacement_is_a_line_in_and_a_line_out():
    trace, _ = record()
    touch = find_touch_down(trace)
    curve = regularise(trace, touch)
    assert len(curve.knots_s) == 3
    assert curve.speed_load_mm_s == pytest.approx(0.96, rel=1e-3)
    assert curve.speed_unload_mm_s == pytest.approx(0.96, rel=1e-3)
    assert curve.depth_mm + touch.displacement_mm == pytest.approx(5.4, abs=2e-3)
    assert curve.knots_mm[[0, -1]] == pytest.approx([0, 0], abs=1e-9)
    assert curve.force_N[0] == pytest.approx(0, abs=1e-3)
    assert curve.force_N.min() >= 0


def test_given_smoothing_is_used():
    trace, _ = record()
    touch = find_touch_down(trace)
    roughness = [
        np.abs(np.diff(regularise(trace, touch, smoothing=lam).force_N, 2)).sum() for lam in (0.0, 1.0, 1e4)
    ]
    assert roughness[0] > 2 * roughness[1] > 2 * roughness[2]


def test_coarse_and_clean_records_are_not_blurred():
    trace, truth = record(rate=10, noise_N=0.0, noise_mm=0.0)
    touch = find_touch_down(trace)
    assert touch.displacement_mm == pytest.approx(0.4, abs=0.05)
    curve = regularise(trace, touch)
    assert curve.peak_force_N == pytest.approx(truth(5.4 / 0.96), rel=0.01)
    assert np.abs(curve.force_N - truth(curve.time_s + touch.time_s)).max() < 0.08 * curve.peak_force_N


def test_what_smoothing_does_to_another_force_is_known():
    noisy, _ = record(noise_N=0.05)
    touch = find_touch_down(noisy)
    smooth = regularise(noisy, touch, 0.1)
    times = smooth.resample(80).time_s

    def force(at):
        return 8 * np.sin(np.pi * np.clip(at / times[-1], 0, 1)) ** 1.5

    smoothed = smooth.curve.compute_response(times) @ force(times)
    raw = force(noisy.time_s - touch.time_s)
    other, clean = dataclasses.replace(noisy, force_N=raw), dataclasses.replace(touch, baseline_N=0.0)
    again = regularise(other, clean, 0.1)
    assert np.interp(times, again.time_s, again.force_N) == pytest.approx(np.maximum(smoothed, 0.0), abs=1e-3)
    assert np.abs(smoothed - force(times)).max() > 0.02  # the start is blunted


def test_smoothing_a_simulated_force_does_not_make_it_stiffer():
    """Between the few points of a simulation a convex force is less than straight: 0.06 % of the largest at
    every point were 5 % of gamma."""
    trace, truth = record(noise_N=0.0)
    touch = dataclasses.replace(find_touch_down(trace), time_s=trace.time_s[0], baseline_N=0.0)
    smooth = regularise(trace, touch, 1e-4)
    times = smooth.resample(80).time_s
    inside = times < 5.4 / 0.96
    exact = np.interp(times, smooth.time_s, smooth.force_N)
    error = smooth.curve.compute_response(times) @ truth(times + touch.time_s) - exact
    assert abs(error[inside].mean()) < 1e-4 * exact.max()


@pytest.mark.parametrize("power", [1.0, 0.5])
def test_cross_validation_chooses_the_spline_that_scipy_chooses(power):
    x, w = 3.0 * np.linspace(0, 1, 150) ** power, np.r_[np.full(149, 4.0), 6e5]
    y = np.sin(2 * x) + 0.1 * np.random.default_rng(3).standard_normal(150)
    ours, _ = _fit_spline(x, y, w, None, {})
    assert ours(x) == pytest.approx(make_smoothing_spline(x, y, w=w)(x), abs=1e-5)


def test_resampling_keeps_corners_peak_and_ends():
    curve = regularise((trace := record()[0]), find_touch_down(trace))
    few = curve.resample(60)
    assert abs(len(few.time_s) - 60) <= 2
    assert np.all(np.isin(curve.knots_s, few.time_s))
    assert few.peak_force_N == pytest.approx(curve.peak_force_N)
    assert few.time_s[-1] == curve.time_s[-1]
    assert np.all(np.diff(few.time_s) > 0)


def test_a_record_that_ends_at_its_peak_is_loading_only():
    trace, _ = record()
    trace = trace.select(trace.time_s < 5.4 / 0.96)
    curve = regularise(trace, find_touch_down(trace))
    assert np.isnan(curve.speed_unload_mm_s)
    assert curve.peak_index == len(curve.time_s) - 1
    assert len(curve.knots_s) == 2


def test_a_long_record_is_quick_and_alike():
    trace, _ = record(rate=20_000)
    short, _ = record(rate=500)
    assert len(trace.time_s) > 200_000
    curves = [regularise(t, find_touch_down(t)) for t in (trace, short)]
    assert curves[0].peak_force_N == pytest.approx(curves[1].peak_force_N, rel=0.01)


@needs_openlimb
@pytest.mark.parametrize("site", ["1", "4", "6"])
def test_foreign_records_keep_their_peak(site):
    trace = read_trace(OPENLIMB / "traces" / f"site-{site}.csv")
    facts = json.loads((OPENLIMB / "sites.json").read_text())["sites"][site]
    curve = regularise(trace, find_touch_down(trace))
    assert curve.peak_force_N == pytest.approx(facts["peak_force_N"], abs=0.03)
    assert curve.noise_N == pytest.approx(0.03, rel=0.1)
    assert curve.speed_load_mm_s == pytest.approx(facts["speed_mm_s"], rel=2e-3)


@pytest.mark.parametrize("samples", [3, 6, 11])
def test_a_hold_of_a_few_samples_is_smoothed_too(samples):
    hold = samples / 50.0
    trace, force = path_record([0.0, 1.5, 1.5 + hold, 3.0 + hold], [0.0, 5.4, 5.4, 0.0], rate=50.0)
    smooth = regularise(trace, find_touch_down(trace))
    assert smooth.peak_force_N == pytest.approx(force(np.array([1.5]))[0], rel=0.03)
