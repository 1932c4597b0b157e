"""Time stepping, interpolation, warm starts, results."""

import pickle
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from blocks import FINE_Z, punch
from scipy.signal import lfilter

from limbfit.errors import ProblemError
from limbfit.fe import History, StepControl, iterate, solve
from limbfit.fe.solution.control import schedule_steps


@pytest.fixture(scope="module")
def problem():
    return punch("hex8", 2, 1, depth=3.0)


STEPS = StepControl(load_steps=5, unload_steps=4)


@pytest.fixture(scope="module")
def result(problem):
    return solve(problem, STEPS, sensitivities=True, store="all")


def test_schedule_hits_knots_and_peak():
    history = History(np.array([0.0, 3.0, 4.0, 9.0]), np.array([0.0, 2.0, 5.0, 0.0]))
    times = schedule_steps(history, StepControl())
    assert {3.0, 4.0, 9.0} <= set(times)
    assert (np.diff(times) > 0).all()
    assert times[0] > 0


def test_interpolation_passes_through_the_steps_and_is_never_negative(result):
    np.testing.assert_allclose(result.force_at(result.times), result.force, atol=1e-10)
    assert (result.force_at(np.linspace(-1.0, 20.0, 500)) >= 0).all()


def layer_force(t, history, tau=0.32, gamma=3.0):
    """Force (n,) of a layer with d^2 and relaxation, 1 + gamma exp(-t / tau): midpoint sums."""
    fine = np.linspace(0.0, history.times[-1], 200_001)
    rate, dt = np.gradient(np.maximum(history.at(fine), 0.0) ** 2, fine), fine[1]
    memory = lfilter([dt], [1.0, -np.exp(-dt / tau)], rate)
    return np.interp(t, fine, np.maximum(history.at(fine), 0.0) ** 2 + gamma * memory)


HELD = History(np.array([0.0, 3.0, 13.0, 16.0]), np.array([0.0, 3.0, 3.006, 0.0]))
FLAT = History(HELD.times, np.array([0.0, 3.0, 3.0, 0.0]))
CYCLES = History(np.arange(7.0) * 3.0, np.array([0.0, 3.0, 1.0, 3.0, 1.0, 3.0, 0.0]))
LEAVING = History(np.arange(5.0) * 3.0, np.array([0.0, 3.0, -0.5, 3.0, 0.0]))


@pytest.mark.parametrize(
    "history", [HELD, FLAT, CYCLES, LEAVING], ids=["creeping", "flat", "cycles", "leaving"]
)
def test_no_spline_crosses_the_kink_of_a_phase(problem, result, history):
    """Given the exact forces at steps that grow from every kink, the curve between them is right."""
    grade = np.linspace(0.0, 1.0, 13) ** 1.5
    times = np.unique(np.concatenate([a + (b - a) * grade for a, b in pairwise(history.times)]))
    known = replace(
        result,
        problem=replace(problem, history=history),
        times=times,
        displacement=history.at(times),
        force=np.maximum(layer_force(times, history), 0.0),
        force_sensitivity=None,
    )
    t = np.linspace(0.0, times[-1], 2001)
    error = np.abs(known.force_at(t) - np.maximum(layer_force(t, history), 0.0))
    assert error.max() < 0.012 * known.peak_force


@pytest.mark.parametrize("store", ["peak", "all"])
def test_fields_of_a_creeping_hold_are_those_where_loading_ends(problem, store):
    history = History(np.array([0.0, 2.0, 6.0, 8.0]), np.array([0.0, 2.0, 2.004, 0.0]))
    found = solve(replace(problem, history=history), StepControl(load_steps=3, unload_steps=3), store=store)
    kept = [state for state in found.states if state.memory is not None]
    assert [state.time for state in kept] == [2.0]


def test_interpolated_sensitivity_is_the_derivative_of_the_interpolated_force(result):
    t, step = np.linspace(0.0, 12.0, 97), np.random.default_rng(0).normal(size=8) * 1e-7
    moved = replace(result, force=result.force + result.force_sensitivity @ step)
    change = moved.force_at(t) - result.force_at(t)
    np.testing.assert_allclose(change, result.sensitivity_at(t) @ step, atol=1e-9 * result.peak_force)


def test_warm_start_gives_the_same_forces_with_fewer_iterations(problem, result):
    skin = problem.materials["skin"]
    changed = problem.with_materials({**problem.materials, "skin": replace(skin, c=1.1 * skin.c)})
    cold, warm = solve(changed, STEPS), solve(changed, STEPS, warm_start=result)
    np.testing.assert_allclose(warm.force, cold.force, atol=2e-5 * cold.peak_force)
    assert warm.statistics["newton_iterations"] < cold.statistics["newton_iterations"]
    assert warm.system is result.system


def test_a_warm_start_from_stiffer_contact_changes_no_force():
    """Tissue that stiffens more needs a stiffer contact; it was taken over, and with it 0.4 % of force."""
    push = History(np.array([0.0, 6.25]), np.array([0.0, 6.0]))
    problem = punch("tet10", 2, 1, z=FINE_Z, history=push)
    hard = problem.with_materials({name: replace(m, m=16.0) for name, m in problem.materials.items()})
    before = solve(hard, sensitivities=True, store="all")
    assert before.statistics["penalty_per_mm"] > 100.0
    cold, warm = solve(problem), solve(problem, warm_start=before)
    np.testing.assert_allclose(warm.force, cold.force, atol=1e-4 * cold.peak_force)


def test_iterate_and_solve_agree_and_states_are_kept_as_asked(problem, result):
    steps = list(iterate(problem, STEPS, sensitivities=True))
    np.testing.assert_allclose([s.force for s in steps], result.force[1:], rtol=1e-6, atol=1e-9)
    assert len(result.states) == len(steps)
    peak = solve(problem, STEPS, store="peak")
    assert [s.displacement for s in peak.states] == [pytest.approx(3.0)]
    assert not solve(problem, STEPS, store="none").states


def test_results_travel_between_processes(result):
    copy = pickle.loads(pickle.dumps(result))
    np.testing.assert_array_equal(copy.force, result.force)
    assert copy.system is None


def test_another_linear_solver_gives_the_same_simulation(problem, result):
    other = solve(problem, replace(STEPS, linear_solver="superlu"), sensitivities=True)
    np.testing.assert_allclose(other.force, result.force, atol=1e-4 * result.peak_force)
    assert other.statistics["linear_solver"] == "superlu"
    most = np.abs(result.force_sensitivity).max(axis=0)
    np.testing.assert_allclose(other.force_sensitivity / most, result.force_sensitivity / most, atol=1e-3)


@pytest.mark.parametrize(
    ("times", "displacement", "what"),
    [
        ([0.0, 2.0, 1.0], [0.0, 1.0, 0.0], "do not grow from 0: 0, 2, 1"),
        ([0.5, 1.0], [0.0, 1.0], "displacement history do not grow from 0: 0.5, 1"),
        ([0.0, np.nan], [0.0, 1.0], "not finite"),
        ([0.0, 1.0], [0.0, np.inf], "not finite"),
        ([0.0, 1.0], [0.0, 1.0, 0.0], "as many displacements"),
        ([0.0], [0.0], "two or more times"),
    ],
)
def test_histories_that_make_no_sense_are_refused(times, displacement, what):
    with pytest.raises(ProblemError, match=what):
        History(times, displacement)
