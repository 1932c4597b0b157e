"""Wrong records are found, right ones left alone, on bars whose truth is known."""

from functools import cache

import numpy as np
import pytest
from bars import PAPER, TRUTH, Bars, simulate_at

from limbfit.identify.checks.outliers import (
    LeaveOutFits,
    LogLinearModel,
    approximate_response,
    find_outliers,
    guess_force_unit,
)
from limbfit.identify.fit.calibration import calibrate
from limbfit.identify.fit.objective import MeasuredCurve

MISFIT = 0.03  # of amplitude and of shape, as a model's own error


def limb(seed: int, sites: int = 6) -> list[Bars]:
    """Sites from thin and stiff to thick and soft."""
    rng = np.random.default_rng(seed)
    shares = rng.permutation(np.linspace(0.0, 1.0, sites))
    return [
        Bars((400 * (1 - h) + 60, 400 * h + 60), (10 + 10 * h, 16 + 8 * h), 3.2 + 3.5 * h) for h in shares
    ]


def history(bar: Bars) -> tuple[np.ndarray, np.ndarray]:
    time = np.linspace(0, 2 * bar.depth / 0.96, bar.points)
    return time, 0.96 * np.minimum(time, time[-1] - time)


def at_other(bar: Bars, record: Bars) -> Bars:
    return Bars(bar.sections, bar.lengths, record.depth)


@cache
def study(seed: int, corruption: tuple = ("none",), fitted: int = 4):
    """The warnings on a study of six sites of which four were fitted, corrupted before the fit."""
    rng = np.random.default_rng([seed, 1])
    bars = limb(seed)
    forces = []
    for bar in bars:
        force = bar.force(TRUTH)
        phase = np.sin(np.linspace(0, 2 * np.pi, force.size))
        force = force * (1 + MISFIT * rng.standard_normal() + MISFIT * rng.standard_normal() * phase)
        forces.append(force + 0.04 * rng.standard_normal(force.size))
    kind, *which = corruption
    if kind == "force":
        forces[which[0]] = forces[which[0]] * which[1]
    if kind == "swap":
        i, j = which
        forces[i], forces[j] = forces[j], forces[i]
        bars[i], bars[j] = at_other(bars[i], bars[j]), at_other(bars[j], bars[i])
    if kind == "stiff":
        other = TRUTH * np.tile([2.5, 1, 1, 1], 2)
        forces[which[0]] = bars[which[0]].force(other)
    data = [MeasuredCurve(f"s{k}", force) for k, force in enumerate(forces)]
    found = calibrate(simulate_at(bars[:fitted]), data[:fitted], PAPER)

    def simulate_exchange(parameters, i, j):
        pair = at_other(bars[i], bars[j]), at_other(bars[j], bars[i])
        return tuple(bar.respond(parameters) for bar in pair)

    one, histories = np.array(found.stages[0].parameters), list(map(history, bars))
    return find_outliers(simulate_at(bars), data, found.parameters, histories, simulate_exchange, one)[1]


def test_the_expansion_is_exact_where_only_moduli_change():
    bar = limb(0)[2]
    first = LogLinearModel(TRUTH, [bar.respond(TRUTH)])
    peak = bar.force(TRUTH).max()
    doubled = TRUTH * np.tile([2.0, 1, 1, 1], 2)
    assert first(doubled)[0].force_N == pytest.approx(2 * bar.force(TRUTH), rel=0.02, abs=0.02 * peak)


def test_derivatives_of_the_expansion_agree_with_differences():
    first = LogLinearModel(TRUTH, [limb(0)[2].respond(TRUTH)])
    at = TRUTH * np.exp(0.2 * np.random.default_rng(0).standard_normal(8))
    for k, row in enumerate(np.eye(8)):
        h = 1e-6 * at[k]
        central = (first(at + h * row)[0].force_N - first(at - h * row)[0].force_N) / (2 * h)
        assert first(at)[0].jacobian[:, k] == pytest.approx(central, rel=1e-4, abs=1e-6)


def test_a_curve_driven_by_another_record_is_close_to_its_simulation():
    bars = limb(0)
    for one, two in ((0, 1), (2, 5), (3, 4)):
        about = approximate_response(bars[one].respond(TRUTH), history(bars[one]), history(bars[two]))
        true = at_other(bars[one], bars[two]).force(TRUTH)
        assert np.abs(about.force_N - true).mean() < 0.12 * true.max()


