"""A worker process: its line to the parent, and its life at the far end of it."""

from __future__ import annotations

import multiprocessing
import os
import signal
import sys
import threading
import time
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection
from types import ModuleType
from typing import Any

import psutil

from ..errors import RunError
from .face import SAFE_PATH, THREAD_VARIABLES, Limits, reporting_to

GRACE_S = 2.0  # for workers to end when told so
READY = "ready"  # a worker's first word: its start is not its first job's time


class JobOutcome:
    """What a job came to: an answer, or an exception with the worker's traceback."""

    def __init__(self, answer: Any = None, error: BaseException | None = None, trace: str = "") -> None:
        self.answer, self.error, self.trace = answer, error, trace

    def result(self) -> Any:
        if self.error is not None:
            raise self.error from RuntimeError(f"in a worker process:\n{self.trace}")
        return self.answer


@dataclass(frozen=True)
class JobReport:
    """What a job says while it goes on."""

    message: Any


class Worker:
    """A process at the far end of a pipe."""

    def __init__(self, threads: int) -> None:
        context = multiprocessing.get_context("spawn")
        self.connection, far = context.Pipe()
        self.process = context.Process(target=serve, args=(far,), daemon=True)
        self.began: float | None = None  # its job; None before it is ready
        variables = dict.fromkeys(THREAD_VARIABLES, str(threads)) | SAFE_PATH
        with _environment(variables), _no_main(), _may_have_children():
            self.process.start()
        far.close()

    def send(self, function: Callable, job: Any) -> None:
        if self.began is not None:
            self.began = time.monotonic()
        with suppress(OSError):  # it died while idle: reading its line tells so
            self.connection.send((function, job))

    def receive(self) -> JobOutcome | JobReport | str | None:
        """The outcome of the job, what it reports, `READY`, or None where the process is dead."""
        try:
            message = self.connection.recv()
        except (EOFError, OSError):  # nothing more, or half a message
            return None
        if message == READY:
            self.began = time.monotonic()
        return message

    def excess(self, limits: Limits) -> str:
        """Which limit the job at work is over, in words; empty where it is within them."""
        began = self.began
        if limits.time_s and began is not None and time.monotonic() - began > limits.time_s:
            return f"it took longer than execution.time_limit_s = {limits.time_s:g} s"
        if limits.memory_GB and self._memory_GB() > limits.memory_GB:
            return f"it needed more than execution.memory_limit_GB = {limits.memory_GB:g} GB"
        return ""

    def _memory_GB(self) -> float:
        """Resident memory of the process and its children (meshers)."""
        total = 0
        with suppress(psutil.Error):
            whole = psutil.Process(self.process.pid)
            for one in (whole, *whole.children(recursive=True)):
                with suppress(psutil.Error):
                    total += one.memory_info().rss
        return total / 1e9

    def dismiss(self, at_once: bool) -> None:
        """Close the line, which ends an idle worker; ``at_once`` ends one in the middle of a job."""
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


@contextmanager
def _may_have_children() -> Iterator[None]:
    """Dask's workers are daemons, which may have no children; these end with their parent by themselves."""
    config = multiprocessing.current_process()._config  # type: ignore[attr-defined]
    before = config.get("daemon")
    config["daemon"] = False
    try:
        yield
    finally:
        config["daemon"] = before


def serve(connection: Connection) -> None:
    """A worker's life: do jobs until the line is closed. The terminal's Ctrl-C is the parent's affair."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_die_with_parent, daemon=True).start()
    with suppress(ConnectionError):
        connection.send(READY)
    while True:
        try:
            with reporting_to(lambda message: connection.send(JobReport(message))):
                outcome = _do(*connection.recv())
        except (EOFError, ConnectionError):
            return
        except Exception as error:  # a function or job that this process cannot import
            outcome = _failure(error)
        _reply(connection, outcome)


def _do(function: Callable, job: Any) -> JobOutcome:
    try:
        return JobOutcome(function(job))
    except MemoryError:
        os._exit(1)  # the parent tries once more in a fresh process
    except Exception as error:
        return _failure(error)


def _failure(error: Exception) -> JobOutcome:
    return JobOutcome(error=error, trace=traceback.format_exc())


def _reply(connection: Connection, outcome: JobOutcome) -> None:
    try:
        connection.send(outcome)
    except ConnectionError:
        return
    except Exception as error:  # neither every answer nor every exception can be pickled
        what = outcome.error if outcome.error is not None else error
        text = f"{type(what).__name__}: {what}"
        connection.send(JobOutcome(error=RunError(text), trace=outcome.trace or traceback.format_exc()))


def _die_with_parent() -> None:
    """An orphan in the middle of an hour's job would keep a core for nothing."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)
