"""The identification against a closed-form viscoelastic model whose truth is known (see bars.py)."""

import numpy as np
import pytest
from bars import (
    BARS,
    PAPER,
    TRUE_THREE,
    TRUTH,
    Bars,
    Counted,
    records,
    respond_three,
    simulate,
    three_tissues,
)

from limbfit.errors import CalibrationError, ProblemError
from limbfit.identify.fit.calibration import Calibration, CalibrationSettings, SearchState, calibrate
from limbfit.identify.fit.objective import MeasuredCurve, SiteResponse
from limbfit.identify.fit.parameters import FIXED, Unknowns, build_space, group_by_kind, group_separately


@pytest.fixture(scope="module")
def noisy() -> Calibration:
    return calibrate(simulate, records(0.03), PAPER)


def test_truth_is_found_from_the_papers_start_in_few_evaluations():
    run = Counted()
    found = calibrate(run, records(), PAPER)
    assert found.converged, found.reason
    assert found.parameters == pytest.approx(TRUTH, rel=2e-3)
    assert found.evaluations == run.calls
    assert found.stages[0].evaluations <= 10
    assert found.stages[1].evaluations <= 10
    assert found.stages[0].parameters[:4] == found.stages[0].parameters[4:]
    one, two = ([h for h in found.history if h.stage == stage] for stage in (0, 1))
    assert [h.cost for h in two] == sorted((h.cost for h in two), reverse=True)
    # The second stage starts where the first ended, without a new simulation.
    assert (two[0].parameters, two[0].evaluations) == (one[-1].parameters, one[-1].evaluations)


def test_the_one_material_stage_alone_keeps_tissues_equal():
    found = calibrate(simulate, records(), PAPER, stages=(group_by_kind(PAPER.names),))
    assert np.array_equal(found.parameters[:4], found.parameters[4:])
    assert found.cost > 1e-3


def test_three_tissues_are_found_from_one_start():
    data = records(truth=TRUE_THREE, sites=BARS)
    found = calibrate(respond_three, data, three_tissues(), CalibrationSettings(relative_tolerance=1e-5))
    assert found.converged, found.reason
    assert found.parameters == pytest.approx(TRUE_THREE, rel=0.02)
    one, three = found.stages
    assert one.grouping == (0, 1, 2, 3) * 3
    assert one.parameters[:4] == one.parameters[4:8] == one.parameters[8:]
    first = next(h for h in found.history if h.stage == 1)
    assert first.parameters == one.parameters
    assert one.evaluations + three.evaluations == found.evaluations


def test_tissues_with_starts_of_their_own_keep_their_ratio_at_the_start_of_the_second_stage():
    unknowns = three_tissues(fat=[4.7 / 8, 3.0, 1.2, 2.0])
    found = calibrate(respond_three, records(truth=TRUE_THREE, sites=BARS), unknowns)
    assert found.converged, found.reason
    very_first = found.history[0].parameters
    assert very_first == pytest.approx(
        [4.7 / 2, 3.0, 1.2, 2.0] * 3
    )  # the geometric mean of 4.7, 4.7 / 8, 4.7
    one = np.array(found.stages[0].parameters)
    second = np.array(next(h for h in found.history if h.stage == 1).parameters)
    ratio = np.ones(12)
    ratio[[0, 4, 8]] = 2, 1 / 4, 2
    assert second == pytest.approx(one * ratio)
    assert max(found.history[-1].errors_percent) < 0.5


def test_a_start_in_the_tissues_ratio_that_fails_moves_to_the_answer_of_one_material():
    unknowns = three_tissues(fat=[4.7 / 8, 3.0, 1.2, 2.0])
    data = records(truth=TRUE_THREE, sites=BARS)

    def fails(parameters):
        apart = parameters[4] < 0.9 * parameters[0]
        return [SiteResponse(r.force_N, r.jacobian, not apart, "too soft") for r in respond_three(parameters)]

    found = calibrate(fails, data, unknowns)
    second = next(h for h in found.history if h.stage == 1)
    assert second.parameters == pytest.approx(found.stages[0].parameters)


def test_a_single_tissue_has_one_stage():
    alone = Unknowns(PAPER.names[4:], PAPER.start[4:], PAPER.lower[4:], PAPER.upper[4:])
    bar = Bars((300.0,), (17.0,), 5.0)
    data = records(truth=TRUTH[4:], sites=[bar])
    found = calibrate(lambda p: [bar.respond(p)], data, alone)
    assert len(found.stages) == 1
    assert found.parameters == pytest.approx(TRUTH[4:], rel=5e-3)


