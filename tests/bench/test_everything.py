"""The matrix of limbs and commands: how a cell ended, its limit, and that it goes on after a kill."""

import importlib.util
import json
import sys
from dataclasses import asdict
from pathlib import Path

import psutil
import pytest

SCRIPT = Path(__file__).parents[2] / "benchmarks" / "everything.py"
SPEC = importlib.util.spec_from_file_location("everything", SCRIPT)
everything = importlib.util.module_from_spec(SPEC)
sys.modules["everything"] = everything
SPEC.loader.exec_module(everything)


@pytest.mark.parametrize(
    ("code", "user_s", "errors", "outcome"),
    [
        (0, 500.0, "", "ok"),
        (2, 3.0, "limbfit: no tibia", "refused"),
        (2, 31.0, "limbfit: no tibia", "late"),
        (1, 3.0, "limbfit: stopped", "failed"),
        (0, 3.0, "Traceback (most recent call last):\nKeyError", "failed"),
        (-9, 3.0, "", "failed"),
        (None, 600.0, "", "over"),
    ],
)
def test_an_ending_has_one_outcome(code, user_s, errors, outcome):
    assert everything.classify_ending(everything.Ending(code, user_s, user_s, 1.0), errors) == outcome
    assert (outcome in everything.RED) == (outcome in ("late", "failed"))


def test_the_limit_ends_a_command_and_what_it_started(tmp_path):
    child = "import os, time; print(os.getpid(), flush=True)\nwhile True: pass"
    parent = f"import subprocess, sys; subprocess.run([sys.executable, '-c', {child!r}])"
    with (tmp_path / "log").open("w") as log:
        ending = everything.run_process((sys.executable, "-c", parent), log, 0.4)
    assert ending.code is None  # by processor time, or on a busy machine by the wall
    assert ending.user_s > 0
    assert ending.memory_MB > 5
    pid = int((tmp_path / "log").read_text())
    assert not psutil.pid_exists(pid) or psutil.Process(pid).status() == psutil.STATUS_ZOMBIE


def test_finished_cells_are_not_run_again_but_those_asked_for(tmp_path):
    def store(outcome: str) -> None:
        cell = everything.Cell("calf", "check", outcome, 1.0, 1.0, 100.0, "said")
        with (tmp_path / "cells.jsonl").open("a") as file:
            file.write(json.dumps(asdict(cell)) + "\n")

    store("failed")
    found = everything.Matrix(tmp_path, tmp_path, 600.0)
    assert found.is_due(("calf", "run"), ())
    assert not found.is_due(("calf", "check"), ())
    assert found.is_due(("calf", "check"), everything.RED)
    store("ok")
    assert not everything.Matrix(tmp_path, tmp_path, 600.0).is_due(("calf", "check"), everything.RED)


def test_a_command_that_does_not_exist_is_refused_in_its_own_words(tmp_path):
    matrix = everything.Matrix(tmp_path, tmp_path, 600.0)
    cell = matrix.run("calf", "check")  # no such study
    assert (cell.outcome, len(matrix.cells)) == ("refused", 1)
    assert "study" in cell.line
    assert cell.user_s > 0
    assert not everything.Matrix(tmp_path, tmp_path, 600.0).is_due(cell.key, ())
