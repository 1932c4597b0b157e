"""A real Dask cluster of local processes: the same answers, threads pinned, workers that are killed."""

from __future__ import annotations

import os
import signal
import threading
import time

import numpy as np
import pytest

from limbfit.errors import InputError, TraceError
from limbfit.execution import THREAD_VARIABLES, DaskExecutor, Limits, SerialExecutor
from test_execution import die, nap, refuse, solve, threads, told

distributed = pytest.importorskip("distributed")


@pytest.fixture(scope="module")
def cluster():
    with DaskExecutor.queued("local", 2, Limits(time_s=8.0)) as executor:
        yield executor


def nannies(executor) -> list[int]:
    """Process ids of the workers that Dask's nannies watch over."""
    return list(executor._client.run(os.getpid).values())


@pytest.mark.slow
def test_the_same_answers_in_order_with_threads_pinned(cluster):
    with SerialExecutor() as serial:
        wanted = list(serial.map(solve, range(8)))
    found = list(cluster.map(solve, range(8), keys=[str(i % 3) for i in range(8)], lost=told))
    assert all(np.array_equal(a, b) for a, b in zip(wanted, found, strict=True))
    assert next(cluster.map(threads, [0])) == ["1"] * len(THREAD_VARIABLES)
    assert cluster.workers == 2


@pytest.mark.slow
def test_bad_input_and_lost_jobs_come_back_in_words(cluster):
    with pytest.raises(TraceError, match="row 3"):
        list(cluster.map(refuse, range(4)))
    (answer,) = cluster.map(die, [0], lost=told)
    assert answer.startswith("0: a worker process died")
    hung, quick = cluster.map(nap, [600, 0], lost=told)
    assert "time_limit_s = 8 s" in hung
    assert isinstance(quick, int)


@pytest.mark.slow
def test_killed_workers_change_nothing():
    """Three workers, of which three are killed while 60 jobs run."""
    stop = threading.Event()
    with DaskExecutor.queued("local", 3) as executor:
        list(executor.map(solve, range(3)))
        killed = []

        def murder() -> None:
            while len(killed) < 3 and not stop.wait(6.0):
                victim = nannies(executor)[0]
                os.kill(victim, signal.SIGKILL)
                killed.append(victim)

        thread = threading.Thread(target=murder, daemon=True)
        thread.start()
        found = list(executor.map(solve_slowly, range(60), lost=told))
        stop.set()
        thread.join(10)
    assert killed
    assert all(np.array_equal(a, solve(i)) for i, a in enumerate(found))


def solve_slowly(seed):
    time.sleep(1.0)
    return solve(seed)


def test_a_scheduler_or_queue_that_is_not_there_is_one_clear_line():
    with pytest.raises(InputError, match=r"--dask: no batch system is named 'slurmy'; use slurm, .*local"):
        DaskExecutor.queued("slurmy", 2)
    with pytest.raises(InputError, match="--scheduler: no Dask scheduler answers"):
        DaskExecutor.at("nonsense://127.0.0.1:1")
