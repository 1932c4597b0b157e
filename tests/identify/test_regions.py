"""Regions of a limb whose tissues differ are told apart; sites that fail do not stop the others."""

from dataclasses import replace

import numpy as np
import pytest
from bars import NAMES, PAPER, SITES, TRUTH, records, simulate_at

from limbfit.identify.checks.crossvalidation import average_errors, compute_site_errors
from limbfit.identify.fit.calibration import calibrate
from limbfit.identify.fit.parameters import group_separately

SOFT = TRUTH * np.array([0.6, 1.0, 1.2, 1.0, 0.7, 1.0, 0.9, 1.1])


def fit_region(identify, simulate, measured, whole):
    """The region's own model from the whole limb's parameters, its errors and theirs."""
    found = identify(PAPER.with_start(whole))
    own, of_whole = (compute_site_errors(simulate, one, measured) for one in (found.parameters, whole))
    return found, own, of_whole


def region(sites, truth, fitted=None):
    """Sites whose records come from ``truth``; identified on the first ``fitted`` of them."""
    measured = records(truth=truth, sites=sites)
    used = fitted or len(sites)

    def identify(start):
        stages = (group_separately(NAMES),)
        return calibrate(simulate_at(sites[:used]), measured[:used], start, stages=stages)

    return identify, simulate_at(sites), measured


@pytest.fixture(scope="module")
def found():
    regions = {"stiff": region(SITES[:3], TRUTH), "soft": region(SITES[1:], SOFT, fitted=2)}
    whole = np.sqrt(TRUTH * SOFT)
    return {name: fit_region(*one, whole) for name, one in regions.items()}


def test_each_region_finds_its_own_tissues(found):
    for name, truth in (("stiff", TRUTH), ("soft", SOFT)):
        calibration = found[name][0]
        assert calibration.converged
        np.testing.assert_allclose(calibration.parameters, truth, rtol=0.05)


def test_a_regions_own_model_errs_less_than_the_whole_limbs(found):
    for _, own, whole in found.values():
        assert average_errors(own) < 0.1 < 3.0 < average_errors(whole)


def test_a_held_out_site_of_a_region_is_judged_too(found):
    assert set(found["soft"][1]) == {"s0", "s1", "s2"}
    assert len(found["soft"][0].sites) == 2


def test_it_starts_from_the_whole_limb_within_the_bounds():
    beyond = np.where(np.arange(8) == 1, 100.0, TRUTH)
    calibration, *_ = fit_region(*region(SITES, TRUTH), beyond)
    assert calibration.history[0].parameters[1] == pytest.approx(20.0)


def test_a_partial_simulation_has_no_error():
    identify, simulate, measured = region(SITES, TRUTH)

    def fails_at_the_last(parameters):
        *others, last = simulate(parameters)
        return [*others, replace(last, completed=False, reason="no")]

    _, own, _ = fit_region(identify, fails_at_the_last, measured, TRUTH)
    assert own["s3"] is None
    assert average_errors(own) == pytest.approx(np.mean([own[f"s{i}"] for i in range(3)]))
    assert average_errors({"s3": None}) is None


def test_the_records_of_a_site_count_as_that_site():
    errors = {"a-slow": 1.0, "a-fast": 3.0, "b": 5.0, "c": None}
    assert average_errors(errors, {"a-slow": "a", "a-fast": "a"}) == pytest.approx(3.5)
