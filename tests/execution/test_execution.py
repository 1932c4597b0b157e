"""Executors: same answers from all of them, and workers that fail, die, keep state and stop."""

import os
import signal
import subprocess
import sys
import textwrap
import time
from pathlib import Path

import numpy as np
import pytest

from limbfit.errors import InputError, RunError, TraceError
from limbfit.execution import (
    THREAD_VARIABLES,
    Limits,
    Placement,
    ProcessExecutor,
    SerialExecutor,
    count_usable_cores,
    make_executor,
    place_jobs,
    report_progress,
    run_in_background,
    share_executor,
)


def square(x):
    return x * x


def solve(seed):
    rng = np.random.default_rng(seed)
    matrix = rng.standard_normal((80, 80))
    return np.linalg.solve(matrix, rng.standard_normal(80))


def nap(seconds):
    time.sleep(seconds)
    return os.getpid()


def pid(_):
    return os.getpid()


def threads(_):
    return [os.environ.get(name) for name in THREAD_VARIABLES]


def refuse(x):
    if x == 2:
        raise TraceError("not finite", file="a.csv", place="row 3", remedy="remove it")
    return x


def unpicklable(_):
    return lambda: 1


def is_first_call(marker):
    """True once for each file."""
    first = not Path(marker).exists()
    Path(marker).touch()
    return first


def die_once(marker):
    if is_first_call(marker):
        os.kill(os.getpid(), signal.SIGKILL)
    return "alive"


def die(_):
    os.kill(os.getpid(), signal.SIGKILL)


@pytest.fixture(scope="module")
def pool():
    with ProcessExecutor(2) as executor:
        yield executor


def test_every_executor_gives_the_same_answers_in_order(pool):
    jobs = list(range(12))
    with SerialExecutor() as serial, ProcessExecutor(1) as single:
        answers = [list(e.map(solve, jobs)) for e in (serial, single, pool)]
    for other in answers[1:]:
        assert all(np.array_equal(a, b) for a, b in zip(answers[0], other, strict=True))


def test_order_is_kept_where_the_first_job_is_the_slowest(pool):
    assert list(pool.map(square, range(5))) == [0, 1, 4, 9, 16]
    slow, *fast = pool.map(nap, [0.4, 0.0, 0.0, 0.0])
    assert slow not in fast


def test_workers_persist_and_keep_their_keys(pool):
    keys = ["a", "b", "c", "d"]
    first = dict(zip(keys, pool.map(nap, [0.05] * 4, keys=keys)))
    second = dict(zip(keys[::-1], pool.map(nap, [0.1, 0.05, 0.0, 0.05], keys=keys[::-1])))
    assert first == second
    assert len(set(first.values())) == 2
    assert os.getpid() not in first.values()


def count(to):
    for i in range(to):
        report_progress([i + 1, f"{i + 1} of {to}"])
    time.sleep(0.2)  # words on their way across a cluster come in before the answer
    return to


def heard(executor, jobs):
    """What jobs report, by job, in its order, and their answers."""
    said = {job: [] for job in jobs}
    answers = list(executor.map(count, jobs, on_report=lambda job, message: said[job].append(tuple(message))))
    return said, answers


@pytest.mark.parametrize("executor", ["pool", "serial"])
def test_what_a_job_reports_is_told_with_the_job(executor, pool):
    said, answers = heard(pool if executor == "pool" else SerialExecutor(), [3, 0, 2])
    assert said == {
        3: [(1, "1 of 3"), (2, "2 of 3"), (3, "3 of 3")],
        0: [],
        2: [(1, "1 of 2"), (2, "2 of 2")],
    }
    assert answers == [3, 0, 2]
    assert list(pool.map(count, [2])) == [2]  # nobody listens


def test_a_listener_that_breaks_off_leaves_no_job_behind(pool):
    def stop(job, message):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        list(pool.map(count, [1, 600], on_report=stop))
    assert list(pool.map(square, [3, 4])) == [9, 16]


def test_jobs_side_by_side_share_the_workers_threads(pool):
    assert [pool.threads_for(jobs) for jobs in (1, 2, 5)] == [2, 1, 1]
    assert ProcessExecutor(8).threads_for(2) == 4
    assert SerialExecutor().threads_for(2) == count_usable_cores()


def test_work_goes_on_meanwhile():
    with run_in_background(pid, None) as wait:
        other = wait()
        assert other != os.getpid()
        assert wait() == other  # asked again, not done again


