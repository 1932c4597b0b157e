"""Intervals from what a calibration simulated anyway: on a bent valley, and where simulations fail."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from bars import NAMES, PAPER, TRUTH, estimate, records, simulate, storing
from coverage_study import coverage_study

from limbfit.identify.fit.calibration import Calibration, calibrate, move_answer
from limbfit.identify.fit.objective import MeasuredCurve, SiteResponse
from limbfit.identify.fit.parameters import Unknowns, build_space, constrain, group_separately
from limbfit.identify.uncertainty.intervals import (
    EvaluationStore,
    count_further_evaluations,
    sample_uncertainty,
)
from limbfit.identify.uncertainty.noise import SiteNoise
from limbfit.identify.uncertainty.uncertainty import (
    LINEARISED,
    SAMPLED,
    WEAK,
    build_combinations,
)

# Forces tell log c + BEND (log m)^2 well and log m itself poorly: a valley that is bent.
POINTS, ABOUT_N, BEND, SD_N = 40, 10.0, 1.0, 0.05
TIME = np.linspace(-1.0, 1.0, POINTS)
X = np.stack([np.ones(POINTS), 0.06 * TIME, TIME**2], axis=1)
BENT = Unknowns(("t.c_kPa", "t.m", "t.gamma"), np.ones(3), np.full(3, 0.05), np.full(3, 20.0))
BENT_TRUTH = np.array([1.2, 1.3, 0.9])
SEPARATE = group_separately(NAMES)


class Valley:
    """A closed-form model of one site; also what a sampler asks thousands of times."""

    def predict_forces(self, parameters):
        a, b, c = np.log(np.atleast_2d(parameters)).T
        return ABOUT_N + np.stack([a + BEND * b**2, b, c], axis=1) @ X.T

    def __call__(self, parameters):
        slopes = np.eye(3)
        slopes[0, 1] = 2 * BEND * np.log(parameters[1])
        return [SiteResponse(self.predict_forces(parameters)[0], X @ slopes / parameters)]


def valley_record(repeat, forces):
    noise = SD_N * np.random.default_rng([3, repeat]).standard_normal(POINTS)
    claimed = SiteNoise("s", np.arange(float(POINTS)), SD_N**2 * np.eye(POINTS), SD_N, 0.0)
    return [MeasuredCurve("s", forces[0] + noise)], [claimed]


@pytest.mark.slow
def test_on_a_bent_valley_the_stated_intervals_hold_the_truth():
    found = coverage_study(Valley(), BENT_TRUTH, BENT, valley_record, repeats=24)
    assert found.linearised.determined.mean() < 0.5 < found.stated.determined.mean()  # what simulations add
    assert 0.9 <= found.stated.share <= 0.99
    assert found.stated.by_parameter.min() > 0.85
    assert found.further <= 10


@cache
def estimate_near_the_truth(grouping):
    data, kept, bounds = records(0.03, seed=4), EvaluationStore(), PAPER.with_start(TRUTH)
    found = calibrate(storing(kept, simulate), data, bounds, stages=(grouping,))
    return data, kept, estimate(found.parameters, found.responses, data, bounds, grouping=grouping)


def near_the_truth(grouping=SEPARATE):
    """Records, the simulations that a calibration made of them, and what is known after it."""
    data, kept, known = estimate_near_the_truth(grouping)
    return data, EvaluationStore([*kept.points], [*kept.responses]), known


def test_further_simulations_are_few_and_asked_for_again_alike():
    _, kept, known = near_the_truth()
    asked = EvaluationStore(), EvaluationStore()
    one, other = (sample_uncertainty(known, kept, storing(again, simulate)) for again in asked)
    assert one.method == SAMPLED
    assert 0 < len(asked[0].points) <= 2
    assert np.array_equal(asked[0].points, asked[1].points)
    assert np.array_equal(one.intervals_95, other.intervals_95)
    assert [c.verdict for c in one.combinations] == [c.verdict for c in other.combinations]


def test_many_records_have_an_evaluation_at_the_most_probable_parameters():
    assert [count_further_evaluations(records, 0) for records in (1, 4, 10, 24)] == [2, 2, 1, 1]
    assert count_further_evaluations(4, 4) == count_further_evaluations(16, 16) == 1


def test_failed_simulations_enter_no_interval():
    _, kept, known = near_the_truth()

    def failing(parameters):
        good, *rest = simulate(parameters)
        return [SiteResponse(100 * good.force_N, good.jacobian, False, "stopped"), *rest]

    before = len(kept.points)
    failing_kept = EvaluationStore([*kept.points], [*kept.responses])
    assert not failing_kept.add(1.1 * TRUTH, failing(1.1 * TRUTH))
    assert len(failing_kept.points) == before
    found = sample_uncertainty(known, kept, failing)
    assert found.method == SAMPLED
    assert np.mean((found.intervals_95[:, 0] < TRUTH) & (found.intervals_95[:, 1] > TRUTH)) >= 0.75
    alone = EvaluationStore(kept.points[:1], kept.responses[:1])
    assert sample_uncertainty(known, alone, failing) is known
    assert known.method == LINEARISED


def test_fixed_and_tied_parameters_stay_so():
    grouping = (0, 1, 2, 3, 4, 1, -1, 3)
    _, kept, known = near_the_truth(grouping=grouping)
    found = sample_uncertainty(known, kept, simulate)
    assert len(found.combinations) == 5
    assert found.intervals_95[1] == pytest.approx(found.intervals_95[5])
    assert found.intervals_95[6] == pytest.approx([TRUTH[6], TRUTH[6]])
    assert found.verdicts[6] == known.verdicts[6] == "given, not identified"
    assert np.isfinite(found.correlation).all()


def test_the_answer_moves_to_what_is_most_probable():
    """Its intervals are about that, and the calibration ends there, with an error that is no smaller."""
    data, kept, known = near_the_truth()
    found = sample_uncertainty(known, kept, simulate, move_answer=True)
    assert found.parameters == pytest.approx(found.centre)
    assert not np.array_equal(found.parameters, known.parameters)
    assert np.array_equal(found.covariance, known.about_centre)
    low, high = found.intervals_95.T
    assert ((low < found.parameters) & (found.parameters < high)).all()
    assert ((low < TRUTH) & (high > TRUTH)).mean() >= 0.75
    bounds = PAPER.with_start(TRUTH)
    least = calibrate(storing(kept, simulate), data, bounds, stages=(group_separately(NAMES),))
    ended = move_answer(least, found.parameters, data, simulate(found.parameters), bounds)
    assert isinstance(ended, Calibration)
    assert np.array_equal(ended.parameters, found.parameters)
    assert ended.cost >= least.cost
    assert (ended.evaluations, len(ended.history)) == (least.evaluations + 1, len(least.history) + 1)
    assert ended.stages[-1].reason.endswith("moved from the least squares to what is most probable")
    failed = [SiteResponse(r.force_N, r.jacobian, False, "stopped") for r in simulate(found.parameters)]
    assert "stopped" in str(move_answer(least, found.parameters, data, failed, bounds))


def test_fixed_and_tied_parameters_stay_so_where_the_answer_moves():
    _, kept, known = near_the_truth(grouping=(0, 1, 2, 3, 4, 1, -1, 3))
    found = sample_uncertainty(known, kept, simulate, move_answer=True)
    assert found.parameters[1] == found.parameters[5]
    assert found.parameters[6] == pytest.approx(TRUTH[6], rel=1e-5)


def test_tied_parameters_have_one_interval_within_the_bounds_of_both():
    lower, upper = PAPER.lower.copy(), PAPER.upper.copy()
    skin, muscle = NAMES.index("skin.m"), NAMES.index("muscle.m")
    lower[skin], upper[muscle] = 4.3, 4.8
    unknowns = replace(PAPER, lower=lower, upper=upper, start=np.tile([4.7, 4.5, 1.2, 2.0], 2))
    grouping = constrain(group_separately(NAMES), NAMES, tied=[["skin.m", "muscle.m"]])
    data, kept = records(0.03, seed=4), EvaluationStore()
    found = calibrate(storing(kept, simulate), data, unknowns, stages=(grouping,))
    linearised = estimate(found.parameters, found.responses, data, unknowns, grouping=grouping)
    for known in (linearised, sample_uncertainty(linearised, kept, simulate)):
        assert known.intervals_95[skin] == pytest.approx(known.intervals_95[muscle], rel=1e-6)
        assert np.all(known.intervals_95[skin] <= 4.8 + 1e-9)
        assert np.all(known.intervals_95[skin] >= 4.3 - 1e-9)


def test_what_bounds_alone_say_of_tied_parameters_is_what_they_say_of_one():
    """The weight of a combination is divided among tied parameters; its spread by the bounds is not: m is
    known within 1.8 times, and by its bounds alone within 3.7 times."""
    grouping = constrain(group_separately(NAMES), NAMES, tied=[["skin.m", "muscle.m"]])
    space = build_space(PAPER, grouping)
    halves = np.where([name.endswith(".m") for name in NAMES], 0.5, 0.0)
    half_log = np.log([1.8])
    (one,) = build_combinations(NAMES, space, halves[None], 0 * half_log, half_log, half_log / 1.96)
    assert one.verdict == WEAK


def test_a_parameter_that_is_given_does_not_end_on_its_bound():
    unknowns = replace(PAPER, start=np.tile([4.7, 2.0, 1.2, 2.0], 2))
    grouping = constrain(group_separately(NAMES), NAMES, fixed=["skin.m"])
    start = unknowns.start
    known = estimate(start, simulate(start), records(0.03), unknowns, grouping=grouping)
    at_bound = [name for name, there in zip(NAMES, known.at_bound, strict=True) if there]
    assert at_bound == ["muscle.m"]
