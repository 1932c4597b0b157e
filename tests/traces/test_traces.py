"""Records: refusals that name file, place and remedy; touch-down; curves that keep the peak.

The synthetic record is a power-law solid with quasi-linear relaxation, F = a d^p filtered by
G(t) = 1 + gamma exp(-t / tau): it starts with slack, is pushed in at constant speed and drawn back.
"""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
from scipy.io import savemat

from limbfit.errors import TraceError
from limbfit.phases import boundaries
from limbfit.traces import (
    TouchDown,
    Trace,
    check_trace,
    find_touch_down,
    read_trace,
    regularise,
    touch_down_at,
)
from limbfit.traces.regularise import _spline

SHARED = Path(__file__).parents[2] / ".." / "shared"
OPENLIMB = SHARED / "reference" / "openlimb-study"
RELAXATION = SHARED / "data" / "relaxation"
needs_openlimb = pytest.mark.skipif(not OPENLIMB.is_dir(), reason="shared/reference is not here")
needs_relaxation = pytest.mark.skipif(not RELAXATION.is_dir(), reason="shared/data is not here")


def relaxing(time, depth, p=1.3, stiffness=0.5, gamma=2.0, tau=0.4):
    """Force in N of the power-law solid, by the exact recursion for piecewise linear elastic force."""
    elastic = stiffness * np.maximum(depth, 0.0) ** p
    history = np.zeros_like(elastic)
    for k in range(1, len(time)):
        dt = time[k] - time[k - 1]
        decay = np.exp(-dt / tau)
        history[k] = decay * history[k - 1] + (1 - decay) / (dt / tau) * (elastic[k] - elastic[k - 1])
    return np.maximum(elastic + gamma * history, 0.0)


def record(
    slack=0.4,
    depth=5.0,
    speed=0.96,
    rate=500.0,
    p=1.3,
    noise_N=0.03,
    noise_mm=0.005,
    offset=0.0,
    wait=0.0,
    seed=0,
):
    """A record, and its force without noise as a function of time."""
    travel = slack + depth
    fine = np.arange(0, wait + 2 * travel / speed, 1e-3)
    moved = speed * np.clip(fine - wait, 0, None)
    path = np.minimum(moved, 2 * travel - moved)
    force = relaxing(fine, path - slack, p)
    time = np.arange(0, fine[-1], 1 / rate)
    rng = np.random.default_rng(seed)
    displacement = np.interp(time, fine, path) + noise_mm * rng.standard_normal(time.size)
    clean = np.interp(time, fine, force)
    noisy = clean + offset + noise_N * rng.standard_normal(time.size)
    return Trace(time, displacement, noisy), lambda t: np.interp(t, fine, force)


def path_record(corners_s, corners_mm, slack=0.4, rate=500.0, noise_N=0.03, noise_mm=0.005, seed=0):
    """A record along a broken line of displacement, and its force without noise as a function of time."""
    fine = np.arange(0, corners_s[-1], 1e-3)
    path = np.interp(fine, corners_s, corners_mm)
    force = relaxing(fine, path - slack)
    time = np.arange(0, fine[-1], 1 / rate)
    rng = np.random.default_rng(seed)
    displacement = np.interp(time, fine, path) + noise_mm * rng.standard_normal(time.size)
    noisy = np.interp(time, fine, force) + noise_N * rng.standard_normal(time.size)
    return Trace(time, displacement, noisy), lambda t: np.interp(t, fine, force)


def write_csv(path, trace, header="time_s,displacement_mm,force_N", delimiter=",", decimal="."):
    rows = zip(trace.time_s, trace.displacement_mm, trace.force_N)
    lines = [delimiter.join(f"{v:.5f}".replace(".", decimal) for v in row) for row in rows]
    path.write_text("\n".join([header.replace(",", delimiter), *lines]) + "\n", encoding="utf-8")
    return path


# --- reading


@pytest.mark.parametrize(("delimiter", "decimal"), [(",", "."), (";", "."), ("\t", "."), (";", ",")])
def test_tables_of_all_flavours_read_the_same(tmp_path, delimiter, decimal):
    trace, _ = record(rate=50)
    read = read_trace(write_csv(tmp_path / "a.csv", trace, delimiter=delimiter, decimal=decimal))
    assert read.force_N == pytest.approx(trace.force_N, abs=1e-5)
    assert read.displacement_mm == pytest.approx(trace.displacement_mm, abs=1e-5)


