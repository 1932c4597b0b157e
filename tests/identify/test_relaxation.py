"""Relaxation beyond the records: superposition, which relaxation fits, and what is left open."""

from dataclasses import dataclass, replace

import numpy as np
import pytest
from bars import NAMES, PAPER, SITES, TRUTH, Bars, simulate_at

from limbfit.bench.timing import build_punched_block
from limbfit.fe import History, OgdenQLV, StepControl, solve
from limbfit.identify.fit.calibration import calibrate
from limbfit.identify.fit.objective import MeasuredCurve, SiteResponse
from limbfit.identify.fit.parameters import build_space, group_separately
from limbfit.identify.fit.prediction import PredictionModel, RelaxationSpread, widen_by_relaxation
from limbfit.identify.uncertainty.noise import SiteNoise
from limbfit.identify.uncertainty.relaxation import (
    FURTHER,
    GIVES_WAY,
    MAX_SLOPE,
    OWN,
    POWER_LAW,
    assess_relaxation,
    limit_verdicts,
)
from limbfit.identify.uncertainty.superposition import (
    RelaxationModel,
    Superposition,
    find_tissue_parameters,
)
from limbfit.identify.uncertainty.uncertainty import DETERMINED, WEAK, estimate_uncertainty

SPACE = build_space(PAPER, group_separately(NAMES))
TISSUES = find_tissue_parameters(NAMES, SPACE)
SD_N = 0.005
DECADES_S = np.array([0.03, 0.2, 1.2, 7.0, 40.0])  # of a power law, with equal amplitudes


@dataclass(frozen=True)
class Held(Bars):
    """Bars that are held for a while at their deepest; a record of ``points`` times."""

    hold_s: float = 0.0
    points: int = 120

    @property
    def times_s(self) -> np.ndarray:
        ramp = self.depth / 0.96
        if not self.hold_s:
            return np.linspace(0, 2 * ramp, self.points)
        third = self.points // 3
        held = np.linspace(ramp, ramp + self.hold_s, third + 1)[1:]
        return np.r_[np.linspace(0, ramp, third), held, held[-1] + np.linspace(0, ramp, third + 1)[1:]]

    def relax(self, p: np.ndarray, terms) -> np.ndarray:
        """The force with terms, amplitude and time, of each tissue."""
        return sum(
            elastic + sum(amplitude * self.remember(elastic, np.array(tau)) for amplitude, tau in own)
            for elastic, own in zip(self.split(p), terms)
        )

    def respond(self, p: np.ndarray) -> SiteResponse:
        """The same without pulling, as an indenter."""
        found = super().respond(p)
        touching = found.force_N > 0
        return SiteResponse(found.force_N * touching, found.jacobian * touching[:, None])


@dataclass(frozen=True)
class Receding(Held):
    """The same where the limb recedes from the indenter, by a ``share`` of the travel at the end."""

    share: float = 0.0

    @property
    def travel(self) -> np.ndarray:
        receded = self.share * self.depth * self.times_s / self.times_s[-1]
        return np.maximum(super().travel - receded, 0.0)


def held_sites(hold_s: float = 0.0) -> list[Held]:
    plain = [Held(one.sections, one.lengths, one.depth) for one in SITES]
    return [replace(plain[0], hold_s=hold_s), *plain[1:]] if hold_s else plain


def assess(sites, forces):
    """Calibrate to forces with white noise, and assess what is known."""
    random = np.random.default_rng(0)
    data = [
        MeasuredCurve(f"s{k}", np.maximum(force + SD_N * random.standard_normal(force.size), 0.0))
        for k, force in enumerate(forces)
    ]
    found = calibrate(simulate_at(sites), data, PAPER)
    noise = [
        SiteNoise(f"s{k}", site.times_s, SD_N**2 * np.eye(site.points), SD_N, 0.0)
        for k, site in enumerate(sites)
    ]
    known = estimate_uncertainty(found.parameters, found.responses, data, PAPER, noise)
    return assess_relaxation(known, found.responses)


def true_moduli(time_s: float) -> np.ndarray:
    """Of a power law, for each tissue."""
    shape = 1 + 0.24 * TRUTH[[2, 6]] * np.exp(-time_s / DECADES_S).sum()
    return TRUTH[[0, 4]] * shape


