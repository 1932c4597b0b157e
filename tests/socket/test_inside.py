"""Strain inside a limb in its socket."""

import numpy as np
import pytest

from limbfit import History, Mesh, Problem
from limbfit.donning import SHEAR_LEVELS, Strains
from limbfit.fe import NeoHookean, State, System
from limbfit.fe.kernel.laws import Laws
from limbfit.fe.memory import Memory

CORNERS = np.array([[i, j, k] for k in (0.0, 1.0) for j in (0.0, 1.0) for i in (0.0, 1.0)])
CELLS = np.array([[0, 1, 3, 7], [0, 3, 2, 7], [0, 2, 6, 7], [0, 6, 4, 7], [0, 4, 5, 7], [0, 5, 1, 7]])


def strains(gradient: np.ndarray) -> Strains:
    """Of a cube of 10 mm, whose displacement has that gradient everywhere."""
    mesh = Mesh.from_arrays(10.0 * CORNERS, CELLS)
    laws = [NeoHookean(0.01)]
    problem = Problem(
        mesh, {mesh.region_names[0]: laws[0]}, np.arange(7), np.zeros((0, 3), dtype=int), None,
        History(np.array([0.0, 1.0]), np.array([0.0, 1.0])),
    )  # fmt: skip
    system, table = System(problem), Laws.build(laws)
    u = mesh.points @ gradient.T
    return Strains.from_state(system, table, State(0.0, 0.0, u, 0.0, memory=Memory.rest(system, table)))


@pytest.mark.parametrize("amount", [0.3, 1.2])
def test_simple_shear_is_the_closed_form(amount):
    """Principal stretches are l, 1 and 1/l with l - 1/l the shear."""
    gradient = np.zeros((3, 3))
    gradient[0, 2] = amount
    longest = amount / 2 + np.hypot(amount / 2, 1.0)
    found = strains(gradient)
    np.testing.assert_allclose(found.shear, (longest**2 - longest**-2) / 4, rtol=1e-6)
    np.testing.assert_allclose(found.compression, (1 - longest**-2) / 2, rtol=1e-6)
    np.testing.assert_allclose(found.energy_kPa, 5.0 * amount**2, rtol=1e-6)  # mu/2 gamma^2
    whole, _ = found.summarise_cells(np.ones(len(CELLS), dtype=bool))
    assert whole["volume_mm3"] == pytest.approx(1000.0)
    over = {f"{level:g}": pytest.approx(1000.0 * (whole["shear"] > level)) for level in SHEAR_LEVELS}
    assert whole["sheared_mm3"] == over


def test_what_one_percent_of_the_volume_exceeds():
    volume = np.array([0.5, 1.5, 98.0])
    found = Strains(np.array([0.9, 0.6, 0.1]), np.array([0.1, 0.2, 0.3]), np.zeros(3), volume)
    told, cell = found.summarise_cells(np.ones(3, dtype=bool))
    assert (told["shear"], told["shear_rare"], cell) == (0.9, 0.6, 0)
    assert told["compression_rare"] == told["compression"] == 0.3
    assert told["sheared_mm3"] == {"0.25": 2.0, "0.5": 2.0, "0.75": 0.5}
    assert found.summarise_cells(np.array([False, True, True]))[1] == 1
