"""Coarse simulations corrected by fine ones; closed-form models whose truth is known (see bars.py)."""

import json
import warnings
from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
from bars import PAPER, SITES, TRUTH, coarsened, plain, records, simulate

from limbfit.errors import CalibrationError
from limbfit.identify.fit.calibration import CalibrationSettings, calibrate
from limbfit.identify.fit.multifidelity import (
    CorrectionSettings,
    MeshCorrection,
    SearchResult,
    calibrate_with_correction,
)
from limbfit.identify.fit.objective import SiteResponse

TIGHT = CorrectionSettings(rounds=4, tolerance_percent=0.02)


def counting(function, calls):
    def run(parameters):
        calls.append(tuple(parameters))
        return function(parameters)

    return run


@pytest.fixture(scope="module")
def corrected() -> SearchResult:
    return calibrate_with_correction(coarsened, plain, records(0.03), PAPER)


def test_the_coarse_model_alone_is_wrong_and_the_corrected_one_is_not():
    biased = calibrate(coarsened, records(), PAPER)
    assert biased.converged
    assert biased.parameters[4] == pytest.approx(TRUTH[4] / 1.1, rel=0.03)
    found = calibrate_with_correction(coarsened, plain, records(), PAPER, fidelity=TIGHT)
    assert found.calibration.converged, found.calibration.reason
    assert found.calibration.parameters == pytest.approx(TRUTH, rel=0.02)
    assert max(found.calibration.history[-1].errors_percent) < 0.05


def test_few_coarse_and_fewer_fine_evaluations():
    coarse, fine = [], []
    found = calibrate_with_correction(
        counting(coarsened, coarse), counting(plain, fine), records(0.03), PAPER
    )
    assert found.calibration.converged, found.calibration.reason
    assert found.calibration.evaluations == len(coarse) == len(set(coarse)) <= 13
    assert len(fine) == len(found.rounds) <= 6
    reference = calibrate(simulate, records(0.03), PAPER)
    assert found.calibration.cost == pytest.approx(reference.cost, rel=0.1)


def test_the_forces_at_the_end_are_the_fine_ones(corrected):
    found = corrected.calibration
    for response, true in zip(found.responses, simulate(found.parameters), strict=True):
        assert response.force_N == pytest.approx(true.force_N, abs=1e-12)
        scale = np.abs(true.jacobian * TRUTH).max()
        assert response.jacobian * TRUTH == pytest.approx(true.jacobian * TRUTH, abs=0.08 * scale)


def test_every_stage_ends_with_fine_forces_and_history_is_whole():
    found = calibrate_with_correction(coarsened, plain, records(), PAPER).calibration
    assert [stage.grouping for stage in found.stages] == [(0, 1, 2, 3) * 2, tuple(range(8))]
    assert {iterate.stage for iterate in found.history} == {0, 1}
    assert found.stages[0].evaluations + found.stages[1].evaluations == found.evaluations
    for number, stage in enumerate(found.stages):
        last = [iterate for iterate in found.history if iterate.stage == number][-1]
        assert (last.parameters, last.cost) == (stage.parameters, stage.cost)
        errors = [
            100 * np.mean(np.abs(site.force(np.array(stage.parameters)) - data.force_N)) / data.force_N.max()
            for site, data in zip(SITES, records(), strict=True)
        ]
        assert last.errors_percent == pytest.approx(errors, rel=1e-9)


def test_a_run_killed_anywhere_and_begun_again_repeats_itself(corrected):
    """Simulations are remembered, as the store of a study does; everything else is computed anew."""
    memory: dict[tuple[str, bytes], list[SiteResponse]] = {}
    left = [0]

    class KilledError(Exception):
        """What a signal would do."""

    def remembered(kind, function):
        def run(parameters):
            key = kind, parameters.tobytes()
            if key not in memory:
                if left[0] == 0:
                    raise KilledError
                left[0] -= 1
                memory[key] = function(parameters)
            return memory[key]

        return run

    def run():
        data = records(0.03)
        return calibrate_with_correction(
            remembered("coarse", coarsened), remembered("fine", plain), data, PAPER
        )

    kills = 0
    while True:
        left[0] = 1
        try:
            again = run()
        except KilledError:
            kills += 1
            continue
        break
    assert kills == corrected.calibration.evaluations + len(corrected.rounds) - 1
    assert np.array_equal(again.calibration.parameters, corrected.calibration.parameters)
    assert again.calibration.history == corrected.calibration.history
    assert again.rounds == corrected.rounds


