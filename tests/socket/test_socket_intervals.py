"""Intervals of a socket's results: what they come from, against drawn parameters; doubts in its words."""

from dataclasses import replace

import numpy as np
import pytest

from limbfit.fe import SimulationWarning
from limbfit.identify.fit.prediction import NORMAL_95
from limbfit.pipeline.socket.intervals import (
    ParameterSpread,
    SimulationSpread,
    draw_step,
    spread_to_facts,
    widen_intervals,
)
from limbfit.pipeline.socket.simulation import format_warning

NAMES = ("skin.c_kPa", "skin.tau_s", "liner.c_kPa")
SLOPES = np.array([3.0, -1.0, 2.0])
COVARIANCE = np.array([[0.04, -0.015], [-0.015, 0.09]])


def spread_of(
    off=(0.0, 0.0), shift=(0.0, 0.0), relaxation=((0.0, 0.0), (0.0, 0.0)), fall=(0.0, 0.0)
) -> SimulationSpread:
    known = ParameterSpread(COVARIANCE, np.array(off))
    worn = replace(known, shift=np.array(shift), relaxation=np.array(relaxation), fall=np.array(fall))
    return SimulationSpread(NAMES, (0, 1), worn)


def test_interval_and_shares_are_those_of_drawn_parameters():
    spread = spread_of()
    interval, shares, changes, _ = spread.propagate(50.0, SLOPES)
    draws = np.random.default_rng(0).multivariate_normal(np.zeros(2), COVARIANCE, 200_000)
    values = 50.0 + draws @ SLOPES[:2]
    assert (interval[1] - interval[0]) / 2 == pytest.approx(NORMAL_95 * values.std(), rel=0.01)
    for i, name in enumerate(NAMES[:2]):
        left = values - np.polyval(np.polyfit(draws[:, i], values, 1), draws[:, i])
        assert shares[name] == pytest.approx(100.0 * (1.0 - left.var() / values.var()), abs=0.5)
    assert list(shares) == ["skin.c_kPa", "skin.tau_s"]  # largest first; the liner was not identified
    assert changes["liner.c_kPa"] == pytest.approx(2.0 * np.log(1.1))


def test_an_interval_covers_the_most_probable_parameters_too():
    plain, *_ = spread_of().propagate(50.0, SLOPES)
    for step in (0.3, -0.3):  # of the skin's c, whose slope is 3 kPa
        (low, high), *_ = spread_of([step, 0.0]).propagate(50.0, SLOPES)
        assert (low, high) == pytest.approx((plain[0] + min(3 * step, 0.0), plain[1] + max(3 * step, 0.0)))


def test_an_interval_counts_relaxation_beyond_the_records_and_holds_the_value():
    """Moduli fall by 40 % on average, with a deviation of 20 %; the simulated value stays inside."""
    further = np.array([[0.04, 0.0], [0.0, 0.0]])
    interval, _, _, (moved, sd, fall) = spread_of(shift=[-0.4, 0.0], relaxation=further).propagate(
        50.0, SLOPES
    )
    draws = np.random.default_rng(0).multivariate_normal([-0.4, 0.0], COVARIANCE + further, 200_000)
    values = 50.0 + draws @ SLOPES[:2]
    assert (moved, sd, fall) == pytest.approx((3.0 * -0.4, 3.0 * 0.2, 0.0))
    half = NORMAL_95 * values.std()  # moduli fall by factors, draws do not
    assert interval == pytest.approx([values.mean() - half, values.mean() + half], abs=0.1)
    (low, high), *_ = spread_of(shift=[-4.0, 0.0]).propagate(50.0, SLOPES)
    assert low < 50.0 * np.exp(-12.0 / 50.0)
    assert high == 50.0


@pytest.mark.parametrize("fall_log", [0.5, 3.0])
def test_an_interval_reaches_to_the_farthest_fall_and_loses_nothing_at_the_other_end(fall_log):
    """A pressure that is proportional to a modulus falls by the same factor, and stays positive."""
    slopes = np.array([50.0, *SLOPES[1:]])
    plain, *_ = spread_of().propagate(50.0, slopes)
    (low, high), *_, (_, _, fall) = spread_of(fall=[fall_log, 0.0]).propagate(50.0, slopes)
    assert fall == pytest.approx(50.0 * (1 - np.exp(-fall_log)))
    assert (low, high) == pytest.approx((plain[0] * np.exp(-fall_log), plain[1]))


