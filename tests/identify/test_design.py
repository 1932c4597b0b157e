"""The best sites to test and the records of a session, against brute force and simple models."""

from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
from bars import PAPER, SITES, TRUTH, records, simulate

from limbfit.errors import CalibrationError
from limbfit.identify.checks.design import (
    Budget,
    Candidate,
    DesignTarget,
    NoiseModel,
    RecordOption,
    choose_design,
    compute_duration_s,
    compute_efficiency,
    compute_factors_95,
    compute_field_information,
    compute_information,
    compute_prior_information,
    evaluate_design,
    plan_records,
    sample_tissues,
)
from limbfit.identify.fit.calibration import calibrate
from limbfit.identify.fit.objective import SiteResponse
from limbfit.identify.fit.parameters import Prior, build_space, constrain, group_separately

SPACE = build_space(PAPER, group_separately(PAPER.names))
PRIOR = compute_prior_information(PAPER, SPACE)


def build_candidate(site, depth_mm, response, parameters, noise):
    """The candidate of a simulated indentation."""
    return Candidate(site, depth_mm, compute_information(response, parameters, noise))


def build_candidates(noise) -> list[Candidate]:
    """Those of the bars, at the truth."""
    return [
        build_candidate(f"s{k}", site.depth, site.respond(TRUTH), TRUTH, NoiseModel(noise))
        for k, site in enumerate(SITES)
    ]


def lines(slopes, noise=0.1):
    """Candidates whose force is a straight line through zero in one of two parameters each."""
    at = np.linspace(0, 1, 20)
    found = []
    for k, (a, b) in enumerate(slopes):
        response = SiteResponse(at + 0.1, np.outer(at, [a, b]))
        found.append(build_candidate(f"s{k}", 1.0, response, np.ones(2), NoiseModel(noise)))
    return found


def random_candidates(sites, depths, seed=0, p=4):
    rng = np.random.default_rng(seed)
    found = []
    for site in range(sites):
        for depth in range(depths):
            J = rng.standard_normal((6, p)) * (1 + depth)
            found.append(Candidate(f"s{site}", float(depth), J.T @ J))
    return found


def test_white_noise_gives_the_information_of_least_squares():
    response = SITES[0].respond(TRUTH)
    found = build_candidate("s0", 4.0, response, TRUTH, NoiseModel(0.05))
    scaled = response.jacobian * TRUTH
    assert found.information == pytest.approx(scaled.T @ scaled / 0.05**2, rel=1e-9)


def test_correlated_noise_is_that_of_the_full_covariance():
    response, noise = SITES[1].respond(TRUTH), NoiseModel(0.02, 0.03, 0.9)
    force, scaled = response.force_N, response.jacobian * TRUTH
    lags = np.abs(np.subtract.outer(np.arange(force.size), np.arange(force.size)))
    S = (0.03 * force.max()) ** 2 * 0.9**lags + 0.02**2 * np.eye(force.size)
    found = build_candidate("s1", 3.5, response, TRUTH, noise).information
    assert found == pytest.approx(scaled.T @ np.linalg.inv(S) @ scaled, rel=1e-6)


def test_a_site_for_each_parameter_beats_two_for_the_same():
    found = choose_design(lines([(1, 0), (1.1, 0), (0, 0.5), (0, 0.4)]), 2, 1e-6 * np.eye(2))
    assert found.chosen == (1, 2)


@pytest.mark.parametrize("criterion", ["D", "A"])
def test_exhaustive_choice_is_the_best_of_all(criterion):
    every = random_candidates(6, 2)
    best = choose_design(every, 3, np.eye(4), criterion)
    pairs = [c for c in combinations(range(12), 3) if len({every[i].site for i in c}) == 3]
    designs = [evaluate_design(every, c, np.eye(4)) for c in pairs]
    if criterion == "D":
        assert best.log_det == pytest.approx(max(d.log_det for d in designs))
    else:
        assert best.trace == pytest.approx(min(d.trace for d in designs))
    assert best.exhaustive