def test_columns_are_found_by_name_whatever_their_order_and_company(tmp_path):
    trace, _ = record(rate=50)
    path = tmp_path / "a.csv"
    rows = [
        f"{t:.4f},x,{f:.4f},{d:.4f}" for t, d, f in zip(trace.time_s, trace.displacement_mm, trace.force_N)
    ]
    path.write_text("\n".join(["# recorded on a Monday", '"t","note","F","u"', *rows]), encoding="utf-8-sig")
    read = read_trace(path, columns=("t", "u", "F"))
    assert read.displacement_mm == pytest.approx(trace.displacement_mm, abs=1e-4)


@pytest.mark.parametrize("struct", [False, True])
def test_mat_files_hold_vectors_or_one_struct(tmp_path, struct):
    trace, _ = record(rate=50)
    content = {
        "time_s": trace.time_s[:, None],
        "displacement_mm": trace.displacement_mm[None],
        "force_N": trace.force_N,
    }
    savemat(tmp_path / "a.mat", {"record": content} if struct else content)
    read = read_trace(tmp_path / "a.mat")
    assert np.array_equal(read.force_N, trace.force_N)
    assert np.array_equal(read.time_s, trace.time_s)


def broken(tmp_path, edit):
    """A file whose lines were edited."""
    trace, _ = record(rate=50)
    path = write_csv(tmp_path / "a.csv", trace)
    lines = path.read_text().splitlines()
    edit(lines)
    path.write_text("\n".join(lines))
    return path


def replace(line, text):
    return lambda lines: lines.__setitem__(line - 1, text)


@pytest.mark.parametrize(
    ("edit", "says"),
    [
        (
            replace(1, "time,displacement_mm,force_N"),
            "header: no column 'time_s'.*it has 'time', 'disp.*rename",
        ),
        (replace(7, "0.1,oops,0.2"), "line 7, column displacement_mm: 'oops' is not a number"),
        (replace(7, "0.1,"), "line 7, column displacement_mm: '' is not a number"),
        (replace(7, "0.1"), "line 7, column displacement_mm: the row is too short"),
        (replace(7, "0.1,0.1,nan"), "force_N: nan in sample 6"),
        (replace(7, "0.1,0.1,inf"), "force_N: inf in sample 6"),
        (replace(7, "9.1,0.1,0.1"), "time_s: time does not increase at sample 7; remove"),
        (lambda lines: lines.__delitem__(slice(12, None)), "only 11 samples; a record needs at least 20"),
        (lambda lines: lines.clear(), "the file is empty"),
    ],
)
def test_broken_tables_are_refused_with_file_place_and_remedy(tmp_path, edit, says):
    path = broken(tmp_path, edit)
    with pytest.raises(TraceError, match=says) as caught:
        read_trace(path)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_files_that_are_no_tables_are_refused(tmp_path):
    with pytest.raises(TraceError, match="no such file"):
        read_trace(tmp_path / "none.csv")
    path = tmp_path / "a.csv"
    path.write_bytes(bytes(100_000))
    with pytest.raises(TraceError, match="not a text table"):
        read_trace(path)
    path.write_bytes(b"time_s,displacement_mm,force_N\n\xff\xfe1,2,3\n")
    with pytest.raises(TraceError, match="not UTF-8"):
        read_trace(path)


def test_broken_mat_files_are_refused(tmp_path):
    path = tmp_path / "a.mat"
    path.write_bytes(b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(124) + b"\x00\x02IM" + bytes(500))
    with pytest.raises(TraceError, match=r"version 7\.3; save it in MATLAB with '-v7'"):
        read_trace(path)
    for content in (b"", b"nonsense" * 100, bytes(1000)):
        path.write_bytes(content)
        with pytest.raises(TraceError, match="not a readable MAT file"):
            read_trace(path)
    trace, _ = record(rate=50)
    columns = {"time_s": trace.time_s, "displacement_mm": trace.displacement_mm}
    savemat(path, columns | {"force_N": np.ones((4, 4))})
    with pytest.raises(TraceError, match="force_N: not a vector of real numbers"):
        read_trace(path)
    savemat(path, columns | {"force_N": "text"})
    with pytest.raises(TraceError, match="force_N: not a vector"):
        read_trace(path)
    savemat(path, columns)
    with pytest.raises(TraceError, match="no column 'force_N'"):
        read_trace(path)
    savemat(path, columns | {"force_N": trace.force_N[:-1]})
    with pytest.raises(TraceError, match=r"force_N: .* values for .* times"):
        read_trace(path)


