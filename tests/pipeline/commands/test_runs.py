"""Runs: what is stale and why, stages anew, logs, batches, faults of the disk, the machine's fitness."""

import ctypes
import json
import os
import re
import resource
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import psutil
import pytest

from conftest import write_trace
from editing import append, edit
from limbfit import diagnose, report_study, run_batch, run_study, study_status
from limbfit.errors import InputError, RunError
from limbfit.execution import Limits, SerialExecutor, make_executor, share_executor
from limbfit.pipeline.commands.doctor import compress_test_cube, judge_self_test
from limbfit.pipeline.commands.run import run_record
from limbfit.pipeline.engine.context import redact_paths
from limbfit.pipeline.engine.store import LOCK, is_held, lock
from limbfit.study import load_study

STORED = Path(__file__).parents[2] / "results" / "stored"


@pytest.fixture
def alone(study):
    """The study on this process alone, with records of few samples."""
    append(study, "[execution]\nworkers = 1\n")
    for name in ("1.csv", "2.csv"):
        write_trace(study / name, rate=20.0)
    return study


def rows_of(study) -> dict[str, dict]:
    return {row["stage"]: row for row in study_status(load_study(study))}


def test_status_names_the_setting_and_the_input_that_changed(alone):
    run_study(load_study(alone), until="traces")
    assert rows_of(alone)["traces"]["state"] == "done"
    append(alone, "[traces]\nsmoothing = 0.5\n")
    rows = rows_of(alone)
    assert rows["traces"]["why"] == ["setting traces.smoothing changed"]
    assert rows["surfaces"]["why"] == []
    (alone / "1.csv").write_text((alone / "1.csv").read_text() + "\n")
    assert "input file sites.1.trace changed" in rows_of(alone)["traces"]["why"]


def test_stages_are_done_anew_where_asked_for(alone):
    def done(**how) -> list[str]:
        told = []
        run_study(load_study(alone), until="traces", listener=told.append, **how)
        return [event.stage for event in told if event.text.startswith("done in")]

    assert done() == ["traces", "surfaces", "sites"]  # records are read first: they need no limb
    assert done() == []
    assert done(force=["surfaces"]) == ["surfaces"]
    assert done(start="sites") == ["traces", "sites"]
    with pytest.raises(InputError, match="no stage is named 'meshing'"):
        done(start="meshing")
    for how in ({"start": "report"}, {"force": ["traces", "predict"]}):
        with pytest.raises(InputError, match="comes after traces"):
            done(**how)


def test_a_report_of_what_there_is_before_a_run_is_not_that_of_the_run(alone):
    report_study(load_study(alone))
    row = rows_of(alone)["report"]
    assert (row["state"], row["why"]) == ("stale", ["stage predict changed"])


def test_the_log_tells_what_happened_and_no_names_of_files(alone):
    secret = alone / "Doe^Jane.csv"
    (alone / "2.csv").rename(secret)
    edit(alone, "2.csv", secret.name)
    run_study(load_study(alone), until="sites")
    secret.write_text("time_s,displacement_mm,force_N\n0,0,zero\n")
    with pytest.raises(InputError, match=r"Doe\^Jane"):
        run_study(load_study(alone), until="traces")
    first, second = sorted((alone / "results/log").glob("*.jsonl"))
    events = [json.loads(line) for line in first.read_text().splitlines()]
    assert [events[0]["event"], events[-1]["event"]] == ["begin", "end"]
    assert {"surfaces", "sites"} <= {row["stage"] for row in events if row["event"] == "progress"}
    last = json.loads(second.read_text().splitlines()[-1])
    assert (last["event"], last["error"]) == ("failed", "TraceError")
    for text in (first.read_text(), second.read_text()):
        assert "Doe" not in text
        assert str(alone) not in text
    assert redact_paths("see /home/jane/x/y.dcm", load_study(alone)) == "see <path>"


def test_a_log_names_no_folder_with_spaces_and_keeps_words_that_hold_the_name_of_an_input(alone):
    (alone / "e").mkdir()
    (alone / "1.csv").rename(alone / "e" / "ring")
    edit(alone, "1.csv", "e/ring")
    study = load_study(alone)
    said = redact_paths(
        r"touring: e/ring is not C:\Users\Jane Doe\scan.dcm, nor /home/Jane Q Doe/x/y.dcm", study
    )
    assert said == "touring: <sites.1.trace> is not <path>, nor <path>"
    (alone / "ring").write_bytes((alone / "e" / "ring").read_bytes())
    edit(alone, "e/ring", "ring")
    assert redact_paths("touring with ring", load_study(alone)) == "touring with <sites.1.trace>"