def test_most_of_an_interval_comes_from_relaxation_where_that_makes_it_wide():
    slopes = np.array([50.0, *SLOPES[1:]])
    plain, alone, *_ = spread_of().propagate(50.0, slopes)
    worn, shares, *_ = spread_of(fall=[0.8, 0.0]).propagate(50.0, slopes)
    left = ((plain[1] - plain[0]) / (worn[1] - worn[0])) ** 2
    assert next(iter(shares)) == "relaxation"
    assert shares["relaxation"] == pytest.approx(100.0 * (1.0 - left))
    assert [shares[name] for name in alone] == pytest.approx([left * alone[name] for name in alone])


@pytest.mark.parametrize("fall_log", [0.0, 1.5])
def test_a_socket_that_moves_off_the_limb_has_an_interval_about_its_move(fall_log):
    spread = spread_of(fall=[fall_log, 0.0])
    onto = spread_to_facts(spread, "settling_", "mm", 2.0, SLOPES)
    off = spread_to_facts(spread, "settling_", "mm", -2.0, -SLOPES)
    low, high = off["settling_interval_mm"]
    assert low < -2.0 < high
    assert [-high, -low] == onto["settling_interval_mm"]
    assert off["settling_relaxation_mm"] == [
        -one if i != 1 else one for i, one in enumerate(onto["settling_relaxation_mm"])
    ]


def test_an_interval_that_draws_widen_still_holds_the_simulated_value():
    found = facts(50.0, interval_kPa=[49.0, 51.0], change_kPa={})
    widen_intervals(found, [({}, facts(value)) for value in (52.9, 53.0, 53.1)])
    (load,) = found["loads"]
    assert load["regions"][0]["interval_kPa"][0] == 50.0 < 53.0 < load["regions"][0]["interval_kPa"][1]
    assert load["settling_interval_mm"][0] == 50.0


def test_what_is_stored_has_the_same_keys_with_and_without_intervals():
    spread = spread_of()
    known = spread_to_facts(spread, "settling_", "mm", 5.0, SLOPES)
    assert known.keys() == spread_to_facts(None, "settling_", "mm", 5.0, None).keys()
    assert known["settling_interval_mm"][0] >= 0.0


def facts(value: float, **known) -> dict:
    region = {"region": "tibial crest", "mean_kPa": value}
    held = {"regions": [region | known]}
    settled = {f"settling_{name}": one for name, one in known.items()}
    settled = {name.replace("_kPa", "_mm"): one for name, one in settled.items()}
    return {"donning": {"regions": []}, "loads": [held | {"settling_mm": value} | settled]}


def test_what_derivatives_miss_of_simulated_draws_widens_the_intervals():
    """A value that bends by as much as it slopes: its 95 % interval holds 83 % of other draws, then 91 %."""
    spread = spread_of()

    def value(step) -> float:
        return 50.0 + step @ SLOPES[:2] + 8.0 * step[1] ** 2

    found = facts(50.0, **spread_to_facts(spread, "", "kPa", 50.0, SLOPES))
    (load,) = found["loads"]
    steps = [draw_step(COVARIANCE, number) for number in range(1000)]
    values = np.array([value(step) for step in steps])

    def held(interval) -> float:
        return float(np.mean((values >= interval[0]) & (values <= interval[1])))

    assert held(load["regions"][0]["interval_kPa"]) < 0.85
    widen_intervals(
        found, [(dict(zip(NAMES, step, strict=False)), facts(value(step))) for step in steps[:100]]
    )
    assert held(load["regions"][0]["interval_kPa"]) > 0.9
    assert load["settling_interval_mm"] == load["regions"][0]["interval_kPa"]
    curved = np.array([8.0 * step[1] ** 2 for step in steps[:100]])
    assert load["settling_missed_mm"] == pytest.approx([curved.mean(), curved.std(ddof=1)])


def test_folded_elements_are_told_with_a_remedy_that_a_socket_has():
    found = format_warning(
        SimulationWarning("folded", "27 elements are inside out: a rounded indenter", 27, 0.0, 0.0)
    )
    assert found.startswith("27 elements of the limb")
    assert "socket.edge_mm" in found
    assert "indenter" not in found
    assert format_warning(SimulationWarning("unsettled", "use more steps", 1, 0.0, 0.0)) == "use more steps"
