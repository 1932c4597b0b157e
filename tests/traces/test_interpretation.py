"""Records that are not what they seem: mended with a remark, or refused in one line."""

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest

from conftest import write_trace
from editing import append, edit, rewrite
from limbfit import check_study, load_study
from limbfit.errors import InputError, StudyError, TraceError
from limbfit.traces import Trace, check_trace, find_touch_down, interpret_record

pytestmark = pytest.mark.usefixtures("commands_unasked")
NOISE_N = 0.03


def record(seed=0, clear=0.5, depth=6.0, speed=1.0, peak=8.0, after=1.0):
    """A record of 500 Hz that turns and comes back to where it started, and what it is without noise."""
    random = np.random.default_rng(seed)
    turn = (clear + depth) / speed
    time = np.arange(0.0, 2 * turn + after, 0.002)
    path = np.interp(time, [0, turn, 2 * turn], [0, clear + depth, 0])
    force = peak * (np.maximum(path - clear, 0.0) / depth) ** 1.5
    noisy = Trace(time, path + 0.005 * random.standard_normal(time.size),
                  force + NOISE_N * random.standard_normal(time.size))  # fmt: skip
    return noisy, force


def kinds(found):
    return [remark.kind for remark in found.warnings]


def test_a_sound_record_is_left_alone():
    for seed in range(3):
        trace, _ = record(seed)
        found = interpret_record(trace)
        assert found.trace is trace
        assert found.warnings == ()
        assert found.touch_down == find_touch_down(trace)


# --- drift


@pytest.mark.parametrize("drift", [0.05, -0.05])
def test_a_force_that_drifts_is_set_straight(drift):
    trace, clean = record()
    found = interpret_record(replace(trace, force_N=trace.force_N + drift * trace.time_s))
    assert kinds(found) == ["drift"]
    assert found.warnings[0].evidence["drift_N_per_s"] == pytest.approx(drift, rel=0.05)
    assert f"{drift:+.2g} N/s" in found.warnings[0].what
    mended = found.trace.force_N - found.touch_down.baseline_N
    assert np.abs(np.mean((mended - clean)[-400:])) < 0.02
    assert found.touch_down.displacement_mm == pytest.approx(0.5, abs=3 * found.touch_down.uncertainty_mm)


def test_a_sensor_that_drifts_away_is_refused():
    trace, _ = record()
    with pytest.raises(
        TraceError, match=r"force_N: the force drifts by \+0\.3 N/s.*; let the sensor warm up"
    ):
        interpret_record(replace(trace, force_N=trace.force_N + 0.3 * trace.time_s))


# --- spikes


def spiked(values, size, per_mille=1.0):
    random, n = np.random.default_rng(3), len(values)
    places = random.choice(n, round(n * per_mille / 1000), replace=False)
    spikes = values.copy()
    spikes[places] += size * random.choice([-1, 1], len(places))
    return spikes, places


@pytest.mark.parametrize(
    ("column", "size", "most"),
    [("force_N", 1.0, 6 * NOISE_N), ("force_N", 500.0, 6 * NOISE_N), ("displacement_mm", 2.0, 0.05)],
)
def test_spikes_are_taken_out_and_counted(column, size, most):
    trace, clean = record()
    values, places = spiked(getattr(trace, column), size)
    found = interpret_record(replace(trace, **{column: values}))
    assert kinds(found) == ["spikes"]
    assert found.warnings[0].evidence["spikes"] == len(places)
    assert f"{len(places)} of {len(values)} samples of the {column.split('_')[0]}" in found.warnings[0].what
    mended = getattr(found.trace, column)
    truth = clean if column == "force_N" else trace.displacement_mm
    assert np.abs(mended - truth).max() < most
    assert np.array_equal(np.flatnonzero(mended != values), np.sort(places))


