"""Posterior, profile and evidence against closed forms, and against each other on the bars."""

import numpy as np
import pytest
from bars import NAMES, PAPER, TRUTH, estimate, records, simulate

from limbfit.identify.fit.objective import MeasuredCurve, SiteResponse
from limbfit.identify.fit.parameters import Unknowns, build_space, group_by_kind, group_separately
from limbfit.identify.uncertainty.discrepancy import ResidualModel
from limbfit.identify.uncertainty.emulator import Emulator
from limbfit.identify.uncertainty.likelihood import (
    Likelihood,
    check_profile_ends,
    compare_models,
    compute_profile,
    fit_alternative,
)
from limbfit.identify.uncertainty.noise import SiteNoise
from limbfit.identify.uncertainty.posterior import sample_posterior
from limbfit.results.uncertainty import ModelEvidence

# A model that is linear in the logarithms, with Gaussian noise: everything has a closed form.
X = np.stack([np.ones(30), np.linspace(-1, 1, 30), np.linspace(-1, 1, 30) ** 2], axis=1)
ABOUT = 20.0
WIDE = Unknowns(("a", "b", "c"), np.ones(3), np.full(3, 0.01), np.full(3, 100.0))
SD = 0.05


def line(p):
    return [SiteResponse(ABOUT + X @ np.log(p), X / p)]


def linear_case(seed=0, sd=SD):
    rng = np.random.default_rng(seed)
    data = [MeasuredCurve("s", ABOUT + X @ [0.3, -0.2, 0.1] + sd * rng.standard_normal(30))]
    noise = SiteNoise("s", np.arange(30.0), sd**2 * np.eye(30), sd, 0.0)
    model = ResidualModel((noise,), np.array([ABOUT]), np.zeros(1), 0.2, 0.0)
    points = np.exp(np.random.default_rng(1).uniform(-1, 1, (5, 3)))
    emulator = Emulator(points, [line(p) for p in points], softening=1e4)
    space = build_space(WIDE, group_separately(WIDE.names))
    exact = np.linalg.lstsq(X, data[0].force_N - ABOUT, rcond=None)[0]
    return Likelihood(emulator, data, model, WIDE, space), exact, sd**2 * np.linalg.inv(X.T @ X)


def bars_case(noise=0.01, seed=4):
    data = records(noise, seed=seed)
    u = estimate(TRUTH, simulate(TRUTH), data)
    rng = np.random.default_rng(0)
    points = TRUTH * np.exp(0.25 * rng.uniform(-1, 1, (24, 8)))
    emulator = Emulator(points, [simulate(p) for p in points])
    return emulator, data, u


def test_the_likelihood_is_that_of_the_gaussian():
    likelihood, exact, _ = linear_case()
    best = likelihood.find_optimum(np.zeros(3))
    assert best.z == pytest.approx(exact, abs=1e-5)
    left = likelihood.measured[0].force_N - ABOUT - X @ exact
    full = left @ left / SD**2 + 30 * np.log(2 * np.pi * SD**2)
    assert best.minus_2_log == pytest.approx(full, rel=1e-4)
    assert likelihood.minus_2_log_of(line(best.parameters), best.parameters) == pytest.approx(full, rel=1e-4)


@pytest.mark.slow
def test_a_linear_posterior_is_the_closed_form():
    likelihood, exact, covariance = linear_case()
    found = sample_posterior(likelihood, exact, covariance, steps=1500, seed=1)
    assert found.long_enough
    assert np.log(found.median) == pytest.approx(exact, abs=0.15 * np.sqrt(np.diag(covariance)).max())
    assert found.covariance == pytest.approx(covariance, abs=0.15 * covariance.max())
    again = sample_posterior(likelihood, exact, covariance, steps=1500, seed=1)
    assert np.array_equal(found.samples, again.samples)


def test_a_linear_profile_is_the_closed_form():
    likelihood, exact, covariance = linear_case()
    best = likelihood.find_optimum(np.zeros(3))
    for k in range(3):
        sd = float(np.sqrt(covariance[k, k]))
        found = compute_profile(likelihood, best, k, sd)
        assert np.log(found.interval_95) == pytest.approx(
            exact[k] + 1.96 * sd * np.array([-1, 1]), abs=0.02 * sd
        )
        assert found.rise == pytest.approx(((np.log(found.values) - exact[k]) / sd) ** 2, abs=0.02)
        assert found.verdict == "determined on both sides"


def test_uninformative_data_open_the_profile():
    likelihood, exact, covariance = linear_case(sd=30.0)
    best = likelihood.find_optimum(np.clip(exact, -4, 4))
    found = compute_profile(likelihood, best, 2, float(np.sqrt(covariance[2, 2])))
    assert found.verdict != "determined on both sides"
    open_side = found.closed.index(False)
    assert found.interval_95[open_side] == pytest.approx((0.01, 100.0)[open_side])