def test_a_run_until_a_stage_tells_nothing_of_later_stages_that_are_not_up_to_date(alone):
    for name in ("calibrate/calibration.json", "predict/predict.json"):
        (alone / "results" / name).parent.mkdir(parents=True)
        shutil.copy(STORED / name, alone / "results" / name)
    (alone / "results" / "report").mkdir()
    (alone / "results" / "report" / "report.html").touch()
    summary = run_study(load_study(alone), until="traces")
    assert summary.keys() == {"study", "results", "until"}
    (row,) = run_batch([alone], until="traces", workers=1)
    assert (row["mean_error_fitted_percent"], row["report"]) == (None, None)
    predicted = alone / "results" / "predict" / "predict.json"
    predicted.write_text(predicted.read_text().replace("{", '{"of another version": 1,', 1))
    assert run_study(load_study(alone), until="traces") == summary


def test_the_record_of_a_run_names_no_program_and_no_extension(alone, tmp_path):
    outside = tmp_path / "jane"
    outside.mkdir()
    (outside / "own.py").write_text("")
    edit(alone, "[study]", f'[study]\nextensions = ["{outside}/own.py"]')
    append(alone, f'[febio]\nprogram = "{outside}/febio4"\n')
    record = run_record(load_study(alone))
    assert "jane" not in record.model_dump_json()
    assert record.settings["febio"]["program"].startswith("sha256:")


@contextmanager
def without_rights() -> Iterator[None]:
    """As a user to whom the modes of files matter: the superuser gives up what overrides them."""
    if os.geteuid():
        yield
        return
    if sys.platform != "linux":
        pytest.skip("the superuser may read anything, and keeps that right here")
    libc, head = ctypes.CDLL(None, use_errno=True), (ctypes.c_uint32 * 2)(0x20080522, 0)
    before = (ctypes.c_uint32 * 6)()  # twice: effective, permitted, inheritable
    assert libc.capget(head, before) == 0
    fewer = (ctypes.c_uint32 * 6)(before[0] & ~0b110, *before[1:])  # CAP_DAC_OVERRIDE, CAP_DAC_READ_SEARCH
    assert libc.capset(head, fewer) == 0
    try:
        yield
    finally:
        assert libc.capset(head, before) == 0


def test_an_input_that_may_not_be_read_is_one_clear_line(alone, limbfit):
    (alone / "1.csv").chmod(0)
    with without_rights():
        code, _, err = limbfit("status", alone)
    assert code == 2
    assert err == f"error: {alone / '1.csv'}: no permission to read or write it; check its owner and mode\n"


def test_a_study_that_another_user_runs_counts_as_held(alone):
    (alone / "results").mkdir()
    with lock(alone / "results"):
        (alone / "results" / LOCK).chmod(0o400)
        with without_rights():
            assert is_held(alone / "results")


def test_a_folder_that_cannot_be_written_is_one_clear_line(alone):
    (alone / "results").mkdir(mode=0o500)
    with without_rights(), pytest.raises(RunError, match="no permission to write"):
        run_study(load_study(alone), until="traces")


def test_a_batch_lists_failures_and_does_the_rest(alone, tmp_path):
    broken = shutil.copytree(alone, tmp_path / "broken")
    (broken / "1.csv").write_text("nothing\n")
    paths = [alone, broken, tmp_path / "missing"]
    rows = list(run_batch(paths, until="traces", workers=1))
    assert [row["state"] for row in rows] == ["done", "failed", "failed"]
    assert rows[0]["error"] is None
    assert "no such study" in rows[2]["error"]
    assert all("\n" not in row["error"] for row in rows[1:])


@pytest.mark.slow
def test_forty_studies_leave_no_growth_in_the_parent(alone, tmp_path):
    paths = [shutil.copytree(alone, tmp_path / f"s{i}") for i in range(40)]
    sizes = []
    for row in run_batch(paths, until="traces", workers=2):
        assert row["state"] == "done", row
        sizes.append(psutil.Process().memory_info().rss / 1e6)
    assert sizes[-1] - sizes[9] < 20.0, sizes


def run_cli(*words: str, limit_bytes: int | None = None, **more) -> subprocess.CompletedProcess:
    def limit() -> None:
        if limit_bytes is not None:
            signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
            resource.setrlimit(resource.RLIMIT_FSIZE, (limit_bytes, limit_bytes))

    command = [sys.executable, "-m", "limbfit", *words]
    return subprocess.run(
        command, capture_output=True, text=True, preexec_fn=limit, timeout=600, check=False, **more
    )


