"""Coarse responses brought to the fine ones: what is exact, what is checked, what has no numbers."""

from __future__ import annotations

import warnings
from dataclasses import replace

import numpy as np
import pytest
from bars import TRUTH, coarsened, plain, simulate

from limbfit.errors import CalibrationError
from limbfit.identify.fit.multifidelity import MeshCorrection
from limbfit.identify.fit.objective import SiteResponse

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