def test_failures_and_deaths_of_what_is_done_meanwhile_are_raised_where_it_is_waited_for():
    with run_in_background(refuse, 2) as wait, pytest.raises(TraceError):
        wait()
    with run_in_background(die, None) as wait, pytest.raises(RunError, match="died"):
        wait()


def test_what_nobody_waits_for_is_ended():
    start = time.monotonic()
    with run_in_background(nap, 60.0):
        pass
    assert time.monotonic() - start < 20.0


def test_threads_are_pinned_in_workers_and_nowhere_else(pool, monkeypatch):
    monkeypatch.setenv("OMP_NUM_THREADS", "7")
    with ProcessExecutor(1, threads=3) as executor:
        assert next(executor.map(threads, [0])) == ["3"] * len(THREAD_VARIABLES)
    assert next(pool.map(threads, [0])) == ["1"] * len(THREAD_VARIABLES)
    assert os.environ["OMP_NUM_THREADS"] == "7"


def test_bad_input_passes_through_unharmed(pool):
    answers = pool.map(refuse, range(6))
    assert [next(answers), next(answers)] == [0, 1]
    with pytest.raises(TraceError) as caught:
        next(answers)
    assert (caught.value.place, caught.value.remedy) == ("row 3", "remove it")
    assert "in refuse" in str(caught.value.__cause__)
    assert list(pool.map(square, [3])) == [9]


def test_an_answer_that_cannot_travel_is_an_error_not_a_death(pool):
    with pytest.raises(RunError, match="pickle"):
        list(pool.map(unpicklable, [0]))


def test_jobs_can_each_have_a_new_process():
    with ProcessExecutor(1, renew=True) as own:
        assert len(set(own.map(pid, range(3)))) == 3


def test_a_dead_worker_costs_one_retry(pool, tmp_path):
    jobs = [str(tmp_path / f"died-{k}") for k in range(3)]
    assert list(pool.map(die_once, jobs)) == ["alive"] * 3


def test_a_worker_that_dies_while_idle_is_replaced(pool):
    victim = next(pool.map(pid, [0], keys=["x"]))
    os.kill(victim, signal.SIGKILL)
    time.sleep(0.2)
    assert next(pool.map(pid, [0], keys=["x"])) != victim


def test_an_interrupt_at_the_terminal_is_left_to_the_parent(pool):
    worker = next(pool.map(pid, [0], keys=["y"]))
    os.kill(worker, signal.SIGINT)
    time.sleep(0.2)
    assert next(pool.map(pid, [0], keys=["y"])) == worker


def test_a_job_that_kills_every_worker_is_named(pool):
    with pytest.raises(RunError, match="die of 'site-4'"):
        list(pool.map(die, [0], keys=["site-4"]))
    assert list(pool.map(square, [3, 4])) == [9, 16]


def test_abandoned_answers_do_not_reach_the_next_map(pool):
    answers = pool.map(nap, [0.0, 0.3, 0.3])
    next(answers)
    answers.close()
    assert list(pool.map(square, range(4))) == [0, 1, 4, 9]


def test_two_maps_at_once_are_refused(pool):
    first = pool.map(square, range(3))
    next(first)
    with pytest.raises(RuntimeError, match="already mapping"):
        next(pool.map(square, range(3)))
    assert list(first) == [1, 4]


def test_leaving_on_an_error_stops_busy_workers_at_once():
    start = time.monotonic()
    executor = ProcessExecutor(1)
    answers = executor.map(nap, [0.0, 60.0])
    worker = next(answers)
    executor.__exit__(KeyError, KeyError(), None)
    assert time.monotonic() - start < 10
    with pytest.raises(ProcessLookupError):
        os.kill(worker, 0)


def test_keys_must_match_jobs(pool):
    for executor in (SerialExecutor(), pool):
        with pytest.raises(ValueError, match="1 keys for 2 jobs"):
            executor.map(square, [1, 2], keys=["a"])


def test_the_number_of_workers_is_the_users_or_the_machines():
    assert isinstance(make_executor(1), SerialExecutor)
    assert make_executor(3).workers == 3
    assert make_executor(0).workers == count_usable_cores()


def assert_group_ends(group, within_s=5.0):
    deadline = time.monotonic() + within_s
    while time.monotonic() < deadline:
        try:
            os.killpg(group, 0)
        except ProcessLookupError:
            return
        time.sleep(0.05)
    os.killpg(group, signal.SIGKILL)
    pytest.fail("a worker survived its parent")


SCRIPT = """
import math
from limbfit.execution import ProcessExecutor
print("started")
with ProcessExecutor(1) as executor:
    print(list(executor.map(math.sqrt, [1, 4, 9])))
"""