@pytest.mark.parametrize("seed", range(3))
def test_one_simulation_in_ten_may_fail_on_either_mesh(seed, corrected):
    def failing(function, rate, offset):
        rng = np.random.default_rng([seed, offset])

        def run(parameters):
            return [
                SiteResponse(r.force_N, r.jacobian, False, "did not converge") if rng.random() < rate else r
                for r in function(parameters)
            ]

        return run

    found = calibrate_with_correction(
        failing(coarsened, 0.1, 0), failing(plain, 0.1, 1), records(0.03), PAPER
    )
    assert found.calibration.converged, found.calibration.reason
    assert found.calibration.parameters == pytest.approx(corrected.calibration.parameters, rel=0.03)


def test_a_fine_simulation_that_always_fails_is_told():
    def fails(parameters):
        return [
            SiteResponse(r.force_N, r.jacobian, k != 2, "folded") for k, r in enumerate(plain(parameters))
        ]

    found = calibrate_with_correction(coarsened, fails, records(), PAPER)
    assert not found.calibration.converged
    assert "the correction fails: s2: on the whole mesh: folded" in found.calibration.reason
    json.dumps([vars(one) for one in found.rounds], allow_nan=False)  # as it is stored


def too_weak(parameters):
    """The same forces at the start, from which every change of a parameter has a third of its effect."""
    damped = PAPER.start * (parameters / PAPER.start) ** (1 / 3)
    slopes = damped / parameters / 3
    return [SiteResponse(r.force_N, r.jacobian * slopes) for r in simulate(damped)]


def fine_cost(parameters, data):
    forces = [response.force_N for response in plain(np.array(parameters))]
    parts = [np.mean(((f - d.force_N) / d.force_N.max()) ** 2) for f, d in zip(forces, data, strict=True)]
    return float(np.sum(parts))


def test_where_the_coarse_model_answers_too_weakly_the_best_corrected_iterate_is_the_answer():
    """A coarse model with a third of the fine one's slope sends the search three times too far."""
    data, fine = records(0.03), []
    found = calibrate_with_correction(too_weak, counting(plain, fine), data, PAPER)

    def cost(parameters):
        return fine_cost(parameters, data)

    last = [one for one in found.rounds if one.stage == 1]
    assert cost(found.calibration.parameters) == pytest.approx(min(cost(one.parameters) for one in last))
    assert cost(found.calibration.parameters) < 0.2 * cost(found.calibration.stages[0].parameters)


@pytest.mark.filterwarnings("error")
def test_a_coarse_simulation_lost_half_way_back_leaves_the_correction_before():
    """Its forces are zero: an anchor there would be 0/0."""
    data, fine = records(0.03), []

    def coarse(parameters):
        between = [(np.log(a) + np.log(b)) / 2 for a, b in combinations(fine, 2)]
        found = too_weak(parameters)
        if any(np.allclose(np.log(parameters), middle) for middle in between):
            return [SiteResponse(0 * r.force_N, 0 * r.jacobian, False, "lost") for r in found]
        return found

    found = calibrate_with_correction(coarse, counting(plain, fine), data, PAPER)
    failed = [one for one in found.rounds if one.reason]
    assert failed
    assert all("s0: in the search: lost" in one.reason for one in failed)
    assert all(one.scales == one.expected_percent == (None,) * 4 for one in failed)
    json.dumps([vars(one) for one in found.rounds], allow_nan=False)
    assert "the correction fails: s0: in the search: lost" in found.calibration.reason
    whole = [one for one in found.rounds if one.stage == 1 and not one.reason]
    costs = [fine_cost(one.parameters, data) for one in whole]
    assert fine_cost(found.calibration.parameters, data) == pytest.approx(min(costs))


def test_corrections_that_cannot_settle_are_not_called_converged():
    rng = np.random.default_rng(0)

    def restless(parameters):
        return [SiteResponse(r.force_N * rng.uniform(0.9, 1.1), r.jacobian) for r in plain(parameters)]

    found = calibrate_with_correction(coarsened, restless, records(), PAPER).calibration
    assert not found.converged
    assert "have not settled" in found.reason


def test_two_equal_models_need_one_correction_per_stage():
    found = calibrate_with_correction(simulate, plain, records(0.03), PAPER, CalibrationSettings())
    assert [one.stage for one in found.rounds][:3] == [-1, 0, 1]
    assert max(found.rounds[0].expected_percent) < 1e-9
    assert found.rounds[-1].scales == pytest.approx([1.0] * 4)
    alone = calibrate(simulate, records(0.03), PAPER)
    assert found.calibration.parameters == pytest.approx(alone.parameters, rel=0.02)


