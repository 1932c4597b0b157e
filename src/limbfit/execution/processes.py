"""The interface of every executor, and those of this machine: in this process, or in worker processes."""

from __future__ import annotations

import multiprocessing
import os
import signal
import sys
import threading
import time
import traceback
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Mapping, MutableMapping, Sequence
from contextlib import AbstractContextManager, contextmanager, suppress
from contextvars import ContextVar
from dataclasses import dataclass
from functools import partial
from multiprocessing.connection import Connection, wait
from types import ModuleType, TracebackType
from typing import Any, Self, TypeVar

import psutil

from ..errors import RunError

Job = TypeVar("Job")
Answer = TypeVar("Answer")
Setting = TypeVar("Setting")

# Read by the numerical libraries when they load: hence set before a worker starts, not in it.
THREAD_VARIABLES = (
    "OMP_NUM_THREADS",
    "MKL_NUM_THREADS",
    "OPENBLAS_NUM_THREADS",
    "NUMBA_NUM_THREADS",
    "VECLIB_MAXIMUM_THREADS",
    "ITK_GLOBAL_DEFAULT_NUMBER_OF_THREADS",
)

# For a Python that starts: it would import a ``pickle.py`` of the folder it is started in.
SAFE_PATH = {"PYTHONSAFEPATH": "1"}


@dataclass(frozen=True)
class Limits:
    """The limits of one job: wall time in s and resident memory in GB (10^9 bytes); 0 means no limit."""

    time_s: float = 0.0
    memory_GB: float = 0.0


NO_LIMITS = Limits()

_cores: ContextVar[int | None] = ContextVar("_cores", default=None)
_listener: ContextVar[Callable[[Any], None] | None] = ContextVar("_listener", default=None)


def report_progress(message: Any) -> None:
    """Report from within a job to the ``on_report`` of its caller: anything plain enough for JSON."""
    listener = _listener.get()
    if listener is not None:
        listener(message)


@contextmanager
def set_in_block(variable: ContextVar[Setting], value: Setting) -> Iterator[None]:
    """Give a variable another value in this block."""
    token = variable.set(value)
    try:
        yield
    finally:
        variable.reset(token)


@dataclass(frozen=True)
class Batch:
    """One call of `Executor.map`: the jobs as a list, and the key of each; None if it has none."""

    function: Callable
    jobs: list
    keys: Sequence[str | None]
    on_lost: Callable | None
    on_report: Callable | None


class Executor(ABC):
    """Runs a function over jobs; use it as a context, which ends its workers."""

    limits: Limits = NO_LIMITS

    @property
    @abstractmethod
    def workers(self) -> int:
        """The number of jobs that it does at a time."""

    @abstractmethod
    def threads_for(self, jobs: int) -> int:
        """Return how many threads each of so many jobs may have, so that no worker is idle beside them."""

    def map(
        self,
        function: Callable[[Job], Answer],
        jobs: Iterable[Job],
        keys: Sequence[str | None] | None = None,
        on_lost: Callable[[Job, str], Answer] | None = None,
        on_report: Callable[[Job, Any], None] | None = None,
    ) -> Iterator[Answer]:
        """Yield answers in the order of ``jobs``, as they are asked for.

        Jobs of one key go to one worker, over all calls, so that it can use again what it keeps (meshes,
        states). A new key goes to the first worker that is free. An exception of a job is raised where its
        answer would come, and ends the call.

        Raises `RunError` if a worker died twice on the same job, and ``on_lost`` is not given.

        ``on_lost``: makes the answer of a job that was lost twice, from the job and the reason in words: its
        worker died, or it exceeded the executor's limits. Without it nothing limits the jobs. ``on_report``:
        called with a job and what it reports by `report_progress`, while answers are waited for.
        """
        listed = list(jobs)
        if keys is not None and len(keys) != len(listed):
            raise ValueError(f"{len(keys)} keys for {len(listed)} jobs")
        every = [None] * len(listed) if keys is None else keys
        return self._run_jobs(Batch(function, listed, every, on_lost, on_report))

    @abstractmethod
    def _run_jobs(self, batch: Batch) -> Iterator[Any]:
        """Yield the answers of `map`."""

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.end(at_once=error is not None)

    def end(self, at_once: bool) -> None:  # noqa: B027
        """End the workers, ``at_once`` in the middle of their jobs; nothing to do where there are none."""


