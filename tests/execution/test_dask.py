"""A real Dask cluster of local processes: the same answers, threads pinned, workers that are killed."""

import gc
import os
import shutil
import signal
import subprocess
import sys
import threading
import time

import numpy as np
import pytest
from test_execution import die, heard, nap, refuse, solve, threads, told

from conftest import COARSE
from editing import append
from limbfit import run_study
from limbfit.errors import InputError, TraceError
from limbfit.execution import THREAD_VARIABLES, DaskExecutor, Limits, SerialExecutor
from limbfit.study import load_study

distributed = pytest.importorskip("distributed")


@pytest.fixture(scope="module")
def cluster():
    with DaskExecutor.from_queue("local", 2, Limits(time_s=8.0)) as executor:
        yield executor


def nannies(executor) -> list[int]:
    """Process ids of the workers that Dask's nannies watch over."""
    return list(executor._client.run(os.getpid).values())


@pytest.mark.slow
def test_the_same_answers_in_order_with_threads_pinned(cluster):
    with SerialExecutor() as serial:
        wanted = list(serial.map(solve, range(8)))
    found = list(cluster.map(solve, range(8), keys=[str(i % 3) for i in range(8)], on_lost=told))
    assert all(np.array_equal(a, b) for a, b in zip(wanted, found, strict=True))
    assert next(cluster.map(threads, [0])) == ["1"] * len(THREAD_VARIABLES)
    assert cluster.workers == 2


@pytest.mark.slow
def test_what_a_job_reports_comes_back_from_the_cluster(cluster):
    said, answers = heard(cluster, [3, 1, 2, 4])
    assert answers == [3, 1, 2, 4]
    assert said[3] == [(1, "1 of 3"), (2, "2 of 3"), (3, "3 of 3")]
    assert cluster.threads_for(2) == 1


@pytest.mark.slow
def test_bad_input_and_lost_jobs_come_back_in_words(cluster):
    with pytest.raises(TraceError, match="row 3"):
        list(cluster.map(refuse, range(4)))
    (answer,) = cluster.map(die, [0], on_lost=told)
    assert answer.startswith("0: a worker process died")
    hung, quick = cluster.map(nap, [600, 0], on_lost=told)
    assert "time_limit_s = 8 s" in hung
    assert isinstance(quick, int)


@pytest.mark.slow
def test_killed_workers_change_nothing():
    """Three workers, of which three are killed while 60 jobs run."""
    stop = threading.Event()
    with DaskExecutor.from_queue("local", 3) as executor:
        list(executor.map(solve, range(3)))
        killed = []

        def murder() -> None:
            while len(killed) < 3 and not stop.wait(6.0):
                victim = nannies(executor)[0]
                os.kill(victim, signal.SIGKILL)
                killed.append(victim)

        thread = threading.Thread(target=murder, daemon=True)
        thread.start()
        found = list(executor.map(solve_slowly, range(60), on_lost=told))
        stop.set()
        thread.join(10)
    assert killed
    assert all(np.array_equal(a, solve(i)) for i, a in enumerate(found))


def solve_slowly(seed):
    time.sleep(1.0)
    return solve(seed)


def test_a_scheduler_or_queue_that_is_not_there_is_one_clear_line():
    with pytest.raises(InputError, match=r"--dask: no batch system is named 'slurmy'; use slurm, .*local"):
        DaskExecutor.from_queue("slurmy", 2)
    with pytest.raises(InputError, match="--scheduler: no Dask scheduler answers"):
        DaskExecutor.connect("nonsense://127.0.0.1:1")


@pytest.mark.filterwarnings("error::pytest.PytestUnraisableExceptionWarning")
@pytest.mark.parametrize("address", ["localhost", "tcp://127.0.0.1", "tcp://127.0.0.1:8786/"])
def test_an_address_without_a_port_is_refused_at_once(address):
    begun = time.monotonic()
    with pytest.raises(InputError, match=r"--scheduler: no Dask scheduler answers .* it prints"):
        DaskExecutor.connect(address)
    gc.collect()  # the client that Dask leaves behind waited for 40 s and ended with a traceback
    assert time.monotonic() - begun < 15.0


SITES = """[[sites]]
name = "{}"
fitted = true
trace = "1.csv"
position = {}
"""


@pytest.mark.slow
def test_a_study_on_a_cluster_that_loses_a_worker_every_ten_seconds_has_the_same_bits(study, tmp_path):
    """Three workers, the study through ``--scheduler``; beside it the same study in one process."""
    more = SITES.format("3", [-40.0, 0.0, 60.0]) + SITES.format("4", [0.0, -40.0, 60.0])
    append(study, more + COARSE.replace("tet4", "tet10"))
    alone = shutil.copytree(study, tmp_path / "alone")
    run_study(load_study(alone), until="predict")
    run_study(load_study(study), until="mesh")
    lost: list[int] = []
    with distributed.LocalCluster(3, threads_per_worker=1, dashboard_address=None, memory_limit=0) as cluster:
        run = subprocess.Popen(
            [sys.executable, "-m", "limbfit", "run", str(study), "--scheduler", cluster.scheduler_address],
            stderr=subprocess.PIPE,
            text=True,
        )
        with distributed.Client(cluster, set_as_default=False) as client:
            while True:
                try:
                    _, err = run.communicate(timeout=10.0)
                    break
                except subprocess.TimeoutExpired:
                    workers = client.run(lambda dask_worker: (os.getpid(), len(dask_worker.state.executing)))
                    busy = [pid for pid, jobs in workers.values() if jobs]
                    if busy:
                        os.kill(busy[0], signal.SIGKILL)
                        lost.append(busy[0])
    assert run.returncode == 0, err
    print(f"workers killed in the middle of a job: {len(lost)}")
    assert len(lost) > 1
    for stage, name in (("calibrate", "calibration.json"), *(("predict", f"{i}.csv") for i in (1, 2, 3, 4))):
        ours, theirs = (folder / "results" / stage / name for folder in (study, alone))
        assert ours.read_bytes() == theirs.read_bytes(), name
