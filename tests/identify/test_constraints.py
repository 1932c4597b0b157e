"""Parameters that are fixed, tied or known; weights; several starts, and a search continued from a bound."""

from dataclasses import replace
from zlib import crc32

import numpy as np
import pytest
from bars import NAMES, PAPER, SITES, TRUTH, Counted, records, simulate, simulate_at

from limbfit.errors import CalibrationError
from limbfit.identify.fit.calibration import Calibration, CalibrationSettings, calibrate
from limbfit.identify.fit.multifidelity import SearchResult
from limbfit.identify.fit.multistart import (
    combine_searches,
    continue_from_bound,
    describe_starts,
    draw_starts,
    find_start_inside,
    run_multistart,
)
from limbfit.identify.fit.objective import MeasuredCurve, SiteResponse
from limbfit.identify.fit.parameters import (
    FIXED,
    Prior,
    build_stage_groupings,
    constrain,
    group_by_kind,
    group_separately,
)

GAMMA, TAU = NAMES.index("skin.gamma"), NAMES.index("skin.tau_s")


def test_fixed_names_move_in_no_stage():
    start = PAPER.start.copy()
    start[GAMMA] = TRUTH[GAMMA]
    stages = [constrain(grouping, NAMES, ["skin.gamma"]) for grouping in build_stage_groupings(NAMES)]
    assert [stage[GAMMA] for stage in stages] == [FIXED, FIXED]
    tight = CalibrationSettings(relative_tolerance=1e-4)
    found = calibrate(simulate, records(), replace(PAPER, start=start), tight, stages=stages)
    assert found.parameters[GAMMA] == TRUTH[GAMMA]
    assert found.stages[0].parameters[GAMMA] == TRUTH[GAMMA]
    assert found.parameters == pytest.approx(TRUTH, rel=2e-3)


def test_tied_names_stay_equal_and_reach_a_truth_in_which_they_are():
    truth = TRUTH.copy()
    truth[TAU] = truth[TAU + 4]
    grouping = constrain(group_separately(NAMES), NAMES, tied=[["skin.tau_s", "muscle.tau_s"]])
    assert len(set(grouping)) == 7
    stages = (group_by_kind(NAMES), grouping)
    found = calibrate(simulate, records(truth=truth), PAPER, stages=stages)
    assert found.parameters[TAU] == found.parameters[TAU + 4]
    assert found.parameters == pytest.approx(truth, rel=2e-3)


def test_all_tied_is_one_material():
    ties = [[f"skin.{name}", f"muscle.{name}"] for name in ("c_kPa", "m", "gamma", "tau_s")]
    assert constrain(group_separately(NAMES), NAMES, tied=ties) == group_by_kind(NAMES)


def test_a_prior_holds_what_the_data_do_not_show_and_hardly_what_they_do():
    """At a site with hardly any skin the force says nothing about it."""
    muscle = tuple(replace(site, sections=(0.002, site.sections[1])) for site in SITES)
    data = records(0.03, sites=muscle)
    known = Prior("skin.c_kPa", 12.0, 1.5), Prior("muscle.c_kPa", 12.0, 1.5)
    with_priors = calibrate(simulate_at(muscle), data, replace(PAPER, priors=known))
    assert with_priors.converged, with_priors.reason
    assert with_priors.parameters[0] == pytest.approx(12.0, rel=0.1)
    assert with_priors.parameters[4] == pytest.approx(TRUTH[4], rel=0.1)


def test_a_narrow_prior_wins_and_a_wide_one_yields():
    def skin(factor):
        known = replace(PAPER, priors=(Prior("skin.c_kPa", 5.0, factor),))
        return calibrate(simulate, records(0.03), known).parameters[0]

    assert skin(1.0001) == pytest.approx(5.0, rel=1e-3)
    assert skin(1e4) == pytest.approx(calibrate(simulate, records(0.03), PAPER).parameters[0], rel=0.01)
    assert skin(1.0001) < skin(1.01) < skin(2.0)


