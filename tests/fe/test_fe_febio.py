"""Parity with FEBio 4.11 on its own meshes: the benchmark's cases and code, held to 1 % and 1e-6."""

from pathlib import Path

import pytest

from limbfit.bench.parity import CUBES, PUNCHED, compare_force, compare_stress

REFERENCE = Path(__file__).parents[3] / "shared" / "reference"
pytestmark = pytest.mark.skipif(
    not REFERENCE.is_dir(), reason="the FEBio reference results are not beside the repository"
)


@pytest.mark.parametrize("case", CUBES, ids=lambda case: case.name)
def test_cube(case):
    row = compare_stress(case, REFERENCE)
    assert row["steps"] == 100
    assert row["max_difference_percent"] < 1e-4
    assert row["max_difference_J"] < 1e-6


# The tet4 limb is what is left to be explained: FEBio's curve is stiffer than with any contact of ours.

CASES = [pytest.param(case, id=case.name, marks=pytest.mark.slow) for case in PUNCHED]


@pytest.mark.parametrize("case", CASES)
def test_indentation(case):
    row = compare_force(case, REFERENCE)
    assert row["max_difference_percent"] is not None, row["note"]
    assert row["max_difference_percent"] < 1.0