@pytest.fixture(scope="module")
def of_model():
    return assess(held_sites(), [site.force(TRUTH) for site in held_sites()])


def assess_power_law(hold_s: float):
    terms = [[(0.24 * gamma, tau) for tau in DECADES_S] for gamma in TRUTH[[2, 6]]]
    sites = held_sites(hold_s)
    return assess(sites, [site.relax(TRUTH, terms) for site in sites])


@pytest.fixture(scope="module")
def of_power_law():
    return assess_power_law(0.0)


def test_superposition_gives_force_and_derivatives_for_another_relaxation():
    """Exact for bars, whose forces are linear in the moduli; m moves forces to first order."""
    site, other = held_sites(20.0)[0], TRUTH.copy()
    other[[0, 2, 3, 6, 7]] *= [1.3, 0.4, 5.0, 1.7, 0.2]
    found = Superposition(site.times_s, site.respond(TRUTH), TRUTH, TISSUES)
    response, exact = found.respond(RelaxationModel(), other), site.respond(other)
    touching, peak = (response.force_N > 0) & (exact.force_N > 0), exact.force_N.max()
    assert touching.sum() > 90
    assert response.force_N[touching] == pytest.approx(exact.force_N[touching], abs=1e-9 * peak)
    slopes = [(one.jacobian * other)[touching] for one in (response, exact)]
    assert slopes[0] == pytest.approx(slopes[1], abs=1e-5 * peak)


def test_superposition_holds_for_the_solver():
    """Half of the amplitude and eight to ten times the time under a punch, from one other simulation."""
    p, other = np.array([9, 6, 2, 0.5, 4, 4, 3, 0.3]), np.array([9, 6, 1, 4.0, 4, 4, 1.5, 3.0])
    depth, ramp, hold = 6.0, 6.25, 20.0
    history = History(np.array([0, ramp, ramp + hold, 2 * ramp + hold]), np.array([0, depth, depth, 0]))
    block, times = build_punched_block("tet10", 4), np.linspace(0.0, 2 * ramp + hold, 81)

    def press(values, sensitivities):
        laws = {
            tissue: OgdenQLV(1e-3 * c, *own)
            for tissue, (c, *own) in zip(("skin", "muscle"), values.reshape(2, 4))
        }
        pressed = replace(block, history=history, materials=laws)
        return solve(pressed, StepControl(load_steps=6, unload_steps=6), sensitivities=sensitivities)

    one, true = press(p, True), press(other, False).force_at(times)
    slopes = one.sensitivity_at(times) * np.array([1e-3, 1, 1, 1] * 2)
    response = SiteResponse(np.maximum(one.force_at(times), 0.0), slopes)
    found = Superposition(times, response, p, TISSUES).respond(RelaxationModel(), other).force_N
    touching, peak = (response.force_N > 0) & (true > 0), true.max()
    error, change = (np.abs(one - true)[touching].mean() / peak for one in (found, response.force_N))
    assert change > 0.05
    assert error < 0.15 * change


@pytest.mark.parametrize("model", [RelaxationModel(0.2, 10.0), RelaxationModel(0.2, 10.0, DECADES_S)])
def test_derivatives_of_other_relaxations_are_those_of_differences(model):
    site = held_sites()[1]
    found = Superposition(site.times_s, site.respond(TRUTH), TRUTH, TISSUES)
    at = found.respond(model, TRUTH).jacobian * TRUTH
    for k, row in enumerate(np.eye(8)):
        high, low = (found.respond(model, TRUTH * np.exp(h * row)).force_N for h in (1e-4, -1e-4))
        assert at[:, k] == pytest.approx((high - low) / 2e-4, abs=1e-4)


def test_a_tail_is_a_power_of_time():
    terms = RelaxationModel(0.2, 10.0).terms(TISSUES[0], np.r_[1.0, 2.0, 1e-9, 1e-3, TRUTH[4:]])
    for time in (1.0, 10.0, 100.0, 3600.0):
        assert terms.evaluate(time) == pytest.approx((1 + time / 10.0) ** -0.2, rel=0.01)


