"""The view Results' server side: stored fields as they are stored, runs kept and compared, files to keep."""

import time

import numpy as np
import pytest
from serving_here import open_page
from stored_fields import block, fields, write_outcome, write_stored

from completing import write_result
from limbfit.results.runs import SimulateResult
from limbfit.studio.folder import StudyFolder
from limbfit.studio.processes import find_simulating
from limbfit.studio.results_routes import FIELDS
from unpacking import unpack


@pytest.fixture
def page(study):
    write_stored(study / "results")
    return open_page(study)


def test_what_can_be_played_is_told_with_its_times(page, study):
    played, peak = page.get("/api/results/site/1").json()["sources"]
    assert played["source"] == "simulate"
    assert played["times_s"] == [0.0, 0.5, 1.0, 1.5]
    assert (peak["source"], peak["times_s"]) == ("predict", [1.0])  # when the record is deepest
    assert page.get("/api/results/site/2").json()["sources"] == []
    assert played["deepest"] == 3  # the newest while there is no curve yet
    curve = study / "results" / "simulate" / "1.csv"
    curve.write_text("time_s,displacement_mm,force_N\n0,0,0\n0.9,5,6\n1.5,1,0\n")
    assert page.get("/api/results/site/1").json()["sources"][0]["deepest"] == 2


def test_steps_of_parameters_that_were_identified_before_are_told_as_such(page, study):
    stored = {"site": "1", "parameters": {"skin": {"c_kPa": 9.0}}, "parameters_from": "identified"}
    write_result(study / "results", SimulateResult, stored, "1")
    played, _ = page.get("/api/results/site/1").json()["sources"]
    assert played["parameters_from"] == "identified, before the study was identified anew"


@pytest.mark.parametrize("name", [*FIELDS])
def test_every_field_comes_as_it_is_stored(page, name):
    mesh = block()
    stored, _ = unpack(page.get("/api/results/mesh/simulate/1").content)
    corners = np.unique(mesh.cells[:, :4])
    np.testing.assert_allclose(stored["points"], mesh.points[corners], atol=1e-5)
    path = f"/api/results/moment/simulate/1/2/{name}"
    if name in ("contact_pressure", "energy_density"):  # not stored here
        assert page.get(path).status_code == 422
        return
    arrays, facts = unpack(page.get(path).content)
    points, cells = fields(mesh, 2 / 3)
    np.testing.assert_allclose(arrays["moved"], points["displacement_mm"][corners], atol=1e-6)
    if name == "displacement":
        assert facts["on"] == "nodes"
        expected = np.linalg.norm(points["displacement_mm"], axis=1)[corners]
    else:
        assert facts["on"] == "cells"
        values = cells[FIELDS[name].array]
        expected = values[:, FIELDS[name].component] if values.ndim == 2 else values
    np.testing.assert_allclose(arrays["values"], expected, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize(
    "path",
    ["moment/simulate/1/4/J", "moment/simulate/1/-1/J", "moment/simulate/2/0/J", "moment/mesh/1/0/J",
     "moment/simulate/..%2f1/0/J", "moment/simulate/1/0/none", "mesh/predict/2", "curves/2", "curves/..%2fx",
     "curves/1?kept=..", "?kept=../..", "site/9"],
)  # fmt: skip
def test_what_is_not_there_is_refused(page, path):
    answer = page.get(f"/api/results/{path}" if path[0] != "?" else f"/api/results{path}")
    assert answer.status_code in (404, 422)
    assert "Traceback" not in answer.text


def test_a_kept_run_is_compared_with_a_later_one(page, study):
    assert page.post("/api/results/keep", json={"name": "before"}).status_code == 200
    write_outcome(study / "results", error=2.0)
    now, before = (page.get(f"/api/results{more}").json() for more in ("", "?kept=before"))
    assert [run["name"] for run in now["kept"]] == ["before"]
    assert (now["sites"][0]["error_percent"], before["sites"][0]["error_percent"]) == (2.0, 3.0)
    assert before["stages"][-1]["parameters"]["skin"]["c_kPa"] == 3.0
    curves = [page.get(f"/api/results/curves/1{more}").json() for more in ("", "?kept=before")]
    assert [one["force_simulated_N"][1] for one in curves] == [2.0, 3.0]
    assert page.post("/api/results/keep", json={"name": "before"}).status_code == 422
    assert page.post("/api/results/drop", json={"name": "before"}).status_code == 200
    assert page.get("/api/results").json()["kept"] == []


@pytest.mark.parametrize("name", ["..", "../out", "a/b", ".hidden", "", "a" * 41, "x\x00"])
def test_a_kept_run_has_a_plain_name(page, study, name):
    assert page.post("/api/results/keep", json={"name": name}).status_code == 422
    assert not (study / "results" / "kept").exists()


def test_files_to_keep_are_those_that_are_stored(page):
    listed = page.get("/api/results/site/1").json()["downloads"]
    assert {"predict/1.csv", "predict/1.vtu"} <= {file["path"] for file in listed}
    for file in listed:
        answer = page.get(f"/api/files/{file['path']}", params={"download": True})
        assert answer.status_code == 200
        assert "attachment" in answer.headers["content-disposition"]


def test_a_febio_input_needs_meshes_that_are_up_to_date(page):
    answer = page.post("/api/results/feb/1")
    assert answer.status_code == 409
    assert "until mesh" in answer.json()["error"]


def test_a_simulation_is_found_by_its_command_and_stopped(page, study, monkeypatch):
    """With a program in place of limbfit that takes the same words and waits."""
    monkeypatch.setattr("limbfit.studio.processes.PROGRAM", ("-c", "import time; time.sleep(60)"))
    folder = StudyFolder(study / "study.toml")
    assert page.post("/api/results/simulate/9").status_code == 422
    started = page.post("/api/results/simulate/1").json()
    assert find_simulating(folder) == started
    assert page.get("/api/results/site/2").json()["simulating"] == started  # whoever asks
    assert page.post("/api/results/simulate/2").status_code == 409
    assert page.post("/api/results/stop").json() == started
    deadline = time.monotonic() + 20
    while find_simulating(folder) is not None and time.monotonic() < deadline:
        time.sleep(0.1)
    assert find_simulating(folder) is None
    assert page.post("/api/results/stop").status_code == 409
