"""Layers pressed by the solver instead of by linear theory, for the benchmark of people."""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks"))
import solved_layers
from layer_compressions import Footprint, Layers
from population_fit import fit
from solved_layers import C_MPA, LOADS_N, ROUNDING_MM, Rectangle, SolvedDesign, SolvedFootprint, press_layers
from test_population import TRUE, made

from limbfit.shapes.shape import Square
from population import SQUARE


def test_small_compressions_are_those_of_linear_theory(monkeypatch: pytest.MonkeyPatch) -> None:
    """At 1 % of strain the flat part alone touches; linear theory takes the pressure for that of strips."""
    monkeypatch.setattr(solved_layers, "LOADS_N", np.array([0.5]))
    thickness, moduli = np.array([1.6, 7.2, 39.4]), np.array([0.02, 0.005, 0.005])
    _, pressed = solved_layers.read_compressions(*press_layers(thickness, SQUARE, moduli, 4.0, 0.5), 0.5)
    side = SQUARE.width_mm - 2 * ROUNDING_MM
    linear = Layers.under(Footprint(side, side), thickness[None]).compressions(moduli[None])[0] * 0.5
    assert pressed[-1].sum() == pytest.approx(linear.sum(), rel=0.12)
    assert (np.argsort(pressed[-1]) == np.argsort(linear)).all()


def test_a_rectangle_is_a_square_drawn_out() -> None:
    points = np.random.default_rng(0).uniform([-15, -15, -10], [15, 15, 20], (50, 3))
    square, rectangle = Square(15.0, 2.0), Rectangle(15.0, 2.0, 30.0)
    for of_square, of_none in zip(
        square.distance(points), Rectangle(15.0, 2.0).distance(points), strict=True
    ):
        assert of_none == pytest.approx(of_square)
    outer = points + np.array([15.0, 0.0, 0.0])
    outer = outer[outer[:, 0] > 15.0]
    moved = square.distance(outer - [15.0, 0.0, 0.0])
    for found, expected in zip(rectangle.distance(outer), moved, strict=True):
        assert found == pytest.approx(expected)


def design_of_a_known_law() -> SolvedDesign:
    """Strains that are those of linear theory, softened: no simulation."""
    random = np.random.default_rng(1)
    runs = np.column_stack(
        [
            np.log([1.6, 7.2, 39.4]) + random.normal(0, 0.3, (28, 3)),
            np.log([4.0, 1.0]) + random.uniform(-1.5, 1.5, (28, 2)),
            np.log(6.9) + random.uniform(-0.7, 0.7, (28, 1)),
        ]
    )
    inputs = np.column_stack([np.repeat(runs, len(LOADS_N), axis=0), np.tile(np.log(LOADS_N), 28)])
    thickness = np.exp(inputs[:, :3])
    moduli = C_MPA * np.column_stack([np.exp(inputs[:, 3:5]), np.ones(len(inputs))])
    linear = Layers.under(SQUARE, thickness).compressions(moduli) * np.exp(inputs[:, 6:]) / thickness
    return SolvedDesign(inputs, 0.3 * np.tanh(linear / 0.3), np.repeat(np.arange(28), len(LOADS_N)))


def test_a_simulation_that_is_left_out_is_interpolated() -> None:
    assert (design_of_a_known_law().leave_out(SQUARE) < [0.05, 0.25, 0.6]).all()


def test_force_and_moduli_scale_together() -> None:
    probe = SolvedFootprint(SQUARE, design_of_a_known_law(), 6.9)
    thickness, moduli = np.array([[1.6, 7.2, 39.4], [2.0, 15.0, 30.0]]), np.full((2, 3), 0.006)
    force = np.array([6.0, 9.0])
    once = probe.under(thickness, force).compressions(moduli) * force[:, None]
    twice = probe.under(thickness, 2 * force).compressions(2 * moduli) * 2 * force[:, None]
    assert twice == pytest.approx(once)
    together = probe.under(np.array([[9.0, 39.4]]), force[:1]).compressions(np.full((1, 2), 0.006))
    assert together.shape == (1, 2)


def test_a_fit_that_starts_near_its_end_ends_there() -> None:
    legs = made(TRUE, 40, 2)
    whole = fit(legs, SQUARE)
    again = fit(legs, SQUARE, start=replace(whole, logs=whole.logs))
    assert again.effects == pytest.approx(whole.effects, abs=0.03)
    assert again.between == pytest.approx(whole.between, rel=0.1)