FORCE = np.array([0.0, 1.0, 2.0, 1.0])
NONE = np.zeros((4, 0))


def response(force, **more) -> SiteResponse:
    return SiteResponse(np.asarray(force, dtype=float), NONE, **more)


def test_at_the_anchor_the_forces_are_the_fine_ones_and_slopes_are_scaled():
    coarse, fine = coarsened(TRUTH), plain(TRUTH)
    correction = MeshCorrection(coarse, fine)
    assert correction.reasons == ("",) * 4
    for found, rough, exact, scale in zip(correction(coarse), coarse, fine, correction.scales, strict=True):
        assert np.array_equal(found.force_N, exact.force_N)
        assert np.array_equal(found.jacobian, scale * rough.jacobian)


def test_nearby_the_corrected_forces_are_nearer_than_the_coarse_ones():
    correction, near = MeshCorrection(coarsened(TRUTH), plain(TRUTH)), 1.05 * TRUTH
    for found, rough, exact in zip(correction(coarsened(near)), coarsened(near), simulate(near), strict=True):
        before, after = (np.abs(one.force_N - exact.force_N).max() for one in (rough, found))
        assert after < 0.1 * before


def test_the_scale_is_the_least_squares_ratio():
    fine = 1.1 * FORCE + np.array([0, 0.1, -0.1, 0.1])
    correction = MeshCorrection([response(FORCE)], [response(fine)])
    assert correction.scales[0] == pytest.approx(1.1)
    assert correction.differences_percent[0] == pytest.approx(100 * np.mean([0, 0.2, 0.1, 0.2]) / 2.1)


@pytest.mark.parametrize(
    ("coarse", "fine", "reason"),
    [
        (response(0 * FORCE, completed=False, reason="lost"), response(FORCE), "in the search: lost"),
        (response(FORCE, completed=False), response(FORCE), "in the search: simulation failed"),
        (response(FORCE), response(FORCE, completed=False, reason="folded"), "on the whole mesh: folded"),
        (response(FORCE * np.nan), response(FORCE), "in the search: the simulated force is not finite"),
        (response(0 * FORCE), response(FORCE), "in the search: there is no force"),
        (response(FORCE), response(0 * FORCE), "on the whole mesh: there is no force"),
    ],
)
def test_a_site_without_an_anchor_has_a_reason_and_no_numbers(coarse, fine, reason):
    other = response(FORCE), response(1.2 * FORCE)
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # 0/0 among them
        correction = MeshCorrection([coarse, other[0]], [fine, other[1]])
        found, right = correction([response(2 * FORCE)] * 2)
        assert correction.scales == (None, pytest.approx(1.2))
        assert correction.differences_percent[0] is None
    assert correction.reasons == (reason, "")
    assert (found.completed, found.reason) == (False, reason)
    assert np.all(np.isnan(found.force_N))
    assert right.force_N == pytest.approx(2.4 * FORCE)


def test_what_fails_later_has_no_numbers_either():
    correction = MeshCorrection([response(FORCE)], [response(1.2 * FORCE)])
    (found,) = correction([response(FORCE, completed=False, reason="did not converge")])
    assert (found.completed, found.reason) == (False, "in the search: did not converge")
    assert np.all(np.isnan(found.force_N))


def test_doubts_of_all_three_simulations_are_carried():
    coarse, fine = response(FORCE, warnings=("slips",)), response(FORCE, warnings=("folds",))
    (found,) = MeshCorrection([coarse], [fine])([response(FORCE, warnings=("slips", "sinks in"))])
    assert found.warnings == ("folds", "in the search: slips", "in the search: sinks in")


@pytest.mark.parametrize(
    ("coarse", "words"),
    [
        ([response(FORCE)] * 2, "2 and 1 responses"),
        ([response(FORCE, site="calf")], "'calf' and 'tibia'"),
        ([SiteResponse(FORCE[:3], NONE[:3], site="tibia")], "of other times"),
    ],
)
def test_other_sites_or_times_are_a_fault_of_the_caller(coarse, words):
    tibia = response(FORCE, site="tibia")
    with pytest.raises(CalibrationError, match=words):
        MeshCorrection(coarse, [tibia])
    with pytest.raises(CalibrationError, match=words):
        MeshCorrection([tibia], [replace(tibia, force_N=1.1 * FORCE)])(coarse)
