"""Choices of sites, their fits and their standing, on bars whose truth is known."""

from dataclasses import replace
from math import comb

import numpy as np
import pytest
from bars import PAPER, TRUTH, Bars, simulate_at

from limbfit.errors import CalibrationError
from limbfit.identify.checks.crossvalidation import (
    cross_validate,
    fit_sites,
    list_choices,
    list_choices_without_regions,
    rank_fold,
    summarise_errors_by_site,
)
from limbfit.identify.fit.objective import MeasuredCurve
from limbfit.identify.fit.parameters import constrain, group_separately

SITES = [
    Bars((400 * (1 - h) + 60, 400 * h + 60), (10 + 10 * h, 16 + 8 * h), 3.2 + 3.5 * h)
    for h in (0.0, 0.2, 0.5, 0.7, 1.0)
]


simulate = simulate_at(SITES)


def records(misfit=()):
    """Forces of the truth; ``misfit`` are factors by which single sites differ from it."""
    factors = np.ones(len(SITES))
    factors[: len(misfit)] = misfit
    return [MeasuredCurve(f"s{k}", f * site.force(TRUTH)) for k, (f, site) in enumerate(zip(factors, SITES))]


def near(truth=TRUTH):
    return PAPER.__class__(PAPER.names, truth * 1.1, truth / 3, truth * 3)


def test_all_choices_and_samples_without_repeats():
    assert len(list_choices(6, 4)) == comb(6, 4)
    drawn = list_choices(18, 4, most=100, seed=3)
    assert len(set(drawn)) == len(drawn) == 100
    assert drawn == list_choices(18, 4, most=100, seed=3) != list_choices(18, 4, most=100, seed=4)
    assert len(set(list_choices(40, 8, most=50))) == 50
    with pytest.raises(CalibrationError, match="none to be predicted"):
        list_choices(4, 4)


def test_every_site_is_left_out_equally_often():
    drawn = list_choices(12, 4, most=300)
    counts = np.bincount(np.concatenate([np.array(c) for c in drawn]), minlength=12)
    assert counts == pytest.approx(100, rel=0.3)


def test_regions_are_left_out_whole():
    assert list_choices_without_regions(["a", "b", "a", "c"]) == {"a": (1, 3), "b": (0, 2, 3), "c": (0, 1, 2)}
    assert list_choices_without_regions(["a", "a"]) == list_choices_without_regions(["", ""]) == {}


def test_perfect_records_are_predicted_from_any_choice():
    folds = cross_validate(simulate, records(), near(), list_choices(5, 3))
    assert len(folds) == 10
    assert max(fold.mean_heldout for fold in folds) < 0.5
    assert all(len(fold.heldout) == 2 and fold.converged for fold in folds)


def test_the_site_that_differs_is_predicted_badly_from_all_choices_without_it():
    folds = cross_validate(simulate, records([1, 1, 1.2]), near(), list_choices(5, 3))
    by_site = summarise_errors_by_site(folds, 5)
    assert [count for count, *_ in by_site] == [4] * 5
    # 20 % more force: a mean absolute error of 20 % of the mean over the peak.
    force = SITES[2].force(TRUTH)
    between = [fold.errors_percent[2] for fold in folds if 2 not in fold.fitted]
    assert np.mean(between) == pytest.approx(100 * 0.2 / 1.2 * force.mean() / force.max(), rel=0.15)


def test_the_standing_of_a_choice_is_its_rank():
    folds = cross_validate(simulate, records([1.2]), near(), list_choices(5, 3))
    ranked = sorted(folds, key=lambda fold: fold.mean_heldout)
    best, worst = rank_fold(ranked[0], folds), rank_fold(ranked[-1], folds)
    assert best["share_better"] < 0.11
    assert worst["share_better"] > 0.89
    assert best["median_percent"] == pytest.approx(np.median([f.mean_heldout for f in folds]))


def test_regions_are_left_out_and_limits_are_told():
    choices = list_choices_without_regions(["a", "a", "b", "b", "b"])
    folds = cross_validate(simulate, records(), near(), list(choices.values()))
    assert [fold.heldout for fold in folds] == [(0, 1), (2, 3, 4)]
    tight = PAPER.__class__(PAPER.names, TRUTH * 1.6, TRUTH * 1.5, TRUTH * 3)
    assert "skin.c_kPa" in fit_sites(simulate, records(), tight, (0, 1, 4)).at_limit


def test_a_parameter_that_is_given_is_at_no_limit():
    """Fixed at its lower bound, as who wants no relaxation fixes its amplitude."""
    unknowns = replace(PAPER, start=np.where(np.arange(8) == 2, PAPER.lower, TRUTH))
    grouping = constrain(group_separately(PAPER.names), PAPER.names, fixed=["skin.gamma"])
    data = [MeasuredCurve(f"s{k}", site.force(unknowns.start)) for k, site in enumerate(SITES)]
    fold = fit_sites(simulate, data, unknowns, (0, 1, 2), grouping=grouping)
    assert fold.at_limit == ()
