"""Sensitivities against central differences."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from blocks import punch

from limbfit.fe import StepControl, solve

TIGHT = StepControl(load_steps=4, unload_steps=4, tolerance=1e-9)


@pytest.mark.parametrize(
    ("cell_type", "element"), [("tet10", ""), ("tet4", ""), ("hex8", ""), ("tet10", "tet10p0")]
)
def test_sensitivities_equal_central_differences(cell_type, element):
    problem = punch(cell_type, 2, 1, element=element)
    centre = solve(problem, TIGHT, sensitivities=True, store="all")
    for j, (region, name) in enumerate(centre.parameter_names):
        material = problem.materials[region]
        step = 1e-4 * getattr(material, name)
        forces = []
        for sign in (1, -1):
            moved = replace(material, **{name: getattr(material, name) + sign * step})
            changed = problem.with_materials({**problem.materials, region: moved})
            forces.append(solve(changed, TIGHT, warm_start=centre).force)
        difference = (forces[0] - forces[1]) / (2 * step)
        error = np.abs(difference - centre.force_sensitivity[:, j]).max()
        assert error <= 1e-4 * np.abs(difference).max(), (region, name)
