"""Layers seen by ultrasound through the indenter: from the file to the prediction."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from seen_blocks import Made, SeenBlock

import layered
from layered import build_block_site, layered_block
from limbfit.bench.timing import build_layered_block as block_of
from limbfit.errors import ProblemError, TraceError
from limbfit.indentation import Simulation, SimulationJob, SiteModel, simulate, to_vector
from limbfit.mesh import find_gauges_along
from limbfit.phantom.robot import write_ultrasound
from limbfit.report.drawing.figures import draw_seen_figures
from limbfit.report.store import load_store
from limbfit.study import SolverTable, Study
from limbfit.traces import Layers, compute_thinnings, read_layers

DOWN = np.array([0.0, 0.0, -1.0])


@pytest.mark.parametrize("place", [(0.0, 0.0), (2.3, -4.1)], ids=["on an edge", "inside"])
@pytest.mark.parametrize("kind", ["hex8", "tet10"])
def test_a_gauge_follows_the_interfaces(kind: str, place: tuple[float, float]) -> None:
    """Displacements that the elements represent exactly: what the layers lose is known."""
    mesh = block_of(kind, 6)
    found = {one.region: one for one in find_gauges_along(mesh, np.array([*place, 0.0]), DOWN)}
    assert {name: one.thickness_mm for name, one in found.items()} == pytest.approx(
        {"skin": 3.0, "muscle": 27.0}
    )
    x, _, z = mesh.points.T
    down = -0.1 * z + 0.01 * x
    for name, one in found.items():
        assert one.weights @ down[one.nodes] == pytest.approx(-0.1 * found[name].thickness_mm, rel=1e-9)


def test_quadratic_faces_are_followed_by_their_own_functions() -> None:
    mesh = block_of("tet10", 6)
    skin, muscle = find_gauges_along(mesh, np.array([2.3, -4.1, 0.0]), DOWN)
    sunk = 0.02 * mesh.points[:, 0] ** 2 * (mesh.points[:, 2] > -1.0)  # of the top alone
    assert skin.weights @ sunk[skin.nodes] == pytest.approx(0.02 * 2.3**2, rel=1e-9)
    assert muscle.weights @ sunk[muscle.nodes] == pytest.approx(0.0, abs=1e-12)


def test_what_lies_on_the_other_side_is_not_counted() -> None:
    """Skin above and below muscle: ultrasound sees the near one."""
    mesh = layered_block((3.0, 9.0, 2.0), ("skin", "muscle", "far"), 12.0, 4, 3.0)
    mesh = replace(mesh, regions=np.where(mesh.regions == 2, 0, mesh.regions))
    found = find_gauges_along(mesh, np.array([1.0, 2.0, 0.0]), DOWN)
    assert {one.region: one.thickness_mm for one in found} == pytest.approx({"skin": 3.0, "muscle": 9.0})


def test_no_tissue_under_the_axis_is_told() -> None:
    with pytest.raises(ProblemError, match="no tissue lies under the indenter's axis"):
        find_gauges_along(block_of("hex8", 4), np.array([100.0, 0.0, 0.0]), DOWN)


@pytest.mark.slow
def test_compressions_follow_the_parameters(tmp_path: Path) -> None:
    """Together the layers lose about the indenter's depth (elements of 6 mm); slopes beside differences."""
    mesh = layered_block((3.0, 4.0, 9.0), half_mm=12.0, divisions=4, height_mm=4.0)
    steps = SolverTable(load_steps=3, unload_steps=2, penalty_per_mm=400.0)
    model = replace(
        build_block_site("a", tmp_path / "a.vtu", mesh, 2.0, steps), layers=("fat", "muscle", "skin")
    )
    tissues, vector = layered.TISSUES, to_vector(layered.TRUTH, layered.TISSUES)
    times = tuple(np.linspace(0.2, 3.5, 12))
    found = simulate(SimulationJob(model, tissues, tuple(vector), times))
    assert found.observed.shape == (3, 12)
    assert found.observed_jacobian is not None
    depth = np.interp(times, model.knots_s, model.knots_mm)
    loading = np.array(times) < 2.0
    assert found.observed.sum(axis=0)[loading] == pytest.approx(depth[loading], rel=0.08)
    assert (found.observed[0] > 0.0).any()
    for i in (0, 4, 9):  # the skin's and the fat's modulus, the muscle's exponent
        step = 1e-3 * vector[i] * np.eye(len(vector))[i]
        ends = [
            simulate(SimulationJob(model, tissues, tuple(vector + s), times, False)) for s in (step, -step)
        ]
        slope = (ends[0].observed - ends[1].observed) / (2e-3 * vector[i])
        assert found.observed_jacobian[:, :, i] == pytest.approx(slope, abs=5e-3 * np.abs(slope).max())


