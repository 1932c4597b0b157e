"""Uncertainty told plainly: intervals that cover, verdicts that match what the data can see."""

from dataclasses import replace

import numpy as np
import pytest
from bars import (
    BARS,
    PAPER,
    SITES,
    TRUE_THREE,
    TRUTH,
    Bars,
    estimate,
    records,
    simulate,
    simulate_at,
    three_tissues,
)
from scipy.linalg import block_diag

from limbfit.identify.fit.calibration import calibrate
from limbfit.identify.fit.objective import MeasuredCurve, SiteResponse
from limbfit.identify.fit.parameters import group_separately
from limbfit.identify.fit.prediction import (
    MAX_FREEDOM,
    NORMAL_95,
    PredictionModel,
    combine_freedom,
    compute_error_percent,
    summarise_errors,
)
from limbfit.identify.uncertainty.discrepancy import ResidualModel, _RestrictedLikelihood, compute_matern
from limbfit.identify.uncertainty.noise import estimate_curve_noise
from limbfit.identify.uncertainty.uncertainty import DETERMINED, GIVEN, UNDETERMINED
from limbfit.results.identification import RecordResiduals


def fitted(data, run=simulate):
    found = calibrate(run, data, PAPER)
    return found, estimate(found.parameters, found.responses, data)


def linear_fit(data, truth=TRUTH, sites=SITES, unknowns=PAPER, mesh_N=(), site_N=()):
    """How far one Gauss-Newton step from the truth goes, in logarithms, and the uncertainty there."""
    responses = [site.respond(truth) for site in sites]
    J = np.concatenate([r.jacobian * truth * d.scale for r, d in zip(responses, data)])
    r = np.concatenate([(r.force_N - d.force_N) * d.scale for r, d in zip(responses, data)])
    step = np.linalg.lstsq(J, -r, rcond=None)[0]
    moved = [type(r)(r.force_N + r.jacobian @ (truth * step), r.jacobian) for r in responses]
    return step, estimate(truth, moved, data, unknowns, mesh_N=mesh_N, site_N=site_N)