# --- what cannot be an indentation


@pytest.mark.parametrize(
    ("factors", "says"),
    [
        ((1, 1e-3, 1), "displacement_mm: a travel of .* looks like metres"),
        ((1, 1e3, 1), "displacement_mm: a travel of .* looks like micrometres"),
        ((1e3, 1, 1), "time_s: a speed of .* looks like milliseconds"),
        ((1 / 3600, 1, 1), "time_s: a speed of .* check the units"),
        ((1, 1, 1e-3), "force_N: a peak force of .* looks like kilonewtons"),
        ((1, 1, 1e3), "force_N: a peak force of .* looks like millinewtons"),
        ((1, -1, 1), "displacement_mm: the displacement falls; .* change the sign"),
        ((1, 1, -1), "force_N: the force falls when the indenter pushes; .* change the sign"),
        ((1, 1, 0), "force_N: no contact"),
    ],
)
def test_units_that_cannot_be_right_are_refused(factors, says):
    trace, _ = record(rate=100)
    t, d, f = factors
    with pytest.raises(TraceError, match=says):
        check_trace(Trace(t * trace.time_s, d * trace.displacement_mm, f * trace.force_N))


def test_a_record_of_noise_is_no_contact():
    trace, _ = record(rate=100)
    rng = np.random.default_rng(5)
    with pytest.raises(
        TraceError, match=r"no contact: the force rises by .* against a noise of .*leave the site"
    ):
        check_trace(Trace(trace.time_s, trace.displacement_mm, 0.03 * rng.standard_normal(trace.time_s.size)))


# --- touch-down


@pytest.mark.parametrize("p", [1.0, 1.3, 1.5, 2.0])
@pytest.mark.parametrize("slack", [0.0, 0.4, 2.0])
def test_touch_down_is_found_under_noise(p, slack):
    for seed in range(3):
        trace, _ = record(slack=slack, p=p, seed=seed)
        touch = find_touch_down(trace)
        assert abs(touch.displacement_mm - slack) < max(0.1, 2.5 * touch.uncertainty_mm), touch
        assert touch.uncertainty_mm < 0.12
        assert touch.time_s == pytest.approx(touch.displacement_mm / 0.96, abs=0.01)


def test_touch_down_does_not_mind_an_offset_or_a_wait_before_the_ramp():
    for seed in range(3):
        trace, _ = record(offset=0.2, wait=1.5, seed=seed)
        touch = find_touch_down(trace)
        assert touch.displacement_mm == pytest.approx(0.4, abs=0.1)
        assert touch.time_s == pytest.approx(1.5 + 0.4 / 0.96, abs=0.1)
        assert touch.baseline_N == pytest.approx(0.2, abs=0.01)
        assert not touch.in_contact_at_start


def test_a_record_without_slack_says_so():
    trace, _ = record(slack=0.0)
    touch = find_touch_down(trace)
    assert touch.in_contact_at_start
    assert touch.displacement_mm < 0.1


def test_more_noise_means_more_uncertainty_and_no_bias():
    errors, stated = [], []
    for seed in range(12):
        touch = find_touch_down(record(noise_N=0.1, seed=seed)[0])
        errors.append(touch.displacement_mm - 0.4)
        stated.append(touch.uncertainty_mm)
    assert abs(np.mean(errors)) < 0.06
    assert 0.5 < np.mean(stated) / np.sqrt(np.mean(np.square(errors))) < 3
    assert np.mean(stated) > 2 * find_touch_down(record(noise_N=0.01)[0]).uncertainty_mm


@needs_openlimb
@pytest.mark.parametrize("site", ["1", "2", "3", "4", "5", "6"])
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


# --- regularisation