@pytest.mark.parametrize("seed", range(2))
def test_clean_studies_have_no_warning(seed):
    assert study(seed) == ()


@pytest.mark.parametrize(
    ("seed", "site", "factor"), [(0, 1, 9.81), (1, 5, 9.81), (2, 1, 4.448), (0, 5, 4.448)]
)
def test_a_force_in_another_unit_is_named(seed, site, factor):
    warnings = study(seed, ("force", site, factor))
    assert [(warning.sites, warning.kind) for warning in warnings] == [((f"s{site}",), "unit")]
    assert f"{factor:.3g}" in warnings[0].cause
    assert warnings[0].evidence["error_after_percent"] < 12


@pytest.mark.parametrize("pair", [(0, 1), (1, 5), (4, 5)], ids=["both fitted", "one of each", "held out"])
def test_swapped_names_are_found_whoever_was_fitted(pair):
    caught = 0
    for seed in range(4):
        bars = limb(seed)
        # Sites that answer alike may be exchanged without harm, and nobody can tell.
        if abs(bars[pair[0]].depth - bars[pair[1]].depth) < 1.5:
            continue
        warnings = study(seed, ("swap", *pair))
        assert [(warning.sites, warning.kind) for warning in warnings] == [
            (tuple(f"s{i}" for i in pair), "swap")
        ]
        caught += 1
    assert caught


@pytest.mark.parametrize("seed", range(2))
def test_a_site_of_other_tissue_is_warned_of_with_the_evidence(seed):
    """Among six sites its record may also be explained by an exchange: there is a warning either way."""
    warnings = study(seed, ("stiff", 4))
    assert "s4" in {site for warning in warnings for site in warning.sites}
    for warning in warnings:
        if warning.kind == "outlier":
            assert warning.evidence["standardised_error"] > 4
            assert warning.evidence["force_ratio"] == pytest.approx(2.5, rel=0.2)


def test_cooks_distance_is_largest_where_the_fit_leans_on_a_bad_record():
    bars = limb(2)
    data = [MeasuredCurve(f"s{k}", bar.force(TRUTH)) for k, bar in enumerate(bars)]
    model = LogLinearModel(TRUTH, [bar.respond(TRUTH) for bar in bars])
    clean = LeaveOutFits(model, data, TRUTH).leave_one_out()
    data[3] = MeasuredCurve("s3", 1.4 * data[3].force_N)
    found = calibrate(simulate_at(bars), data, PAPER)
    simulate = LogLinearModel(found.parameters, [bar.respond(found.parameters) for bar in bars])
    left = LeaveOutFits(simulate, data, found.parameters).leave_one_out()
    assert max(entry.cook for entry in clean) < 0.1 * left[3].cook
    assert max(left, key=lambda entry: entry.standardised).site == "s3"


def test_fits_without_a_site_keep_what_is_fixed_and_tied():
    bars = limb(2)
    data = [MeasuredCurve(f"s{k}", 1.2 * bar.force(TRUTH)) for k, bar in enumerate(bars)]
    model = LogLinearModel(TRUTH, [bar.respond(TRUTH) for bar in bars])
    tie = np.vstack([np.eye(4), np.eye(4)])[:, [0, 2]]  # c and gamma of both tissues, each pair together
    found = LeaveOutFits(model, data, TRUTH, tie).fit_without(0) / TRUTH
    assert found[[1, 3, 5, 7]].tolist() == [1.0] * 4
    assert found[[0, 2]] == pytest.approx(found[[4, 6]], rel=1e-12)
    assert found[0] > 1.05


def test_too_few_sites_cannot_tell_who_is_wrong():
    bars = limb(0)[:3]
    data = [MeasuredCurve(f"s{k}", bar.force(TRUTH) * (9.81 if k else 1)) for k, bar in enumerate(bars)]
    simulate = LogLinearModel(TRUTH, [bar.respond(TRUTH) for bar in bars])
    assert find_outliers(simulate, data, TRUTH, [], None, TRUTH)[1] == ()


def test_ratios_name_units():
    assert "kgf" in guess_force_unit(0.1)
    assert "gf" in guess_force_unit(98.0)
    assert guess_force_unit(1.3) == guess_force_unit(0.8) == guess_force_unit(-1.0) == ""
