"""Uncertainty told plainly: intervals that cover, verdicts that match what the data can see."""

from __future__ import annotations

import json

import numpy as np
import pytest
from bars import BARS, PAPER, SITES, TRUE_THREE, TRUTH, records, simulate, three_tissues
from scipy.stats import t as student

from limbfit.identify import (
    DETERMINED,
    UNDETERMINED,
    Measured,
    calibrate,
    error_percent,
    estimate_uncertainty,
    prediction_sd,
    separate,
    summarise,
)


def fitted(data, run=simulate):
    found = calibrate(run, data, PAPER)
    return found, estimate_uncertainty(found.parameters, found.responses, data, PAPER)


def linear_fit(data, truth=TRUTH, sites=SITES, unknowns=PAPER):
    """Uncertainty at the truth, without the nonlinear part: one Gauss-Newton step from there."""
    responses = [site.respond(truth) for site in sites]
    J = np.concatenate([r.jacobian * truth * d.scale for r, d in zip(responses, data)])
    r = np.concatenate([(r.force_N - d.force_N) * d.scale for r, d in zip(responses, data)])
    step = np.linalg.lstsq(J, -r, rcond=None)[0]
    moved = [type(r)(r.force_N + r.jacobian @ (truth * step), r.jacobian) for r in responses]
    return step, estimate_uncertainty(truth, moved, data, unknowns)