def count_usable_cores() -> int:
    """Return how many cores this process may use; a batch system, or `limit_cores`, can allow fewer."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return min(cores, _cores.get() or cores)


def limit_cores(count: int) -> AbstractContextManager[None]:
    """Let what this block runs use no more cores, since others like it run beside it."""
    return set_in_block(_cores, count)


class SerialExecutor(Executor):
    """Runs jobs one after the other in this process; no limit can end them."""

    workers = 1

    def threads_for(self, jobs: int) -> int:
        return count_usable_cores()

    def _run_jobs(self, batch: Batch) -> Iterator[Any]:
        def do_job(job: Any) -> Any:
            report = None if batch.on_report is None else partial(batch.on_report, job)
            with set_in_block(_listener, report):
                return batch.function(job)

        return map(do_job, batch.jobs)


MAX_TRIES = 2
_POLL_S = 0.25  # between two looks at what jobs take
_WORKER_DIED = "a worker process died: out of memory, killed or crashed"


class ProcessExecutor(Executor):
    """Worker processes that live as long as the executor, each with ``threads`` threads.

    They start when first needed, and never run the caller's script again, guarded or not. A worker that dies
    (killed, out of memory, crashed) or exceeds the ``limits`` is replaced, and its job is tried once more.
    With ``renew`` every job has a new process: what long jobs leave in memory goes with it.
    """

    def __init__(
        self, workers: int, threads: int = 1, limits: Limits = NO_LIMITS, renew: bool = False
    ) -> None:
        if workers < 1 or threads < 1:
            raise ValueError("workers and threads must be at least 1")
        self.threads, self.limits, self.renew = threads, limits, renew
        self._seats: list[Worker | None] = [None] * workers
        self._seat_of_key: dict[str, int] = {}
        self._mapping = False

    @property
    def workers(self) -> int:
        return len(self._seats)

    def threads_for(self, jobs: int) -> int:
        return max(self.workers * self.threads // max(jobs, 1), self.threads)

    def _run_jobs(self, batch: Batch) -> Iterator[Any]:
        if self._mapping:
            raise RuntimeError("the executor is already mapping: take all answers of one map before the next")
        self._mapping = True
        waiting, busy, tries = list(range(len(batch.jobs))), dict[int, int](), [0] * len(batch.jobs)
        limits = self.limits if batch.on_lost is not None else NO_LIMITS
        answers: dict[int, JobOutcome] = {}
        try:
            for index in range(len(batch.jobs)):
                while index not in answers:
                    for seat, job in self._assign_jobs(waiting, busy, batch.keys):
                        tries[job] += 1
                        busy[seat] = job
                        self._get_worker(seat).send(batch.function, batch.jobs[job])
                    for seat, outcome in self._collect(busy, limits):
                        if isinstance(outcome, JobReport):
                            if batch.on_report is not None:
                                batch.on_report(batch.jobs[busy[seat]], outcome.message)
                            continue
                        job = busy.pop(seat)
                        if isinstance(outcome, JobOutcome):
                            answers[job] = outcome
                            if self.renew:
                                self._replace(seat)
                        elif tries[job] < MAX_TRIES:
                            waiting.insert(0, job)
                        elif batch.on_lost is not None:
                            answers[job] = JobOutcome(batch.on_lost(batch.jobs[job], f"{outcome}, twice"))
                        else:
                            key = batch.keys[job]
                            name = f"number {job + 1}" if key is None else f"{key!r}"
                            what = f"a worker process died twice in {batch.function.__name__} of {name}"
                            raise RunError(f"{what}: out of memory, killed or crashed")
                yield answers.pop(index).result()
        finally:
            self._mapping = False
            for seat in busy:  # left in the middle: their answers have no reader any more
                self._replace(seat)

    def _assign_jobs(
        self, waiting: list[int], busy: dict[int, int], keys: Sequence[str | None]
    ) -> Iterator[tuple[int, int]]:
        """Take jobs that can start now from ``waiting``; yield (seat, job)."""
        for job in tuple(waiting):
            free = [seat for seat in range(self.workers) if seat not in busy]
            if not free:
                return
            key = keys[job]
            seat = free[0] if key is None else self._seat_of_key.setdefault(key, free[0])
            if seat in free:
                waiting.remove(job)
                yield seat, job

    def _collect(
        self, busy: dict[int, int], limits: Limits
    ) -> Iterator[tuple[int, JobOutcome | JobReport | str]]:
        """Wait for workers to send something; yield (seat, outcome or report), or why there will be none."""
        lines = {self._get_worker(seat).connection: seat for seat in busy}
        limited = limits.time_s or limits.memory_GB
        ready = wait(list(lines), _POLL_S if limited else None)
        for line in ready:
            seat = lines[line]  # type: ignore[index]
            outcome = self._get_worker(seat).receive()
            if outcome == READY:
                continue
            if outcome is None:
                self._replace(seat)
            yield seat, outcome or _WORKER_DIED
        for line, seat in lines.items():
            if line not in ready and (excess := self._get_worker(seat).find_exceeded_limit(limits)):
                self._replace(seat)
                yield seat, excess

    def _get_worker(self, seat: int) -> Worker:
        worker = self._seats[seat]
        if worker is None:
            worker = self._seats[seat] = Worker(self.threads)
        return worker

    def _replace(self, seat: int) -> None:
        worker, self._seats[seat] = self._seats[seat], None
        if worker is not None:
            worker.dismiss(at_once=True)
            worker.end(time.monotonic() + GRACE_S)

    def end(self, at_once: bool) -> None:
        staff, self._seats = [worker for worker in self._seats if worker], [None] * self.workers
        for worker in staff:
            worker.dismiss(at_once)
        until = time.monotonic() + GRACE_S  # for all of them together
        for worker in staff:
            worker.end(until)


GRACE_S = 2.0  # for workers to end when they are asked to
READY = "ready"  # a worker's first word: its start is not its first job's time


@dataclass(frozen=True)
class JobOutcome:
    """The outcome of a job: an answer, or an exception with the worker's traceback."""

    answer: Any = None
    error: BaseException | None = None
    trace: str = ""

    def result(self) -> Any:
        if self.error is not None:
            raise self.error from RuntimeError(f"in a worker process:\n{self.trace}")
        return self.answer


