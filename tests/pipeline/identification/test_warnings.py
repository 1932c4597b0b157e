"""What the solver doubts about its own result reaches the stored files, the command line and the report."""

import json
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np

from completing import complete
from limbfit.cli.commands import show_warnings
from limbfit.execution import SerialExecutor
from limbfit.fe import SimulationWarning
from limbfit.indentation import Simulation
from limbfit.pipeline.identification.calibrate import summarise_doubts
from limbfit.pipeline.identification.search import SearchWarning
from limbfit.pipeline.simulation import simulations
from limbfit.report import build_report
from limbfit.results.identification import CalibrationResult

sys.path.insert(0, str(Path(__file__).parents[2] / "report"))
from stored_results import leave_unarranged, write_results

FOLD = SimulationWarning("folded", "7 elements are inside out at a node at 9.1 mm", 7, 9.1, 1.0)
DOUBT = FOLD.text


def test_a_kept_simulation_keeps_its_warnings(tmp_path, monkeypatch):
    made = Simulation("tibia", np.arange(3.0), None, True, "", 0.02, {"steps": 2}, (FOLD,))
    monkeypatch.setattr(simulations, "compute_job_digest", lambda job: "one")
    simulations.SimulationCache(tmp_path).keep(None, made)
    again = next(simulations.SimulationCache(tmp_path).run([None], SerialExecutor()))
    assert again.doubts == (FOLD,)
    assert again.warnings == (DOUBT,)
    assert again.completed


def test_the_command_line_names_the_site(capsys):
    show_warnings([{"site": "calf", "warnings": []}, {"site": "tibia", "warnings": [DOUBT]}])
    assert capsys.readouterr().err.strip() == f"warning: site tibia: {DOUBT}"


def test_the_report_shows_them_and_counts_those_of_the_search(tmp_path, monkeypatch):
    results = write_results(tmp_path / "results", geometry=False)
    leave_unarranged(monkeypatch)
    file = results / "predict" / "predict.json"
    predicted = json.loads(file.read_text())
    predicted["sites"][0]["warnings"] = [DOUBT]
    file.write_text(json.dumps(predicted))
    file = results / "calibrate" / "calibration.json"
    content = json.loads(file.read_text())
    slip = SimulationWarning("slipped", "the force falls from 5 N to 4 N", 1, 6.0, 0.75)
    found = SimpleNamespace(names=("c",), history=[SimpleNamespace(parameters=(1.0,))])
    searched = [SearchWarning(1, "tibia", (1.0,), FOLD), SearchWarning(2, "tibia", (2.0,), slip)]
    answer = Simulation("tibia", np.arange(3.0), None, True, "", 0.02, {}, (FOLD,))
    content["doubts"] = summarise_doubts(searched, {"tibia": answer}, 8, found).to_plain()
    content["contact"] = {"tibia": {"from_rest_percent": 0.3}}
    file.write_text(json.dumps(complete(CalibrationResult, content)))
    text = build_report(results, tmp_path / "report.html").read_text()
    assert f"Site {predicted['sites'][0]['site']}: {DOUBT}" in text
    assert f"Site {predicted['sites'][1]['site']}: {DOUBT}" not in text
    assert "2 of 8 simulations of the search completed but are doubtful" in text
    assert "1 of these doubts are at accepted iterates" in text
    assert f"At the answer, site tibia: {DOUBT}" in text
    assert "force from rest differs from the fitted one by 0.30 % at site tibia" in text
    assert "force falls in loading" in text
    assert [row["iterate"] for row in content["doubts"]["search"]] == [0, None]
