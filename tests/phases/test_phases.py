"""Phases of an indentation, from corners and from samples of its displacement."""

from itertools import pairwise

import numpy as np
import pytest

from limbfit.fe import History
from limbfit.fe.solution.control import StepControl, schedule_steps
from limbfit.phases import describe_phases, find_boundaries, find_loading_end, find_phases


def kinds(times, displacement):
    return [phase.kind for phase in find_phases(np.array(times), np.array(displacement))]


CYCLES = ([0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0], [0.0, 10.0, 2.0, 10.0, 2.0, 10.0, 0.0])
HISTORIES = {
    "ramp": ([0.0, 1.0, 2.0], [0.0, 10.0, 0.0], "load unload"),
    "flat hold": ([0.0, 1.0, 31.0, 32.0], [0.0, 10.0, 10.0, 0.0], "load hold unload"),
    "creeping hold": ([0.0, 1.0, 31.0, 32.0], [0.0, 3.0, 3.006, 0.0], "load hold unload"),
    "receding hold": ([0.0, 1.0, 31.0, 32.0], [0.0, 3.0, 2.994, 0.0], "load hold unload"),
    "creep in two pieces": (
        [0.0, 1.0, 5.0, 31.0, 32.0],
        [0.0, 3.0, 3.005, 3.008, 0.0],
        "load hold unload",
    ),
    "two rates": ([0.0, 1.0, 6.0, 7.0], [0.0, 5.0, 10.0, 0.0], "load load unload"),
    "loading alone": ([0.0, 1.0], [0.0, 10.0], "load"),
    "cycles": (*CYCLES, "load unload load unload load unload"),
    "steps": (
        [0.0, 1.0, 11.0, 12.0, 22.0, 23.0],
        [0.0, 5.0, 5.0, 10.0, 10.0, 0.0],
        "load hold load hold unload",
    ),
    "rest first": ([0.0, 1.0, 2.0, 3.0], [0.0, 0.0, 10.0, 0.0], "hold load unload"),
    "back within the tolerance": (
        [0.0, 1.0, 1.005, 2.0, 3.0],
        [0.0, 5.0, 5.0, 10.0, 0.0],
        "load unload",
    ),
}


@pytest.mark.parametrize("name", HISTORIES)
def test_corners_and_samples_give_the_same_phases(name):
    times, displacement, expected = HISTORIES[name]
    assert kinds(times, displacement) == expected.split()
    samples = np.linspace(0.0, times[-1], 20001)
    values = np.interp(samples, times, displacement)
    assert kinds(samples, values) == expected.split()
    noise = np.random.default_rng(1).uniform(-1.0, 1.0, len(samples))
    assert kinds(samples, values + 0.0001 * np.ptp(values) * noise) == expected.split()


def test_phases_meet_and_cover_the_history():
    for times, displacement, _ in HISTORIES.values():
        phases = find_phases(np.array(times), np.array(displacement))
        ends = find_boundaries(phases)
        assert ends[0] == times[0]
        assert ends[-1] == times[-1]
        np.testing.assert_array_equal(ends[1:-1], [phase.start_s for phase in phases[1:]])
        assert all(a.end_mm == b.start_mm for a, b in pairwise(phases))


def test_rates_are_signed_means():
    load, hold, unload = find_phases(np.array([0.0, 2.0, 4.0, 5.0]), np.array([0.0, 8.0, 8.0, 0.0]))
    assert (load.rate_mm_s, hold.rate_mm_s, unload.rate_mm_s) == (4.0, 0.0, -8.0)
    assert hold.duration_s == 2.0


def test_phases_in_words():
    def words(times, displacement):
        return describe_phases(find_phases(np.array(times), np.array(displacement)))

    held = words([0.0, 1.0, 31.0, 33.0], [0.0, 5.0, 5.0, 0.0])
    assert held == "load at 5 mm/s, hold for 30 s, unload at 2.5 mm/s"
    assert words([0.0, 5.0], [0.0, 5.0]) == "load at 1 mm/s"
    cycles = words([0.0, 4.0, 9.0, 14.0, 19.0, 24.0, 28.0], [1.0, 5.0, 0.0, 5.0, 0.0, 5.0, 1.0])
    assert cycles == "3 cycles of load at 1 mm/s, unload at 1 mm/s"
    faster = words([0.0, 5.0, 10.0, 12.0, 17.0], [0.0, 5.0, 0.0, 5.0, 0.0])
    assert faster == "load at 1 mm/s, unload at 1 mm/s, load at 2.5 mm/s, unload at 1 mm/s"


def test_a_smooth_overshoot_is_part_of_its_hold():
    times = np.linspace(0.0, 5.0, 5001)
    values = np.interp(times, [0.0, 1.0, 4.0, 5.0], [0.0, 10.0, 10.0, 0.0])
    values += np.where(times > 1.0, 0.02 * np.exp(-(times - 1.0) / 0.1), 0.0)
    assert kinds(times, values) == ["load", "hold", "unload"]


@pytest.mark.parametrize("end_mm", [3.0, 3.006, 2.994])
def test_loading_ends_where_the_hold_begins(end_mm):
    history = History(np.array([0.0, 1.0, 31.0, 32.0]), np.array([0.0, 3.0, end_mm, 0.0]))
    assert history.loading_s == 1.0


def test_loading_ends_at_the_first_of_equal_cycles():
    times, displacement = np.array(CYCLES[0]), np.array(CYCLES[1])
    assert find_loading_end(find_phases(times, displacement)).end_s == 1.0
    displacement[3] = 10.02  # the second is deeper by less than the tolerance
    assert find_loading_end(find_phases(times, displacement)).end_s == 1.0
    displacement[3] = 11.0
    assert find_loading_end(find_phases(times, displacement)).end_s == 3.0


def test_a_history_without_loading_is_loaded_to_its_end():
    assert History(np.array([0.0, 1.0]), np.array([0.0, -1.0])).loading_s == 1.0
    assert History(np.array([0.0, 1.0]), np.array([0.0, 0.0])).loading_s == 1.0


@pytest.mark.parametrize("end_mm", [3.0, 3.006])
def test_a_hold_takes_no_steps_from_the_loading(end_mm):
    """A creeping hold put the peak at its end: loading got two steps of ten."""
    history = History(np.array([0.0, 1.0, 31.0, 32.0]), np.array([0.0, 3.0, end_mm, 0.0]))
    times = schedule_steps(history, StepControl(load_steps=10, unload_steps=8))
    assert (times <= 1.0).sum() == 10
