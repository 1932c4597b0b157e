"""What a trial says of stored people whose pressures are a known function of their inputs."""

from pathlib import Path

import numpy as np
import pytest

import limbfit
from limbfit.population.answers import resample_interval
from limbfit.population.people import WEIGHT, People
from limbfit.population.running import DONE, FAILED, INPUT, REJECTED, TrialStore
from limbfit.population.trial import load_trial

TEXT = """
[population]
people = 40
[shapes]
phantom = "transtibial"
[[rules]]
name = "tight"
[[rules]]
name = "loose"
[[limits]]
kPa = 100.0
"""
PEOPLE, LOWER = 40, 12.0


def find_pressure(inputs):
    return 0.05 * (inputs[WEIGHT] - 800.0) - 20.0 * np.log(inputs["muscle.c_kPa"] / 5.0)


@pytest.fixture(scope="module")
def trial(tmp_path_factory):
    """Forty people; pressures grow with weight and fall with stiffness, and *loose* lowers them all."""
    folder = tmp_path_factory.mktemp("trial")
    (folder / "population.toml").write_text(TEXT)
    trial = load_trial(folder)
    people, store, random = People(trial), TrialStore(trial), np.random.default_rng(0)
    for number in range(1, PEOPLE + 3):
        inputs = people.draw(number).inputs
        for rule, lower in zip(trial.rules, (0.0, LOWER), strict=True):
            if number == 2:
                store.write(number, rule, REJECTED, "too thin", [])
                continue
            if number == 5 and rule.name == "loose":
                store.write(number, rule, FAILED, "could not be put on", [])
                continue
            mean = 60.0 - lower + find_pressure(inputs)
            rows = [("", INPUT, name, value) for name, value in inputs.items()]
            for load in ("donning", "single stance"):
                share = 0.5 if load == "donning" else 1.0
                rows.append((load, "the limb", "peak_kPa", 1.6 * share * mean))
                for region, part in (("tibial crest", 1.0), ("fibular head", 0.7)):
                    noise = random.normal(0.0, 0.5)
                    rows.append((load, region, "mean_kPa", share * part * mean + noise))
            store.write(number, rule, DONE, "", [*rows, ("", "", "seconds", 100.0)])
    return trial


@pytest.fixture(scope="module")
def found(trial):
    return limbfit.report_population(trial.file)


def test_only_people_who_wear_every_socket_count(found, trial):
    assert found["people"] == PEOPLE
    assert found["rejected"] == ["person 2, tight: too thin"]
    assert found["failed"] == ["person 5, loose: could not be put on"]
    assert found["seconds_per_person"] == pytest.approx(200.0)
    status = limbfit.count_people(trial.file)
    assert (status["people"], status["failed"], status["rejected"]) == (PEOPLE, 1, 1)
    assert status["sockets"] == {"tight": PEOPLE + 1, "loose": PEOPLE}


def test_the_difference_of_two_rules_is_sharp_since_the_people_are_the_same(found):
    worst = next(one for one in found["differences"] if one["place"] == "worst region")
    assert worst["interval"][0] < -LOWER < worst["interval"][1]
    assert worst["interval"][1] - worst["interval"][0] < 1.0
    assert worst["lower_percent"] == 100.0


def test_shares_over_a_limit_have_intervals_even_where_nobody_is(found, trial):
    tight, loose = found["shares"]
    assert tight["share_percent"] > loose["share_percent"]
    low, high = tight["interval_percent"]
    assert low < tight["share_percent"] < high
    table = TrialStore(trial).read()
    peaks = table[(table["rule"] == "tight") & (table["quantity"] == "peak_kPa") & (table["person"] != 5)]
    share = 100.0 * (peaks.groupby("person")["value"].max() > 100.0).mean()
    assert tight["share_percent"] == pytest.approx(share)


def test_what_drives_the_pressure_is_found(found):
    drivers = [one for one in found["drivers"] if one["rule"] == "tight"]
    assert {drivers[0]["name"], drivers[1]["name"]} == {"muscle.c_kPa", WEIGHT}
    assert drivers[2]["total"] < 0.1
    assert all(one["explained"] > 0.9 for one in found["surrogates"])


def test_the_worst_and_the_median_person_are_named(found, trial):
    people = People(trial)

    there = [number for number in range(1, PEOPLE + 3) if number not in (2, 5)]
    ranked = sorted(there, key=lambda number: find_pressure(people.draw(number).inputs))
    assert found["worst"]["tight"] == ranked[-1]
    assert found["median"]["tight"] in ranked[PEOPLE // 2 - 3 : PEOPLE // 2 + 4]


def test_the_report_has_every_section_and_no_request(found):
    page = Path(found["report"]).read_text(encoding="utf-8")
    for name in ("", "-pressure", "-limits", "-rules", "-drivers"):
        assert f'id="population{name}"' in page
    assert "http://" not in page.replace("http://www.w3.org", "")


def test_a_changed_rule_is_not_answered_by_what_the_old_one_did(trial, tmp_path):
    text = TEXT.replace('name = "loose"', 'name = "loose"\nsocket = { flare_mm = 4.0 }')
    (tmp_path / "population.toml").write_text(text)
    changed = load_trial(tmp_path)
    same, other = (
        TrialStore(changed).file(1, new).name == TrialStore(trial).file(1, old).name
        for new, old in zip(changed.rules, trial.rules, strict=True)
    )
    assert same
    assert not other


def test_bootstrap_intervals_hold_the_mean():
    random = np.random.default_rng(1)
    held = 0
    for _ in range(100):
        low, high = resample_interval(random.normal(3.0, 1.0, 40), lambda drawn: drawn.mean(axis=-1))
        held += low < 3.0 < high
    assert 88 <= held <= 99
