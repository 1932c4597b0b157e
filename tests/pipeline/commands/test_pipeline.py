"""Runs that go on where they stopped, do nothing twice, and store what the report needs."""

import json
import shutil

import numpy as np
import pytest

from conftest import COARSE
from editing import append, edit
from limbfit import run_study, simulate_site
from limbfit.errors import InputError
from limbfit.mesh import read_vtu
from limbfit.study import load_study
from stages import StoppedError, states, stop_at


@pytest.fixture
def coarse(study):
    append(study, COARSE)
    return study


def finished_simulations(study) -> dict[str, int]:
    return {p.name: p.stat().st_mtime_ns for p in study.glob("results/.work-calibrate-*/runs/*.npz")}


@pytest.mark.slow
def test_interrupted_calibration_goes_on_and_ends_the_same(coarse, tmp_path_factory):
    other = shutil.copytree(coarse, tmp_path_factory.mktemp("other") / "study")
    with pytest.raises(StoppedError):
        run_study(load_study(coarse), listener=stop_at("evaluation 3"))
    kept = finished_simulations(coarse)
    assert len(kept) >= 2
    found = states(coarse)
    assert found["mesh"] == "done"
    assert found["calibrate"] == "begun"
    resumed = run_study(load_study(coarse))
    runs = coarse / "results/calibrate/runs"
    assert all((runs / name).stat().st_mtime_ns == stamp for name, stamp in kept.items())
    straight = run_study(load_study(other))
    for tissue, values in straight["parameters"].items():
        for name, value in values.items():
            assert resumed["parameters"][tissue][name] == pytest.approx(value, rel=1e-4)
    assert resumed["mean_error_heldout_percent"] == pytest.approx(
        straight["mean_error_heldout_percent"], rel=1e-3
    )
    check_stored(coarse)
    check_repeated_run_does_nothing(coarse)
    check_another_held_out_record_leaves_the_calibration(coarse)
    check_identified_parameters_are_used_until_stale(coarse)


def check_stored(study) -> None:
    """Formats that ParaView, a spreadsheet and the report read."""
    results = study / "results"
    predicted = json.loads((results / "predict/predict.json").read_text())
    assert [row["site"] for row in predicted["sites"]] == ["1", "2"]
    assert all(row["completed"] for row in predicted["sites"])
    curve = np.genfromtxt(results / "predict/1.csv", delimiter=",", names=True)
    error = 100 * np.abs(curve["force_simulated_N"] - curve["force_measured_N"]).mean()
    assert predicted["sites"][0]["error_percent"] == pytest.approx(
        error / curve["force_measured_N"].max(), rel=1e-4
    )
    assert np.all(curve["force_low_N"] <= curve["force_high_N"])
    mesh = read_vtu(results / "predict/1.vtu")
    assert mesh.region_names == ("skin", "muscle")
    report = (results / "report/report.html").read_text()
    assert "stump" in report
    run = json.loads((results / "run.json").read_text())
    assert set(run["inputs"]) == {
        "surfaces.skin",
        "surfaces.bones.tibia",
        "sites.1.trace",
        "sites.2.trace",
    }
    assert all(stage["seconds"] > 0 for stage in run["stages"].values())
    assert not [p for p in results.iterdir() if p.name.startswith((".work", ".old"))]


def check_repeated_run_does_nothing(study) -> None:
    told = []
    run_study(load_study(study), listener=told.append)
    assert {event.text for event in told} == {"is up to date"}


def list_runs(results, site: str) -> set[str]:
    """Names of the files that hold a prediction's simulations of a site."""
    files = (results / "predict/runs").iterdir()
    return {file.name for file in files if json.loads(str(np.load(file)["facts"]))["site"] == site}