def test_forces_weigh_less_against_priors_where_their_error_is_larger():
    known = replace(PAPER, priors=(Prior("skin.c_kPa", 5.0, 1.05),))
    found = [
        calibrate(simulate, records(0.03), known, CalibrationSettings(force_error_percent=error)).parameters[
            0
        ]
        for error in (0.1, 1.0, 10.0)
    ]
    assert found[0] > found[1] > found[2]


def test_a_heavier_record_is_fitted_closer():
    wrong = [MeasuredCurve(d.name, d.force_N * (1.15 if d.name == "s1" else 1.0)) for d in records()]
    heavy = [replace(d, weight=100.0) if d.name == "s1" else d for d in wrong]
    light, strong = (calibrate(simulate, data, PAPER).history[-1].errors_percent for data in (wrong, heavy))
    assert strong[1] < 0.5 * light[1]
    assert sum(strong) > sum(light)


def test_twenty_random_starts_between_the_bounds_end_at_the_same_optimum():
    data = records(0.03, seed=1)
    found = run_multistart(lambda number, unknowns: calibrate(simulate, data, unknowns), PAPER, 20, seed=4)
    assert found.reached_count == 20, [
        (start.start, start.reason) for start in found.starts if not start.same
    ]
    assert max(start.apart for start in found.starts) < 1.05
    assert max(start.cost for start in found.starts) == pytest.approx(found.best.cost, rel=5e-3)
    assert found.best.cost == min(start.cost for start in found.starts)
    assert "20 of 20 starts end at the same error" in describe_starts(found, NAMES)


def test_random_starts_are_of_their_seed_and_within_the_bounds():
    one, two, other = (draw_starts(PAPER, 5, seed) for seed in (1, 1, 2))
    assert np.array_equal(one, two)
    assert not np.array_equal(one[1:], other[1:])
    assert np.array_equal(one[0], PAPER.start)
    assert np.all((one >= PAPER.lower) & (one <= PAPER.upper))
    assert all(np.array_equal(start[:4], start[4:]) for start in one)


def test_random_starts_leave_what_is_fixed_and_keep_what_is_tied():
    names = list(PAPER.names)
    grouping = constrain(group_by_kind(names), names, fixed=[names[1]], tied=[[names[3], names[7]]])
    drawn = np.array(draw_starts(PAPER, 6, 1, grouping))
    assert np.all(drawn[:, 1] == PAPER.start[1])
    assert drawn[:, 3] == pytest.approx(drawn[:, 7])
    assert len(np.unique(drawn[:, 5].round(9))) == 6


def test_starts_that_end_in_one_place_count_as_one_however_good_the_fit():
    """Where the last step is large, it decides how small the error is."""
    loose = CalibrationSettings(relative_tolerance=0.01)
    data = records(0.002, seed=1)

    def run(number, unknowns):
        return calibrate(simulate, data, unknowns, loose)

    found = run_multistart(run, PAPER, 6, seed=4)
    costs = [start.cost for start in found.starts]
    assert max(costs) > 1.5 * min(costs)
    assert found.reached_count == 6, costs


def test_a_start_that_fails_is_told_and_the_others_count():
    def run(number, unknowns):
        failing = Counted(forbidden=lambda p: number == 1)
        return calibrate(failing, records(), unknowns)

    found = run_multistart(run, PAPER, 3, seed=1)
    assert [start.parameters is None for start in found.starts] == [False, True, False]
    assert "did not converge" in found.starts[1].reason
    assert found.reached_count == 2
    with pytest.raises(CalibrationError, match="no simulation completes"):
        run_multistart(lambda n, u: calibrate(Counted(forbidden=lambda p: True), records(), u), PAPER, 1)
    with pytest.raises(CalibrationError, match="none of 2 starts"):
        run_multistart(lambda n, u: calibrate(Counted(forbidden=lambda p: True), records(), u), PAPER, 2)


