"""What a doubtful touch-down does to a record counts for less, and no more than that."""

from dataclasses import replace

import numpy as np
import pytest
from bars import PAPER, TRUTH, records, simulate

from limbfit.errors import TraceError
from limbfit.identify.fit.calibration import calibrate
from limbfit.identify.fit.objective import MeasuredCurve, SiteResponse, compute_residuals
from limbfit.identify.fit.prediction import compute_error_percent

N, SHARE = 50, 0.01
DOUBTFUL = MeasuredCurve(
    "a", np.linspace(0.0, 2.0, N), touch_down_sd_N=np.linspace(0.0, 0.1, N) ** 2, error_share=SHARE
)


def test_the_cost_is_the_least_over_where_the_touch_down_may_be() -> None:
    """A shift by one standard deviation costs as much as forces that are off by their share throughout."""
    left = 0.05 * np.random.default_rng(0).standard_normal(N)
    shape = DOUBTFUL.scale * DOUBTFUL.touch_down_sd_N
    rest = DOUBTFUL.scale * left
    shift = shape @ rest / (shape @ shape + SHARE**2)
    least = float(np.sum((rest - shift * shape) ** 2) + (SHARE * shift) ** 2)
    assert float(np.sum((DOUBTFUL.scale * DOUBTFUL.discount_touch_down(left)) ** 2)) == pytest.approx(least)
    assert left @ DOUBTFUL.compute_cost_curvature("pointwise", left) @ left == pytest.approx(least)


def test_a_sure_touch_down_changes_nothing() -> None:
    sure = replace(DOUBTFUL, touch_down_sd_N=np.zeros(N))
    left = np.linspace(-1.0, 2.0, N)
    assert sure.discount_touch_down(left) is left
    rows, plain = simulate(TRUTH)[:1], records(0.02)[:1]
    found = compute_residuals("pointwise", rows, plain)[0]
    same = compute_residuals("pointwise", rows, [replace(plain[0], touch_down_sd_N=np.zeros(60))])[0]
    assert np.array_equal(found, same)


@pytest.mark.parametrize("wrong", range(4))
def test_parameters_suffer_less_from_a_wrong_touch_down(wrong: int) -> None:
    """One record, whose force is known to 10 % as a small ball's may be, is off by two deviations."""
    doubts = []
    for i, record in enumerate(records()):
        slope = np.gradient(record.force_N)
        size = 0.1 if i == wrong else 0.01
        doubts.append(size * slope * record.force_N.max() / np.abs(slope).max())
    data = [
        replace(r, force_N=r.force_N + 2.0 * d * (i == wrong))
        for i, (r, d) in enumerate(zip(records(), doubts, strict=True))
    ]
    doubted = [replace(r, touch_down_sd_N=d) for r, d in zip(data, doubts, strict=True)]
    off = [np.log(calibrate(simulate, given, PAPER).parameters / TRUTH) for given in (data, doubted)]
    assert np.linalg.norm(off[1]) < 0.55 * np.linalg.norm(off[0])


def test_lengths_may_be_negative_and_forces_may_not() -> None:
    """Displacements count over the largest one, whatever its sign."""
    down = np.array([-0.5, -2.0, 0.1])
    with pytest.raises(TraceError, match="no measured force"):
        MeasuredCurve("a", -np.abs(down))
    seen = MeasuredCurve("a+surface", down, unit="mm")
    assert seen.peak_N == 2.0
    off, _ = compute_residuals("pointwise", [SiteResponse(down + 0.2, np.zeros((3, 1)))], [seen])
    assert off @ off == pytest.approx(0.1**2)
    assert compute_error_percent(down + 0.2, down) == pytest.approx(10.0)
