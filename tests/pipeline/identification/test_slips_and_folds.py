"""Folds and slips as the solver itself finds them, and what the search makes of them."""

import numpy as np
import pytest

from layered import build_block_site, layered_block
from limbfit.identify.fit.calibration import CalibrationSettings, calibrate
from limbfit.identify.fit.objective import MeasuredCurve
from limbfit.identify.fit.parameters import FIXED, Unknowns
from limbfit.indentation import SimulationJob, simulate
from limbfit.pipeline.records.records import to_response
from limbfit.study import SolverTable

TISSUES = ("skin", "muscle")
TRUTH = (2.0, 5.0, 1.0, 1.0, 12.0, 5.0, 1.0, 1.0)
SLIPPING = (0.5, 5.0, 1.0, 1.0, 30.0, 5.0, 1.0, 1.0)  # soft skin that is squeezed out over stiff muscle


class Block:
    """A punch on plain quadratic tetrahedra, which fold under its edge."""

    def __init__(self, folder):
        steps = SolverTable(load_steps=4, unload_steps=2)
        mesh = layered_block((3.0, 12.0), TISSUES)
        self.model = build_block_site("a", folder / "a.vtu", mesh, 5.0, steps, element="tet10")
        self.times = tuple(np.linspace(0.0, self.model.knots_s[-1], 13))
        self.doubts: dict[tuple[float, ...], set[str]] = {}

    def __call__(self, parameters):
        values = tuple(map(float, parameters))
        found = simulate(SimulationJob(self.model, TISSUES, values, self.times))
        self.doubts[self.key(values)] = {doubt.kind for doubt in found.doubts}
        return [to_response(found)]

    def kinds(self, parameters):
        return self.doubts[self.key(parameters)]

    @staticmethod
    def key(parameters):
        return tuple(float(f"{value:.9g}") for value in parameters)


@pytest.fixture
def block(tmp_path):
    return Block(tmp_path)


def test_the_solver_s_own_folds_and_slips_reach_the_search(block):
    (clean,), (doubtful,) = block(TRUTH), block(SLIPPING)
    assert clean.completed
    assert not clean.warnings
    assert doubtful.completed
    assert "the force falls from" in doubtful.slipped
    assert "elements are inside out" in doubtful.folded


@pytest.mark.slow
def test_a_search_that_starts_where_the_tissue_slips_leaves_it_and_does_not_return(block):
    measured = [MeasuredCurve("a", block(TRUTH)[0].force_N)]
    names = tuple(f"{tissue}.{name}" for tissue in TISSUES for name in ("c_kPa", "m", "gamma", "tau_s"))
    start = np.array(SLIPPING)
    lower, upper = start / 100, start * 100
    lower[[0, 4]], upper[[0, 4]] = (0.4, 5.0), (20.0, 40.0)
    stage = (0, FIXED, FIXED, FIXED, 1, FIXED, FIXED, FIXED)
    found = calibrate(
        block, measured, Unknowns(names, start, lower, upper), CalibrationSettings(), stages=[stage]
    )
    assert block.kinds(SLIPPING) >= {"slipped", "folded"}
    assert not any("slipped" in block.kinds(iterate.parameters) for iterate in found.history)
    assert found.history[0].parameters[0] > 1.05 * SLIPPING[0]
    assert found.history[-1].errors_percent[0] < 0.6 * found.history[0].errors_percent[0]
