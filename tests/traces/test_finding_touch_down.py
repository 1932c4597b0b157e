"""Touch-down is found under noise, in records of others and where it is stated."""

import numpy as np
import pytest
from made_records import OPENLIMB, RELAXATION, needs_openlimb, needs_relaxation, record

from limbfit.errors import TraceError
from limbfit.phases import find_boundaries
from limbfit.traces import Trace, find_touch_down, read_trace, regularise, touch_down_at


@pytest.mark.parametrize("p", [1.0, 2.0])
@pytest.mark.parametrize("slack", [0.0, 0.4, 2.0])
def test_touch_down_is_found_under_noise(p, slack):
    for seed in range(2):
        trace, _ = record(slack=slack, p=p, seed=seed)
        touch = find_touch_down(trace)
        assert abs(touch.displacement_mm - slack) < max(0.1, 2.5 * touch.uncertainty_mm), touch
        assert touch.uncertainty_mm < 0.12
        assert touch.time_s == pytest.approx(touch.displacement_mm / 0.96, abs=0.01)


def test_touch_down_does_not_mind_an_offset_or_a_wait_before_the_ramp():
    for seed in range(2):
        trace, _ = record(offset=0.2, wait=1.5, seed=seed)
        touch = find_touch_down(trace)
        assert touch.displacement_mm == pytest.approx(0.4, abs=0.1)
        assert touch.time_s == pytest.approx(1.5 + 0.4 / 0.96, abs=0.1)
        assert touch.baseline_N == pytest.approx(0.2, abs=0.01)
        assert not touch.in_contact_at_start


def test_more_noise_means_more_uncertainty_and_no_bias():
    errors, stated = [], []
    for seed in range(8):
        touch = find_touch_down(record(noise_N=0.1, seed=seed)[0])
        errors.append(touch.displacement_mm - 0.4)
        stated.append(touch.uncertainty_mm)
    assert abs(np.mean(errors)) < 0.06
    assert 0.5 < np.mean(stated) / np.sqrt(np.mean(np.square(errors))) < 3
    assert np.mean(stated) > 2 * find_touch_down(record(noise_N=0.01)[0]).uncertainty_mm


@needs_openlimb
@pytest.mark.parametrize("site", ["1", "4", "6"])
def test_touch_down_of_foreign_records(site):
    """Between FEBio's last point without force and the first with more than 10 mN, to 0.1 mm."""
    trace = read_trace(OPENLIMB / "traces" / f"site-{site}.csv")
    points = np.loadtxt(OPENLIMB / "febio" / f"site-{site}.csv", delimiter=",", skiprows=1)
    first = int(np.argmax(points[:, 2] > 0.01))
    before = int(np.flatnonzero(points[:first, 2] == 0)[-1])
    touch = find_touch_down(trace)
    assert points[before, 1] - 0.1 < touch.displacement_mm < points[first, 1] + 0.05
    assert touch.uncertainty_mm < 0.1


def test_a_force_that_comes_only_on_the_way_out_is_refused():
    trace, _ = record()
    after = trace.time_s > 6.0
    with pytest.raises(TraceError, match="does not rise while the indenter goes in"):
        find_touch_down(Trace(trace.time_s, trace.displacement_mm, np.where(after, 1.0, -0.1 * trace.time_s)))


@needs_relaxation
def test_the_late_touch_down_of_the_poor_run_is_found():
    touch = find_touch_down(read_trace(RELAXATION / "230403-FF1A.csv"))
    assert touch.displacement_mm == pytest.approx(3.4, abs=0.2)
    assert not touch.in_contact_at_start


def test_stated_touch_down_and_peak_are_taken():
    trace = record(slack=0.4)[0]
    found = find_touch_down(trace)
    stated = touch_down_at(trace, found.time_s + 0.3)
    assert stated.displacement_mm == pytest.approx(found.displacement_mm + 0.3 * 0.96, abs=0.01)
    assert stated.baseline_N == found.baseline_N
    turn = 5.4 / 0.96
    later = regularise(trace, stated, peak_s=turn + 0.1)
    assert find_boundaries(later.phases)[1] == pytest.approx(turn + 0.1 - stated.time_s)
    assert later.depth_mm == pytest.approx(5.0 - 0.3 * 0.96, abs=0.12)
    assert find_boundaries(regularise(trace, found).phases)[1] == pytest.approx(turn - found.time_s, abs=0.01)


def test_stated_times_off_the_record_are_refused():
    trace = record()[0]
    with pytest.raises(TraceError, match=r"touch_down_s: 7 s is not on the way in; give a time from 0"):
        touch_down_at(trace, 7.0)
    with pytest.raises(TraceError, match=r"peak_s: the way in cannot end at 30 s; the record turns at 5\.6"):
        regularise(trace, find_touch_down(trace), peak_s=30.0)