@dataclass(frozen=True)
class JobReport:
    """What a job reports while it runs."""

    message: Any


class Worker:
    """A process at the far end of a pipe."""

    def __init__(self, threads: int) -> None:
        context = multiprocessing.get_context("spawn")
        self.connection, far = context.Pipe()
        self.process = context.Process(target=serve_jobs, args=(far,), daemon=True)
        self.began: float | None = None  # its job; None before it is ready
        variables = dict.fromkeys(THREAD_VARIABLES, str(threads)) | SAFE_PATH
        # A spawned process would import the caller's main script, and so run it if it is unguarded.
        main = {"__main__": ModuleType("__main__")}
        # Dask's workers are daemons, which may have no children; these end with their parent.
        config, no_daemon = multiprocessing.current_process()._config, {"daemon": False}  # type: ignore[attr-defined]
        with (
            _replace_items(os.environ, variables),
            _replace_items(sys.modules, main),
            _replace_items(config, no_daemon),
        ):
            self.process.start()
        far.close()

    def send(self, function: Callable, job: Any) -> None:
        if self.began is not None:
            self.began = time.monotonic()
        with suppress(OSError):  # it died while idle: reading its line shows it
            self.connection.send((function, job))

    def receive(self) -> JobOutcome | JobReport | str | None:
        """Return the outcome of the job, what it reports, `READY`, or None if the process is dead."""
        try:
            message = self.connection.recv()
        except (EOFError, OSError):  # nothing more, or half a message
            return None
        if message == READY:
            self.began = time.monotonic()
        return message

    def find_exceeded_limit(self, limits: Limits) -> str:
        """Return which limit the running job exceeds, in words; empty if it is within them."""
        began = self.began
        if limits.time_s and began is not None and time.monotonic() - began > limits.time_s:
            return f"it took longer than execution.time_limit_s = {limits.time_s:g} s"
        if limits.memory_GB and self._memory_GB() > limits.memory_GB:
            return f"it needed more than execution.memory_limit_GB = {limits.memory_GB:g} GB"
        return ""

    def _memory_GB(self) -> float:
        """Return the resident memory of the process and its children (meshers)."""
        total = 0
        with suppress(psutil.Error):
            whole = psutil.Process(self.process.pid)
            for one in (whole, *whole.children(recursive=True)):
                with suppress(psutil.Error):
                    total += one.memory_info().rss
        return total / 1e9

    def dismiss(self, at_once: bool) -> None:
        """Close the connection, which ends an idle worker; ``at_once`` ends one in the middle of a job."""
        self.connection.close()
        if at_once:
            self.process.terminate()

    def end(self, until: float) -> None:
        """Wait for a dismissed worker to end until that time of the monotonic clock, then kill it."""
        self.process.join(max(until - time.monotonic(), 0.0))
        if self.process.is_alive():
            self.process.kill()
            self.process.join()
        self.process.close()