def coverage(noise_of, repeats=100, truth=TRUTH, sites=SITES, unknowns=PAPER, stiffer=0.0, expected=0.0):
    """Share of repeats in which each combination's 95 % interval holds the truth, the best known half.

    Sites are ``stiffer`` at random, by one standard deviation, where ``expected`` is what is said of that.
    """
    inside, clean = [], records(truth=truth, sites=sites)
    for seed in range(repeats):
        rng = np.random.default_rng(seed)
        forces = [(1 + stiffer * rng.standard_normal()) * d.force_N for d in clean]
        data = [MeasuredCurve(d.name, f + noise_of(rng, f.size)) for d, f in zip(clean, forces)]
        site_N = [expected * d.force_N for d in clean] if expected else ()
        off, u = linear_fit(data, truth, sites, unknowns, site_N=site_N)
        best = u.combinations[: len(truth) // 2]
        inside.append([abs(c.weights @ off) < np.log(c.factor_95) for c in best])
    return np.mean(inside, axis=0)


def smooth_misfit(rng, n, length=0.2, size=0.05):
    """A misfit that wanders along the record, and a little noise."""
    L = np.linalg.cholesky(compute_matern(np.arange(float(n)), length) + 1e-9 * np.eye(n))
    return size * L @ rng.standard_normal(n) + 0.004 * rng.standard_normal(n)


@pytest.mark.slow
def test_intervals_cover_the_truth_under_white_noise():
    shares = coverage(lambda rng, n: 0.03 * rng.standard_normal(n))
    assert np.all((shares > 0.90) & (shares < 0.99)), shares


@pytest.mark.slow
def test_intervals_of_three_tissues_cover_the_truth_with_four_sites():
    shares = coverage(
        lambda rng, n: 0.03 * rng.standard_normal(n),
        repeats=80,
        truth=TRUE_THREE,
        sites=BARS[:4],
        unknowns=three_tissues(),
    )
    assert np.all(shares > 0.85), shares
    assert shares.mean() < 0.995


@pytest.mark.slow
def test_intervals_cover_the_truth_where_the_model_is_wrong():
    shares = coverage(smooth_misfit, repeats=100)
    assert np.all(shares > 0.86), shares
    assert 0.90 < shares.mean() < 0.99


@pytest.mark.parametrize("stiffer", [0.02, pytest.param(0.06, marks=pytest.mark.slow)])
def test_intervals_cover_the_truth_where_sites_are_of_other_stiffness(stiffer):
    """Stiffness that scatters from site to site by as much as expected, or three times as much."""
    shares = coverage(
        lambda rng, n: 0.02 * rng.standard_normal(n), repeats=24, stiffer=stiffer, expected=0.02
    )
    assert shares.mean() > 0.9, shares
    without = coverage(lambda rng, n: 0.02 * rng.standard_normal(n), repeats=24, stiffer=stiffer)
    assert without.mean() < shares.mean() - 0.1, without


@pytest.mark.parametrize(("sites", "freedom"), [(SITES, (3, 6)), (3 * SITES, (15, 30))])
def test_how_far_sites_are_off_is_found_and_few_sites_tell_it_poorly(sites, freedom):
    """Sites that differ by 10 % where 2 % is expected: a factor of 5."""
    clean, found = records(sites=sites), []
    for seed in range(6):
        rng = np.random.default_rng(seed)
        data = [replace(d, force_N=(1 + 0.1 * rng.standard_normal()) * d.force_N) for d in clean]
        data = [replace(d, force_N=d.force_N + 0.01 * rng.standard_normal(60)) for d in data]
        data = [replace(d, name=f"s{i}") for i, d in enumerate(data)]
        _, known = linear_fit(data, sites=sites, site_N=[0.02 * d.force_N for d in clean])
        found.append(known.residual_model)
    assert 3.0 < np.median([model.site_factor for model in found]) < 7.0
    assert all(freedom[0] < model.site_freedom < freedom[1] for model in found)
    inside = [np.quantile(m.site_factors, 0.025) < 5.0 < np.quantile(m.site_factors, 0.975) for m in found]
    assert np.mean(inside) > 0.6


def test_few_sites_widen_the_interval_of_a_site():
    """Deviations are normal for each site factor; where that is uncertain, they have Student's tails."""
    size = np.ones(1)
    known = ResidualModel((), size, size, 0.1, 5.0, site_factor=3.0, site_factors=np.full(9, 3.0))
    assert known.site_freedom == MAX_FREEDOM
    rng = np.random.default_rng(0)
    factors = 2.0 * np.sqrt(6 / rng.chisquare(6, 4000))  # Student's distribution with six degrees of freedom
    few = replace(known, site_factor=2.0, site_factors=factors)
    assert 5.0 < few.site_freedom < 7.5


def test_degrees_of_freedom_of_a_sum_are_those_of_its_largest_estimated_part():
    assert combine_freedom((1.0, 7.0)) == pytest.approx(7.0)
    assert combine_freedom((0.5, 4.0), (0.5, 4.0)) == pytest.approx(8.0)
    np.testing.assert_allclose(combine_freedom((np.array([0.0, 1.0]), 4.0)), [MAX_FREEDOM, 4.0])


def test_the_error_of_the_mesh_is_in_the_intervals():
    """Records of a finer mesh, 3 % softer everywhere: c takes it all, and no residual tells of it."""
    softer = [replace(record, force_N=0.97 * record.force_N) for record in records()]
    softer = [replace(d, force_N=d.force_N + n) for d, n in zip(softer, scatter(0.01))]
    step, without = linear_fit(softer)
    mesh = [0.03 * record.force_N for record in records()]
    _, counted = linear_fit(softer, mesh_N=mesh)

    def farthest(u):
        return max(abs(c.weights @ step) / np.log(c.factor_95) for c in u.combinations)

    assert farthest(without) > 2
    assert farthest(counted) < 1
    told = [u.residual_model.summarise().sites["s0"].mesh_share for u in (without, counted)]
    assert told[0] is None
    assert 0.005 < told[1] < 0.03
    stored = counted.residual_model.summarise()
    assert stored.sites["s0"].mesh_N == pytest.approx(mesh[0])
    assert stored.mesh_misfit.share < 0.002
    assert without.residual_model.summarise().mesh_misfit is None


def test_records_of_a_site_share_the_error_of_its_mesh():
    """A second record of every site says nothing more of what its mesh lacks."""
    mesh = [0.03 * record.force_N for record in records()]
    twice = [replace(d, name=f"{d.name}-2", site=d.name) for d in records()]
    noisy = [replace(d, force_N=d.force_N + n) for d, n in zip([*records(), *twice], 2 * scatter(0.01))]
    responses = 2 * simulate(TRUTH)
    one = estimate(TRUTH, responses[:4], noisy[:4], mesh_N=mesh)
    both = estimate(TRUTH, responses, noisy, mesh_N=2 * mesh)
    apart = estimate(TRUTH, responses, [replace(d, site="") for d in noisy], mesh_N=2 * mesh)
    stiffness = np.eye(8)[0] + np.eye(8)[4]  # both moduli, which the mesh moves

    def sd(found):
        return float(np.sqrt(stiffness @ found.covariance @ stiffness))

    assert sd(both) > 0.9 * sd(one)
    assert sd(apart) < 0.8 * sd(one)
    model = both.residual_model
    rows = [np.cos(np.arange(60.0))[:, None] + i for i in range(8)]
    E = np.concatenate(model.shared_deviations)
    whole = block_diag(*(model.own_covariance(i) for i in range(8))) + E @ E.T
    assert np.concatenate(model.solve(rows)) == pytest.approx(np.linalg.solve(whole, np.concatenate(rows)))


def scatter(sd):
    rng = np.random.default_rng(4)
    return [sd * rng.standard_normal(record.force_N.size) for record in records()]


def test_misfit_and_noise_are_told_apart():
    rng = np.random.default_rng(1)
    data = [MeasuredCurve(d.name, d.force_N + smooth_misfit(rng, d.force_N.size)) for d in records()]
    model = linear_fit(data)[1].residual_model
    noise = [site.sd_N for site in model.noise]
    assert noise == pytest.approx([0.004] * 4, rel=0.5)
    assert np.median(model.misfit * model.peaks_N) == pytest.approx(0.05, rel=0.5)
    assert 0.07 < model.correlation < 0.6
    assert model.known_scale > 10
    only_noise = linear_fit(records(0.03, seed=2))[1].residual_model
    assert np.median(only_noise.misfit * only_noise.peaks_N) < 0.015
    assert only_noise.effective_samples() > 3 * model.effective_samples()


def test_intervals_are_useful_where_the_model_is_wrong_a_little():
    """Misfit of one percent of the force, smooth: well narrower than the bounds, unlike one free residual."""
    rng = np.random.default_rng(3)
    data = [
        MeasuredCurve(d.name, d.force_N + smooth_misfit(rng, d.force_N.size, 0.2, 0.01 * d.force_N.max()))
        for d in records()
    ]
    u = linear_fit(data)[1]
    assert u.verdicts[4] == DETERMINED
    assert sum(verdict != UNDETERMINED for verdict in u.verdicts) >= 6
    assert np.min(u.degrees_of_freedom) > 5


def test_a_misfit_that_jumps_where_the_indenter_turns_is_not_many_times_larger_than_what_is_seen():
    """Tissue relaxes with two times, 0.15 and 3 s, where the model has one."""

    def relax(site: Bars, gamma: float, tau_s: float) -> np.ndarray:
        p = TRUTH.copy()
        p[[2, 6]], p[[3, 7]] = gamma, tau_s
        return site.force(p)

    rng = np.random.default_rng(0)
    forces = [relax(site, 2.0, 0.15) + relax(site, 2.0, 3.0) - relax(site, 0.0, 1.0) for site in SITES]
    data = [MeasuredCurve(f"s{k}", f + 0.01 * rng.standard_normal(f.size)) for k, f in enumerate(forces)]
    found, u = fitted(data)
    seen = [
        np.sqrt(np.mean((response.force_N - own.force_N) ** 2))
        for response, own in zip(found.responses, data)
    ]
    misfit = u.residual_model.misfit * u.residual_model.peaks_N
    assert np.all(np.array(seen) < misfit)
    assert np.all(misfit < 4 * np.array(seen))


def test_uninformative_data_flip_the_verdict():
    said = [linear_fit(records(noise, seed=5))[1].verdicts for noise in (0.003, 3.0, 30.0)]
    assert said[0].count(DETERMINED) >= 6
    assert said[1].count(DETERMINED) == 0
    assert said[2].count(UNDETERMINED) >= 6


@pytest.mark.slow
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
    assert [n.sd_N for n in u.residual_model.noise] == pytest.approx([0.01] * 4, rel=0.3)


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
    assert np.sqrt(u.covariance[7, 7]) == pytest.approx(np.log(1000) / np.sqrt(12), rel=1e-6)
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


def test_what_is_given_is_not_called_identified():
    data, grouping = records(0.01), (0, 1, 2, -1, 3, 4, 5, -1)
    u = estimate(TRUTH, simulate(TRUTH), data, grouping=grouping)
    assert u.verdicts[3] == u.verdicts[7] == GIVEN
    assert u.covariance[3, 3] == 0
    assert len(u.combinations) == 6


def test_an_answer_on_its_bound_is_flagged():
    upper = PAPER.upper.copy()
    upper[0] = 6.0
    bounded, data = replace(PAPER, upper=upper), records(0.01)
    found = calibrate(simulate, data, bounded)
    u = estimate(found.parameters, found.responses, data, bounded)
    assert u.at_bound == (True,) + (False,) * 7
    assert u.intervals_95[0, 1] <= 6.0


def test_a_perfect_fit_is_no_division_by_zero():
    u = estimate(TRUTH, simulate(TRUTH), records())
    assert np.all(np.isfinite(u.covariance))
    assert set(u.verdicts) == {DETERMINED}


def test_prediction_intervals_match_the_spread_of_predictions():
    held_out, rest = SITES[1], [SITES[k] for k in (0, 2, 3)]
    forces, predicted, stages = [], None, (group_separately(PAPER.names),)
    for seed in range(30):
        data = records(0.03, seed=seed, sites=rest)
        found = calibrate(simulate_at(rest), data, PAPER.with_start(TRUTH), stages=stages)
        forces.append(held_out.force(found.parameters))
        if seed == 0:
            u = estimate(found.parameters, found.responses, data)
            response, known = (
                held_out.respond(found.parameters),
                (u.covariance, found.parameters, {}, 0.0, 1e6),
            )
            low, high = PredictionModel(*known).compute_interval_95(response, found.parameters, "elsewhere")
            predicted = (high - low) / (2 * NORMAL_95)
    spread = np.std(forces, axis=0)
    ratio = predicted[10:50] / spread[10:50]
    assert 0.6 < np.median(ratio) < 1.7


def test_noise_adds_to_a_prediction():
    response, model = SiteResponse(np.ones(3), np.zeros((3, 2))), (np.eye(2), np.ones(2), {}, 0.0, 1e6)
    low, high = PredictionModel(*model).compute_interval_95(response, np.ones(2), "elsewhere", noise_N=0.05)
    assert (high - low) / (2 * NORMAL_95) == pytest.approx([0.05] * 3, rel=1e-5)


def test_the_error_is_the_papers():
    assert compute_error_percent(np.array([1.0, 2.0, 3.0]), np.array([1.0, 2.5, 4.0])) == pytest.approx(12.5)
    sd = pytest.approx(np.std([1, 2, 6], ddof=1))
    assert summarise_errors([1.0, 2.0, 6.0]) == (3, 3.0, sd)
    assert summarise_errors([2.0]) == (1, 2.0, None)
    assert summarise_errors([]) == (0, None, None)


@pytest.mark.parametrize("site", [(), [0.03 * np.linspace(0, 1, 60) ** 2] * 4], ids=["same", "sites"])
@pytest.mark.parametrize("mesh", [(), [0.02 * np.linspace(0, 1, 60)] * 4], ids=["no mesh", "mesh"])
def test_the_slope_of_the_restricted_likelihood_is_its_derivative(mesh, site):
    data = records(0.02, seed=1)
    left = [r.force_N - d.force_N for r, d in zip(simulate(TRUTH), data)]
    noise = estimate_curve_noise(simulate(TRUTH), data)
    peaks = np.array([d.force_N.max() for d in data])
    scaled = [r.jacobian * TRUTH for r in simulate(TRUTH)]
    unit = ResidualModel(tuple(noise), peaks, np.ones(4), 0.2, 0.0, mesh_N=tuple(mesh), site_N=tuple(site))
    rows = _RestrictedLikelihood(left, scaled, unit, np.eye(8))
    at, h = np.log([0.01, 0.02, 0.005, 0.03, 1.5][: 5 if site else 4]), 1e-5
    steps = h * np.eye(len(at))
    slopes = [(rows.criterion(at + e)[0] - rows.criterion(at - e)[0]) / (2 * h) for e in steps]
    assert rows.criterion(at)[1] == pytest.approx(np.array(slopes), rel=1e-4)


def counted_residuals() -> RecordResiduals:
    """What is stored of a record's residuals."""
    return linear_fit(records(0.02, seed=1))[1].residual_model.summarise().sites["s0"]


def test_the_error_of_a_mesh_keeps_its_shape_where_it_was_measured():
    """Elsewhere it goes with the force, and is as large as the median of the others."""
    force, own = np.array([1.0, 2.0, 3.0, 0.0]), [0.01, 0.0, -0.02, 0.0]
    plain = counted_residuals()
    stored = {
        "a": plain.model_copy(update={"mesh_N": own, "mesh_share": 0.02}),
        "b": plain.model_copy(update={"mesh_N": None, "mesh_share": None}),
    }
    known = PredictionModel(np.eye(1), np.ones(1), stored, 0.0, 10.0)
    assert known.find_mesh_error("a", force) == pytest.approx(own)
    assert known.find_mesh_error("b", force) == pytest.approx(np.zeros(4))
    elsewhere = known.find_mesh_error("c", force)
    assert elsewhere / force.max() == pytest.approx(elsewhere[2] / 3.0 * force / 3.0)
    assert np.sqrt(np.mean(elsewhere**2)) == pytest.approx(0.01 * force.max())