def coverage(noise_of, repeats=200, truth=TRUTH, sites=SITES, unknowns=PAPER):
    """Share of repeats in which each combination's 95 % interval holds the truth, the best known half."""
    inside, clean = [], records(truth=truth, sites=sites)
    for seed in range(repeats):
        rng = np.random.default_rng(seed)
        data = [Measured(d.name, d.force_N + noise_of(rng, d.force_N.size)) for d in clean]
        step, u = linear_fit(data, truth, sites, unknowns)
        t = student.ppf(0.975, u.degrees_of_freedom)
        inside.append([abs(c.weights @ step) < t * c.sd_log for c in u.combinations[: len(truth) // 2]])
    return np.mean(inside, axis=0)


def test_intervals_cover_the_truth_under_white_noise():
    shares = coverage(lambda rng, n: 0.03 * rng.standard_normal(n))
    assert np.all((shares > 0.90) & (shares < 0.99)), shares


def test_intervals_of_three_tissues_cover_the_truth_with_four_sites():
    shares = coverage(
        lambda rng, n: 0.03 * rng.standard_normal(n),
        repeats=100,
        truth=TRUE_THREE,
        sites=BARS[:4],
        unknowns=three_tissues(),
    )
    assert np.all(shares > 0.88), shares
    assert shares.mean() < 0.99


def test_intervals_still_cover_where_the_noise_drifts():
    def drifting(rng, n):
        noise = np.zeros(n)
        for k in range(1, n):
            noise[k] = 0.8 * noise[k - 1] + 0.6 * 0.03 * rng.standard_normal()
        return noise

    shares = coverage(drifting)
    assert np.all(shares > 0.80), shares


def test_verdicts_after_a_calibration_and_intervals_around_the_answer():
    found, u = fitted(records(0.01, seed=4))
    assert np.all(u.intervals_95[:, 0] < found.parameters)
    assert np.all(u.intervals_95[:, 1] > found.parameters)
    assert np.mean((u.intervals_95[:, 0] < TRUTH) & (u.intervals_95[:, 1] > TRUTH)) >= 0.75
    assert u.verdicts[0] == u.verdicts[4] == DETERMINED
    assert not any(u.at_bound)
    assert [n.sd_N for n in u.noise] == pytest.approx([0.01] * 4, rel=0.3)
    json.dumps(u.to_dict(), allow_nan=False)


def test_one_site_does_not_determine_two_materials():
    site = SITES[3]
    data = records(0.03, sites=[site])
    found, u = fitted(data, lambda p: [site.respond(p)])
    assert found.converged, found.reason
    skin = u.verdicts[:4]
    assert UNDETERMINED in skin
    assert u.verdicts.count(DETERMINED) < 4
    assert u.combinations[0].verdict == DETERMINED
    assert u.combinations[-1].verdict == UNDETERMINED


def test_a_parameter_without_influence_is_known_by_its_bounds_only():
    def blind(parameters):
        responses = simulate(np.r_[parameters[:7], TRUTH[7]])
        return [type(r)(r.force_N, r.jacobian * [1, 1, 1, 1, 1, 1, 1, 0]) for r in responses]

    _, u = fitted(records(0.03), blind)
    assert u.verdicts[7] == UNDETERMINED
    assert u.sd_log[7] == pytest.approx(np.log(1000) / np.sqrt(12), rel=1e-6)
    assert np.abs(u.correlation[7, :7]).max() < 1e-6
    assert u.combinations[-1].text == "muscle.tau_s^1.00"


def test_two_tissues_that_cannot_be_told_apart_are_correlated():
    def twins(parameters):
        mean = np.tile(np.sqrt(parameters[:4] * parameters[4:]), 2)
        half = np.hstack([np.diag(mean[:4] / parameters[:4]), np.diag(mean[:4] / parameters[4:])]) / 2
        responses = simulate(mean)
        return [type(r)(r.force_N, (r.jacobian[:, :4] + r.jacobian[:, 4:]) @ half) for r in responses]

    truth = np.tile(np.sqrt(TRUTH[:4] * TRUTH[4:]), 2)
    _, u = fitted(records(0.02, truth=truth), twins)
    assert u.correlation[0, 4] < -0.95
    assert u.verdicts[0] == UNDETERMINED
    known = u.combinations[0].weights
    assert known[:4] == pytest.approx(known[4:], abs=1e-6)


def test_drifting_residuals_widen_the_intervals():
    rng = np.random.default_rng(0)
    white = rng.standard_normal(60)
    drift = np.cumsum(white) - np.linspace(0, white.sum(), 60)
    drift *= white.std() / drift.std()
    wide, narrow = (
        linear_fit([Measured(d.name, d.force_N + 0.03 * e) for d in records()])[1] for e in (drift, white)
    )
    assert wide.noise[0].effective_samples < 0.5 * narrow.noise[0].effective_samples
    assert np.median(wide.sd_log / narrow.sd_log) > 1.5


def test_an_answer_on_its_bound_is_flagged():
    upper = PAPER.upper.copy()
    upper[0] = 6.0
    bounded = type(PAPER)(PAPER.names, PAPER.start, PAPER.lower, upper)
    data = records(0.01)
    found = calibrate(simulate, data, bounded)
    u = estimate_uncertainty(found.parameters, found.responses, data, bounded)
    assert u.at_bound == (True,) + (False,) * 7
    assert u.intervals_95[0, 1] <= 6.0


def test_a_perfect_fit_is_no_division_by_zero():
    data = records()
    u = estimate_uncertainty(TRUTH, simulate(TRUTH), data, PAPER)
    assert np.all(np.isfinite(u.covariance))
    assert set(u.verdicts) == {DETERMINED}


def test_prediction_intervals_match_the_spread_of_predictions():
    held_out = SITES[1]
    forces, predicted = [], None
    for seed in range(60):
        rest = [SITES[k] for k in (0, 2, 3)]
        data = records(0.03, seed=seed, sites=rest)
        found = calibrate(
            lambda p: [s.respond(p) for s in rest],  # noqa: B023
            data,
            type(PAPER)(PAPER.names, TRUTH, PAPER.lower, PAPER.upper),
            stages=(separate(PAPER.names),),
        )
        forces.append(held_out.force(found.parameters))
        if seed == 0:
            u = estimate_uncertainty(found.parameters, found.responses, data, PAPER)
            predicted = prediction_sd(
                held_out.respond(found.parameters).jacobian, found.parameters, u.covariance
            )
    spread = np.std(forces, axis=0)
    ratio = predicted[10:50] / spread[10:50]
    assert 0.6 < np.median(ratio) < 1.7


def test_noise_adds_to_a_prediction():
    sd = prediction_sd(np.zeros((3, 2)), np.ones(2), np.eye(2), noise_N=0.05)
    assert sd == pytest.approx([0.05] * 3)


def test_the_error_is_the_papers():
    assert error_percent(np.array([1.0, 2.0, 3.0]), np.array([1.0, 2.5, 4.0])) == pytest.approx(12.5)
    summary = summarise([1.0, 2.0, 6.0])
    assert (summary.sites, summary.mean_percent, summary.largest_percent) == (3, 3.0, 6.0)
    assert summary.sd_percent == pytest.approx(np.std([1, 2, 6], ddof=1))
    assert np.isnan(summarise([]).mean_percent)
