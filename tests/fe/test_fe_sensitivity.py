"""Sensitivities against central differences."""

import numpy as np
import pytest
from blocks import check_sensitivities, punch

from limbfit.fe import Indenter, Ogden, StepControl, solve
from limbfit.fe.solution import sensitivity, simulation

TIGHT = StepControl(load_steps=3, unload_steps=3, tolerance=1e-10)


def test_sensitivities_equal_central_differences():
    problem = punch("hex8", 2, 1)
    check_sensitivities(problem, TIGHT, 1e-4, *problem.parameter_names)


@pytest.mark.parametrize(("cell_type", "element"), [("tet4", ""), ("tet10", "tet10p0")])
def test_sensitivities_of_other_elements_equal_central_differences(cell_type, element):
    """Along one direction of all eight parameters."""
    check_sensitivities(punch(cell_type, 2, 1, element=element), TIGHT, 1e-4)


def test_an_edge_taken_as_flat_on_the_way_changes_no_answer(monkeypatch):
    """Rounded edges are left out of the tangent of every closed point, but near the equilibrium."""
    rounded = Indenter(axis=(0, 0, -1), centre=(0.0, 0.0, 1.0), edge_radius=3.0)
    problem = punch("hex8", 2, 1, indenter=rounded)
    monkeypatch.setattr(sensitivity, "TOLERANCE", 1e-6)
    usual = solve(problem, TIGHT, sensitivities=True)
    monkeypatch.setattr(simulation, "STEEP_PRESSURE", 1e-6)
    flat = solve(problem, TIGHT, sensitivities=True)
    assert np.abs(flat.force - usual.force).max() <= 1e-8 * usual.peak_force
    error = np.abs(flat.force_sensitivity - usual.force_sensitivity).max(axis=0)
    assert (error <= 1e-5 * np.abs(usual.force_sensitivity).max(axis=0)).all()


def test_tissue_without_relaxation_has_sensitivities():
    """Force is proportional to all moduli together (Euler's theorem of homogeneous functions)."""
    problem = punch("hex8", 2, 1)
    tissues = {name: Ogden(((0.006, 4.0),), ()) for name in problem.mesh.region_names}
    result = solve(problem.with_materials(tissues), TIGHT, sensitivities=True)
    moduli = [number for number, (_, name) in enumerate(result.parameter_names) if name == "c1"]
    assert len(moduli) == len(tissues)
    slopes = result.force_sensitivity[:, moduli].sum(axis=1) * 0.006
    assert slopes == pytest.approx(result.force, abs=1e-6 * result.peak_force)
