"""Experiments are stored like stages: done once, resumed, stale when what decides them changes."""

import shutil
from dataclasses import replace
from importlib import import_module

import pytest

from conftest import write_trace
from editing import edit
from limbfit import Progress, run_experiment, run_study, study_status
from limbfit.errors import InputError, RunError
from limbfit.pipeline.commands.experiments import EXPERIMENTS, Experiment, register_experiment
from limbfit.pipeline.commands.run import compute_keys
from limbfit.pipeline.engine.store import write_json
from limbfit.study import load_study
from stages import StoppedError, states, stop_at


def run_peaks(context, folder, *, factor: float = 1.0, parameters_from: str = ""):
    """The largest forces of the records times a factor; halfway it can be stopped."""
    seen = folder / "seen.txt"
    if not seen.is_file():
        seen.write_text("begun")
        context.tell("peaks", 1, 2, "halfway")
    sites = context.results.traces.to_plain()["sites"]
    peaks = {name: factor * facts["peak_force_N"] for name, facts in sites.items()}
    write_json(folder / "peaks.json", {"peaks_N": peaks})
    return {}


PEAKS = Experiment("peaks", run_peaks, needs=("traces",), tables=("material",))


@pytest.fixture(scope="module")
def traced(pristine, tmp_path_factory):
    """The study with records of few samples, after the stages that the experiment needs."""
    folder = shutil.copytree(pristine, tmp_path_factory.mktemp("traced") / "study")
    for name in ("1.csv", "2.csv"):
        write_trace(folder / name, rate=20.0)
    run_study(load_study(folder), until="traces")
    return folder


@pytest.fixture
def study(traced, tmp_path):
    return shutil.copytree(traced, tmp_path / "study")


@pytest.fixture(autouse=True)
def peaks():
    register_experiment(PEAKS)


def state(study, name: str = "peaks") -> str:
    return states(study).get(name, "missing")


def test_an_experiment_is_done_once_after_the_stages_it_needs(study):
    shutil.rmtree(study / "results")
    assert state(study) == "missing"
    found = run_experiment(load_study(study), "peaks")
    assert found["peaks_N"]["1"] == pytest.approx(6.0, abs=0.2)
    assert state(study) == "done"
    assert state(study, "traces") == "done"
    told = []
    run_experiment(load_study(study), "peaks", listener=told.append)
    assert [event.text for event in told if event.stage == "peaks"] == ["is up to date"]


@pytest.mark.parametrize("options", [{}, {"factor": 2.0}], ids=["its defaults", "others"])
def test_a_stopped_experiment_has_begun_and_goes_on_in_its_own_folder(study, options):
    stop = stop_at("halfway")
    with pytest.raises(StoppedError):
        run_experiment(load_study(study), "peaks", **options, listener=stop)
    assert state(study) == "begun"
    # What it had begun is there: no second half.
    run_experiment(load_study(study), "peaks", **options, listener=stop)
    assert state(study) == "done"


def test_an_experiment_is_not_done_on_records_that_are_others_by_now(study):
    shutil.rmtree(study / "results")

    def edit(event: Progress) -> None:
        if event.stage == "traces" and event.text.startswith("done"):
            (study / "2.csv").write_bytes((study / "2.csv").read_bytes() + b"\n")

    with pytest.raises(RunError, match=r"study\.toml: an input of the stage traces has changed .*run the"):
        run_experiment(load_study(study), "peaks", listener=edit)
    assert state(study) == "missing"


def test_options_settings_and_records_decide_an_experiment(study):
    once = run_experiment(load_study(study), "peaks")
    twice = run_experiment(load_study(study), "peaks", factor=2.0)
    assert twice["peaks_N"]["1"] == pytest.approx(2 * once["peaks_N"]["1"])
    assert state(study) == "done"  # judged with the options that it was run with
    edit(study, "[surfaces]", "[material]\nkappa_ratio = 50\n[surfaces]")
    assert state(study) == "stale"
    run_experiment(load_study(study), "peaks")
    edit(study, 'trace = "2.csv"', 'trace = "1.csv"')
    assert state(study) == "stale"


@pytest.mark.parametrize(("origin", "after"), [("identified", "stale"), ("given", "done")])
def test_what_was_done_with_identified_parameters_is_stale_where_others_are_identified(study, origin, after):
    """It does not need the calibration; it says that its parameters are from there."""
    run_experiment(load_study(study), "peaks", parameters_from=origin)
    assert state(study) == "done"
    edit(study, "[surfaces]", "[calibration]\nmax_iterations = 3\n[surfaces]")
    assert state(study) == after
    (row,) = [row for row in study_status(load_study(study)) if row["stage"] == "peaks"]
    assert row["why"] == ["stage calibrate changed"] * (after == "stale")


def test_the_report_is_stale_once_there_is_an_experiment_to_show(study):
    before = compute_keys(load_study(study))
    run_experiment(load_study(study), "peaks")
    after = compute_keys(load_study(study))
    assert after.pop("report") != before.pop("report")
    assert after == before


OTHER_CODE = """
from limbfit.mesh import Mesh


def run_peaks(context, folder, *, factor=1.0):
    return {}
"""


def test_an_experiment_changes_when_its_code_does(study, monkeypatch, tmp_path):
    run_experiment(load_study(study), "peaks")
    (tmp_path / "other_code.py").write_text(OTHER_CODE)
    monkeypatch.syspath_prepend(tmp_path)
    other = import_module("other_code").run_peaks
    register_experiment(replace(PEAKS, run=other))
    assert state(study) == "stale"
    (row,) = [row for row in study_status(load_study(study)) if row["stage"] == "peaks"]
    assert "code of" in " ".join(row["why"])


def test_what_there_is_not_is_refused(study):
    with pytest.raises(InputError, match="no experiment is named 'nothing'"):
        run_experiment(load_study(study), "nothing")
    with pytest.raises(InputError, match="peaks has no option colour"):
        run_experiment(load_study(study), "peaks", colour="red")


def test_names_are_folders_that_do_not_shadow_each_other():
    """Unfinished work lies in .work-<name>-<key>: no name may begin with another one and a dash."""
    names = EXPERIMENTS.names
    assert len(set(names)) == len(names)
    assert not [(a, b) for a in names for b in names if b.startswith(f"{a}-")]