def test_bars_all_three_intervals_agree_and_hold_the_truth():
    emulator, data, u = bars_case(0.003)
    space = build_space(PAPER, group_separately(NAMES))
    likelihood = Likelihood(emulator, data, u.residual_model, PAPER, space)
    best = likelihood.find_optimum(np.log(TRUTH))
    found = sample_posterior(likelihood, best.z, u.covariance, steps=400, seed=2)
    assert np.log(found.median / best.parameters) == pytest.approx(np.zeros(8), abs=0.1)
    sampled = (np.log(found.samples) @ np.array([c.weights for c in u.combinations]).T).std(axis=0)
    stated = np.array([np.sqrt(c.weights @ u.covariance @ c.weights) for c in u.combinations])
    # Stated is what the calibration reaches with its own weights, which is never less.
    assert np.all((sampled / stated > 0.5) & (sampled / stated < 1.8)), sampled / stated
    sd = np.sqrt(u.covariance[4, 4])
    one = compute_profile(likelihood, best, 4, sd)
    width = np.log(one.interval_95[1] / one.interval_95[0]) / (2 * 1.96)
    assert 0.5 < width / sd < 1.8
    assert one.interval_95[0] < TRUTH[4] < one.interval_95[1]
    ends = check_profile_ends(
        likelihood, best, simulate(best.parameters), one, [simulate(p) for p in one.ends]
    )
    assert ends.largest_difference < 0.5


def two_models(truth, noise=0.003):
    data = records(noise, seed=6, truth=truth)
    u = estimate(truth, simulate(truth), data)
    middle = np.sqrt(truth * np.r_[truth[4:], truth[:4]])
    rng = np.random.default_rng(0)
    points = np.vstack(
        [
            truth * np.exp(0.3 * rng.uniform(-1, 1, (20, 8))),
            middle * np.exp(0.3 * rng.uniform(-1, 1, (20, 8))),
        ]
    )
    emulator = Emulator(points, [simulate(p) for p in points])
    found = []
    for name, grouping in (
        ("one material", group_by_kind(NAMES)),
        ("two materials", group_separately(NAMES)),
    ):
        space = build_space(PAPER, grouping)
        likelihood = Likelihood(emulator, data, u.residual_model, PAPER, space)
        found.append(
            fit_alternative(name, likelihood, space.reduce(np.log(middle if len(found) == 0 else truth)))[0]
        )
    return found


def test_the_evidence_is_the_likelihood_s_mean_over_the_bounds():
    likelihood, exact, covariance = linear_case()
    model, at = fit_alternative("line", likelihood, exact)
    axis = np.linspace(-6, 6, 41)
    grid = np.stack(np.meshgrid(axis, axis, axis), axis=-1).reshape(-1, 3)
    L = np.linalg.cholesky(covariance)
    rise = likelihood.compute_minus_2_log(at.z + grid @ L.T) - at.minus_2_log
    volume = (axis[1] - axis[0]) ** 3 * np.linalg.det(L)
    box = np.prod(likelihood.space.upper - likelihood.space.lower)
    mean = np.sum(np.exp(-rise / 2)) * volume / box
    assert model.minus_2_log_evidence == pytest.approx(at.minus_2_log - 2 * np.log(mean), abs=0.05)


def test_a_parameter_that_the_records_do_not_tell_costs_nothing():
    """Ten effective samples for nine parameters: a criterion that counts both would be far off."""
    likelihood, exact, _ = linear_case()
    three, _ = fit_alternative("three", likelihood, exact)
    names = ("a", "b", "c", *"defghi")
    more = Unknowns(names, np.ones(9), np.full(9, 0.01), np.full(9, 100.0))

    def silent(p):
        return [SiteResponse(r.force_N, np.pad(r.jacobian, ((0, 0), (0, 6)))) for r in line(p[:3])]

    points = np.exp(np.random.default_rng(1).uniform(-1, 1, (12, 9)))
    emulator = Emulator(points, [silent(p) for p in points], softening=1e4)
    space = build_space(more, group_separately(names))
    wide = Likelihood(emulator, likelihood.measured, likelihood.model, more, space)
    found, _ = fit_alternative("nine", wide, np.r_[exact, np.zeros(6)])
    per_parameter = (found.minus_2_log_evidence - three.minus_2_log_evidence) / 6
    assert abs(per_parameter) < 0.7  # of the bounds taken as a Gaussian: log(6 / pi) = 0.65
    assert compare_models(three, three).better == ""


def test_two_materials_are_supported_where_there_are_two():
    one, two = two_models(TRUTH)
    assert compare_models(one, two).better == "two materials"
    assert "strongly" in compare_models(one, two).verdict


def test_one_material_is_supported_where_there_is_one():
    one, two = two_models(np.tile([5.0, 4.5, 2.5, 0.4], 2))
    assert one.minus_2_log_evidence < two.minus_2_log_evidence
    assert compare_models(one, two).better == "one material"


def test_held_out_errors_speak_where_the_fit_does_not():
    one, two = (candidate_like(name) for name in ("one material", "two materials"))
    rng = np.random.default_rng(0)
    errors = 5 + rng.standard_normal(12)
    alike = compare_models(one, two, errors, errors + 0.1 * rng.standard_normal(12))
    assert alike.better == ""
    better = compare_models(one, two, errors, errors - 2 + 0.1 * rng.standard_normal(12))
    assert better.better == "two materials"
    assert "predict better" in better.verdict


def candidate_like(name):
    return ModelEvidence(
        name=name,
        parameters=3,
        minus_2_log=10.0,
        effective_samples=30.0,
        misfit_factor=1.0,
        minus_2_log_evidence=16.0,
    )