def test_an_optimum_beyond_a_bound_is_found_on_it():
    upper = PAPER.upper.copy()
    upper[[0, 4]] = 6.0
    found = calibrate(simulate, records(), Unknowns(PAPER.names, PAPER.start, PAPER.lower, upper))
    assert found.converged, found.reason
    assert found.parameters[0] == pytest.approx(6.0)
    assert np.all(found.parameters <= upper * (1 + 1e-12))


@pytest.mark.parametrize("seed", range(2))
def test_one_simulation_in_ten_may_fail(seed, noisy):
    run = Counted(failing=0.1, seed=seed)
    found = calibrate(run, records(0.03), PAPER)
    assert found.converged, found.reason
    assert found.parameters == pytest.approx(noisy.parameters, rel=0.01)
    assert run.calls <= 60


def test_a_region_that_cannot_be_simulated_is_walked_around():
    run = Counted(forbidden=lambda p: p[0] * (1 + p[2]) > 31.0)
    found = calibrate(run, records(), PAPER)
    assert found.converged, found.reason
    assert found.parameters == pytest.approx(TRUTH, rel=2e-3)


def test_an_answer_that_cannot_be_simulated_ends_with_the_reason():
    found = calibrate(Counted(forbidden=lambda p: p[0] > 8.0), records(), PAPER)
    assert not found.converged
    assert "stuck: the simulations fail" in found.reason
    assert "did not converge" in found.reason
    assert found.parameters[0] <= 8.0


def test_a_start_that_fails_moves_towards_the_middle_of_the_bounds():
    run = Counted(forbidden=lambda p: abs(p[0] - 4.7) < 0.01)
    assert calibrate(run, records(), PAPER).parameters == pytest.approx(TRUTH, rel=2e-3)
    with pytest.raises(CalibrationError, match=r"no simulation completes.*s0: did not converge"):
        calibrate(Counted(forbidden=lambda p: True), records(), PAPER)


def test_a_force_that_is_not_finite_is_a_failure():
    def broken(parameters):
        responses = simulate(parameters)
        return [SiteResponse(responses[0].force_N * np.nan, responses[0].jacobian), *responses[1:]]

    with pytest.raises(CalibrationError, match="s0: the simulated force is not finite"):
        calibrate(broken, records(), PAPER)


def test_wrong_shapes_are_the_callers_fault():
    with pytest.raises(CalibrationError, match="3 responses for 4 sites"):
        calibrate(lambda p: simulate(p)[:3], records(), PAPER)
    with pytest.raises(CalibrationError, match="s1: the simulated force has the wrong shape"):
        calibrate(
            lambda p: [
                r if k != 1 else SiteResponse(r.force_N[1:], r.jacobian[1:])
                for k, r in enumerate(simulate(p))
            ],
            records(),
            PAPER,
        )


def test_a_run_taken_up_again_from_any_state_gives_the_same_answer():
    """From a corner of the bounds, where the trust region has work to do."""
    far = Unknowns(PAPER.names, np.tile([0.06, 18.0, 9.0, 0.02], 2), PAPER.lower, PAPER.upper)
    states: list[SearchState] = []
    whole = calibrate(simulate, records(0.03), far, on_iterate=states.append)
    assert whole.converged, whole.reason
    assert len(states) > 12
    for state in states:
        again = calibrate(simulate, records(0.03), far, state=state)
        assert np.array_equal(again.parameters, whole.parameters)
        assert (again.stages, again.history) == (whole.stages, whole.history)
        assert again.evaluations == whole.evaluations


def test_the_papers_objective_leads_to_the_truth_too():
    settings = CalibrationSettings(objective="paper", max_iterations=60)
    found = calibrate(simulate, records(), PAPER, settings)
    assert max(found.history[-1].errors_percent) < 0.5


def test_the_papers_stopping_rule_stops_earlier():
    loose = calibrate(simulate, records(0.03), PAPER, CalibrationSettings(stopping="paper"))
    tight = calibrate(simulate, records(0.03), PAPER, CalibrationSettings(relative_tolerance=1e-6))
    assert loose.converged
    assert "0.01" in loose.stages[0].reason
    assert loose.evaluations < tight.evaluations
    assert loose.cost >= tight.cost * (1 - 1e-6)  # the tolerance of the other


def test_the_limit_of_iterations_is_not_called_convergence():
    found = calibrate(simulate, records(), PAPER, CalibrationSettings(max_iterations=2))
    assert not found.converged
    assert [stage.iterations for stage in found.stages] == [2, 2]
    assert "limit" in found.reason


def test_sites_count_alike_whatever_their_force_and_sampling():
    data = records()
    big = [MeasuredCurve(d.name, d.force_N * 10) for d in data]
    scaled = [SiteResponse(10 * r.force_N, 10 * r.jacobian) for r in simulate(PAPER.start)]
    settings, stages = CalibrationSettings(max_iterations=1), (group_by_kind(PAPER.names),)
    own = calibrate(simulate, data, PAPER, settings, stages=stages)
    tenfold = calibrate(lambda p: scaled, big, PAPER, settings, stages=stages)
    assert tenfold.history[0].cost == pytest.approx(own.history[0].cost)


