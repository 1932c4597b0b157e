"""What goes wrong with a record is told with its figures, and the touch-down knows no better than it can."""

from dataclasses import replace

import numpy as np
import pytest
from made_records import path_record, record, relaxing
from scipy.signal import lfilter

from editing import write_record
from limbfit.errors import TraceError
from limbfit.traces import COLUMNS, Trace, check_trace, interpret_record, read_trace

SLACK_MM, SPEED, NOISE_N = 0.4, 0.96, 0.03
TURN_S = 5.4 / SPEED
WITHIN = 1.96  # standard deviations


@pytest.fixture(scope="module")
def sound():
    """A record and its force without noise."""
    trace, clean = record()
    return trace, clean(trace.time_s)


def noisy(force):
    return force + NOISE_N * np.random.default_rng(1).standard_normal(len(force))


def only(found, kind):
    """The one remark on a record, which is of this kind."""
    (remark,) = found.warnings
    assert remark.kind == kind, remark
    return remark


def assert_within(found, touch_down_mm=SLACK_MM, most_sd_mm=0.6):
    touch = found.touch_down
    assert abs(touch.displacement_mm - touch_down_mm) < WITHIN * touch.uncertainty_mm
    assert touch.uncertainty_mm < most_sd_mm


def without(trace, start_s, end_s):
    return trace.select((trace.time_s < start_s) | (trace.time_s > end_s))


@pytest.mark.parametrize(("share", "before_noise"), [(0.6, True), (0.95, True), (0.8, False)])
def test_a_force_at_the_end_of_its_range(sound, share, before_noise):
    trace, clean = sound
    limit = share * clean.max()
    force = noisy(np.minimum(clean, limit)) if before_noise else np.minimum(trace.force_N, limit)
    found = interpret_record(replace(trace, force_N=force))
    remark = only(found, "saturation")
    assert remark.evidence["limit_N"] == pytest.approx(limit, rel=0.02)
    beyond = trace.time_s[clean > limit]
    assert remark.evidence["moved_mm"] == pytest.approx(SPEED * np.ptp(beyond), rel=0.35)
    assert f"stays at {remark.evidence['limit_N']:.3g} N" in remark.what
    assert_within(found, most_sd_mm=0.1)


@pytest.mark.parametrize(("start_s", "end_s"), [(2.0, 3.2), (5.1, 6.1), (7.0, 8.0)])
def test_lost_samples(sound, start_s, end_s):
    found = interpret_record(without(sound[0], start_s, end_s))
    remark = only(found, "gap")
    assert remark.evidence["start_s"] == pytest.approx(start_s, abs=0.003)
    assert remark.evidence["end_s"] == pytest.approx(end_s, abs=0.003)
    assert remark.evidence["moved_mm"] == pytest.approx(SPEED * (end_s - start_s), rel=0.05)
    assert_within(found, most_sd_mm=0.1)


def test_samples_lost_where_the_skin_is_met(sound):
    found = interpret_record(without(sound[0], 0.2, 0.8))
    assert "gap" in [remark.kind for remark in found.warnings]
    assert_within(found)


@pytest.mark.parametrize("start_s", [2.0, 4.9])
def test_a_force_that_froze(sound, start_s):
    trace, _ = sound
    force = trace.force_N.copy()
    held = (trace.time_s >= start_s) & (trace.time_s < start_s + 0.8)
    force[held] = force[held][0]
    found = interpret_record(replace(trace, force_N=force))
    remark = only(found, "frozen")
    assert remark.evidence["start_s"] == pytest.approx(start_s, abs=0.003)
    assert remark.evidence["end_s"] == pytest.approx(start_s + 0.8, abs=0.005)
    assert remark.evidence["force_N"] == force[held][0]
    assert_within(found, most_sd_mm=0.15)


@pytest.mark.parametrize("lag_s", [0.06, 0.2])
def test_a_force_that_comes_late(sound, lag_s):
    trace, clean = sound
    found = interpret_record(
        replace(trace, force_N=noisy(np.interp(trace.time_s - lag_s, trace.time_s, clean)))
    )
    remark = only(found, "lag")
    assert remark.evidence["lag_s"] == pytest.approx(lag_s, abs=0.02)
    assert "no passive tissue" in remark.what
    assert_within(found, most_sd_mm=1.3 * SPEED * lag_s)


def test_a_force_that_is_filtered(sound):
    """A low-pass filter of 0.1 s moves straight parts by as much, and takes the edge off a kink."""
    trace, clean = sound
    decay = np.exp(-0.002 / 0.1)
    found = interpret_record(replace(trace, force_N=noisy(lfilter([1.0 - decay], [1.0, -decay], clean))))
    assert 0.03 < only(found, "lag").evidence["lag_s"] < 0.12
    assert_within(found, most_sd_mm=0.15)


