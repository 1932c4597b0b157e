"""The error of the steps in time over the whole curve, on a layer whose exact force is known."""

import sys
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from blocks import FINE_Z, punch

from limbfit.fe import History, StepControl, solve
from limbfit.fe.materials import compute_prony_factors
from limbfit.fe.solution.control import grade_steps, predict_remaining_times
from limbfit.phantom.robot import DISCRETISATIONS
from limbfit.study import SolverTable

sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks"))
from material_point import compute_curve_error, solve_layer, solve_reference_layer

T = 10.0
HISTORIES = {
    "ramp": History(np.array([0.0, T, 2 * T]), np.array([0.0, 1.0, 0.0])),
    "hold": History(np.array([0.0, T, T + 30.0, 2 * T + 30.0]), np.array([0.0, 1.0, 1.0, 0.0])),
    "cycles": History(T * np.arange(7), np.array([0.0, 1.0, 0.0, 1.0, 0.0, 1.0, 0.0])),
    "two rates": History(np.array([0.0, T, 1.3 * T, 2 * T]), np.array([0.0, 0.5, 1.0, 0.0])),
}
STUDY = SolverTable()
USUAL = StepControl(load_steps=STUDY.load_steps, unload_steps=STUDY.unload_steps)
FEWER = StepControl(load_steps=6, unload_steps=8)


@cache
def exact(name, tau, parts=300):
    return solve_reference_layer(HISTORIES[name], parts, prony=((3.0, tau),))


@pytest.mark.parametrize(
    ("name", "tau", "control"),
    [
        *[("ramp", tau, control) for tau in (0.1, 3.0) for control in (USUAL, FEWER)],
        *[("hold", 0.32, USUAL), ("hold", 0.32, FEWER), ("cycles", 0.1, USUAL), ("two rates", 0.1, USUAL)],
    ],
)
def test_the_curve_is_within_its_goal(name, tau, control):
    """0.3 % rms and 1 % at worst of the peak, read between the steps too."""
    rms, worst = compute_curve_error(solve_layer(HISTORIES[name], control, ((3.0, tau),)), exact(name, tau))
    assert rms < 0.3
    assert worst < 1.0


@pytest.mark.parametrize("tau", [0.4, 1.6])
def test_slow_tissue_that_has_not_come_back_is_met_on_the_way(tau):
    """At a time that no step foresees: the curve goes to zero there, not at the step before it."""
    found = solve_layer(HISTORIES["cycles"], USUAL, ((3.0, tau),))
    rms, worst = compute_curve_error(found, exact("cycles", tau))
    assert rms < 0.3
    assert worst < 1.8


@pytest.mark.parametrize(("control", "most"), [(USUAL, 18), (FEWER, 14)])
@pytest.mark.parametrize("tau", [0.1, 3.0])
def test_a_ramp_takes_no_more_steps_than_stated(control, most, tau):
    found = solve_layer(HISTORIES["ramp"], control, ((3.0, tau),))
    assert len(found.times) - 1 <= control.load_steps + control.unload_steps == most


@pytest.mark.parametrize("tau", [0.1, 1.0])
@pytest.mark.parametrize("detail", DISCRETISATIONS)
def test_the_phantoms_truth_has_a_tenth_of_the_goals_error(detail, tau):
    found = solve_layer(HISTORIES["ramp"], DISCRETISATIONS[detail].steps(20.0), ((3.0, tau),))
    rms, worst = compute_curve_error(found, exact("ramp", tau, 1000))
    assert rms < 0.03
    assert worst < 0.1


@pytest.mark.parametrize(("stress", "order"), [("linear", 2.0), ("quadratic", 3.0)])
def test_order_of_convergence(stress, order):
    """At the end of a loading whose elastic force grows as the cube of time, even steps, two Prony terms."""
    history = History(np.array([0.0, 4.0]), np.array([0.0, 1.0]))
    layer = {"prony": ((2.0, 0.5), (1.0, 3.0)), "power": 3.0}
    ends = []
    for n in (20, 40, 80, 800):
        times = tuple(4.0 * np.arange(1, n + 1) / n)
        ends.append(solve_layer(history, StepControl(times=times, stress=stress), **layer).force[-1])
    errors = np.abs(np.array(ends[:-1]) - ends[-1])
    assert np.log2(errors[1] / errors[2]) == pytest.approx(order, abs=0.2)


@pytest.mark.parametrize(("x", "q"), [(1e-4, 0.4), (0.019, 1.0), (0.021, 1.0), (0.5, 3.0), (4.0, 0.4)])
def test_the_history_of_a_quadratic_stress_is_exact(x, q):
    """Against the integral, and derivatives against differences."""
    tau = 0.32
    dt = x * tau
    s, w = np.polynomial.legendre.leggauss(40)
    s = 0.5 * dt * (s + 1.0)
    whole = 0.5 * dt * w @ (np.exp(-(dt - s) / tau) * (0.3 + 2.0 * 0.7 * s / dt))
    f = compute_prony_factors(dt, tau, q * dt)
    change, before = 0.3 * dt + 0.7 * dt, 0.3 * q * dt - 0.7 * q**2 * dt
    assert f.ramp * change + f.back * before == pytest.approx(whole, rel=1e-9)
    h = 1e-5 * tau
    ends = [compute_prony_factors(dt, tau + sign * h, q * dt) for sign in (1, -1)]
    for name in ("decay", "ramp", "back"):
        slope = (getattr(ends[0], name) - getattr(ends[1], name)) / (2 * h)
        assert getattr(f, f"d_{name}") == pytest.approx(slope, rel=1e-5, abs=1e-9)


def test_a_step_before_the_end_of_contact_does_not_move_with_the_parameters():
    places = set()
    for g in np.linspace(2.9, 3.1, 5):
        places |= set(solve_layer(HISTORIES["ramp"], USUAL, ((g, 1.0),)).times.round(9))
    planned = set(grade_steps(HISTORIES["ramp"], USUAL.load_steps, USUAL.unload_steps).round(9))
    assert 1 <= len(places - planned - {0.0}) <= 2


def test_only_what_unloads_foresees_the_end_of_contact():
    history = HISTORIES["hold"]
    planned = grade_steps(history, 4, 4)
    left = [t for t in planned if t > 12.0]
    assert predict_remaining_times(history, planned, left, [0.0, T, 11.0, 12.0], [0.0, 5.0, 2.0, 1.0]) == left


def test_a_block_is_within_the_goal_with_fewer_steps():
    problem = punch("tet4", 2, 1, z=FINE_Z)
    fine = solve(problem, StepControl(load_steps=24, unload_steps=30), store="none")
    found = solve(problem, FEWER, store="none")
    t = np.linspace(0.0, problem.history.times[-1], 400)
    error = 100.0 * (found.force_at(t) - fine.force_at(t)) / fine.peak_force
    assert np.sqrt((error**2).mean()) < 0.3
    assert np.abs(error).max() < 1.0
    assert found.statistics["steps"] <= 14
