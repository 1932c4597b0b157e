"""What the solver doubts about its own result reaches the stored files, the command line and the report."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
import pytest

from limbfit.cli.commands import show_warnings
from limbfit.execution import SerialExecutor
from limbfit.indentation import Simulation
from limbfit.pipeline import simulations
from limbfit.report import build_report

sys.path.insert(0, str(Path(__file__).parent / "report"))
from stored_results import write_results

DOUBT = "7 elements are inside out at a node at 9.1 mm"


def test_a_kept_simulation_keeps_its_warnings(tmp_path, monkeypatch):
    made = Simulation("tibia", np.arange(3.0), None, True, "", 0.02, {"steps": 2}, (DOUBT,))
    monkeypatch.setattr(simulations, "job_digest", lambda job: "one")
    simulations.SimulationCache(tmp_path)._keep(None, made)
    again = next(simulations.SimulationCache(tmp_path).run([None], SerialExecutor()))
    assert again.warnings == (DOUBT,)
    assert again.completed


def test_the_command_line_names_the_site(capsys):
    show_warnings([{"site": "calf", "warnings": []}, {"site": "tibia", "warnings": [DOUBT]}])
    assert capsys.readouterr().err.strip() == f"warning: site tibia: {DOUBT}"


@pytest.mark.parametrize("doubted", [True, False])
def test_the_report_shows_them(tmp_path, doubted):
    results = write_results(tmp_path / "results")
    file = results / "predict" / "predict.json"
    content = json.loads(file.read_text())
    content["sites"][0]["warnings"] = [DOUBT] * doubted
    file.write_text(json.dumps(content))
    text = build_report(results, tmp_path / "report.html").read_text()
    assert (f"Site {content['sites'][0]['site']}: {DOUBT}" in text) == doubted