@contextmanager
def _replace_items(mapping: MutableMapping[str, Any], changes: Mapping[str, Any]) -> Iterator[None]:
    """Give some items of a mapping other values in this block."""
    before = {name: mapping[name] for name in changes if name in mapping}
    mapping.update(changes)
    try:
        yield
    finally:
        for name in changes.keys() - before.keys():
            del mapping[name]
        mapping.update(before)


def serve_jobs(connection: Connection) -> None:
    """Do jobs until the connection is closed; the terminal's Ctrl-C is handled by the parent."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_die_with_parent, daemon=True).start()
    with suppress(ConnectionError):
        connection.send(READY)
    while True:
        try:
            with set_in_block(_listener, lambda message: connection.send(JobReport(message))):
                outcome = _run_job(*connection.recv())
        except (EOFError, ConnectionError):
            return
        except Exception as error:  # a function or job that this process cannot import
            outcome = JobOutcome(error=error, trace=traceback.format_exc())
        _send_outcome(connection, outcome)


def _run_job(function: Callable, job: Any) -> JobOutcome:
    try:
        return JobOutcome(function(job))
    except MemoryError:
        os._exit(1)  # the parent tries once more in a fresh process
    except Exception as error:
        return JobOutcome(error=error, trace=traceback.format_exc())


def _send_outcome(connection: Connection, outcome: JobOutcome) -> None:
    try:
        connection.send(outcome)
    except ConnectionError:
        return
    except Exception as error:  # neither every answer nor every exception can be pickled
        what = outcome.error if outcome.error is not None else error
        text = f"{type(what).__name__}: {what}"
        connection.send(JobOutcome(error=RunError(text), trace=outcome.trace or traceback.format_exc()))


def _die_with_parent() -> None:
    """End this process with its parent: an orphan would keep a core for a job that nobody waits for."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


@contextmanager
def run_in_background(function: Callable[[Any], Any], job: Any) -> Iterator[Callable[[], Any]]:
    """Run ``function(job)`` beside the block, which gets a function that waits for the answer.

    An exception of the job is raised where it is waited for. A job that is not done when the block ends is
    ended. Raises `RunError` if the process died.
    """
    worker = Worker(threads=1)
    worker.send(function, job)
    found: list[JobOutcome] = []

    def wait() -> Any:
        while not found:
            outcome = worker.receive()
            if outcome is None:
                raise RunError(f"the process of {function.__name__} died: out of memory, killed or crashed")
            if isinstance(outcome, JobOutcome):
                found.append(outcome)
        return found[0].result()

    try:
        yield wait
    finally:
        worker.dismiss(at_once=not found)
        worker.end(time.monotonic() + GRACE_S)
