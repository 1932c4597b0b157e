"""A search that ended at a bound goes on from inside: what goes on, and what is told of both."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from bars import NAMES, PAPER, TRUTH, Counted, records

from limbfit.identify.fit.calibration import Calibration, calibrate
from limbfit.identify.fit.multistart import combine_searches, continue_from_bound, find_start_inside
from limbfit.identify.fit.parameters import FIXED, build_stage_groupings, group_separately

GAMMA = NAMES.index("skin.gamma")
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
        return calibrate(Counted(forbidden=lambda p: True), records(), unknowns, stages=stages), ()

    said = []
    first = bounded, ()
    assert continue_from_bound(first, LOW, build_stage_groupings(NAMES), search, said.append) is first
    assert said[0] == "skin.gamma at a bound: searched again from inside"
    assert said[1].startswith("warning: skin.gamma at a bound: searched again from inside, which fails: ")
