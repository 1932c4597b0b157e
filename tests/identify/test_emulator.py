"""The emulator: exact where it can be, honest about its error, derivatives that belong to its forces."""

import numpy as np
import pytest
from bars import NAMES, PAPER, TRUTH, records, simulate

from limbfit.errors import CalibrationError
from limbfit.identify.fit.calibration import calibrate
from limbfit.identify.fit.objective import SiteResponse
from limbfit.identify.fit.prediction import compute_errors_percent
from limbfit.identify.uncertainty.emulator import Emulator


def cloud(count, width, seed=0, centre=TRUTH):
    random = np.random.default_rng(seed)
    return centre * np.exp(width * random.uniform(-1, 1, (count, len(centre))))


def bars_emulator(count=20, width=0.3):
    points = cloud(count, width)
    return Emulator(points, [simulate(p) for p in points])


def quadratic(p):
    """Two sites whose forces are quadratic in the logarithms of two parameters."""
    x, y = np.log(p)
    grid = np.linspace(1.0, 2.0, 7)
    force = 5.0 + grid * (2 * x - 3 * y) + 0.5 * x * y + grid**2 * y**2
    by_x, by_y = 2 * grid + 0.5 * y, -3 * grid + 0.5 * x + 2 * grid**2 * y
    jacobian = np.stack([by_x / p[0], by_y / p[1]], axis=1)
    return [SiteResponse(force, jacobian), SiteResponse(force[:3], jacobian[:3])]


def test_a_quadratic_is_met_exactly_even_far_outside():
    points = cloud(4, 0.5, centre=np.ones(2))
    emulator = Emulator(points, [quadratic(p) for p in points], softening=1e4)
    for p in cloud(5, 2.0, seed=1, centre=np.ones(2)):
        assert max(compute_errors_percent(emulator(p), quadratic(p))) < 1e-3
        for ours, true in zip(emulator(p), quadratic(p)):
            assert ours.jacobian == pytest.approx(true.jacobian, rel=1e-4, abs=1e-4)


def test_the_stated_errors_are_those_at_runs_it_does_not_know():
    emulator = bars_emulator()
    fresh = cloud(20, 0.3, seed=1)
    actual = np.array([compute_errors_percent(emulator(p), simulate(p)) for p in fresh])
    stated = np.array([emulator.expected_error_percent(p) for p in fresh])
    assert np.median(actual) < 0.1
    assert 0.4 < np.median(emulator.loo_percent) / np.median(actual) < 2.5
    assert 0.4 < np.median(stated) / np.median(actual) < 2.5


def test_more_runs_make_it_better_and_distance_makes_it_worse():
    few, many = bars_emulator(8), bars_emulator(24)
    assert np.median(many.loo_percent) < 0.5 * np.median(few.loo_percent)
    assert many.is_inside(TRUTH)
    assert not many.is_inside(3 * TRUTH)
    assert many.expected_error_percent(3 * TRUTH).max() > 10 * many.expected_error_percent(TRUTH).max()


def test_derivatives_are_those_of_the_emulated_force():
    emulator = bars_emulator()
    for response, k in ((r, i) for i, r in enumerate(emulator(TRUTH))):
        for j in range(len(TRUTH)):
            h = np.zeros(8)
            h[j] = 1e-4 * TRUTH[j]
            ends = [emulator(TRUTH + sign * h)[k].force_N for sign in (1, -1)]
            slope = (ends[0] - ends[1]) / (2 * h[j])
            assert response.jacobian[:, j] == pytest.approx(slope, abs=1e-3 * np.abs(slope).max() + 1e-9)


def test_many_parameters_at_once_give_the_same_forces():
    emulator = bars_emulator(6)
    at = cloud(3, 0.2, seed=2)
    one_by_one = [np.concatenate([r.force_N for r in emulator(p)]) for p in at]
    assert emulator.predict_forces(at) == pytest.approx(np.array(one_by_one), rel=1e-12)


def test_a_calibration_on_the_emulator_is_one_on_the_solver():
    data = records(0.002, seed=3)
    slow = calibrate(simulate, data, PAPER)
    points = np.vstack([[i.parameters for i in slow.history], cloud(10, 0.2, centre=slow.parameters)])
    emulator = Emulator(points, [simulate(p) for p in points])
    fast = calibrate(emulator, data, type(PAPER)(NAMES, slow.parameters, PAPER.lower, PAPER.upper))
    errors = [np.mean(found.history[-1].errors_percent) for found in (slow, fast)]
    assert errors[1] == pytest.approx(errors[0], rel=0.05)


def test_failed_runs_are_left_out_and_one_run_is_no_emulator():
    points = cloud(5, 0.3)
    responses = [list(simulate(p)) for p in points]
    responses[2][1] = SiteResponse(responses[2][1].force_N, responses[2][1].jacobian, False, "stopped")
    assert len(Emulator(points, responses).points) == 4
    with pytest.raises(CalibrationError, match="two complete"):
        Emulator(points[:1], responses[:1])


def test_far_outside_its_runs_forces_stay_finite() -> None:
    found = bars_emulator(6)
    far = TRUTH * np.exp(40.0 * np.array([[1.0], [-1.0]]))
    with np.errstate(over="raise"):
        assert np.isfinite(found.predict_forces(far)).all()
        assert np.isfinite(found.predict_forces_and_sd(far)[0]).all()
        assert all(np.isfinite(one.force_N).all() for one in found(far[0]))
