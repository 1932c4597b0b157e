"""Kill -9 of a whole run at random moments: the next run ends the same, and does nothing twice."""

import csv
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import psutil
import pytest

from conftest import COARSE
from editing import append
from limbfit import load_study
from limbfit.mesh import read_vtu
from limbfit.pipeline.commands.run import list_stages

READERS = {
    ".json": lambda file: json.loads(file.read_text()),
    ".npz": lambda file: [array.shape for array in np.load(file).values()],
    ".vtu": read_vtu,
    ".csv": lambda file: np.array(list(csv.reader(file.open(encoding="utf-8")))),  # rows of one length
}
SAME = ("sites/sites.json", "traces/*.csv", "mesh/*.vtu", "calibrate/calibration.json", "predict/*.csv")


def begin(folder: Path, workers: int) -> subprocess.Popen:
    return subprocess.Popen(
        [sys.executable, "-m", "limbfit", "run", str(folder), "--workers", str(workers)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        process_group=0,
        env={**os.environ, "OMP_NUM_THREADS": "1", "NUMBA_NUM_THREADS": "1"},
    )


def finish(folder: Path, workers: int) -> int:
    """Run a study to its end; how many lines it said."""
    run = begin(folder, workers)
    _, err = run.communicate(timeout=1200)
    assert run.returncode == 0, err
    return len(err.splitlines())


def finished(results: Path) -> dict[str, str]:
    """When each stage that stands in its place was done."""
    stages = [stage.name for stage in list_stages(load_study(results.parent))]
    files = {stage: results / stage / "stage.json" for stage in stages}
    return {stage: file.read_text() for stage, file in files.items() if file.is_file()}


def kept(results: Path) -> dict[tuple[str, str], int]:
    """When each kept simulation was written, by its stage and name, wherever it lies now."""
    found = {}
    for file in [*results.glob("*/runs/*.npz"), *results.glob(".work-*/runs/*.npz")]:
        stage = file.parent.parent.name.removeprefix(".work-").split("-")[0]
        found[stage, file.name] = file.stat().st_mtime_ns
    return found


def assert_whole(results: Path) -> None:
    """Every file of every finished stage can be read."""
    for stage in finished(results):
        for file in (results / stage).rglob("*"):
            if file.suffix in READERS and not file.name.startswith("."):
                READERS[file.suffix](file)


def group_is_empty(group: int, within_s: float = 5.0) -> bool:
    """Whether all processes of a killed run are gone soon: workers and meshers too."""
    until = time.monotonic() + within_s
    while time.monotonic() < until:
        alive = [p for p in psutil.process_iter() if _group_of(p.pid) == group and p.status() != "zombie"]
        if not alive:
            return True
        time.sleep(0.1)
    return False


def _group_of(pid: int) -> int | None:
    try:
        return os.getpgid(pid)
    except ProcessLookupError:
        return None


def killed(folder: Path, after_lines: int, and_s: float, workers: int) -> str:
    """Start a run and kill its main process so long after it said so much; what was under way."""
    run = begin(folder, workers)
    for _ in range(after_lines):
        run.stderr.readline()
    time.sleep(and_s)
    run.send_signal(signal.SIGKILL)
    run.communicate()
    assert group_is_empty(run.pid)
    done = finished(folder / "results")
    stages = [stage.name for stage in list_stages(load_study(folder))]
    return next((stage for stage in stages[1:] if stage not in done), "done")


@pytest.mark.slow
def test_a_run_killed_at_random_moments_ends_the_same(study, tmp_path):
    append(study, COARSE)
    straight = shutil.copytree(study, tmp_path / "straight")
    lines, random = finish(straight, 1), np.random.default_rng(7)
    for i in range(30):
        after, and_s = int(random.integers(lines)), float(random.uniform(0.0, 1.0))
        folder, workers = shutil.copytree(study, tmp_path / f"killed-{i}"), 1 + i % 2
        results = folder / "results"
        where = killed(folder, after, and_s, workers)
        print(f"kill {i}: after line {after} of {lines}, {workers} worker(s): {where}", flush=True)
        assert_whole(results)
        stages, simulations = finished(results), kept(results)
        finish(folder, workers)
        assert_whole(results)
        now, again = finished(results), kept(results)
        assert all(now[stage] == stamp for stage, stamp in stages.items())
        assert all(again[name] == written for name, written in simulations.items())
        for pattern in SAME:
            for one in straight.glob(f"results/{pattern}"):
                assert (results / one.relative_to(straight / "results")).read_bytes() == one.read_bytes(), one
        names = [p.name for p in results.rglob(".*") if p.name not in (".lock", ".holder")]
        assert not names, names
        shutil.rmtree(folder)


@pytest.mark.slow
@pytest.mark.parametrize("workers", [1, 2])
@pytest.mark.parametrize("at", ["mesh 0/2", "evaluation 2"])
def test_an_interrupt_ends_the_run_with_its_workers_and_meshers(study, workers, at):
    append(study, COARSE)
    run = begin(study, workers)
    while at not in (line := run.stderr.readline()):
        assert line, "the run ended before"
    time.sleep(0.5)
    os.killpg(run.pid, signal.SIGINT)
    start = time.monotonic()
    _, err = run.communicate(timeout=60)
    assert run.returncode == 130
    assert "run the same command again to continue" in err.splitlines()[-1]
    assert group_is_empty(run.pid)
    print(
        f"{at}, {workers} worker(s): ended {time.monotonic() - start:.1f} s after the interrupt", flush=True
    )
    assert_whole(study / "results")