@pytest.mark.parametrize("seed", range(4))
def test_the_peak_is_kept_and_the_noise_is_gone(seed):
    trace, truth = record(seed=seed)
    touch = find_touch_down(trace)
    curve = regularise(trace, touch)
    assert curve.peak_force_N == pytest.approx(truth(5.4 / 0.96), abs=0.03)
    assert curve.time_s[curve.peak_index] + touch.time_s == pytest.approx(5.4 / 0.96, abs=0.005)
    error = curve.force_N - truth(curve.time_s + touch.time_s)
    assert np.sqrt(np.mean(error**2)) < 0.015
    assert curve.noise_N == pytest.approx(0.03, rel=0.1)
    assert curve.noise_mm == pytest.approx(0.005, rel=0.1)


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


def test_a_single_smoothing_over_the_corner_would_lose_the_peak():
    """What treating loading and unloading apart is for."""
    trace, truth = record()
    touch = find_touch_down(trace)
    peak = truth(5.4 / 0.96)
    window = np.ones(250) / 250
    over = np.convolve(trace.force_N, window, "same").max()
    assert peak - over > 5 * abs(peak - regularise(trace, touch).peak_force_N)


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

    smoothed = smooth.curve.response(times) @ force(times)
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
    error = smooth.curve.response(times) @ truth(times + touch.time_s) - exact
    assert abs(error[inside].mean()) < 1e-4 * exact.max()


def test_the_penalty_of_cross_validation_is_found_out():
    x = np.linspace(0, 3, 150)
    y, w = np.sin(2 * x) + 0.1 * np.random.default_rng(3).standard_normal(150), np.full(150, 4.0)
    chosen, penalty = _spline(x, y, w, None, {0.0: np.array(0.0)})
    given, _ = _spline(x, y, w, penalty, {0.0: np.array(0.0)})
    assert penalty > 0
    assert given(x) == pytest.approx(chosen(x), abs=1e-7)


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
    half = trace.time_s < 5.4 / 0.96
    trace = Trace(trace.time_s[half], trace.displacement_mm[half], trace.force_N[half])
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


# --- holds, rates and cycles

PROTOCOLS = {
    "flat hold": ([0, 5, 35, 40], [0, 5.4, 5.4, 0], "load hold unload"),
    "creeping hold": ([0, 5, 35, 40], [0, 5.4, 5.406, 0], "load hold unload"),
    "long hold": ([0, 0.5, 60.5, 61], [0, 5.4, 5.4, 0], "load hold unload"),
    "two rates": ([0, 1, 6, 7], [0, 3, 5.4, 0], "load load unload"),
    "steps": ([0, 3, 13, 16, 26, 30], [0, 3, 3, 5.4, 5.4, 0], "load hold load hold unload"),
    "three cycles": (
        [0, 5, 10, 15, 20, 25, 30],
        [0, 5.4, 0, 5.4, 0, 5.4, 0],
        "load unload load unload load unload",
    ),
    "cycles in contact": (
        [0, 5, 8, 11, 14, 17, 22],
        [0, 5.4, 2, 5.4, 2, 5.4, 0],
        "load unload load unload load unload",
    ),
    "growing cycles": (
        [0, 2, 4, 8, 12, 18, 24],
        [0, 2, 0, 4, 0, 6, 0],
        "load unload load unload load unload",
    ),
}


@pytest.mark.parametrize("name", PROTOCOLS)
def test_every_phase_of_a_record_is_found_and_smoothed_by_itself(name):
    corners_s, corners_mm, expected = PROTOCOLS[name]
    trace, truth = path_record(corners_s, corners_mm)
    check_trace(trace)
    touch = find_touch_down(trace)
    assert touch.displacement_mm == pytest.approx(0.4, abs=0.1)
    curve = regularise(trace, touch)
    assert [phase.kind for phase in curve.phases] == expected.split()
    ends = boundaries(curve.phases)[1:-1] + touch.time_s
    assert ends == pytest.approx(corners_s[1:-1], abs=0.01)
    error = curve.force_N - truth(curve.time_s + touch.time_s)
    assert np.sqrt(np.mean(error**2)) < 0.01
    assert np.abs(error).max() < 0.1
    for at in ends:  # the corners are kept
        assert np.interp(at - touch.time_s, curve.time_s, curve.force_N) == pytest.approx(truth(at), abs=0.06)


