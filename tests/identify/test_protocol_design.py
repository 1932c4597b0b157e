"""The records of a session: within its time, against brute force, and over several tissues."""

from __future__ import annotations

from itertools import combinations

import numpy as np
import pytest

from limbfit.errors import CalibrationError
from limbfit.identify.checks.protocol import (
    Budget,
    DesignTarget,
    RecordOption,
    compute_duration_s,
    compute_factors_95,
    plan_records,
)

P = 3
PRIOR = 0.1 * np.eye(P)


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
@pytest.mark.parametrize("seed", range(4))
def test_a_plan_is_nearly_that_of_brute_force_and_keeps_its_time(criterion, seed):
    some, budget = options(9, seed=seed), Budget(260.0, 40.0)
    wanted = DesignTarget(PRIOR, np.eye(P), criterion)

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
    assert plan_records(tells, budget, DesignTarget(PRIOR, np.eye(P)[[0]])) == (0,)
    assert plan_records(tells, budget, DesignTarget(PRIOR, np.eye(P)[[1]])) == (1,)


def test_what_follows_from_parameters_decides():
    """A pressure that only the second parameter moves, and one that the two move against each other."""
    tells = [
        RecordOption(("a", "tip"), 50.0, 100.0 * np.outer(row, row)[None]) for row in (*np.eye(P), [1, -1, 0])
    ]
    budget = Budget(60.0, 0.0)
    assert plan_records(tells, budget, DesignTarget(PRIOR, np.array([[0.0, 0.2, 0.0]]), "A")) == (1,)
    assert plan_records(tells, budget, DesignTarget(PRIOR, np.array([[0.3, -0.3, 0.0]]), "A")) == (3,)
    both = DesignTarget(PRIOR, np.array([[0.3, -0.3, 0.0], [0.0, 0.0, 0.1]]), "A")
    (covariance,) = both.project(both.compute_covariances(tells, [3], 1))
    exact = np.linalg.inv(PRIOR + 100.0 * np.outer([1, -1, 0], [1, -1, 0]))
    assert covariance == pytest.approx(both.rows @ exact @ both.rows.T)


def test_a_record_must_tell_at_every_tissue():
    """Much at one tissue and nothing at the other is less, on average, than some at both."""
    uneven = np.stack([1e4 * np.eye(P), np.zeros((P, P))])
    even = np.stack([1e3 * np.eye(P)] * 2)
    both = [RecordOption(("a", "tip"), 50.0, uneven), RecordOption(("a", "tip"), 50.0, even)]
    assert plan_records(both, Budget(60.0, 0.0), DesignTarget(PRIOR, np.eye(P))) == (1,)
    assert plan_records(both, Budget(60.0, 0.0), DesignTarget(PRIOR, np.eye(P), "A")) == (1,)


def test_the_expected_factor_is_of_the_covariance():
    covariance = np.diag([0.01, 0.04, 1e9])[None]
    assert compute_factors_95(covariance)[0, :2] == pytest.approx(np.exp([0.1959964, 0.3919928]))
    assert np.isfinite(compute_factors_95(covariance)).all()


def test_too_little_time_is_told():
    with pytest.raises(CalibrationError, match="no record fits"):
        plan_records(options(4), Budget(10.0, 40.0), DesignTarget(PRIOR, np.eye(P)[[0]]))


def test_records_of_a_site_share_what_it_is_off_by():
    """As if each site's stiffness were one more parameter with a known spread, that nobody asks for.

    What one site tells of a modulus is then no better than that spread, however many records it has.
    """
    stiffness, share = np.array([1.0, 0.0, 1.0]), 0.05
    some = [
        RecordOption((f"s{i % 2}", "tip"), 10.0, one.information, share) for i, one in enumerate(options(6))
    ]
    found = DesignTarget(PRIOR, np.eye(P), stiffness=stiffness).compute_covariances(some, range(6), 2)
    for draw in range(2):
        whole = np.zeros((P + 2, P + 2))
        whole[:P, :P], whole[P:, P:] = PRIOR, np.eye(2)
        for one in some:
            columns = np.zeros((P, P + 2))
            columns[:, :P] = np.eye(P)
            columns[:, P + int(one.place[0] == "s1")] = share * stiffness
            whole += columns.T @ one.information[draw] @ columns
        assert found[draw] == pytest.approx(np.linalg.inv(whole)[:P, :P])
    many = [RecordOption(("a", "tip"), 10.0, 1e8 * np.eye(P)[None], share)] * 5
    known = DesignTarget(PRIOR, np.eye(P), stiffness=np.array([1.0, 0.0, 0.0])).compute_covariances(
        many, range(5), 1
    )[0]
    assert np.diag(known) == pytest.approx([share**2, 0.0, 0.0], rel=1e-2, abs=1e-8)
