"""Speeds of shear waves beside the force: from the file to the prediction."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import layered
from layered import layered_block, store_blocks
from limbfit.errors import TraceError
from limbfit.execution import SerialExecutor
from limbfit.indentation import Parameters, SimulationJob, SiteModel, simulate, waves_under
from limbfit.mesh import write_vtu
from limbfit.phantom.record import Ramp, record, write_waves
from limbfit.pipeline.shared.context import Context
from limbfit.pipeline.shared.simulations import SimulationCache, recorded_model
from limbfit.pipeline.stages.calibrate import run_calibrate
from limbfit.pipeline.stages.curves import run_traces
from limbfit.pipeline.stages.laboratory import Laboratory, linearised
from limbfit.pipeline.stages.predict import run_predict
from limbfit.report.drawing.observed_figures import wave_figure
from limbfit.report.site_tables import observed_table
from limbfit.report.store import load_store
from limbfit.study import Study, load_study

BLOCK = (3.0, 9.0)
TRUTH = {
    "skin": {"c_kPa": 9.0, "m": 6.0, "gamma": 2.0, "tau_s": 0.6},
    "muscle": {"c_kPa": 4.5, "m": 4.5, "gamma": 3.0, "tau_s": 0.3},
}
TEXT = """
[study]
name = "a block"
[surfaces]
skin = "skin.stl"
[indenter]
width_mm = 10.0
edge_radius_mm = 2.0
[solver]
load_steps = 8
unload_steps = 8
penalty_per_mm = 100.0
[mesh.coarse]
edge_near_mm = 6.0
[calibration]
max_iterations = 2
corrections = 1
[[sites]]
name = "a"
fitted = true
trace = "a.csv"
position = [0.0, 0.0, 0.0]
"""
WAVES = 'shear_waves = "a-waves.csv"\n'


def stored(folder: Path, monkeypatch: pytest.MonkeyPatch, more: str) -> Context:
    """A study of a block, whose record and shear waves come from the same mesh and element."""
    mesh = layered_block(BLOCK, ("skin", "muscle"), 12.0, 6, 3.0)

    def write(study: Study, model: SiteModel, truth: Parameters, random: np.random.Generator) -> None:
        write_vtu(mesh, folder / "truth.vtu")
        model = replace(model, mesh=folder / "truth.vtu", mesh_digest="truth", element=study.mesh.element)
        model = replace(model, waves=waves_under(model, mesh))
        times = np.linspace(0.0, model.knots_s[-1], 201)
        job = SimulationJob(model, study.tissues, tuple(study.vector(truth)), tuple(times), False)
        found = simulate(job)
        made = record(Ramp(max(model.knots_mm), 0.96), lambda t: np.interp(t, times, found.force_N), random)
        made.write(study.path(Path("a.csv")))
        speeds = {
            place.tissue: lambda t, row=row: np.interp(t, times, row)
            for place, row in zip(model.waves, found.observed, strict=True)
        }
        write_waves(folder / "a-waves.csv", made, speeds, random)

    monkeypatch.setattr(layered, "_write_record", write)
    for name in ("skin.stl", "a.csv", "a-waves.csv"):
        (folder / name).touch()
    (folder / "study.toml").write_text(TEXT + more)
    study = load_study(folder)
    store = store_blocks(study, {"a": (BLOCK, 3.0, True)}, TRUTH, 4, coarse=4)
    for place in (store["mesh"], store["mesh"] / "coarse"):
        write_vtu(mesh, place / "a.vtu")
    return Context(study, store, SerialExecutor(), lambda event: None)


@pytest.mark.slow
def test_speeds_are_fitted_and_predicted(tmp_path: Path, monkeypatch) -> None:
    """Beside one ramp: nothing is off at the truth, every interval is narrower than by force alone, and the
    moduli of both tissues are known several times as well."""
    widths = []
    for name, more in (("force", ""), ("both", WAVES)):
        (tmp_path / name).mkdir()
        context = stored(tmp_path / name, monkeypatch, more)
        study = context.study
        laboratory = Laboratory(context, SimulationCache(tmp_path / name / "runs"), study.recorded)
        at = laboratory.anchored(study.vector(TRUTH))
        known = linearised(context, laboratory.records, study.vector(TRUTH), at)
        widths.append(np.log(known.intervals_95[:, 1] / known.intervals_95[:, 0]))
    assert [one.name for one in laboratory.records] == ["a", "a+skin-waves", "a+muscle-waves"]
    assert [one.unit for one in laboratory.measured] == ["N", "m/s", "m/s"]
    assert {one.where for one in laboratory.measured} == {"a"}
    for one, response, noise in zip(
        laboratory.records[1:], at.responses[1:], known.residual_model.noise[1:], strict=True
    ):
        off = response.force_N - one.compared
        assert off @ np.linalg.solve(noise.covariance, off) / len(off) < 2.5
    assert laboratory.simulated == 1
    assert (widths[1] < widths[0]).all()
    assert (widths[1][[0, 4]] < 0.6 * widths[0][[0, 4]]).all()
    for stage, run in (("calibrate", run_calibrate), ("predict", run_predict)):
        context.store[stage].mkdir()
        run(context, context.store[stage])
    found = context.store.read("calibrate", "calibration.json")
    assert found["uncertainty"]["residuals"]["sites"]["a+muscle-waves"]["unit"] == "m/s"
    intervals = found["uncertainty"]["intervals_95"]
    for tissue, values in TRUTH.items():
        for name, value in values.items():
            low, high = intervals[tissue][name]
            assert low <= value <= high, (tissue, name)
    (row,) = context.store.read("predict", "predict.json")["sites"]
    skin, muscle = row["observed"]
    assert (skin["kind"], skin["unit"], skin["what"]) == ("shear waves", "m/s", "skin-waves")
    assert muscle["error_percent"] < 10.0
    assert (context.store["predict"] / "a+muscle-waves.csv").is_file()
    results = load_store(study.results)
    figure, shown = wave_figure(results, fitted=True), observed_table(results)
    assert figure is not None
    assert "a, skin-waves" in figure.markup
    assert shown is not None
    assert shown.rows[0].cells[7].text == "m/s"


@pytest.mark.parametrize(
    ("name", "told"),
    [
        ("skin_9mm_m_s", "site a: skin lies 0.0 to 3.0 mm deep, and not at 9 mm"),
        ("fat_m_s", "the model has no tissue 'fat'; name columns among skin_m_s, muscle_m_s"),
    ],
)
def test_a_place_that_is_not_there_is_refused(tmp_path: Path, monkeypatch, name: str, told: str) -> None:
    context = stored(tmp_path, monkeypatch, WAVES)
    file = tmp_path / "a-waves.csv"
    file.write_text(file.read_text().replace("skin_m_s", name))
    with pytest.raises(TraceError, match=told) as caught:
        _model_anew(context)
    assert caught.value.file == file


def _model_anew(context: Context) -> SiteModel:
    run_traces(context, context.store["traces"])
    return recorded_model(context, context.study.recorded[0])
