"""Holds, rates and cycles: every phase of a record is found and smoothed by itself."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from made_records import RELAXATION, needs_relaxation, path_record

from limbfit.errors import TraceError
from limbfit.phases import find_boundaries
from limbfit.traces import TouchDown, Trace, check_trace, find_touch_down, read_trace, regularise

PROTOCOLS = {
    "creeping hold": ([0, 5, 35, 40], [0, 5.4, 5.406, 0], "load hold unload"),
    "long hold": ([0, 0.5, 60.5, 61], [0, 5.4, 5.4, 0], "load hold unload"),
    "two rates": ([0, 1, 6, 7], [0, 3, 5.4, 0], "load load unload"),
    "steps": ([0, 3, 13, 16, 26, 30], [0, 3, 3, 5.4, 5.4, 0], "load hold load hold unload"),
    "cycles": ([0, 5, 10, 15, 20], [0, 5.4, 0, 5.4, 0], "load unload load unload"),
    "cycles in contact": ([0, 5, 8, 11, 16], [0, 5.4, 2, 5.4, 0], "load unload load unload"),
    "growing cycles": ([0, 2, 4, 8, 12], [0, 2, 0, 4, 0], "load unload load unload"),
}


@cache
def follow(name: str):
    """The record of a protocol: its touch-down, its curve, and the true force over time."""
    trace, truth = path_record(*PROTOCOLS[name][:2])
    check_trace(trace)
    touch = find_touch_down(trace)
    return touch, regularise(trace, touch), truth


@pytest.mark.parametrize("name", PROTOCOLS)
def test_every_phase_of_a_record_is_found_and_smoothed_by_itself(name):
    corners_s, _, expected = PROTOCOLS[name]
    touch, curve, truth = follow(name)
    assert touch.displacement_mm == pytest.approx(0.4, abs=0.1)
    assert [phase.kind for phase in curve.phases] == expected.split()
    ends = find_boundaries(curve.phases)[1:-1] + touch.time_s
    assert ends == pytest.approx(corners_s[1:-1], abs=0.01)
    error = curve.force_N - truth(curve.time_s + touch.time_s)
    assert np.sqrt(np.mean(error**2)) < 0.01
    assert np.abs(error).max() < 0.1
    for at in ends:  # the corners are kept
        assert np.interp(at - touch.time_s, curve.time_s, curve.force_N) == pytest.approx(truth(at), abs=0.06)


def test_cycles_that_leave_the_skin_have_no_force_between():
    touch, curve, _ = follow("cycles")
    assert curve.knots_mm[2] == pytest.approx(-touch.displacement_mm, abs=0.01)
    away = np.abs(curve.time_s + touch.time_s - 10.0) < 0.3
    assert curve.force_N[away].max() < 0.03
    assert curve.time_s[-1] + touch.time_s == pytest.approx(19.6, abs=0.1)


def test_a_long_hold_takes_no_points_of_comparison_from_the_ramps():
    even = follow("long hold")[1].resample(81)
    counts = [
        int(((even.time_s > phase.start_s) & (even.time_s <= phase.end_s)).sum()) for phase in even.phases
    ]
    assert counts == [40, 30, 40]
    held = np.diff(even.time_s[41:71])
    assert (np.diff(held) > 0).all()  # densest where most relaxes
    assert held[0] < 0.1


def test_the_start_of_a_relaxation_is_smoothed_alike_in_record_and_simulation():
    """In a hold of 120 s, with a time of relaxation of half a second: of both within 0.3 % of the peak."""
    trace, truth = path_record(*PROTOCOLS["long hold"][:2], noise_N=0.005)
    touch = find_touch_down(trace)
    even = regularise(trace, touch).resample(81)
    true = truth(even.time_s + touch.time_s)
    start = even.phases[1].start_s
    early = (even.time_s > start) & (even.time_s < start + 2.0)
    assert early.sum() >= 5
    simulated = even.curve.compute_response(even.time_s) @ true
    assert np.abs(even.force_N - true)[early].max() < 0.003 * true.max()
    assert np.abs(simulated - even.force_N)[early].max() < 0.003 * true.max()


def test_the_response_of_the_smoothing_follows_every_phase():
    _, curve, _ = follow("cycles in contact")
    times = curve.resample(81).time_s
    matrix = curve.curve.compute_response(times)
    force = np.interp(times, curve.knots_s, curve.knots_mm)
    assert matrix @ force == pytest.approx(force, abs=0.03 * force.max())


def test_a_stated_peak_is_that_of_the_first_cycle():
    trace, _ = path_record(*PROTOCOLS["cycles in contact"][:2])
    touch, _, _ = follow("cycles in contact")
    moved = regularise(trace, touch, smoothing=0.1, peak_s=5.05)
    assert moved.peak_s + touch.time_s == pytest.approx(5.05)
    assert len(moved.phases) == 4


def test_a_displacement_that_wanders_is_refused():
    time = np.arange(0, 40, 0.04)
    wander = np.abs(0.2 * np.cumsum(np.random.default_rng(1).standard_normal(time.size)))
    with pytest.raises(TraceError, match=r"displacement: the displacement wanders: 40 .* cut out the part"):
        regularise(Trace(time, wander, wander), TouchDown(0.0, 0.0, 0.1, 0.0, True))


def test_a_record_that_is_only_held_or_drawn_back_is_refused():
    time = np.linspace(0, 10, 1000)
    with pytest.raises(TraceError, match="displacement: the displacement never advances"):
        find_touch_down(Trace(time, 5.0 - 0.5 * time, time))


def fast_and_held():
    """5 mm in a second, held for 30 s; half of the force relaxes within a second."""
    rng = np.random.default_rng(0)
    time = np.arange(0.0, 32.6, 0.002)
    depth = np.interp(time, [0.0, 1.1, 31.1, 32.2], [-0.4, 5.0, 5.0, -0.4])
    held = np.clip(time - 1.1, 0.0, None)
    force = 0.02 * np.clip(depth, 0.0, None) ** 2 * (1.0 + np.exp(-held / 0.3)) * (time < 31.2)
    noise = 0.05 * rng.standard_normal(time.size), 0.01 * rng.standard_normal(time.size)
    return Trace(time, depth + 0.4 + noise[1], force + noise[0])


def test_a_fast_ramp_with_a_long_hold_is_read():
    """Half of the first means are of a force that is there already."""
    trace = fast_and_held()
    check_trace(trace)
    curve = regularise(trace, find_touch_down(trace))
    assert [phase.kind for phase in curve.phases] == ["load", "hold", "unload"]
    assert curve.peak_force_N == pytest.approx(1.0, abs=0.06)


def test_its_sign_is_still_looked_at():
    trace = fast_and_held()
    with pytest.raises(TraceError, match="pushing must be positive: change the sign"):
        check_trace(replace(trace, force_N=-trace.force_N))


@needs_relaxation
@pytest.mark.parametrize("name", ["230403-FF1A", "230403-RDG1A", "230411-RDG1C"])
def test_real_ramp_and_hold_records(name):
    trace = read_trace(RELAXATION / f"{name}.csv")
    touch = find_touch_down(trace)
    curve = regularise(trace, touch)
    assert curve.peak_force_N == pytest.approx(trace.force_N.max() - touch.baseline_N, rel=0.02)
    assert np.isnan(curve.speed_unload_mm_s)
    ramp = np.max(np.diff(trace.displacement_mm) / np.diff(trace.time_s))
    assert 0.85 * ramp < curve.speed_load_mm_s < ramp
    end = trace.force_N[-5:].mean() - touch.baseline_N
    assert curve.force_N[-1] == pytest.approx(end, rel=0.02)
    held = np.interp(np.arange(curve.peak_s, curve.time_s[-1], 0.5), curve.time_s, curve.force_N)
    assert np.all(np.diff(held) < 0)
