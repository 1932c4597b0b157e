"""The fit behind the priors of people: its mechanics, its statistics, and its table in the package."""

import sys
import tomllib
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from limbfit.priors import LITERATURE, POPULATION

sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks"))
from layer_compressions import Footprint, Layers
from population_fit import Fit, Legs, coverage, fit, predict

from population import DATA, SQUARE, THREE, TWO, constant, exponent, seen_in, steps

STORED = tomllib.loads(POPULATION.read_text(encoding="utf-8"))
needs_data = pytest.mark.skipif(not DATA.is_file(), reason="needs shared/data/multis/measurements.csv")
RADIUS = 10.0


class Disc(Footprint):
    """A rigid disc; the closed form of its half-space is known."""

    def spectrum(self, k: np.ndarray) -> np.ndarray:
        return np.sin(RADIUS * k) / (RADIUS * k) * np.exp(-((0.3 * k) ** 2) / 2)


@pytest.fixture
def fine(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("layer_compressions._NODES", 100)
    monkeypatch.setattr("layer_compressions._ROUNDING_MM", 0.3)


@pytest.mark.usefixtures("fine")
def test_layers_of_a_half_space_are_compressed_as_boussinesq_has_it() -> None:
    depth, mu = np.array([3.0, 7.0, 9000.0]), 0.006
    z = np.r_[0.0, np.cumsum(depth)]
    t = z / RADIUS
    w = 3 / (4 * np.pi * 3 * mu * RADIUS) * (np.arctan2(1, t) + t / (1 + t**2))
    found = Layers.under(Disc(20.0, 20.0), depth[None]).compressions(np.full((1, 3), mu))
    assert found[0] == pytest.approx(-np.diff(w), rel=0.006)


@pytest.mark.usefixtures("fine")
def test_bone_stiffens_as_hayes_has_it() -> None:
    """Hayes and others 1972, incompressible, radius over thickness 0.2: 1.281."""
    thickness, mu = np.array([[10.0, 40.0], [10.0, 1e4]]), np.full((2, 2), 0.006)
    on_bone, free = Layers.under(Disc(20.0, 20.0), thickness).compressions(mu).sum(axis=1)
    assert free / on_bone == pytest.approx(1.281, rel=0.005)


def test_cutting_a_layer_in_two_changes_nothing() -> None:
    one = Layers.under(SQUARE, np.array([[8.0, 40.0]])).compressions(np.array([[0.01, 0.004]]))[0]
    two = Layers.under(SQUARE, np.array([[3.0, 5.0, 40.0]])).compressions(np.array([[0.01, 0.01, 0.004]]))[0]
    assert [two[0] + two[1], two[2]] == pytest.approx(one, rel=1e-9)


def made(found: Fit, people: int, seed: int) -> Legs:
    """Legs drawn of a known population."""
    random = np.random.default_rng(seed)
    person, site = np.repeat(np.arange(people), 4), np.tile(np.arange(4), people)
    thickness = np.exp(random.normal(np.log([8.0, 40.0]), [0.4, 0.2], (len(person), 2)))
    force = np.exp(random.normal(np.log(9.0), 0.35, len(person)))
    legs = Legs(person, site, force, thickness, np.zeros_like(thickness))
    legs.compression_mm[:] = predict(found, legs, SQUARE, 1, seed)[0]
    return legs


TRUE = Fit(
    np.array([[-5.2, -5.0, -4.6, -4.9, 0.5], [-4.6, -5.2, -5.6, -5.5, 0.4]]),
    np.zeros((10, 10)),
    np.array([0.35, 0.20]),
    np.array([0.30, 0.15]),
    np.array([0.10, 0.30]),
)


def test_the_fit_finds_a_population_that_is_known() -> None:
    found = fit(made(TRUE, 150, 1), SQUARE)
    assert found.effects == pytest.approx(TRUE.effects, abs=0.25)
    assert found.between == pytest.approx(TRUE.between, rel=0.25)
    assert found.within == pytest.approx(TRUE.within, rel=0.3)
    assert found.reading_mm == pytest.approx(TRUE.reading_mm, rel=0.4)


def test_the_prior_of_c_is_made_of_what_is_stored() -> None:
    for name in ("skin_fat", "fat", "muscle"):
        assert STORED["prior"][name]["c_kPa"] == constant(STORED["apparent"][name], STORED["step"][name])
    assert all(prior["m"] == exponent() for prior in STORED["prior"].values())


def test_the_exponent_of_one_term_is_twice_that_of_the_pair_under_compression() -> None:
    """The slope of log stress over log stretch, which is what an exponent is."""
    stretch = np.array([0.5, 0.501])

    def slope(stress: np.ndarray) -> float:
        return float(np.diff(np.log(-stress))[0] / np.diff(np.log(stretch))[0])

    def pair(m: float) -> np.ndarray:
        return stretch**m - stretch**-m - stretch ** (-m / 2) + stretch ** (m / 2)

    one_term = [one for one in LITERATURE if "m_of_pair" in one]
    assert len(one_term) == 2
    for one in one_term:
        of_one = slope(stretch ** one["m"] - stretch ** (-one["m"] / 2))
        assert slope(pair(one["m_of_pair"])) == pytest.approx(of_one, rel=0.1)
        assert slope(pair(one["m"])) < 1.8 * of_one  # both are negative: too steep by far


@pytest.mark.slow
@needs_data
def test_two_layers_of_held_out_persons_are_predicted() -> None:
    found = coverage(TWO.legs(DATA), SQUARE, TWO.known)
    assert min((*found.layers, found.whole)) >= 0.85
    assert max((*found.layers, found.whole)) <= 0.95
    assert 0.88 <= found.all <= 0.93


@pytest.mark.slow
@needs_data
def test_three_layers_of_held_out_persons_are_predicted() -> None:
    found = coverage(THREE.legs(DATA), SQUARE, THREE.known)
    assert min((*found.layers, found.whole)) >= 0.85
    assert max((*found.layers, found.whole)) <= 0.96  # 0.953 of one layer


@pytest.mark.slow
@needs_data
def test_too_sure_a_population_does_not_cover(monkeypatch: pytest.MonkeyPatch) -> None:
    """With people who do not differ and readings that are exact the same intervals hold far too little."""

    def sure(legs: Legs, *rest: Any) -> Fit:
        found = fit(legs, *rest)
        sds = {"between": found.between / 3, "within": found.within / 3, "reading_mm": found.reading_mm / 3}
        return replace(found, **sds)

    monkeypatch.setattr("population_fit.fit", sure)
    assert coverage(TWO.legs(DATA), SQUARE, folds=4, draws=200).all < 0.6


@pytest.mark.slow
@needs_data
def test_the_package_s_table_is_what_the_fit_gives() -> None:
    found = seen_in(DATA)
    for name, stored in STORED["apparent"].items():
        assert found[name].keys() == stored.keys()
        for key, value in stored.items():
            assert found[name][key] == pytest.approx(value, rel=0.02, abs=0.005), (name, key)


@pytest.mark.slow
def test_the_step_to_the_law_is_what_the_solver_gives() -> None:
    found = steps()
    for name, stored in STORED["step"].items():
        assert found[name] == pytest.approx(stored, rel=0.01, abs=0.003)  # of three digits
