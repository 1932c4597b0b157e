"""What was seen beside the force, in the report: a figure of each kind, a row of each thing seen."""

from pathlib import Path

import numpy as np
import pytest
from stored_results import write_results

from editing import rewritten
from limbfit.report.drawing.figures import draw_seen_figures
from limbfit.report.sections.identification import (
    make_fit_section,
    make_observed_table,
    make_prediction_section,
)
from limbfit.report.store import load_store

SURFACE = {
    "kind": "surface",
    "what": "surface",
    "name": "PT-1+surface",
    "compared": "4 points, 96 values",
    "left_out": {"under the indenter": 3},
    "components": ["x", "y", "z"],
    "unit": "mm",
    "largest": 1.236,
    "noise": 0.021,
    "sd": 0.05,
    "error_percent": 2.25,
}
LAYER = {
    "kind": "ultrasound",
    "what": "muscle",
    "name": "TI-5+muscle",
    "compared": "81 times",
    "unit": "mm",
    "largest": 3.5,
    "noise": 0.03,
    "sd": 0.1,
    "thickness_mm": 20.0,
    "error_percent": None,
}
WAVE = {
    "kind": "shear waves",
    "what": "skin-waves",
    "name": "TI-5+skin-waves",
    "compared": "9 times",
    "unit": "m/s",
    "largest": 5.31,
    "noise": 0.12,
    "sd": 0.1,
    "bias": 0.1,
    "error_percent": 1.5,
}


@pytest.fixture
def results(tmp_path: Path) -> Path:
    """A study with a surface at a fitted site, ultrasound and shear waves at a held-out one."""
    folder = write_results(tmp_path / "results", geometry=False)
    with rewritten(folder / "predict" / "predict.json") as content:
        for row in content["sites"]:
            row["observed"] = {"PT-1": [SURFACE], "TI-5": [LAYER, WAVE]}.get(row["site"], [])
    moves = np.linspace(-1.2, 0.4, 96)
    columns = {
        "time_s": np.linspace(0.5, 9.0, 96),
        "component": np.arange(96) % 3,
        "displacement_measured_mm": moves,
        "displacement_simulated_mm": moves + 0.01,
        "displacement_low_mm": moves - 0.1,
        "displacement_high_mm": moves + 0.1,
    }
    _write(folder / "predict" / "PT-1+surface.csv", columns)
    times = np.linspace(0.0, 9.0, 81)
    layer = {"time_s": times, "compression_measured_mm": times / 3.0}
    _write(folder / "predict" / "TI-5+muscle.csv", layer)
    speed = 4.9 + 0.05 * times[::10]
    wave = {"time_s": times[::10], "speed_measured_m_s": speed, "speed_simulated_m_s": speed + 0.02}
    _write(folder / "predict" / "TI-5+skin-waves.csv", wave)
    return folder


def _write(file: Path, columns: dict[str, np.ndarray]) -> None:
    table = np.column_stack(list(columns.values()))
    np.savetxt(file, table, delimiter=",", header=",".join(columns), comments="")


def test_each_kind_is_drawn_where_it_belongs(results: Path) -> None:
    store = load_store(results)
    surface, layer = draw_seen_figures(store, fitted=True)[2], draw_seen_figures(store, fitted=False)[0]
    wave = draw_seen_figures(store, fitted=False)[1]
    assert surface is not None
    assert layer is not None
    assert wave is not None
    assert wave.name == "waves-held-out"
    assert "Speed (m/s)" in wave.markup
    assert wave in make_prediction_section(store).blocks
    assert surface.name == "surface-fitted"
    assert "PT-1: 2.2 %" in surface.markup
    assert "TI-5, muscle" in layer.markup
    assert draw_seen_figures(store, fitted=False)[2] is None
    assert draw_seen_figures(store, fitted=True)[0] is None
    assert surface in make_fit_section(store).blocks
    assert layer in make_prediction_section(store).blocks


def test_each_has_a_row_with_what_was_left_out(results: Path) -> None:
    table = make_observed_table(load_store(results))
    assert table is not None
    told = [[cell.text for cell in row.cells] for row in table.rows]
    assert told[0] == [
        "PT-1", "surface", "fitted", "4 points, 96 values", "3 under the indenter",
        "1.24", "0.021", "mm", "2.2",
    ]  # fmt: skip
    assert told[1][1:5] == ["muscle", "held out", "81 times", "\u2013"]
    assert told[2][5:] == ["5.31", "0.120", "m/s", "1.5"]
    assert [row.marked for row in table.rows] == [True, False, False]


def test_a_study_of_forces_alone_shows_nothing_of_it(tmp_path: Path) -> None:
    store = load_store(write_results(tmp_path / "results", geometry=False))
    assert make_observed_table(store) is None
    assert draw_seen_figures(store, fitted=True)[2] is None