def test_an_unguarded_script_runs_once(tmp_path):
    script = tmp_path / "script.py"
    script.write_text(SCRIPT)
    for command in ([str(script)], ["-c", SCRIPT]):
        done = subprocess.run([sys.executable, *command], capture_output=True, text=True, timeout=60)
        assert done.stdout.split("\n")[:2] == ["started", "[1.0, 2.0, 3.0]"], done.stderr


def test_ctrl_c_ends_the_run_and_its_workers_quietly(tmp_path):
    script = textwrap.dedent(
        """
        import os, time
        from limbfit.execution import ProcessExecutor
        with ProcessExecutor(2) as executor:
            print(*executor.map(os.getenv, ["HOME", "HOME"], keys=["a", "b"]), flush=True)
            list(executor.map(time.sleep, [60, 60], keys=["a", "b"]))
        """
    )
    run = subprocess.Popen(
        [sys.executable, "-c", script],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    run.stdout.readline()
    time.sleep(0.3)
    os.killpg(run.pid, signal.SIGINT)
    _, errors = run.communicate(timeout=60)
    assert errors.count("Traceback") == 1
    assert "KeyboardInterrupt" in errors
    assert_group_ends(run.pid)


def test_workers_do_not_outlive_a_killed_parent():
    script = (
        "import time\nfrom limbfit.execution import ProcessExecutor\n"
        "e = ProcessExecutor(1)\nprint(*e.map(time.sleep, [0]), flush=True)\nlist(e.map(time.sleep, [60]))"
    )
    run = subprocess.Popen(
        [sys.executable, "-c", script], stdout=subprocess.PIPE, text=True, start_new_session=True
    )
    run.stdout.readline()
    time.sleep(0.2)
    run.kill()
    run.wait()
    assert_group_ends(run.pid)


def hang_once(marker):
    if is_first_call(marker):
        time.sleep(600)
    return "alive"


def swell(megabytes):
    kept = np.ones(megabytes * 125_000)
    time.sleep(600 if megabytes > 1000 else 0)
    return float(kept[0])


def told(job, reason):
    return f"{Path(str(job)).name}: {reason}"


@pytest.mark.slow
def test_a_hung_worker_costs_one_retry_and_twice_is_lost_with_the_reason(tmp_path):
    with ProcessExecutor(2, limits=Limits(time_s=20.0)) as executor:
        answers = list(executor.map(hang_once, [str(tmp_path / "x")], on_lost=told))
    assert answers == ["alive"]
    with ProcessExecutor(1, limits=Limits(time_s=0.1)) as executor:
        first, second = executor.map(nap, [600, 601], on_lost=told)
    assert first == "600: it took longer than execution.time_limit_s = 0.1 s, twice"
    assert second.startswith("601: ")


def test_a_worker_over_its_memory_is_ended_and_the_others_go_on():
    with ProcessExecutor(2, limits=Limits(memory_GB=0.8)) as executor:
        answers = list(executor.map(swell, [1, 1100, 2], on_lost=told))
    assert answers[::2] == [1.0, 1.0]
    assert answers[1] == "1100: it needed more than execution.memory_limit_GB = 0.8 GB, twice"


def test_a_job_that_kills_every_worker_can_be_a_failure_instead_of_an_end(pool):
    assert list(pool.map(die, [0], on_lost=told)) == [
        "0: a worker process died: out of memory, killed or crashed, twice"
    ]


def test_limits_are_for_jobs_that_can_be_lost():
    with ProcessExecutor(1, limits=Limits(time_s=0.01)) as executor:
        assert list(executor.map(square, [3])) == [9]


def test_code_that_lies_where_a_run_is_started_is_not_run(tmp_path, monkeypatch):
    (tmp_path / "pickle.py").write_text("import os; os._exit(3)")
    monkeypatch.chdir(tmp_path)
    with ProcessExecutor(1) as executor:
        assert list(executor.map(square, [3])) == [9]


def test_placement_and_sharing_decide_the_executor(pool):
    with place_jobs(Placement(workers=1)):
        assert isinstance(make_executor(3), SerialExecutor)
    with share_executor(pool):
        with make_executor(1) as lent:
            assert lent.workers == 2
        assert list(make_executor().map(square, [2])) == [4]  # still runs
    assert make_executor(3).workers == 3
    with pytest.raises(InputError, match="--scheduler"):
        Placement(workers=2, scheduler="tcp://127.0.0.1:1")
