"""From a calibration to posterior and profiles with few runs; sources as shifts; coverage of it all."""

import numpy as np
import pytest
from bars import NAMES, PAPER, SITES, TRUTH, estimate, records, simulate
from coverage_study import coverage_study

from limbfit.identify.fit.calibration import calibrate
from limbfit.identify.fit.objective import SiteResponse
from limbfit.identify.fit.parameters import build_space, group_by_kind, group_separately
from limbfit.identify.fit.prediction import compute_errors_percent
from limbfit.identify.uncertainty.noise import estimate_curve_noise
from limbfit.identify.uncertainty.posterior import ExplorationSettings, Posterior, explore_posterior
from limbfit.identify.uncertainty.uncertainty import FitSensitivity, compute_principal_axes
from limbfit.results.uncertainty import LikelihoodProfile

SPACE = build_space(PAPER, group_separately(NAMES))


def calibrated(noise=0.03):
    data = records(noise, seed=4)
    found = calibrate(simulate, data, PAPER.with_start(TRUTH), stages=(group_separately(NAMES),))
    return data, found, estimate(found.parameters, found.responses, data)


@pytest.mark.slow
def test_an_exploration_spends_its_runs_and_holds_the_truth():
    _, found, known = calibrated()
    asked = []

    def many(points):
        asked.extend(points)
        return [simulate(p) for p in points]

    earlier = [np.array(i.parameters) for i in found.history]
    settings = ExplorationSettings(runs=24, batch=4, steps=600, checked=1)
    done = explore_posterior(many, known, earlier, settings)
    # A check asks for the optimum and two ends of a profile, the narrowest and the widest.
    assert len(asked) <= len(earlier) + 24 + 5
    assert done.good_enough
    assert max(done.rounds[-1].error_percent) < min(done.needed_percent)
    inside = [low < true < high for true, (low, high) in zip(TRUTH, done.posterior.intervals_95)]
    assert sum(inside) >= 6
    assert {one.name for one in done.profiles} == set(NAMES)
    assert done.checks[0].largest_difference < 0.5


def test_failed_runs_do_not_stop_an_exploration():
    _, found, known = calibrated()

    def flaky(points):
        runs = [list(simulate(p)) for p in points]
        bad = runs[-1][0]
        runs[-1][0] = SiteResponse(bad.force_N, bad.jacobian, False, "stopped")
        return runs

    settings = ExplorationSettings(runs=8, batch=8, steps=100, checked=0)
    earlier = [np.array(i.parameters) for i in found.history]
    done = explore_posterior(flaky, known, earlier, settings)
    assert len(done.runs) == len(earlier) + 8 - 2
    assert max(compute_errors_percent(done.likelihood.emulator(TRUTH), simulate(TRUTH))) < 0.5


def test_a_source_shifts_the_answer_as_a_new_calibration_would():
    data, found, known = calibrated(0.001)
    gain = FitSensitivity.linearise(known, found.responses)
    bump = [0.002 * d.force_N for d in data]

    def changed(p):
        return [SiteResponse(r.force_N + b, r.jacobian) for r, b in zip(simulate(p), bump)]

    again = calibrate(changed, data, PAPER.with_start(found.parameters), stages=(group_separately(NAMES),))
    # The two weigh the records differently, so the shift is the same in what all sites agree on.
    moved = np.log(again.parameters / found.parameters)
    assert gain.compute_shift(bump)[[0, 4]] == pytest.approx(moved[[0, 4]], abs=5e-4)
    assert gain.compute_shift(bump)[[0, 4]] == pytest.approx([-0.002, -0.002], abs=5e-4)
    alone = gain.compute_covariance(bump, shared=False)
    parts = [gain.matrices[k] @ bump[k] for k in range(len(SITES))]
    assert alone == pytest.approx(sum(np.outer(part, part) for part in parts))
    assert gain.compute_covariance(bump, shared=True) == pytest.approx(
        np.outer(gain.compute_shift(bump), gain.compute_shift(bump))
    )