def test_a_person_who_breathes_in_the_force(sound):
    trace, clean = sound
    swing = 0.3 * np.sin(2 * np.pi * 0.25 * trace.time_s) * np.clip(clean / 0.3, 0.0, 1.0)
    found = interpret_record(replace(trace, force_N=noisy(clean + swing)))
    remark = only(found, "swing")
    assert remark.evidence["cycles_per_s"] == pytest.approx(0.25, abs=0.03)
    assert remark.evidence["swing_N"] == pytest.approx(0.3, rel=0.3)
    assert_within(found)


def test_a_person_whose_limb_moves(sound):
    trace, _ = sound
    fine = np.arange(0.0, trace.time_s[-1] + 0.002, 0.001)
    path = np.minimum(SPEED * fine, 10.8 - SPEED * fine) - SLACK_MM
    force = relaxing(fine, path + 0.3 * np.sin(2 * np.pi * 0.25 * fine + 1.0), p=1.3)
    found = interpret_record(replace(trace, force_N=noisy(np.interp(trace.time_s, fine, force))))
    assert only(found, "swing").evidence["cycles_per_s"] == pytest.approx(0.25, abs=0.04)
    assert_within(found, most_sd_mm=1.0)


@pytest.mark.parametrize("to_the_end", [True, False])
def test_a_sensor_that_was_zeroed_in_contact(sound, to_the_end):
    trace, clean = sound
    start = int(np.argmax(trace.displacement_mm >= SLACK_MM + 0.15))
    end = None if to_the_end else int(np.flatnonzero(trace.displacement_mm > SLACK_MM + 0.15)[-1])
    shifted = Trace(
        trace.time_s - trace.time_s[start],
        trace.displacement_mm - trace.displacement_mm[start],
        trace.force_N - clean[start],
    )
    found = interpret_record(shifted.select(slice(start, end)))
    remark = only(found, "start")
    assert remark.evidence["preload_N"] == pytest.approx(0.12, abs=0.05)
    assert "as if it had been zeroed in contact" in remark.what
    assert_within(found, touch_down_mm=-0.15, most_sd_mm=0.9)


@pytest.mark.parametrize("size", [0.5, -0.5, 0.2])
def test_a_force_that_jumps_does_not_drift(sound, size):
    trace, _ = sound
    found = interpret_record(replace(trace, force_N=trace.force_N + size * (trace.time_s >= 3.0)))
    remark = only(found, "step")
    assert remark.evidence["step_N"] == pytest.approx(size, abs=0.06)
    assert remark.evidence["time_s"] == pytest.approx(3.0, abs=0.005)
    assert f"jumps by {remark.evidence['step_N']:+.2g} N" in remark.what
    assert_within(found, most_sd_mm=0.1)


def test_a_jump_off_the_skin_is_adhesion():
    trace, _ = path_record([0.0, 5.4, 10.8, 11.8], [0.0, 5.4, 0.0, 0.0])
    sticks = (trace.time_s > 10.2) & (trace.time_s < 10.45)  # from 0.2 mm below the skin
    assert interpret_record(replace(trace, force_N=trace.force_N - 0.4 * sticks)).warnings == ()


@pytest.mark.parametrize("share", [0.1, -0.1])
def test_a_sensor_that_warms_up(share):
    trace, clean_at = path_record([0.0, 6.0, 12.0, 12.4], [0.0, 5.8, 0.0, 0.0], slack=0.8)
    clean = clean_at(trace.time_s)
    drift = share * clean.max() * (1.0 - np.exp(-trace.time_s / 3.0))
    found = interpret_record(replace(trace, force_N=trace.force_N + drift))
    remark = only(found, "drift")
    assert "not along a straight line" in remark.what
    assert remark.evidence["drift_start_N_per_s"] == pytest.approx(share * clean.max() / 3.0, rel=0.5)
    assert_within(found, touch_down_mm=0.8)
    left = found.trace.force_N - found.touch_down.baseline_N - clean
    assert np.abs(lfilter(np.full(50, 0.02), 1.0, left)[50:]).max() < 0.4 * abs(drift).max()


def test_a_force_in_coarse_steps_is_read(sound):
    trace, _ = sound
    found = interpret_record(replace(trace, force_N=np.round(trace.force_N / 0.25) * 0.25))
    remark = only(found, "resolution")
    assert remark.evidence["step_N"] == 0.25
    assert remark.what == "the force comes in steps of 0.25 N"
    assert_within(found)