@pytest.mark.slow
def test_no_room_for_a_file_is_one_clear_line_and_the_run_goes_on_later(alone):
    done = run_cli("run", str(alone), "--until", "traces", limit_bytes=1500)
    assert done.returncode == 1
    assert "written" in done.stderr.splitlines()[-1]
    assert "internal error" not in done.stderr
    assert "Traceback" not in done.stderr
    run_study(load_study(alone), until="traces")
    assert rows_of(alone)["traces"]["state"] == "done"


MOUNTS = {
    "full at once": "mount -t tmpfs -o size=20k tmpfs {0}/results",
    "full later": "mount -t tmpfs -o size=340k tmpfs {0}/results",
    "read-only": "mount --bind {0} {0} && mount -o remount,ro,bind {0}",
}


@pytest.mark.slow
@pytest.mark.parametrize("how", MOUNTS)
def test_a_full_and_a_read_only_disk_are_one_clear_line(alone, how):
    """On real file systems, in a name space of their own."""
    if shutil.which("unshare") is None or subprocess.run(["unshare", "-rm", "true"], check=False).returncode:
        pytest.skip("no name spaces for mounts here")
    (alone / "results").mkdir()
    run = f"{sys.executable} -m limbfit run {alone} --until traces"
    script = f"{MOUNTS[how].format(alone)} && {run}"
    done = subprocess.run(
        ["unshare", "-rm", "sh", "-c", script], capture_output=True, text=True, timeout=600, check=False
    )
    *progress, last = done.stderr.splitlines()
    assert done.returncode == 1
    assert last.startswith("error: ")
    assert re.search("disk is full|file system is read-only", last), last
    assert all(re.match(r"\[ *[\d.]+ s\] ", line) for line in progress), progress
    run_study(load_study(alone), until="traces")


def test_the_self_test_knows_its_answer():
    found, wanted = compress_test_cube(1e-4)
    assert found == pytest.approx(wanted, rel=1e-3)
    right = judge_self_test(found, wanted, seconds=3600.0)  # a compiler may take its time
    assert (right.state, right.remedy) == ("ok", "")
    for wrong in (1.01 * wanted, 0.0, float("nan")):
        judged = judge_self_test(wrong, wanted, seconds=1.0)
        assert judged.state == "failed"
        assert judged.remedy


@pytest.mark.slow
def test_doctor_says_what_there_is_and_what_cannot_be_written(tmp_path, monkeypatch):
    monkeypatch.setenv("PATH", str(tmp_path))  # neither browser nor FEBio there
    monkeypatch.delenv("FEBIO_CMD", raising=False)
    found = diagnose(tmp_path)
    remedies = {row["check"]: row["remedy"] for row in found["checks"]}
    assert "copy report.html" in remedies["browser"]
    assert "FEBIO_CMD" in remedies["FEBio"]
    assert found["healthy"], found
    assert {"cores", "memory", "sparse solvers", "mesher MMG", "self-test"} <= {
        row["check"] for row in found["checks"]
    }
    worse = diagnose(tmp_path / "missing")
    assert not worse["healthy"]
    (bad,) = [row for row in worse["checks"] if row["state"] == "failed"]
    assert bad["check"] == "write access"
    assert bad["remedy"]


SOLVER = """
import contextlib, sys, time
from limbfit.cli.console import prompt_interrupt
from limbfit.execution import ProcessExecutor
with prompt_interrupt(), contextlib.ExitStack() as stack:
    if sys.argv[1] == "slow":  # to clear up, once it has heard
        stack.callback(time.sleep, 4)
    with ProcessExecutor(2) as executor:
        list(executor.map(time.sleep, [0, 0], keys=["a", "b"]))
        if sys.argv[1] == "deaf":  # a library that does not come back
            import signal
            signal.signal(signal.SIGINT, lambda *_: None)
        print("at work", flush=True)
        list(executor.map(time.sleep, [60, 60], keys=["a", "b"]))
"""


@pytest.mark.parametrize("how", ["slow", "deaf"])
def test_an_interrupt_ends_a_run_soon_even_where_nobody_listens(how):
    run = subprocess.Popen(
        [sys.executable, "-c", SOLVER, how], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    assert run.stdout.readline() == "at work\n"
    run.send_signal(signal.SIGINT)
    _, errors = run.communicate(timeout=30)
    assert run.returncode != 0
    if how != "deaf":
        assert "KeyboardInterrupt" in errors, errors
    else:
        assert run.returncode == 130
        assert "run the same command again to continue" in errors, errors


def test_a_lent_executor_takes_the_limits_of_whoever_uses_it():
    with SerialExecutor() as executor, share_executor(executor):
        make_executor(limits=Limits(time_s=7.0))
        assert executor.limits.time_s == 7.0