def test_cycles_that_leave_the_skin_have_no_force_between():
    trace, _ = path_record(*PROTOCOLS["three cycles"][:2])
    touch = find_touch_down(trace)
    curve = regularise(trace, touch)
    assert curve.knots_mm[2] == pytest.approx(-touch.displacement_mm, abs=0.01)
    away = np.abs(curve.time_s + touch.time_s - 10.0) < 0.3
    assert curve.force_N[away].max() < 0.03
    assert curve.time_s[-1] + touch.time_s == pytest.approx(29.6, abs=0.1)


def test_a_long_hold_takes_no_points_of_comparison_from_the_ramps():
    trace, _ = path_record(*PROTOCOLS["long hold"][:2])
    even = regularise(trace, find_touch_down(trace)).resample(81)
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
    simulated = even.curve.response(even.time_s) @ true
    assert np.abs(even.force_N - true)[early].max() < 0.003 * true.max()
    assert np.abs(simulated - even.force_N)[early].max() < 0.003 * true.max()


def test_the_response_of_the_smoothing_follows_every_phase():
    trace, _ = path_record(*PROTOCOLS["cycles in contact"][:2])
    curve = regularise(trace, find_touch_down(trace))
    times = curve.resample(81).time_s
    matrix = curve.curve.response(times)
    force = np.interp(times, curve.knots_s, curve.knots_mm)
    assert matrix @ force == pytest.approx(force, abs=0.03 * force.max())


def test_a_stated_peak_is_that_of_the_first_cycle():
    trace, _ = path_record(*PROTOCOLS["cycles in contact"][:2])
    touch = find_touch_down(trace)
    moved = regularise(trace, touch, peak_s=5.05)
    assert moved.peak_s + touch.time_s == pytest.approx(5.05)
    assert len(moved.phases) == 6


def test_a_displacement_that_wanders_is_refused():
    time = np.arange(0, 40, 0.01)
    wander = np.abs(0.2 * np.cumsum(np.random.default_rng(1).standard_normal(time.size)))
    with pytest.raises(TraceError, match=r"displacement: the displacement wanders: 40 .* cut out the part"):
        regularise(Trace(time, wander, wander), TouchDown(0.0, 0.0, 0.1, 1.0, 0.0, True))


def test_a_record_that_is_only_held_or_drawn_back_is_refused():
    time = np.linspace(0, 10, 1000)
    with pytest.raises(TraceError, match="displacement: the displacement never advances"):
        find_touch_down(Trace(time, 5.0 - 0.5 * time, time))


@needs_openlimb
@pytest.mark.parametrize("site", ["1", "2", "3", "4", "5", "6"])
def test_foreign_records_keep_their_peak(site):
    trace = read_trace(OPENLIMB / "traces" / f"site-{site}.csv")
    facts = json.loads((OPENLIMB / "sites.json").read_text())["sites"][site]
    curve = regularise(trace, find_touch_down(trace))
    assert curve.peak_force_N == pytest.approx(facts["peak_force_N"], abs=0.03)
    assert curve.noise_N == pytest.approx(0.03, rel=0.1)
    assert curve.speed_load_mm_s == pytest.approx(facts["speed_mm_s"], rel=2e-3)


@needs_relaxation
@pytest.mark.parametrize(
    "name", ["230403-FF1A", "230403-FF1b", "230403-RDG1A", "230411-RDG1A", "230411-RDG1B", "230411-RDG1C"]
)
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
    assert boundaries(later.phases)[1] == pytest.approx(turn + 0.1 - stated.time_s)
    assert later.depth_mm == pytest.approx(5.0 - 0.3 * 0.96, abs=0.12)
    assert boundaries(regularise(trace, found).phases)[1] == pytest.approx(turn - found.time_s, abs=0.01)


def test_stated_times_off_the_record_are_refused():
    trace = record()[0]
    with pytest.raises(TraceError, match=r"touch_down_s: 7 s is not on the way in; give a time from 0"):
        touch_down_at(trace, 7.0)
    with pytest.raises(TraceError, match=r"peak_s: the way in cannot end at 30 s; the record turns at 5\.6"):
        regularise(trace, find_touch_down(trace), peak_s=30.0)