@pytest.mark.parametrize(("size", "noise_mm"), [(0.1, 0.0), (0.05, 0.005)])
def test_a_displacement_in_coarse_steps_is_read(size, noise_mm):
    trace, _ = record(noise_mm=noise_mm)
    found = interpret_record(replace(trace, displacement_mm=np.round(trace.displacement_mm / size) * size))
    remark = only(found, "resolution")
    assert remark.evidence["step_mm"] == pytest.approx(size)
    assert remark.what == f"the displacement comes in steps of {size:g} mm"
    assert_within(found, most_sd_mm=0.1)


# --- times


def test_rounded_times_are_spread(sound, tmp_path):
    trace, _ = sound
    rounded = replace(trace, time_s=np.round(trace.time_s, 2))
    write_record(tmp_path / "a.csv", np.stack([getattr(rounded, name) for name in COLUMNS], axis=1))
    found = interpret_record(read_trace(tmp_path / "a.csv"))
    remark = only(found, "times")
    assert remark.evidence["time_step_s"] == pytest.approx(0.01)
    assert remark.evidence["doubled_times"] == np.sum(np.diff(rounded.time_s) == 0.0)
    assert np.abs(found.trace.time_s - trace.time_s).max() < 0.001
    assert_within(found, most_sd_mm=0.1)


def test_rounded_times_with_a_gap_stay_where_they_are(sound):
    gapped = without(sound[0], 2.0, 3.0)
    found = interpret_record(replace(gapped, time_s=np.round(gapped.time_s, 2)))
    assert [remark.kind for remark in found.warnings] == ["times", "gap"]
    assert np.abs(found.trace.time_s - gapped.time_s).max() < 0.011
    assert (np.diff(found.trace.time_s) > 0.0).all()


def test_rows_that_are_there_twice_are_left_out(sound):
    trace, _ = sound
    rows = np.sort(np.r_[np.arange(len(trace.time_s)), [5, 400, 400, 2000]])
    doubled = trace.select(rows)
    check_trace(doubled)
    found = interpret_record(doubled)
    assert only(found, "rows").evidence["doubled_rows"] == 4
    assert np.array_equal(found.trace.time_s, trace.time_s)
    assert np.array_equal(found.trace.force_N, trace.force_N)


def test_a_record_of_few_different_times_is_refused(sound):
    trace, _ = sound
    with pytest.raises(
        TraceError, match=r"time_s: only 12 different times for \d+ samples; export times with"
    ):
        check_trace(replace(trace, time_s=np.round(trace.time_s)))


def test_a_way_in_within_one_time_is_refused(sound):
    trace, _ = sound
    moving = np.abs(np.gradient(trace.displacement_mm)) > 1e-6
    inwards = moving & (np.arange(len(moving)) <= trace.displacement_mm.argmax())
    time = np.where(inwards, trace.time_s[inwards].min(), trace.time_s)
    with pytest.raises(TraceError, match=r"time_s: the indenter moves in by .* mm within one time"):
        check_trace(replace(trace, time_s=np.maximum.accumulate(time)))


# --- sound records


@pytest.mark.parametrize(
    "changes",
    [
        {"p": 1.0},
        {"p": 2.0},
        {"noise_N": 0.2, "seed": 2},
        {"noise_N": 0.002, "noise_mm": 0.001},
        {"rate": 100.0},
        {"rate": 25.0},
        {"offset": 3.0},
        {"speed": 5.0},
        {"wait": 2.0},
    ],
    ids=str,
)
def test_sound_records_have_no_remarks(changes):
    assert interpret_record(record(**changes)[0]).warnings == ()


MOVEMENTS = {
    "hold": ([0.0, 6.0, 36.0, 42.0], [0.0, 6.0, 6.0, 0.0]),
    "creeps on": ([0.0, 6.0, 16.0, 22.0], [0.0, 6.0, 6.1, 0.0]),
    "five cycles": (3.0 * np.arange(11), np.tile([0.0, 6.0], 6)[:11]),
    "slow way out": ([0.0, 6.0, 66.0], [0.0, 6.0, 0.0]),
    "way in": ([0.0, 6.0], [0.0, 6.0]),
    "sine": (np.linspace(0, 10, 101), 3.25 * (1.0 - np.cos(2 * np.pi * np.linspace(0, 1, 101)))),
}


@pytest.mark.parametrize("movement", MOVEMENTS)
def test_other_movements_have_no_remarks(movement):
    assert interpret_record(path_record(*MOVEMENTS[movement], rate=100.0)[0]).warnings == ()


def test_samples_that_are_missing_at_random_are_no_gap(sound):
    trace, _ = sound
    kept = np.random.default_rng(0).random(len(trace.time_s)) > 0.3
    assert interpret_record(trace.select(kept)).warnings == ()