def check_another_held_out_record_leaves_the_calibration(study) -> None:
    results = study / "results"
    stamp = (results / "calibrate/stage.json").read_text()
    before = list_runs(results, "1"), list_runs(results, "2")
    record = np.loadtxt(study / "2.csv", delimiter=",", skiprows=1) * [1.0, 1.0, 1.1]
    header = "time_s,displacement_mm,force_N"
    np.savetxt(study / "2.csv", record, delimiter=",", header=header, comments="")
    told = []
    run_study(load_study(study), listener=told.append)
    assert (results / "calibrate/stage.json").read_text() == stamp
    assert any(event.stage == "calibrate" and event.text == "is up to date" for event in told)
    assert list_runs(results, "1") == before[0]  # the fitted site is not simulated again
    assert all(before)
    assert not list_runs(results, "2") & before[1]


def check_identified_parameters_are_used_until_stale(study) -> None:
    found = simulate_site(load_study(study), "1")
    identified = json.loads((study / "results/calibrate/calibration.json").read_text())["stages"][-1]
    assert found["parameters_from"] == "identified"
    assert found["parameters"] == identified["parameters"]
    append(study, "lower = { c_kPa = 0.1, m = 2.0, gamma = 0.01, tau_s = 0.01 }\n")
    with pytest.raises(InputError, match=r"identified parameters are stale.*limbfit run.*--parameters"):
        simulate_site(load_study(study), "1")
    given = {tissue: {**values, "c_kPa": 5.0} for tissue, values in identified["parameters"].items()}
    assert simulate_site(load_study(study), "1", parameters=given)["parameters"] == given


@pytest.mark.slow
def test_planned_indentation_is_simulated_without_a_record(coarse):
    planned = "depth_mm = 3.0\nposition = [0.0, 40.0, 50.0]"
    edit(coarse, 'trace = "2.csv"\nposition = [0.0, 40.0, 50.0]', planned)
    steps = coarse / "results/simulate/2.pvd"  # of an animation that was made before
    steps.parent.mkdir(parents=True)
    steps.write_text("")
    found = simulate_site(load_study(coarse), "2", parameters=None)
    assert found["completed"]
    assert not steps.exists()
    assert found["depth_mm"] == 3.0
    assert found["parameters_from"] == "start of the study"
    assert found["penetration_mm"] <= 0.0101 * 3.0
    curve = np.genfromtxt(coarse / "results/simulate/2.csv", delimiter=",", names=True)
    assert curve["force_N"].argmax() == pytest.approx(len(curve) // 2, abs=1)  # peak force at the peak depth
    assert curve["force_N"].max() == pytest.approx(found["peak_force_N"], rel=0.02)
    fields = read_vtu(coarse / "results/simulate/2.vtu")
    assert len(fields.points) > 100


LAYERS = """
[geometry]
layers = [{ name = "skin", thickness_mm = 2.0 }, { name = "fat", thickness_mm = 6.0 }]
core = "calf"
[material.tissues.fat]
start = { c_kPa = 3.0 }
"""


@pytest.mark.slow
def test_three_tissues_from_surfaces_to_report(coarse):
    append(coarse, LAYERS)
    summary = run_study(load_study(coarse))
    tissues = ("skin", "fat", "calf")
    assert tuple(summary["parameters"]) == tuple(summary["intervals_95"]) == tissues
    assert summary["mean_error_fitted_percent"] < 10.0
    results = coarse / "results"
    assert read_vtu(results / "mesh/1.vtu").region_names == tissues
    calibration = json.loads((results / "calibrate/calibration.json").read_text())
    assert [stage["name"] for stage in calibration["stages"]] == ["one material", "three materials"]
    assert calibration["stages"][0]["start"]["fat"]["c_kPa"] == 3.0
    assert set(calibration["uncertainty"]["correlation"]["names"]) == set(
        calibration["uncertainty"]["verdict"]
    )
    report = (results / "report/report.html").read_text()
    assert "first as one material, then as skin, fat and calf." in report
    assert "outermost first: skin (2.0 mm), fat (6.0 mm)" in report
    before = states(coarse)
    assert set(before.values()) == {"done"}
    edit(coarse, '"calf"', '"muscle"')
    after = states(coarse)
    assert {after[stage] for stage in ("mesh", "calibrate", "predict", "report")} == {"stale"}
    assert after["traces"] == "done"
