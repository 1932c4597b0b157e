"""One face for running jobs: in this process, or side by side in worker processes.

A job is anything that can be pickled, and the function that does it is importable; answers come back in the
order of the jobs whatever runs them, so a caller cannot tell one executor from another but by the clock.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import sys
import threading
import traceback
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from multiprocessing.connection import Connection, wait
from types import ModuleType, TracebackType
from typing import Any, Protocol, Self, TypeVar

from .errors import RunError

Job = TypeVar("Job")
Answer = TypeVar("Answer")

# Read by the numerical libraries when they load: hence set before a worker starts, not in it.
THREAD_VARIABLES = (
    "OMP_NUM_THREADS",
    "MKL_NUM_THREADS",
    "OPENBLAS_NUM_THREADS",
    "NUMBA_NUM_THREADS",
    "VECLIB_MAXIMUM_THREADS",
    "ITK_GLOBAL_DEFAULT_NUMBER_OF_THREADS",
)
_TRIES = 2
_GRACE_S = 2.0  # for a worker to end when told so


class Executor(Protocol):
    """Runs a function over jobs; use it as a context, which ends its workers."""

    workers: int

    def map(
        self, function: Callable[[Job], Answer], jobs: Iterable[Job], keys: Sequence[str] | None = None
    ) -> Iterator[Answer]:
        """Answers in the order of ``jobs``, as they are asked for.

        Jobs of one key go to one worker, over all calls, so that what it keeps (meshes, last states) serves
        again; a new key goes to the first worker that is free. An exception of a job is raised where its
        answer would come, and ends the call.

        Raises
        ------
        RunError
            Where a worker died twice on the same job.
        """
        ...

    def __enter__(self) -> Self: ...

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None: ...


def make_executor(workers: int = 0) -> Executor:
    """An executor with that many workers, one thread each; 0 means one worker per usable core.

    One worker means this process itself, with as many threads as its libraries take.
    """
    count = workers or usable_cores()
    return ProcessExecutor(count) if count > 1 else SerialExecutor()


def usable_cores() -> int:
    """Cores that this process may use, which a batch system can make fewer than the machine has."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


class SerialExecutor:
    """Runs jobs one after the other in this process."""

    workers = 1

    def map(
        self, function: Callable[[Job], Answer], jobs: Iterable[Job], keys: Sequence[str] | None = None
    ) -> Iterator[Answer]:
        listed = list(jobs)
        _check_keys(listed, keys)
        return map(function, listed)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        return None


class ProcessExecutor:
    """Worker processes that live as long as the executor, each with ``threads`` threads.

    They start when first needed, and never run the caller's script again, guarded or not. A worker that dies
    (killed, out of memory, crashed) is replaced, and its job is tried once more.
    """

    def __init__(self, workers: int, threads: int = 1) -> None:
        if workers < 1 or threads < 1:
            raise ValueError("workers and threads must be at least 1")
        self.workers, self.threads = workers, threads
        self._staff: list[_Worker | None] = [None] * workers
        self._home: dict[str, int] = {}
        self._mapping = False

    def map(
        self, function: Callable[[Job], Answer], jobs: Iterable[Job], keys: Sequence[str] | None = None
    ) -> Iterator[Answer]:
        listed = list(jobs)
        _check_keys(listed, keys)
        return self._answers(function, listed, list(keys) if keys is not None else [None] * len(listed))

    def _answers(self, function: Callable, jobs: list, keys: Sequence[str | None]) -> Iterator[Any]:
        if self._mapping:
            raise RuntimeError("the executor is already mapping: take all answers of one map before the next")
        self._mapping = True
        waiting, busy, tries = list(range(len(jobs))), dict[int, int](), [0] * len(jobs)
        answers: dict[int, _Outcome] = {}
        try:
            for index in range(len(jobs)):
                while index not in answers:
                    for seat, job in self._seat(waiting, busy, keys):
                        tries[job] += 1
                        busy[seat] = job
                        self._worker(seat).send(function, jobs[job])
                    for seat, outcome in self._collect(busy):
                        job = busy.pop(seat)
                        if outcome is not None:
                            answers[job] = outcome
                        elif tries[job] < _TRIES:
                            waiting.insert(0, job)
                        else:
                            raise RunError(_obituary(function, job, keys[job]))
                yield answers.pop(index).result()
        finally:
            self._mapping = False
            for seat in busy:  # left in the middle: their answers have no reader any more
                self._dismiss(seat)

    def _seat(
        self, waiting: list[int], busy: dict[int, int], keys: Sequence[str | None]
    ) -> Iterator[tuple[int, int]]:
        """Take jobs that can start now from ``waiting``: (worker, job)."""
        for job in tuple(waiting):
            free = [seat for seat in range(self.workers) if seat not in busy]
            if not free:
                return
            key = keys[job]
            seat = free[0] if key is None else self._home.setdefault(key, free[0])
            if seat in free:
                waiting.remove(job)
                yield seat, job

    def _collect(self, busy: dict[int, int]) -> Iterator[tuple[int, _Outcome | None]]:
        """Wait for workers to answer: (worker, outcome), or None where the worker is dead."""
        lines = {self._worker(seat).connection: seat for seat in busy}
        for line in wait(list(lines)):
            seat = lines[line]  # type: ignore[index]
            outcome = self._worker(seat).receive()
            if outcome is None:
                self._dismiss(seat)
            yield seat, outcome

    def _worker(self, seat: int) -> _Worker:
        worker = self._staff[seat]
        if worker is None:
            worker = self._staff[seat] = _Worker(self.threads)
        return worker

    def _dismiss(self, seat: int) -> None:
        worker, self._staff[seat] = self._staff[seat], None
        if worker is not None:
            worker.end(at_once=True)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        staff, self._staff = self._staff, [None] * self.workers
        for worker in staff:
            if worker is not None:
                worker.end(at_once=error is not None)