@pytest.mark.slow
def test_coverage_of_whole_calibrations():
    def record(repeat, forces):
        data = records(0.03, seed=repeat)
        return data, estimate_curve_noise([SiteResponse(f, np.zeros((60, 0))) for f in forces], data)

    found = coverage_study(simulate, TRUTH, PAPER, record, repeats=20).linearised
    assert found.determined.mean() > 0.99
    assert 0.88 < found.share <= 1.0
    low, high = found.limits()
    assert low == pytest.approx(0.85)
    assert high == pytest.approx(1.0)
    assert found.by_parameter.mean() > 0.85


def test_combinations_of_bent_draws_are_as_wide_as_the_bend():
    rng = np.random.default_rng(0)
    along = rng.normal(0, 0.6, 4000)
    logs = np.log(TRUTH) + 0.02 * rng.standard_normal((4000, TRUTH.size))
    logs[:, 0] += along
    logs[:, 1] += 0.5 * along**2
    posterior = Posterior(NAMES, np.exp(logs), np.ones(4000), 0.3, 1.0, 4000.0, True)
    axes = compute_principal_axes(posterior.covariance, SPACE)
    assert axes @ axes.T == pytest.approx(np.eye(TRUTH.size), abs=1e-12)
    widths = (np.log(posterior.samples) @ axes.T).std(axis=0)
    assert (np.diff(widths) > 0).all()
    assert widths[-2] == pytest.approx(np.sqrt(0.5) * 0.6**2, rel=0.1)  # of half the square
    assert abs(axes[-2, 1]) > 0.95
    tied = build_space(PAPER, group_by_kind(NAMES))
    rows = compute_principal_axes(posterior.covariance, tied)
    assert rows.shape == (4, TRUTH.size)
    assert rows[:, :4] == pytest.approx(rows[:, 4:])


@pytest.fixture(scope="module")
def vague():
    """Records that leave some parameters open, and what is found with few runs; one end of the narrowest
    profile cannot be simulated."""
    _, found, known = calibrated(noise=0.5)

    def failing(points):
        runs = [list(simulate(p)) for p in points]
        if len(points) == 5:  # the optimum and the ends of two profiles
            end = runs[2][0]
            runs[2][0] = SiteResponse(end.force_N, end.jacobian, False, "stopped")
        return runs

    earlier = [np.array(i.parameters) for i in found.history]
    settings = ExplorationSettings(runs=8, batch=8, steps=100, checked=1)
    return explore_posterior(failing, known, earlier, settings)


def test_profiles_say_where_they_are_extrapolated(vague):
    low, high = vague.likelihood.emulator.lower, vague.likelihood.emulator.upper
    for one in vague.profiles:
        k = NAMES.index(one.name)
        beyond = (one.values < low[k]) | (one.values > high[k])
        assert np.all(one.extrapolated[beyond]), one.name
        for at_bound, end, said in zip((0, 1), one.ends, one.ends_extrapolated):
            outside = bool(np.any((end < low * (1 - 1e-9)) | (end > high * (1 + 1e-9))))
            assert said == outside, (one.name, at_bound)
        assert LikelihoodProfile.model_validate(one).extrapolated == one.extrapolated.tolist()
    ends = [end for one in vague.profiles for end in one.ends_extrapolated]
    assert any(ends)
    assert not all(ends)
    assert any(not all(one.closed) for one in vague.profiles)


def test_the_solver_is_asked_at_the_ends_of_the_widest_profile_too(vague):
    widths = {one.name: one.interval_95[1] / one.interval_95[0] for one in vague.profiles}
    checks = {check.why: check for check in vague.checks}
    assert checks["narrowest"].name == min(widths, key=widths.get)
    assert checks["widest"].name == max(widths, key=widths.get)
    widest = next(one for one in vague.profiles if one.name == checks["widest"].name)
    assert checks["widest"].extrapolated == widest.ends_extrapolated
    assert None not in checks["widest"].solved


def test_an_end_that_cannot_be_simulated_is_told(vague):
    narrowest = next(check for check in vague.checks if check.why == "narrowest")
    assert [end is None for end in narrowest.solved] == [False, True]
