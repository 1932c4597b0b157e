"""How much of an interval comes from what was known beforehand; priors of people on the bars of bars.py."""

from dataclasses import replace

import numpy as np
import pytest
from bars import NAMES, PAPER, SITES, TRUTH, estimate, records, simulate_at, storing

from limbfit.identify.fit.calibration import calibrate
from limbfit.identify.fit.parameters import Prior, build_space, group_separately
from limbfit.identify.uncertainty.intervals import EvaluationStore, sample_uncertainty
from limbfit.identify.uncertainty.uncertainty import PriorPrecision
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


def test_shares_of_correlated_parameters_are_those_of_the_estimates_without_priors():
    """Records see two parameters together, priors know each of them: nothing is diagonal but the bounds."""
    seen, rows = np.array([[5.0, 3.0], [3.0, 4.0]]), np.array([[1.5, 0.0], [0.5, 2.0]])
    beliefs = PriorPrecision(np.array([0.8, 0.6]), rows, np.zeros(2))
    without = np.linalg.inv(seen + np.diag(beliefs.sd**-2))
    together = np.linalg.inv(seen + np.diag(beliefs.sd**-2) + rows.T @ rows)
    share, wider = beliefs.compute_shares(together, np.eye(2))
    assert wider == pytest.approx(np.sqrt(np.diag(without) / np.diag(together)))
    assert share == pytest.approx(np.sum((together @ rows.T) ** 2, axis=1) / np.diag(together))


def test_a_parameter_that_does_not_move_has_no_share():
    beliefs = PriorPrecision(np.ones(1), np.ones((1, 1)), np.zeros(1))
    share, wider = beliefs.compute_shares(np.array([[0.2]]), np.array([[1.0], [0.0]]))
    assert (share[1], wider[1]) == (0.0, 1.0)


def told(unknowns, seed=0):
    """The answer and what is known of it, as a run states it, for a draw of noise."""
    kept, data, simulate = EvaluationStore(), records(0.03, seed=seed, sites=THIN), simulate_at(THIN)
    found = calibrate(storing(kept, simulate), data, unknowns)
    known = estimate(found.parameters, found.responses, data, unknowns)
    return found, sample_uncertainty(known, kept, simulate)


def precision(found, known, unknowns):
    """Precision of the logarithms by records and what is known of ``unknowns``, at the answer."""
    J = [response.jacobian * found.parameters for response in found.responses]
    records_ = sum(own.T @ solved for own, solved in zip(J, known.residual_model.solve(J), strict=True))
    space = build_space(unknowns, group_separately(NAMES))
    return records_ + PriorPrecision.from_unknowns(unknowns, space).precision


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
    assert np.abs(np.log(helped.parameters / alone.parameters))[shown].max() < 0.02
    assert half_widths(with_people)[shown] == pytest.approx(half_widths(without)[shown], rel=0.2)
    assert with_people.prior_share[shown].max() < 0.02
    skin = [NAMES.index("skin.c_kPa"), NAMES.index("skin.m")]
    share = with_people.prior_share[skin]
    assert share.min() > 0.2
    # The shares are those of the linearised estimates at the answer, with and without the priors.
    variances = [
        np.diag(np.linalg.inv(precision(helped, with_people, known)))
        for known in (PAPER, replace(PAPER, priors=PEOPLE))
    ]
    assert with_people.wider_without == pytest.approx(np.sqrt(variances[0] / variances[1]), rel=1e-6)
    low, high = with_people.intervals_95.T
    assert np.all((low < TRUTH) & (high > TRUTH))
    assert (half_widths(with_people)[skin] < 0.85 * half_widths(without)[skin]).all()


@pytest.mark.slow
def test_priors_of_people_narrow_what_records_leave_open_on_average_over_noise():
    """The width of an open parameter hangs on it: 0.5 to 1.2 times that without, one draw by another."""
    skin, narrowed = [NAMES.index("skin.c_kPa"), NAMES.index("skin.m")], []
    for seed in (0, 1, 2):
        both = [told(unknowns, seed)[1] for unknowns in (replace(PAPER, priors=PEOPLE), PAPER)]
        narrowed.append(half_widths(both[0])[skin] / half_widths(both[1])[skin])
    assert np.exp(np.log(narrowed).mean(axis=0)).max() < 0.85