@pytest.mark.parametrize("criterion", ["D", "A"])
def test_exchanges_reach_what_looking_at_all_choices_finds(criterion, monkeypatch):
    for seed in range(5):
        every = random_candidates(9, 2, seed)
        best = choose_design(every, 4, np.eye(4), criterion)
        with monkeypatch.context() as patch:
            patch.setattr("limbfit.identify.checks.design.MAX_EXHAUSTIVE_CHOICES", 0)
            found = choose_design(every, 4, np.eye(4), criterion)
        assert not found.exhaustive
        assert len({every[i].site for i in found.chosen}) == 4
        assert compute_efficiency(found, best, criterion) > 0.995


def test_a_deeper_indentation_with_more_information_is_chosen():
    every = random_candidates(5, 3)
    assert all(every[i].depth_mm == 2.0 for i in choose_design(every, 2, np.eye(4)).chosen)


def test_efficiency_is_the_share_of_the_data_that_tells_as_much():
    every = random_candidates(4, 1)
    one = evaluate_design(every, (0, 1), 1e-9 * np.eye(4))
    double = [Candidate(c.site, c.depth_mm, 2 * c.information) for c in every]
    two = evaluate_design(double, (0, 1), 2e-9 * np.eye(4))
    assert compute_efficiency(one, two, "D") == pytest.approx(0.5)
    assert compute_efficiency(one, two, "A") == pytest.approx(0.5)


def test_expected_widths_are_those_that_repeated_fits_scatter_with():
    sd, stages = [], (group_separately(PAPER.names),)
    expected = evaluate_design(build_candidates(0.03), range(4), PRIOR)
    for seed in range(25):
        found = calibrate(simulate, records(0.03, seed=seed), PAPER.with_start(TRUTH), stages=stages)
        sd.append(np.log(found.parameters / TRUTH))
    spread, said = np.std(sd, axis=0), np.log(expected.factors_95) / 1.96
    known = said < 0.2  # where the linearisation holds
    assert known.sum() >= 4
    assert np.all((spread / said)[known] < 1.8)
    assert np.all((spread / said)[known] > 0.6)


def test_what_cannot_be_chosen_is_refused():
    with pytest.raises(CalibrationError, match="5 sites are wanted of 4"):
        choose_design(random_candidates(4, 2), 5, np.eye(4))
    with pytest.raises(CalibrationError, match="noise"):
        NoiseModel(0.0)


def test_the_information_of_a_field_is_that_of_its_whole_covariance() -> None:
    """The misfit is alike between curves and along them; curves that share nothing add up."""
    rng = np.random.default_rng(4)
    values, slopes = rng.normal(size=(3, 7)), rng.normal(size=(3, 7, 2))
    noise, parameters = NoiseModel(0.1, 0.05, 0.8), np.array([2.0, 0.5])
    along = 0.8 ** np.abs(np.subtract.outer(np.arange(7), np.arange(7)))
    alike = np.exp(-np.abs(np.subtract.outer(np.arange(3), np.arange(3))) / 2.0)
    size = (0.05 * np.abs(values).max()) ** 2
    scaled = (slopes * parameters).reshape(21, 2)
    whole = scaled.T @ np.linalg.solve(0.01 * np.eye(21) + size * np.kron(alike, along), scaled)
    assert compute_field_information(values, slopes, alike, parameters, noise) == pytest.approx(whole)
    apart = sum(
        row.T @ np.linalg.solve(0.01 * np.eye(7) + size * along, row) for row in scaled.reshape(3, 7, 2)
    )
    assert compute_field_information(values, slopes, np.eye(3), parameters, noise) == pytest.approx(apart)


P = 3
WEAK_PRIOR = 0.1 * np.eye(P)


def options(number: int, draws: int = 2, seed: int = 0) -> list[RecordOption]:
    """Records at two places, each of its own length."""
    rng = np.random.default_rng(seed)
    found = []
    for i in range(number):
        J = rng.standard_normal((draws, 4, P))
        information = np.transpose(J, (0, 2, 1)) @ J
        found.append(RecordOption((f"s{i % 2}", "tip"), float(rng.integers(20, 90)), information))
    return found


