"""The benchmark of real relaxation curves: closed forms, and its verdict on curves of known laws."""

import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks"))
from relaxation import (
    DATA,
    POWER_TIMES_S,
    POWERS,
    Curve,
    fall_per_decade,
    fit_law,
    judge_law,
    power_law,
    prony_law,
    read_curve,
    relaxed_forces,
)

MODULI_N = np.array([0.1, 0.05, 0.05])


def made(amplitudes: np.ndarray, times_s: np.ndarray) -> Curve:
    """A ramp of 3 s and a hold of 10 s at 10 Hz with a known relaxation."""
    time = np.arange(0.0, 13.05, 0.1)
    depth = np.minimum(time * 1.5, 4.5)
    curve = Curve("made", time, depth, np.zeros_like(time), 30)
    force = relaxed_forces(curve, amplitudes, times_s) @ MODULI_N
    return Curve("made", time, depth, force + np.random.default_rng(0).normal(0.0, 5e-4, len(time)), 30)


def test_a_ramp_relaxes_as_its_closed_form() -> None:
    """A ramp of T seconds under 1 + g e^(-t / tau) ends at 1 + g (1 - e^-x) / x, x = T / tau."""
    time = np.linspace(0.0, 2.0, 21)
    found = relaxed_forces(Curve("ramp", time, time, time, 20), np.array([3.0]), np.array([0.5]))
    assert found[-1, POWERS.index(1.0)] == pytest.approx(1 + 3 * (1 - np.exp(-4.0)) / 4.0, rel=1e-12)


def test_a_single_term_is_found_and_preferred() -> None:
    curve = made(np.array([1.5]), np.array([1.2]))
    parameters, _, _ = fit_law(curve, prony_law(1))
    assert np.exp(parameters) == pytest.approx([1.5, 1.2], rel=0.02)
    one, others = judge_law(curve, prony_law(1)), (prony_law(2), power_law())
    assert all(one.bic < judge_law(curve, law).bic for law in others)
    assert one.ahead < 0.003


def test_a_power_of_time_is_found_and_preferred() -> None:
    curve = made(POWER_TIMES_S**-0.4, POWER_TIMES_S)
    power = judge_law(curve, power_law())
    assert power.parameters == pytest.approx([0.0, 0.4], abs=0.05)
    one, two = judge_law(curve, prony_law(1)), judge_law(curve, prony_law(2))
    assert power.bic < two.bic < one.bic
    assert power.ahead < 0.005 < one.ahead


@pytest.mark.skipif(not DATA.is_dir(), reason="needs shared/data/relaxation")
def test_real_muscle_relaxes_rather_by_a_power_of_time_than_by_one_term() -> None:
    """docs/validation.md: one term is off by 2.5 % and predicts 7 % too much, a power of time 0.5 and 1 %."""
    curve = read_curve(DATA / "230411-RDG1B.csv")
    power, one = judge_law(curve, power_law()), judge_law(curve, prony_law(1))
    assert power.bic < one.bic - 100
    assert (power.error, power.ahead) < (0.006, 0.012)
    assert one.ahead > 0.05
    assert power.parameters[1] == pytest.approx(0.46, abs=0.03)
    assert fall_per_decade(curve) == pytest.approx(0.187, abs=0.01)