def test_records_of_the_model_prefer_it_and_leave_the_long_term_open(of_model):
    known = of_model.known
    assert of_model.preferred_model == OWN
    assert known.verdicts[4] == DETERMINED
    verdicts = limit_verdicts(known.verdicts, known, of_model.summarise())
    assert verdicts[4] == "determined at 1 s and 10 s; its long-term value not"
    assert verdicts[6] == known.verdicts[6]  # gamma
    for time in (1.0, 3600.0):
        for number, (c, _, gamma, tau) in enumerate(TRUTH.reshape(2, 4)):
            low, high = of_model.state_modulus(number, time)[1]
            assert low < c * (1 + gamma * np.exp(-time / tau)) < high


def test_a_modulus_that_is_weakly_determined_at_all_times_is_not_called_undetermined(of_model):
    spread = of_model.spread
    open_log = np.broadcast_to(0.03 * np.eye(len(NAMES)), spread.covariance_log.shape)
    wider = replace(spread, covariance_log=open_log, fall_log=0 * spread.fall_log)
    known, relaxation = of_model.known, replace(of_model, spread=wider).summarise()
    assert limit_verdicts(known.verdicts, known, relaxation)[4] == WEAK


def test_records_of_a_power_law_are_told_and_later_moduli_lie_inside(of_power_law):
    assert of_power_law.preferred_model == POWER_LAW
    known = of_power_law.known
    verdicts = limit_verdicts(known.verdicts, known, of_power_law.summarise())
    assert DETERMINED not in (verdicts[2], verdicts[3], verdicts[4], verdicts[6], verdicts[7])
    for time in (1.0, 10.0, 60.0):
        for number, true in enumerate(true_moduli(time)):
            modulus, (low, high) = of_power_law.state_modulus(number, time)
            assert low < true < high
    assert modulus > 1.2 * true  # what the model alone says of a minute


def test_records_of_two_terms_ask_for_a_further_term_and_later_moduli_lie_inside():
    """Two times that are a factor of 30 apart; up to the records' end the moduli are then well known."""
    terms = [[(0.5 * gamma, 0.1), (0.5 * gamma, 3.0)] for gamma in TRUTH[[2, 6]]]
    found = assess(held_sites(), [site.relax(TRUTH, terms) for site in held_sites()])
    assert found.preferred_model == FURTHER
    assert GIVES_WAY not in found.describe()
    for number, (c, _, gamma, _) in enumerate(TRUTH.reshape(2, 4)):
        _, (low, high) = found.state_modulus(number, 10.0)
        assert low < c * (1 + 0.5 * gamma * np.exp(-10.0 / 3.0)) < high < 1.4 * low
        _, (low, high) = found.state_modulus(number, 60.0)
        assert low < c < high


def test_tissue_that_relaxes_more_loses_contact_earlier_and_does_not_pull():
    site, other = held_sites(20.0)[0], TRUTH.copy()
    other[[2, 3, 6, 7]] = 6.0, 30.0, 6.0, 30.0
    found = Superposition(site.times_s, site.respond(TRUTH), TRUTH, TISSUES)
    force, exact = (one.respond(*by, other).force_N for one, by in ((found, [RelaxationModel()]), (site, [])))
    lost = (site.respond(TRUTH).force_N > 0) & (exact == 0)
    assert lost.sum() > 5
    assert not force[lost].any()


def test_a_hold_of_a_minute_narrows_what_is_open_after_it(of_model):
    sites = held_sites(60.0)
    found, held = of_model, assess(sites, [site.force(TRUTH) for site in sites])
    assert held.spread.longest_s > 60.0 > 4 * found.spread.longest_s
    for number, true in enumerate(TRUTH[[0, 4]]):
        low, high = found.state_modulus(number, 60.0)[1]
        low_held, high_held = held.state_modulus(number, 60.0)[1]
        assert low_held < true < high_held
        assert np.log(high_held / low_held) < 0.6 * np.log(high / low)


@pytest.mark.slow
def test_a_hold_tells_a_power_law_of_time():
    found = assess_power_law(60.0)
    assert found.preferred_model == POWER_LAW
    for number, true in enumerate(true_moduli(60.0)):
        low, high = found.state_modulus(number, 60.0)[1]
        assert low < true < high


