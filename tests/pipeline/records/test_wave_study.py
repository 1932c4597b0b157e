"""Speeds of shear waves beside the force: from the file to the prediction."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from seen_blocks import PUNCH, Made, SeenBlock, check_truth_within

from limbfit.errors import TraceError
from limbfit.indentation import Simulation, SiteModel, place_waves_under
from limbfit.phantom.robot import write_waves
from limbfit.pipeline.engine.context import Context
from limbfit.pipeline.records.records import build_model
from limbfit.pipeline.records.traces import run_traces
from limbfit.report.drawing.figures import draw_seen_figures
from limbfit.report.sections.identification import make_observed_table
from limbfit.report.store import load_store
from limbfit.study import Study

WAVES = 'shear_waves = "a-waves.csv"\n'


def write_seen(study: Study, model: SiteModel, found: Simulation, made: Made) -> None:
    whole, times, random = made
    speeds = {
        place.tissue: lambda t, row=row: np.interp(t, times, row)
        for place, row in zip(model.waves, found.observed, strict=True)
    }
    write_waves(study.path(Path("a-waves.csv")), whole, speeds, random)


BLOCK = SeenBlock(
    "a-waves.csv", lambda model, mesh: replace(model, waves=place_waves_under(model, mesh)), write_seen
)


@pytest.mark.slow
def test_speeds_are_fitted_and_predicted(tmp_path: Path) -> None:
    """Beside one ramp: nothing is off at the truth, every interval is narrower than by force alone, and the
    moduli of both tissues are known several times as well."""
    known = BLOCK.narrowed(tmp_path, WAVES)
    assert [one.name for one in known.records.own] == ["a", "a+skin-waves", "a+muscle-waves"]
    assert [one.unit for one in known.records.curves] == ["N", "m/s", "m/s"]
    assert max(known.misfits) < 2.5
    assert (known.by_both[[0, 4]] < 0.6 * known.by_force[[0, 4]]).all()
    found, (skin, muscle) = known.fit_and_predict()
    assert found["uncertainty"]["residuals"]["sites"]["a+muscle-waves"]["unit"] == "m/s"
    check_truth_within(found["uncertainty"]["intervals_95"])
    assert (skin["kind"], skin["unit"], skin["what"]) == ("shear waves", "m/s", "skin-waves")
    assert muscle["error_percent"] < 10.0
    assert (known.context.store["predict"] / "a+muscle-waves.csv").is_file()
    results = load_store(known.context.study.results)
    figure, shown = draw_seen_figures(results, fitted=True)[1], make_observed_table(results)
    assert figure is not None
    assert "a, skin-waves" in figure.markup
    assert shown is not None
    assert shown.rows[0].cells[7].text == "m/s"


def test_a_place_that_is_not_there_is_refused(tmp_path: Path) -> None:
    rough = PUNCH.replace("load_steps = 8", "load_steps = 2").replace("unload_steps = 8", "unload_steps = 2")
    rough += "[traces]\nsmoothing = 0.1\n"
    context = replace(BLOCK, tools=rough).stored(tmp_path, WAVES)
    file = tmp_path / "a-waves.csv"
    text = file.read_text()
    for name, told in (
        ("skin_9mm_m_s", "site a: skin lies 0.0 to 3.0 mm deep, and not at 9 mm"),
        ("fat_m_s", "the model has no tissue 'fat'; name columns among skin_m_s, muscle_m_s"),
    ):
        file.write_text(text.replace("skin_m_s", name))
        with pytest.raises(TraceError, match=told) as caught:
            _model_anew(context)
        assert caught.value.file == file


def _model_anew(context: Context) -> SiteModel:
    run_traces(context, context.store["traces"])
    return build_model(context, context.study.recorded[0])