def table(folder: Path, head: str, rows: np.ndarray) -> Path:
    np.savetxt(folder / "u.csv", rows, delimiter=",", header=head, comments="")
    return folder / "u.csv"


def test_readings_become_compressions_with_their_noise(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    time = np.arange(0.0, 10.0, 0.02)
    true = np.interp(time, [1.0, 5.0, 9.0], [0.0, 2.0, 0.0])
    rows = np.column_stack([time, 20.0 - true + rng.normal(0.0, 0.1, time.size), 2.0 + 0.0 * time])
    layers = read_layers(table(tmp_path, "time_s,muscle_mm,skin_mm", rows), "time_s")
    muscle, skin = compute_thinnings(layers, 1.0, 9.0, 0.1)
    assert (muscle.tissue, skin.tissue) == ("muscle", "skin")
    assert muscle.is_detectable
    assert not skin.is_detectable
    assert muscle.thickness_mm == pytest.approx(20.0, abs=0.05)
    assert len(muscle.time_s) <= 81
    assert muscle.samples.sum() == np.sum((time >= 1.0) & (time <= 9.0))
    off = muscle.compression_mm - np.interp(muscle.time_s + 1.0, time, true)
    assert np.sqrt(off @ np.linalg.solve(muscle.covariance, off) / len(off)) == pytest.approx(1.0, abs=0.25)


WRONG = {
    "no tissue": ("time_s,depth", [[0.0, 1.0], [1.0, 2.0]], "no thickness of a tissue"),
    "no time": ("t,fat_mm", [[0.0, 1.0], [1.0, 2.0]], "no column 'time_s'"),
    "metres": ("time_s,fat_mm", [[0.0, 0.01], [1.0, 0.01]], "is no tissue's thickness"),
    "order": ("time_s,fat_mm", [[1.0, 5.0], [0.0, 5.0]], "time does not increase"),
    "a gap": ("time_s,fat_mm", [[0.0, 5.0], [1.0, np.nan]], "nan in sample 2"),
}


@pytest.mark.parametrize(("head", "rows", "told"), WRONG.values(), ids=WRONG)
def test_what_is_wrong_with_a_file_is_told(tmp_path: Path, head: str, rows: list, told: str) -> None:
    with pytest.raises(TraceError, match=told):
        read_layers(table(tmp_path, head, np.array(rows)), "time_s")


def test_readings_must_begin_before_and_last_into_contact() -> None:
    layers = Layers(np.linspace(2.0, 3.0, 20), {"fat": np.full(20, 5.0)})
    with pytest.raises(TraceError, match="no reading before touch-down"):
        compute_thinnings(layers, 1.0, 9.0, 0.1)
    with pytest.raises(TraceError, match="only 1 readings in contact"):
        compute_thinnings(layers, 2.98, 9.0, 0.1)


def write_seen(study: Study, model: SiteModel, found: Simulation, made: Made) -> None:
    whole, times, random = made
    layers = {
        tissue: (thick, lambda t, lost=lost: np.interp(t, times, lost))
        for tissue, thick, lost in zip(model.layers, BLOCK.thickness, found.observed, strict=True)
    }
    write_ultrasound(study.path(Path("a-layers.csv")), whole, layers, random)


BLOCK = SeenBlock("a-layers.csv", lambda model, mesh: replace(model, layers=("skin", "muscle")), write_seen)


@pytest.mark.slow
def test_what_ultrasound_sees_is_fitted_and_predicted(tmp_path: Path) -> None:
    """Beside one ramp: nothing is off at the truth, and every interval is narrower than by force alone."""
    known = BLOCK.narrowed(tmp_path, 'ultrasound = "a-layers.csv"\n')
    assert [one.name for one in known.records.own] == ["a", "a+skin", "a+muscle"]
    assert [one.unit for one in known.records.curves] == ["N", "mm", "mm"]
    assert max(known.misfits) < 2.0
    found, observed = known.fit_and_predict()
    assert list(found["contact"]) == ["a"]
    assert found["uncertainty"]["residuals"]["sites"]["a+muscle"]["unit"] == "mm"
    last = found["stages"][-1]["iterations"][-1]
    assert list(last["error_percent_by_site"]) == ["a", "a+skin", "a+muscle"]
    assert {one["what"]: one["thickness_mm"] for one in observed} == pytest.approx(
        {"skin": 3.0, "muscle": 9.0}, abs=0.1
    )
    assert (known.context.store["predict"] / "a+muscle.csv").is_file()
    figure = draw_seen_figures(load_store(known.context.study.results), fitted=True)[0]
    assert figure is not None
    assert "a, muscle" in figure.markup
