"""The interface of every executor, the limits of a job, and the executor that needs no workers."""

import os
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from functools import partial
from types import TracebackType
from typing import Any, Self, TypeVar

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

_listener: ContextVar[Callable[[Any], None] | None] = ContextVar("_listener", default=None)


def report_progress(message: Any) -> None:
    """Report from within a job to the ``on_report`` of its caller: anything plain enough for JSON."""
    listener = _listener.get()
    if listener is not None:
        listener(message)


def send_reports_to(listener: Callable[[Any], None] | None) -> AbstractContextManager[None]:
    """Send what `report_progress` is given in this block to ``listener``."""
    return set_in_block(_listener, listener)


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

        Parameters
        ----------
        on_lost : makes the answer of a job that was lost twice, from the job and the reason in words: its
            worker died, or it exceeded the executor's limits. Without it nothing limits the jobs.
        on_report : called with a job and what it reports by `report_progress`, while answers are waited for.

        Raises
        ------
        RunError
            If a worker died twice on the same job, and ``on_lost`` is not given.
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
    """Return the number of cores that this process may use; a batch system can allow fewer than there are."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


class SerialExecutor(Executor):
    """Runs jobs one after the other in this process; no limit can end them."""

    workers = 1

    def threads_for(self, jobs: int) -> int:
        return count_usable_cores()

    def _run_jobs(self, batch: Batch) -> Iterator[Any]:
        def done(job: Any) -> Any:
            with send_reports_to(None if batch.on_report is None else partial(batch.on_report, job)):
                return batch.function(job)

        return map(done, batch.jobs)
