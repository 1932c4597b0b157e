"""`limbfit uncertainty` on a small stump: what it stores, what it says, and the section of the report."""

import json

import numpy as np
import pytest

from conftest import COARSE
from limbfit import report_study, run_experiment
from limbfit.pipeline.uncertainty.uncertainty import EMULATOR
from limbfit.study import load_study

QUICK = (
    COARSE.replace("max_iterations = 2", "max_iterations = 4")
    + """
[uncertainty]
runs = 4
checked = 1
"""
)


@pytest.fixture
def done(study):
    file = study / "study.toml"
    file.write_text(file.read_text() + QUICK)
    return study, run_experiment(load_study(study), "uncertainty", listener=lambda event: None)


@pytest.mark.slow
def test_the_experiment_on_a_stump(done):
    study, content = done
    folder = study / "results/uncertainty"
    stored = json.loads((folder / "uncertainty.json").read_text())
    assert stored["verdict"] == content["verdict"]
    names = [row["name"] for row in stored["parameters"]]
    assert len(names) == 8
    for row in stored["parameters"]:
        records, all_sources = row["posterior_95"], row["with_sources_95"]
        assert all_sources[0] <= records[0] * 1.001
        assert all_sources[1] >= records[1] * 0.999
    # One site cannot determine two materials.
    said = [row["verdict"] for row in stored["parameters"]]
    assert "not determined by these data" in said
    assert said.count("determined") < 4
    sources = {row["source"] for row in stored["sources"]}
    assert sources >= {"layer thickness", "site position", "site axis", "mesh", "friction", "bulk modulus"}
    assert all(not row["failed"] for row in stored["sources"])
    assert all(row["force_percent"]["1"] > 0 for row in stored["sources"])
    assert {row["site"]: row["fitted"] for row in stored["predictions"]["sites"]} == {"1": True, "2": False}
    for file in ("parameters.csv", "sources.csv", "predictions.csv", "profiles.csv", "draws.csv"):
        assert len((folder / file).read_text().splitlines()) > 1
    with np.load(folder / EMULATOR) as runs:
        assert len(runs["points"]) == stored["emulator"]["runs"]
        assert list(runs["names"]) == [row["name"] for row in stored["parameters"]]
        assert runs["jacobians"].shape == (*runs["forces"].shape, 8)
        assert np.isfinite(runs["forces"]).all()
    for profile in stored["profiles"].values():
        assert len(profile["extrapolated"]) == len(profile["values"])
    assert [check["why"] for check in stored["checks"]] == ["narrowest", "widest"]
    report_study(load_study(study), listener=lambda event: None)
    page = (study / "results/report/report.html").read_text()
    assert "What the records determine" in page
    assert "Profile likelihood" in page
    # Done once: the second time nothing is simulated.
    events = []
    run_experiment(load_study(study), "uncertainty", listener=events.append)
    assert not any("sources, site" in event.text for event in events)