def test_search_space_round_trip_and_derivatives():
    for grouping in (
        group_by_kind(PAPER.names),
        group_separately(PAPER.names),
        (0, 1, 2, FIXED, 3, 1, 2, FIXED),
    ):
        space = build_space(PAPER, grouping)
        z = (space.lower + space.upper) / 2
        assert space.reduce(space.to_logarithms(z)) == pytest.approx(z)
        jacobian = space.pull_back(np.eye(8), space.expand(z))
        for k, row in enumerate(np.eye(len(z))):
            difference = (space.expand(z + 1e-6 * row) - space.expand(z - 1e-6 * row)) / 2e-6
            assert jacobian[:, k] == pytest.approx(difference, rel=1e-6)


def test_impossible_bounds_are_bad_input():
    with pytest.raises(ProblemError, match=r"skin.gamma.*0 < lower"):
        Unknowns(PAPER.names, PAPER.start, PAPER.lower * [1, 1, 0, 1, 1, 1, 1, 1], PAPER.upper)
    with pytest.raises(ProblemError, match="no parameter is left"):
        build_space(PAPER, (FIXED,) * 8)


class Doubtful:
    """The bars, of which one slips, or folds, in a part of the parameter space: its force is then another."""

    def __init__(self, where, kind: str, factor: float = 1.0):
        self.where, self.kind, self.factor = where, kind, factor
        self.asked: list[bool] = []

    def __call__(self, parameters):
        responses = simulate(parameters)
        self.asked.append(bool(self.where(parameters)))
        if self.asked[-1]:
            force, jacobian = (self.factor * one for one in (responses[1].force_N, responses[1].jacobian))
            responses[1] = SiteResponse(force, jacobian, **{self.kind: "the force falls"})
        return responses

    def accepted(self, found) -> list[bool]:
        return [bool(self.where(np.array(iterate.parameters))) for iterate in found.history]


def too_soft(p):
    """Around the one-material optimum of a record whose second site slips there."""
    return p[0] < 4.0


def test_a_slip_does_not_lure_the_search():
    """Records as they look where the second bar slips: nearer to them, but another equilibrium's force."""
    run = Doubtful(too_soft, "slipped", 0.7)
    record = run(np.tile([3.5, 4.0, 2.5, 0.4], 2))
    measured = [MeasuredCurve(f"s{i}", one.force_N) for i, one in enumerate(record)]
    found = calibrate(run, measured, PAPER, stages=[group_by_kind(PAPER.names)])
    assert any(run.asked[1:])
    assert not any(run.accepted(found))
    assert not found.converged
    assert "s1: the force falls" in found.reason


def test_folds_that_the_search_can_keep_away_from_are_refused():
    """Folds lie on the first long steps only: the answer is the true one."""
    run = Doubtful(lambda p: p[1] > 8.0 or p[2] > 5.0, "folded")
    found = calibrate(run, records(), PAPER)
    assert found.parameters == pytest.approx(TRUTH, rel=1e-2)
    assert not any(run.accepted(found))


def test_an_optimum_is_not_given_up_for_folds():
    """All around the truth elements fold: three trials of a stage are refused for it, and no more."""
    run = Doubtful(lambda p: p[0] > 6.0, "folded")
    found = calibrate(run, records(), PAPER)
    assert found.converged, found.reason
    assert found.parameters == pytest.approx(TRUTH, rel=1e-2)
    assert run.accepted(found)[-1]
    assert 3 <= found.history[-1].failures <= 6
    assert found.evaluations < 30


@pytest.mark.parametrize("kind", ["slipped", "folded"])
def test_a_start_in_doubt_is_left_where_it_can_be(kind):
    run = Doubtful(lambda p: abs(p[0] - 4.7) < 0.01, kind)
    found = calibrate(run, records(), PAPER)
    assert found.parameters == pytest.approx(TRUTH, rel=2e-3)
    everywhere = Doubtful(lambda p: True, kind)
    assert calibrate(everywhere, records(), PAPER).parameters == pytest.approx(TRUTH, rel=2e-3)


def test_a_doubtful_run_taken_up_again_gives_the_same_answer():
    run = Doubtful(lambda p: p[0] > 6.0, "folded")
    states = []
    found = calibrate(run, records(), PAPER, on_iterate=states.append)
    for state in states[:: max(len(states) // 4, 1)]:
        again = calibrate(run, records(), PAPER, state=state)
        assert np.array_equal(again.parameters, found.parameters)
        assert again.evaluations == found.evaluations