def test_predictions_widen_only_beyond_the_longest_load(of_model):
    site = held_sites(60.0)[0]
    response = site.respond(TRUTH)
    plain = PredictionModel(1e-6 * np.eye(8), TRUTH, {}, 1e-6, 10.0)
    low, high = plain.compute_interval_95(response, TRUTH, "s", times_s=site.times_s)
    wide = replace(plain, relaxation=of_model.spread)
    below, above = wide.compute_interval_95(response, TRUTH, "s", times_s=site.times_s)
    later = site.times_s > of_model.spread.longest_s
    assert np.array_equal(below[~later], low[~later])
    assert np.array_equal(above[~later], high[~later])
    i = int(np.searchsorted(site.times_s, 60.0))
    assert high[i] - below[i] > 5 * (high[i] - low[i])


def test_an_interval_after_the_records_holds_any_fall_within_the_bound(of_model):
    """The lower end gives room for the steepest fall, the upper one is that of no fall at all."""
    longest = of_model.spread.longest_s
    for number in (0, 1):
        _, (low, high) = of_model.state_modulus(number, longest)
        _, (later_low, later_high) = of_model.state_modulus(number, 100 * longest)
        assert later_low == pytest.approx(low * 100.0**-MAX_SLOPE, rel=0.05)
        assert later_high == pytest.approx(high, rel=0.05)


def test_a_force_falls_by_the_factor_of_its_moduli_and_stays_positive(of_model):
    """All moduli lower by a factor lower the force by it, however large the fall."""
    falling = np.tile([1.0, 0.0, 0.0, 0.0] * 2, (2, 1))  # of both tissues' c
    spread = RelaxationSpread(
        1.0, 1.0, np.array([1.0, 1e4]), 0.0 * falling, np.zeros((2, 8, 8)), 3.0 * falling
    )
    force, times = np.array([2.0, 5.0]), np.array([10.0, 1e4])
    slopes = force[:, None] * np.tile([0.3, 0.0, 0.0, 0.0, 0.7, 0.0, 0.0, 0.0], (2, 1))
    none = np.zeros(2)
    low, high = spread.widen_band(force, slopes, times, (force, force), none)
    assert low == pytest.approx(force * np.exp(-3.0))
    assert np.array_equal(high, force)


def test_a_band_of_relaxation_holds_the_draws_and_no_force_below_zero():
    """A modulus that is known within a factor, with a force in proportion to it."""
    force, moved, sd = 5.0, -0.8, 0.6
    ends = widen_by_relaxation(force, (force, force), 0.0, moved * force, sd * force, 0.0)
    draws = force * np.exp(moved + sd * np.random.default_rng(0).standard_normal(10_000))
    assert 0.0 < ends[0] < force * np.exp(moved) < ends[1]
    assert np.mean((draws > ends[0]) & (draws < ends[1])) > 0.94


def test_a_limb_that_gives_way_is_named_where_the_records_cannot_tell_it_from_relaxation(of_power_law):
    """The tissue relaxes as the model's, and the limb recedes from the indenter by a tenth of the travel."""
    sites = [Receding(one.sections, one.lengths, one.depth, share=0.1) for one in SITES]
    found = assess(held_sites(), [site.force(TRUTH) for site in sites])
    assert GIVES_WAY in found.describe()
    assert found.summarise().tail_weight > 0.5
    assert GIVES_WAY not in of_power_law.describe()


def test_moduli_fall_as_a_power_of_time_from_the_longest_load_on_however_long_it_lasts(of_model):
    """Nothing yet just after the longest load, and more in 16 hours than in ten."""
    longest = of_model.spread.longest_s
    for duration_s in (0.9 * longest, 1.001 * longest, 2.0 * longest, 36_000.0, 57_600.0):
        fall = of_model.spread.interpolate(duration_s)[2]
        expected = MAX_SLOPE * np.log(max(duration_s / longest, 1.0))
        assert fall == pytest.approx(np.tile([expected, 0.0, 0.0, 0.0], 2), abs=1e-9)