@pytest.mark.parametrize("criterion", ["D", "A"])
@pytest.mark.parametrize("seed", range(2))
def test_a_plan_is_nearly_that_of_brute_force_and_keeps_its_time(criterion, seed):
    some, budget = options(9, seed=seed), Budget(260.0, 40.0)
    wanted = DesignTarget(WEAK_PRIOR, np.eye(P), criterion)

    def cost(chosen):
        return wanted.compute_cost(wanted.compute_covariances(some, chosen, 2))

    every = [c for k in range(1, 10) for c in combinations(range(9), k)]
    fits = [c for c in every if compute_duration_s(some, c, budget) <= budget.seconds]
    best, found = min(map(cost, fits)), plan_records(some, budget, wanted)
    assert compute_duration_s(some, found, budget) <= budget.seconds
    assert cost(found) <= best + (0.05 if criterion == "D" else 0.02 * best)


def test_a_place_is_prepared_once():
    two = [RecordOption(("a", "tip"), 30.0, np.eye(P)[None]) for _ in range(2)]
    apart = [two[0], RecordOption(("a", "ball"), 30.0, np.eye(P)[None])]
    budget = Budget(1000.0, 60.0)
    assert compute_duration_s(two, [0, 1], budget) == 120.0
    assert compute_duration_s(apart, [0, 1], budget) == 180.0


def test_what_is_wanted_decides():
    """One record tells of the first parameter, one of the second; time is for one."""
    tells = [RecordOption(("a", "tip"), 50.0, 100.0 * np.diag(np.eye(P)[k])[None]) for k in (0, 1)]
    budget = Budget(60.0, 0.0)
    assert plan_records(tells, budget, DesignTarget(WEAK_PRIOR, np.eye(P)[[0]])) == (0,)
    assert plan_records(tells, budget, DesignTarget(WEAK_PRIOR, np.eye(P)[[1]])) == (1,)


def test_what_follows_from_parameters_decides():
    """A pressure that only the second parameter moves, and one that the two move against each other."""
    tells = [
        RecordOption(("a", "tip"), 50.0, 100.0 * np.outer(row, row)[None]) for row in (*np.eye(P), [1, -1, 0])
    ]
    budget = Budget(60.0, 0.0)
    assert plan_records(tells, budget, DesignTarget(WEAK_PRIOR, np.array([[0.0, 0.2, 0.0]]), "A")) == (1,)
    assert plan_records(tells, budget, DesignTarget(WEAK_PRIOR, np.array([[0.3, -0.3, 0.0]]), "A")) == (3,)
    both = DesignTarget(WEAK_PRIOR, np.array([[0.3, -0.3, 0.0], [0.0, 0.0, 0.1]]), "A")
    (covariance,) = both.project(both.compute_covariances(tells, [3], 1))
    exact = np.linalg.inv(WEAK_PRIOR + 100.0 * np.outer([1, -1, 0], [1, -1, 0]))
    assert covariance == pytest.approx(both.rows @ exact @ both.rows.T)


def test_a_record_must_tell_at_every_tissue():
    """Much at one tissue and nothing at the other is less, on average, than some at both."""
    uneven = np.stack([1e4 * np.eye(P), np.zeros((P, P))])
    even = np.stack([1e3 * np.eye(P)] * 2)
    both = [RecordOption(("a", "tip"), 50.0, uneven), RecordOption(("a", "tip"), 50.0, even)]
    assert plan_records(both, Budget(60.0, 0.0), DesignTarget(WEAK_PRIOR, np.eye(P))) == (1,)
    assert plan_records(both, Budget(60.0, 0.0), DesignTarget(WEAK_PRIOR, np.eye(P), "A")) == (1,)


def test_the_expected_factor_is_of_the_covariance():
    covariance = np.diag([0.01, 0.04, 1e9])[None]
    assert compute_factors_95(covariance)[0, :2] == pytest.approx(np.exp([0.1959964, 0.3919928]))
    assert np.isfinite(compute_factors_95(covariance)).all()


def test_too_little_time_is_told():
    with pytest.raises(CalibrationError, match="no record fits"):
        plan_records(options(4), Budget(10.0, 40.0), DesignTarget(WEAK_PRIOR, np.eye(P)[[0]]))