def _check_keys(jobs: list, keys: Sequence[str] | None) -> None:
    if keys is not None and len(keys) != len(jobs):
        raise ValueError(f"{len(keys)} keys for {len(jobs)} jobs")


def _obituary(function: Callable, job: int, key: str | None) -> str:
    name = f"{key!r}" if key is not None else f"number {job + 1}"
    return f"a worker process died twice in {function.__name__} of {name}: out of memory, killed or crashed"


class _Outcome:
    """What a job came to: an answer, or an exception with the worker's traceback."""

    def __init__(self, answer: Any = None, error: BaseException | None = None, trace: str = "") -> None:
        self.answer, self.error, self.trace = answer, error, trace

    def result(self) -> Any:
        if self.error is not None:
            raise self.error from RuntimeError(f"in a worker process:\n{self.trace}")
        return self.answer


class _Worker:
    """A process at the far end of a pipe."""

    def __init__(self, threads: int) -> None:
        context = multiprocessing.get_context("spawn")
        self.connection, far = context.Pipe()
        self.process = context.Process(target=_serve, args=(far,), daemon=True)
        with _environment(dict.fromkeys(THREAD_VARIABLES, str(threads))), _no_main():
            self.process.start()
        far.close()

    def send(self, function: Callable, job: Any) -> None:
        with suppress(OSError):  # it died while idle: reading its line tells so
            self.connection.send((function, job))

    def receive(self) -> _Outcome | None:
        try:
            return self.connection.recv()
        except (EOFError, OSError):  # nothing more, or half a message
            return None

    def end(self, at_once: bool) -> None:
        """Close the line, which ends an idle worker; ``at_once`` kills one in the middle of a job."""
        self.connection.close()
        if at_once:
            self.process.terminate()
        self.process.join(_GRACE_S)
        if self.process.is_alive():
            self.process.kill()
            self.process.join()
        self.process.close()


@contextmanager
def _environment(variables: dict[str, str]) -> Iterator[None]:
    before = {name: os.environ.get(name) for name in variables}
    os.environ.update(variables)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


@contextmanager
def _no_main() -> Iterator[None]:
    """Spawned processes import the caller's main script, which would run an unguarded one again: hide it."""
    main = sys.modules["__main__"]
    sys.modules["__main__"] = ModuleType("__main__")
    try:
        yield
    finally:
        sys.modules["__main__"] = main


def _serve(connection: Connection) -> None:
    """A worker's life: do jobs until the line is closed. The terminal's Ctrl-C is the parent's affair."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_die_with_parent, daemon=True).start()
    while True:
        try:
            outcome = _do(*connection.recv())
        except (EOFError, ConnectionError):
            return
        except Exception as error:  # a function or job that this process cannot import
            outcome = _failure(error)
        _reply(connection, outcome)


def _do(function: Callable, job: Any) -> _Outcome:
    try:
        return _Outcome(function(job))
    except Exception as error:
        return _failure(error)


def _failure(error: Exception) -> _Outcome:
    return _Outcome(error=error, trace=traceback.format_exc())


def _reply(connection: Connection, outcome: _Outcome) -> None:
    try:
        connection.send(outcome)
    except ConnectionError:
        return
    except Exception as error:  # neither every answer nor every exception can be pickled
        what = outcome.error if outcome.error is not None else error
        text = f"{type(what).__name__}: {what}"
        connection.send(_Outcome(error=RunError(text), trace=outcome.trace or traceback.format_exc()))


def _die_with_parent() -> None:
    """An orphan in the middle of an hour's job would keep a core for nothing."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)