def test_one_spike_in_a_short_record_is_taken_out():
    trace, clean = record()
    short = trace.select(slice(None, None, len(clean) // 60))
    force = short.force_N.copy()
    force[30] += 5.0
    found = interpret_record(replace(short, force_N=force))
    assert "spikes" in kinds(found)
    assert abs(found.trace.force_N[30] - short.force_N[30]) < 0.3


def test_a_broken_cable_is_refused():
    trace, _ = record()
    force, _ = spiked(trace.force_N, 5.0, per_mille=30)
    with pytest.raises(
        TraceError, match="samples stick out from their neighbours; check the sensor and its cable"
    ):
        interpret_record(replace(trace, force_N=force))


def test_a_corner_is_no_spike():
    """At 10 Hz a peak is three samples."""
    trace, clean = record()
    few = replace(trace, force_N=clean).select(slice(None, None, 50))
    assert interpret_record(few).trace is few


# --- in contact


def cut(trace, at_mm):
    """The record as if it had been started with the indenter ``at_mm``, and ended there."""
    top = int(trace.displacement_mm.argmax())
    start = int(np.argmax(trace.displacement_mm >= at_mm))
    end = top + int(np.argmax(trace.displacement_mm[top:] <= at_mm))
    shifted = Trace(trace.time_s - trace.time_s[start], trace.displacement_mm - at_mm, trace.force_N)
    return shifted.select(slice(start, end))


@pytest.mark.parametrize("at_mm", [2.5, 4.5])
def test_a_record_that_begins_in_full_contact_is_refused(at_mm):
    with pytest.raises(TraceError, match=r"force_N: the record begins in contact: .*; zero the sensor clear"):
        interpret_record(cut(record()[0], at_mm))


def test_a_sensor_that_was_zeroed_in_contact_is_refused():
    trace, _ = record()
    start = int(np.argmax(trace.displacement_mm >= 2.5))
    pressed = replace(trace, force_N=trace.force_N - trace.force_N[start]).select(slice(start, None))
    with pytest.raises(TraceError, match=r"begins in contact: .* N when it is released"):
        interpret_record(pressed)


def test_a_record_that_starts_on_the_skin_is_taken_with_a_remark():
    found = interpret_record(record(clear=0.0)[0])
    assert kinds(found) == ["start"]
    assert "no approach" in found.warnings[0].what


def test_a_sensor_with_an_offset_is_no_contact():
    trace, _ = record()
    found = interpret_record(replace(trace, force_N=trace.force_N + 0.6))
    assert found.warnings == ()
    assert found.touch_down.baseline_N == pytest.approx(0.6, abs=0.02)


def fast(seed):
    """A weak record at 4.8 mm/s: a twentieth of its peak is but 1.5 times the noise."""
    trace, _ = record(seed, clear=0.4, depth=3.0, speed=4.8, peak=1.5, after=0.4)
    noise = 0.04 * np.random.default_rng([seed, 1]).standard_normal(trace.time_s.size)
    return replace(trace, force_N=trace.force_N + noise)


@pytest.mark.parametrize("seed", [0, 8, 43, 51])
def test_noise_is_no_contact(seed):
    """Three of these look like contact where the noise is not counted."""
    assert kinds(interpret_record(fast(seed))) in ([], ["start"])


def test_contact_is_seen_in_noise():
    for seed in range(3):
        with pytest.raises(TraceError, match="begins in contact"):
            interpret_record(cut(fast(seed), 1.9))


# --- what `limbfit check` says


@pytest.fixture
def study(pristine, tmp_path):
    """The stump, and a smoothing that need not be chosen anew for each record."""
    folder = shutil.copytree(pristine, tmp_path / "study")
    append(folder, "[traces]\nsmoothing = 0.1\n")
    return folder


def checked(study):
    return check_study(load_study(study), listener=lambda event: None)


def test_check_tells_what_was_mended_and_what_is_wrong_and_not_mended(study):
    def drift(table):
        table[:, 2] += 0.05 * table[:, 0]
        table[[300, 900], 2] += 5.0
        return table

    def cut_off(table):
        table[:, 2] = np.minimum(table[:, 2], 0.7 * table[:, 2].max())
        return table[(table[:, 0] < 2.0) | (table[:, 0] > 2.6)]

    rewrite(study / "1.csv", drift)
    rewrite(study / "2.csv", cut_off)
    found = checked(study)
    told = {(*flag["sites"], flag["kind"]): flag["text"] for flag in found["flags"]}
    assert list(told)[:2] == [("1", "spikes"), ("1", "drift")]
    assert set(told) == {("1", "spikes"), ("1", "drift"), ("2", "gap"), ("2", "saturation")}
    assert "site 1: the force drifts by +0.05" in told["1", "drift"]
    assert any("site 2: the force stays at" in text for text in told.values())
    json.dumps(found)


def test_check_names_the_file_of_a_record_that_begins_in_contact(study):
    rewrite(study / "1.csv", lambda table: table[200:800])
    with pytest.raises(InputError, match=r"1\.csv.*force_N: the record begins in contact"):
        checked(study)


def test_check_says_that_a_record_has_loading_only(study):
    rewrite(study / "1.csv", lambda table: table[: int(table[:, 1].argmax())])
    found = checked(study)
    assert any(fact.startswith("site 1:") and "loading only" in fact for fact in found["facts"])
    assert found["flags"] == []


def test_two_sites_at_one_place_with_different_records_are_told(study):
    edit(study, "position = [0.0, 40.0, 50.0]", "position = [40.0, 0.0, 60.0]")
    sound = checked(study)  # repeats of one record
    assert sound["flags"] == []
    assert not any("loading only" in fact for fact in sound["facts"])
    write_trace(study / "2.csv", peak=9.0)
    (flag,) = checked(study)["flags"]
    assert flag["sites"] == ["1", "2"]
    assert flag["kind"] == "place"
    assert flag["text"].startswith("sites 1 and 2: they are at one place (0.0 mm apart)")


# --- settings that cannot be meant


@pytest.mark.parametrize("ratio", ["1e9", "0.5"])
def test_a_bulk_modulus_that_no_tissue_has_is_refused(study, ratio):
    append(study, f"[material]\nkappa_ratio = {ratio}\n")
    with pytest.raises(
        StudyError, match=r"study\.toml: material\.kappa_ratio: give (10 or more|at most 10000)"
    ):
        load_study(study)


@pytest.mark.parametrize("table", ["mesh", "mesh.coarse"])
def test_a_mesh_of_billions_of_cells_is_refused(study, table):
    append(study, f"[{table}]\nedge_near_mm = 0.01\n")
    with pytest.raises(
        StudyError, match=r"study\.toml: mesh.*billion cells.* give edge_near_mm of 0\.\d+ or more"
    ) as caught:
        load_study(study)
    least = float(str(caught.value).split("edge_near_mm of ")[1].split()[0])
    edit(study, "0.01", str(least))
    load_study(study)


@pytest.mark.parametrize(("place", "value"), [(0, 9999.0), (300, 9.0), (-1, 9999.0)])
def test_one_sample_that_sticks_out_is_replaced_wherever_it_is(place, value):
    trace, _ = record(clear=1.0)
    for column in ("displacement_mm", "force_N"):
        values = getattr(trace, column).copy()
        values[place] = value if column == "displacement_mm" else 10 * value
        spiked = replace(trace, **{column: values})
        check_trace(spiked)
        found = interpret_record(spiked)
        assert kinds(found) == ["spikes"]
        assert found.touch_down.displacement_mm == pytest.approx(1.0, abs=0.1)


def test_samples_of_another_indentation_before_a_record_are_refused():
    trace, _ = record()
    displacement = trace.displacement_mm.copy()
    displacement[:2] = 6.0
    with pytest.raises(TraceError, match=r"starts at 6 mm and falls to .* at once; cut off the samples"):
        check_trace(replace(trace, displacement_mm=displacement))


def test_rows_left_out_leave_what_was_said_of_reading_the_record():
    trace, _ = record()
    twice = np.repeat(np.arange(len(trace.time_s)), np.arange(len(trace.time_s)) % 50 // 49 + 1)
    columns = (trace.time_s[twice], trace.displacement_mm[twice], trace.force_N[twice])
    found = interpret_record(Trace(*columns, ("the force is converted",)))
    assert "rows" in kinds(found)
    assert found.trace.notes == ("the force is converted",)


def test_a_stated_force_that_rises_within_a_sample_is_refused():
    time = np.arange(0.0, 22.6, 0.1)
    random = np.random.default_rng(0)
    force = np.interp(time, [1.0, 1.1, 21.1, 21.2], [0.0, 5.0, 5.0, 0.0])
    creep = 3.0 * (force / 5.0) ** 0.6 * (1.2 - 0.2 * np.exp(-np.maximum(time - 1.0, 0.0) / 5.0))
    depth = np.interp(time, [0.0, 1.0], [0.0, 0.5]) + creep + 0.005 * random.standard_normal(time.size)
    trace = Trace(time, depth, force + 0.02 * random.standard_normal(time.size))
    with pytest.raises(TraceError, match="does not rise where the skin is met; sample it faster"):
        interpret_record(trace, forced=True)


@pytest.mark.parametrize("offset_N", [-30.0, 12.0])
def test_a_stated_force_may_have_an_offset(offset_N):
    time, random = np.arange(0.0, 13.0, 0.02), np.random.default_rng(0)
    force = np.interp(time, [3.0, 5.0, 10.0, 12.0], [0.0, 5.0, 5.0, 0.0])
    depth = np.interp(time, [1.0, 3.0], [0.0, 1.0]) + 2.0 * force**0.6
    noise = 0.005 * random.standard_normal((2, time.size))
    plain = interpret_record(Trace(time, depth + noise[0], force + noise[1]), forced=True)
    offset = interpret_record(Trace(time, depth + noise[0], force + noise[1] + offset_N), forced=True)
    assert offset.touch_down.time_s == pytest.approx(plain.touch_down.time_s, abs=0.05)