def test_records_of_a_site_share_what_it_is_off_by():
    """As if each site's stiffness were one more parameter with a known spread, that nobody asks for.

    What one site tells of a modulus is then no better than that spread, however many records it has.
    """
    stiffness, share = np.array([1.0, 0.0, 1.0]), 0.05
    some = [
        RecordOption((f"s{i % 2}", "tip"), 10.0, one.information, share) for i, one in enumerate(options(6))
    ]
    found = DesignTarget(WEAK_PRIOR, np.eye(P), stiffness=stiffness).compute_covariances(some, range(6), 2)
    for draw in range(2):
        whole = np.zeros((P + 2, P + 2))
        whole[:P, :P], whole[P:, P:] = WEAK_PRIOR, np.eye(2)
        for one in some:
            columns = np.zeros((P, P + 2))
            columns[:, :P] = np.eye(P)
            columns[:, P + int(one.place[0] == "s1")] = share * stiffness
            whole += columns.T @ one.information[draw] @ columns
        assert found[draw] == pytest.approx(np.linalg.inv(whole)[:P, :P])
    many = [RecordOption(("a", "tip"), 10.0, 1e8 * np.eye(P)[None], share)] * 5
    known = DesignTarget(WEAK_PRIOR, np.eye(P), stiffness=np.array([1.0, 0.0, 0.0])).compute_covariances(
        many, range(5), 1
    )[0]
    assert np.diag(known) == pytest.approx([share**2, 0.0, 0.0], rel=1e-2, abs=1e-8)


def test_what_a_study_fixes_is_known_and_what_it_ties_is_one():
    """skin.m is fixed; the records tell tau_s of both tissues only together."""
    fixed, tied = ["skin.m"], [["skin.tau_s", "muscle.tau_s"]]
    space = build_space(PAPER, constrain(group_separately(PAPER.names), PAPER.names, fixed, tied))
    candidates = build_candidates(0.05)
    prior = compute_prior_information(PAPER, space)
    factors = evaluate_design(candidates, [0, 1], prior).factors_95
    assert factors[1] == pytest.approx(1.0, abs=1e-3)
    assert factors[3] == pytest.approx(factors[7], rel=1e-3)
    # Exactly: the information in the space of what moves.
    inside = [space.tie.T @ one.information @ space.tie for one in candidates]
    bounds = np.diag(12.0 / (space.upper - space.lower) ** 2)
    exact = np.linalg.inv(bounds + inside[0] + inside[1])
    assert np.log(factors[0]) == pytest.approx(1.959964 * np.sqrt(exact[0, 0]), rel=1e-4)
    pair, single = (evaluate_design(candidates, chosen, prior) for chosen in ([0, 1], [0]))
    ratio = np.linalg.det(bounds + inside[0]) / np.linalg.det(bounds + inside[0] + inside[1])
    assert compute_efficiency(single, pair, "D") == pytest.approx(ratio ** (1 / 6), rel=1e-3)


def test_sampled_tissues_keep_what_a_study_fixes_and_ties():
    fixed, tied = ["skin.m"], [["skin.tau_s", "muscle.tau_s"]]
    known = PAPER.with_start(np.where(np.arange(8) % 4 == 3, 0.4, TRUTH))
    space = build_space(known, constrain(group_separately(PAPER.names), PAPER.names, fixed, tied))
    tissues = sample_tissues(known, space, known.start, 9, seed=1)
    assert np.all(tissues[:, 1] == known.start[1])
    assert tissues[:, 3] == pytest.approx(tissues[:, 7])
    assert len(np.unique(tissues[:, 0])) == 9


def test_stated_priors_count_beside_the_data_of_a_design():
    """skin.m is known within 5 %: no record has to tell it, and its interval is no wider."""
    known = replace(PAPER, priors=(Prior("skin.m", 6.0, 1.05),))
    plain, stated = (compute_prior_information(one, SPACE) for one in (PAPER, known))
    candidates = build_candidates(0.5)
    without, beside = (evaluate_design(candidates, [3], prior).factors_95[1] for prior in (plain, stated))
    assert without > 2.0
    assert beside < 1.05**1.97
    expected = np.zeros((8, 8))
    expected[1, 1] = np.log(1.05) ** -2
    assert stated - plain == pytest.approx(expected)
