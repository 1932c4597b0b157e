"""Each covariance is that of the estimator that was used, by 200 simulated calibrations of every kind."""

from dataclasses import replace

import numpy as np
import pytest
from bars import NAMES, PAPER, SITES, TRUTH, records, simulate

from limbfit.identify.fit.calibration import CalibrationSettings, calibrate
from limbfit.identify.fit.objective import SiteResponse, compute_residuals
from limbfit.identify.fit.parameters import Prior, group_separately
from limbfit.identify.uncertainty.noise import SiteNoise
from limbfit.identify.uncertainty.uncertainty import DETERMINED, estimate_uncertainty

DRAWS, SD = 200, 0.03
NOISE = [SiteNoise(d.name, np.arange(60.0), SD**2 * np.eye(60), SD, 0.0) for d in records()]
# Strong enough to hold what four sites tell worst, and one that they tell well.
KNOWN = (("muscle.gamma", 1.01), ("muscle.tau_s", 1.02), ("skin.c_kPa", 1.003))


def answers(settings, with_priors, medians_drawn):
    """200 calibrations of records with noise of 0.03 N and, where wanted, of priors whose medians are drawn.

    Errors (200, 8) of the logarithms of the answers, what is told of them, and the draws (200, 240 + 3) of
    noise and medians in standard deviations.
    """
    errors, told, draws = [], [], []
    for seed in range(DRAWS):
        data = records(SD, seed=seed)
        off = np.random.default_rng(1000 + seed).standard_normal(len(KNOWN)) * medians_drawn
        stated = [
            Prior(name, TRUTH[NAMES.index(name)] * factor**one, factor)
            for (name, factor), one in zip(KNOWN, off)
        ]
        start = replace(PAPER.with_start(TRUTH), priors=tuple(stated if with_priors else ()))
        found = calibrate(simulate, data, start, settings, stages=(group_separately(NAMES),))
        assert found.converged, found.reason
        errors.append(np.log(found.parameters / TRUTH))
        arguments = (found.parameters, found.responses, data, start, NOISE)
        told.append(estimate_uncertainty(*arguments, settings=settings))
        noise = [(d.force_N - c.force_N) / SD for d, c in zip(data, records())]
        draws.append(np.concatenate([*noise, off]))
    return np.array(errors), told, np.array(draws)


def actual_covariance(errors, draws):
    """Mean square of the errors (8, 8), with the luck of the draws taken out by a control variate.

    Any linear map of draws of unit variance has a covariance that is known; what the 200 draws make of it
    is off by the same luck as the errors are.
    """
    jacobian = np.concatenate([r.jacobian * TRUTH for r in simulate(TRUTH)])
    scale = np.concatenate([np.full(d.force_N.size, d.scale) for d in records()])
    by_noise = np.linalg.lstsq(jacobian * scale[:, None], np.diag(scale), rcond=None)[0]
    linear = np.zeros((8 + len(KNOWN), draws.shape[1]))
    linear[:8, : scale.size], linear[8:, scale.size :] = by_noise, np.eye(len(KNOWN))
    seen = np.flatnonzero(draws.any(axis=0))
    linear = linear[:, seen][linear[:, seen].any(axis=1)]
    linear = np.linalg.lstsq(draws[:, seen] @ linear.T, errors, rcond=None)[0].T @ linear
    drawn = draws[:, seen] @ linear.T
    return (errors.T @ errors - drawn.T @ drawn) / DRAWS + linear @ linear.T


def ratios(errors, told, draws, which):
    """Stated over actual variance of all that is determined: parameters, then principal axes of the stated.

    The stated one is the median: in one draw of seven noise alone looks like a little misfit as well.
    """
    _, axes = np.linalg.eigh(np.median([u.covariance for u in told], axis=0))
    rows = np.vstack([np.eye(8), axes.T])
    said = [[*u.verdicts, *(c.verdict for c in u.combinations)] for u in told]
    known = np.mean(np.array(said) == DETERMINED, axis=0) > 0.5
    assert known.sum() >= 12
    stated = np.median([np.einsum("ai,ij,aj->a", rows, getattr(u, which), rows) for u in told], axis=0)
    actual = np.einsum("ai,ij,aj->a", rows, actual_covariance(errors, draws), rows)
    return (stated / actual)[known]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("objective", "with_priors", "medians_drawn", "which"),
    [
        ("pointwise", False, False, "covariance"),
        ("paper", False, False, "covariance"),
        ("pointwise", True, True, "covariance"),
        ("pointwise", True, False, "sampling_covariance"),
    ],
    ids=["default", "paper", "priors, their medians drawn too", "the same priors, other noise"],
)
def test_the_covariance_is_that_of_the_calibration(objective, with_priors, medians_drawn, which):
    settings = CalibrationSettings(objective, relative_tolerance=1e-5, max_iterations=60)
    found = ratios(*answers(settings, with_priors, medians_drawn), which)
    assert np.all((found > 0.8) & (found < 1.25)), found.round(2)


def test_the_paper_objective_reaches_its_minimum():
    data = records(SD, seed=0)
    settings = CalibrationSettings("paper", relative_tolerance=1e-4, max_iterations=60)
    start = PAPER.with_start(TRUTH * np.exp(np.random.default_rng(0).normal(0, 0.1, 8)))
    found = calibrate(simulate, data, start, settings, stages=(group_separately(NAMES),))
    assert found.converged, found.reason
    assert found.evaluations <= 15
    r, J = compute_residuals("paper", found.responses, data)
    step = np.linalg.lstsq(J * found.parameters, -r, rcond=None)[0]
    assert np.abs(step).max() < 2e-3


@pytest.mark.parametrize("objective", ["pointwise", "paper"])
def test_the_curvature_is_the_second_derivative_of_the_cost(objective):
    site = replace(records(0.1)[1], weight=2.0)
    force, eye = SITES[1].force(TRUTH), np.eye(60)

    def gradient(at):
        r, J = compute_residuals(objective, [SiteResponse(at, eye)], [site])
        return r @ J

    W = site.compute_cost_curvature(objective, force - site.force_N)
    slopes = np.array([(gradient(force + h) - gradient(force - h)) / 2e-6 for h in 1e-6 * eye])
    assert slopes == pytest.approx(W, abs=1e-6 * np.abs(W).max())
    _, J = compute_residuals(objective, [SiteResponse(force, eye)], [site])
    normal = J.T @ J
    assert normal == pytest.approx(W, abs=1e-12 * np.abs(W).max())