@pytest.mark.parametrize("roughness", [1e-4, 1e-3])
def test_rough_forces_end_at_their_noise_floor_without_a_search_for_nothing(roughness):
    """Simulations are smooth only to their tolerance; here they are off by a random amount everywhere."""

    def rough(parameters):
        rng = np.random.default_rng(crc32(parameters.tobytes()))
        return [
            SiteResponse(r.force_N * (1 + roughness * rng.standard_normal()), r.jacobian)
            for r in simulate(parameters)
        ]

    run = Counted()
    found = calibrate(lambda p: (run(p), rough(p))[1], records(0.03), PAPER)
    assert found.converged, found.reason
    assert run.calls <= 16
    smooth = calibrate(simulate, records(0.03), PAPER)
    assert found.parameters[4:] == pytest.approx(smooth.parameters[4:], rel=0.03 if roughness < 1e-3 else 0.2)


LOW = replace(PAPER, upper=np.where(np.arange(8) == GAMMA, 1.5, PAPER.upper))  # below the truth of 2


@pytest.fixture(scope="module")
def bounded() -> Calibration:
    found = calibrate(Counted(), records(), LOW)
    assert found.parameters[GAMMA] == pytest.approx(1.5)
    return found


def test_what_ended_at_a_bound_goes_back_to_its_start(bounded):
    names, again = find_start_inside(bounded, LOW, group_separately(NAMES))
    assert names == ["skin.gamma"]
    others = np.arange(8) != GAMMA
    assert again.start[GAMMA] == PAPER.start[GAMMA]
    assert again.start[others] == pytest.approx(bounded.parameters[others])


def test_nothing_goes_on_where_nothing_ended_at_a_bound_or_could_move(bounded):
    assert find_start_inside(calibrate(Counted(), records(), PAPER), PAPER, group_separately(NAMES)) is None
    fixed = tuple(FIXED if i == GAMMA else i for i in range(8))
    assert find_start_inside(bounded, LOW, fixed) is None
    assert find_start_inside(bounded, LOW.with_start(LOW.upper), group_separately(NAMES)) is None


def test_no_smaller_error_leaves_the_answer(bounded):
    """There is one optimum: it is reached again."""
    names, again = find_start_inside(bounded, LOW, group_separately(NAMES))
    second = calibrate(Counted(), records(), again, stages=(group_separately(NAMES),))
    found = combine_searches(bounded, second, names)
    assert np.array_equal(found.parameters, bounded.parameters)
    assert found.history == bounded.history
    assert found.evaluations == bounded.evaluations + second.evaluations
    assert found.reason.endswith(
        "with skin.gamma at a bound; searched again from inside, without a smaller error"
    )


def test_a_smaller_error_is_the_answer_and_its_way_follows_the_first(bounded):
    """The second search within wider bounds stands for one that leaves a worse optimum."""
    second = calibrate(
        Counted(), records(), PAPER.with_start(bounded.parameters), stages=(group_separately(NAMES),)
    )
    found = combine_searches(bounded, second, ["skin.gamma"])
    assert found.parameters == pytest.approx(TRUTH, rel=0.02)
    assert found.cost == second.cost < bounded.cost
    assert [stage.grouping for stage in found.stages] == list(build_stage_groupings(NAMES))
    assert [one.stage for one in found.history] == sorted(one.stage for one in found.history)
    assert found.history[-1].parameters == second.history[-1].parameters
    assert found.history[-1].evaluations == found.evaluations
    last = found.stages[-1]
    assert last.evaluations == bounded.stages[-1].evaluations + second.evaluations
    assert last.iterations == sum(one.stage == 1 for one in found.history) - 1
    assert "went on from inside" in last.reason


def test_a_second_search_that_fails_leaves_the_answer_and_is_told(bounded):
    def search(unknowns, stages):
        return SearchResult(calibrate(Counted(forbidden=lambda p: True), records(), unknowns, stages=stages))

    said = []
    first = SearchResult(bounded)
    assert continue_from_bound(first, LOW, build_stage_groupings(NAMES), search, said.append) is first
    assert said[0] == "skin.gamma at a bound: searched again from inside"
    assert said[1].startswith("warning: skin.gamma at a bound: searched again from inside, which fails: ")
