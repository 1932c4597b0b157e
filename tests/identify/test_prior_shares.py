"""How much of an interval comes from what was known beforehand; priors of people on the bars of bars.py."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from bars import NAMES, PAPER, SITES, TRUTH, records, storing

from limbfit.identify.fit.calibration import calibrate
from limbfit.identify.fit.parameters import Prior, build_space, group_separately
from limbfit.identify.uncertainty.estimator import PriorPrecision
from limbfit.identify.uncertainty.intervals import EvaluationStore, sample_uncertainty
from limbfit.identify.uncertainty.noise import estimate_curve_noise
from limbfit.identify.uncertainty.uncertainty import estimate_uncertainty
from limbfit.priors import of_tissues

PEOPLE = tuple(Prior(name, *known) for name, known in of_tissues(("skin", "muscle")).items())
# So little skin beside the muscle that its force is lost in the noise.
THIN = tuple(replace(site, sections=(0.005 * site.sections[0], site.sections[1])) for site in SITES)


def test_shares_of_one_parameter_are_those_of_its_precisions():
    records_, prior, bounds = 5.0, 3.0, 2.0
    beliefs = PriorPrecision(np.array([bounds**-0.5]), np.array([[prior**0.5]]), np.zeros(1))
    share, wider = beliefs.compute_shares(np.array([[1 / (records_ + prior + bounds)]]), np.ones((1, 1)))
    assert share[0] == pytest.approx(prior / (records_ + prior + bounds))
    assert wider[0] == pytest.approx(np.sqrt((records_ + prior + bounds) / (records_ + bounds)))


def test_a_parameter_that_does_not_move_has_no_share():
    beliefs = PriorPrecision(np.ones(1), np.ones((1, 1)), np.zeros(1))
    share, wider = beliefs.compute_shares(np.array([[0.2]]), np.array([[1.0], [0.0]]))
    assert (share[1], wider[1]) == (0.0, 1.0)


def told(unknowns, seed=0):
    """Logarithms of the answer and what is known of it, as a run states it, for a draw of noise."""
    kept, data = EvaluationStore(), records(0.03, seed=seed, sites=THIN)

    def simulate(parameters):
        return [site.respond(parameters) for site in THIN]

    found = calibrate(storing(kept, simulate), data, unknowns)
    known = estimate_uncertainty(
        found.parameters, found.responses, data, unknowns, estimate_curve_noise(found.responses, data)
    )
    space = build_space(unknowns, group_separately(NAMES))
    return np.log(found.parameters), sample_uncertainty(known, data, unknowns, space, kept, simulate)


def half_widths(known):
    low, high = np.log(known.intervals_95.T)
    return (high - low) / 2


def test_priors_of_people_narrow_what_records_leave_open_and_let_stand_what_they_show():
    alone, without = told(PAPER)
    helped, with_people = told(replace(PAPER, priors=PEOPLE))
    assert np.array_equal(without.prior_share, np.zeros(8))
    assert without.wider_without == pytest.approx(np.ones(8))
    shown = np.array([name.startswith("muscle") for name in NAMES])
    assert {without.verdicts[i] for i in np.flatnonzero(shown)} == {"determined"}
    assert "determined" not in {without.verdicts[i] for i in np.flatnonzero(~shown)}
    assert np.abs(helped - alone)[shown].max() < 0.02
    assert half_widths(with_people)[shown] == pytest.approx(half_widths(without)[shown], rel=0.2)
    assert with_people.prior_share[shown].max() < 0.02
    skin = [NAMES.index("skin.c_kPa"), NAMES.index("skin.m")]
    share = with_people.prior_share[skin]
    assert share.min() > 0.2
    # Exact for one parameter with a prior; c and m of the skin are correlated.
    assert with_people.wider_without[skin] == pytest.approx((1 - share) ** -0.5, rel=0.1)
    low, high = with_people.intervals_95.T
    assert np.all((low < TRUTH) & (high > TRUTH))
    # The width of an open parameter hangs on the noise: 0.5 to 1.2 times that without, one draw by another.
    narrowed = [half_widths(with_people)[skin] / half_widths(without)[skin]]
    for seed in (1, 2):
        both = [told(unknowns, seed)[1] for unknowns in (replace(PAPER, priors=PEOPLE), PAPER)]
        narrowed.append(half_widths(both[0])[skin] / half_widths(both[1])[skin])
    assert np.exp(np.log(narrowed).mean(axis=0)).max() < 0.85
