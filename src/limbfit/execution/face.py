"""What every executor does, what a job may cost, and the executor that needs no workers."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from functools import partial
from types import TracebackType
from typing import Any, Protocol, Self, TypeVar

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

# For a Python that starts: it would import a ``pickle.py`` of the folder it is started in.
SAFE_PATH = {"PYTHONSAFEPATH": "1"}


@dataclass(frozen=True)
class Limits:
    """What one job may take: wall time in s and resident memory in GB (10^9 bytes); 0 means no limit."""

    time_s: float = 0.0
    memory_GB: float = 0.0


NO_LIMITS = Limits()

_listener: ContextVar[Callable[[Any], None] | None] = ContextVar("_listener", default=None)


def report_progress(message: Any) -> None:
    """From within a job, to the ``told`` of whoever maps it: numbers and words, plain enough for JSON."""
    listener = _listener.get()
    if listener is not None:
        listener(message)


@contextmanager
def reporting_to(listener: Callable[[Any], None] | None) -> Iterator[None]:
    """`report_progress` calls ``listener`` in this block."""
    token = _listener.set(listener)
    try:
        yield
    finally:
        _listener.reset(token)


class Executor(Protocol):
    """Runs a function over jobs; use it as a context, which ends its workers."""

    limits: Limits

    @property
    def workers(self) -> int:
        """How many jobs it does at a time."""
        ...

    def threads_for(self, jobs: int) -> int:
        """How many threads each of so many jobs may have, so that no worker is idle beside them."""
        ...

    def map(
        self,
        function: Callable[[Job], Answer],
        jobs: Iterable[Job],
        keys: Sequence[str] | None = None,
        lost: Callable[[Job, str], Answer] | None = None,
        told: Callable[[Job, Any], None] | None = None,
    ) -> Iterator[Answer]:
        """Answers in the order of ``jobs``, as they are asked for.

        Jobs of one key go to one worker, over all calls, so that what it keeps (meshes, states) serves again;
        a new key goes to the first worker that is free. An exception of a job is raised where its answer
        would come, and ends the call.

        Parameters
        ----------
        lost : makes the answer of a job that was lost twice, from it and the reason in words: its worker
            died, or it went over the executor's limits. Without it nothing limits the jobs.
        told : is given a job and what it says by `report_progress`, while answers are waited for.

        Raises
        ------
        RunError
            Where a worker died twice on the same job, and ``lost`` is not given.
        """
        ...

    def __enter__(self) -> Self: ...

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None: ...


def usable_cores() -> int:
    """Cores that this process may use, which a batch system can make fewer than the machine has."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def paired(jobs: Iterable[Job], keys: Sequence[str] | None) -> tuple[list[Job], list[str | None]]:
    """Jobs as a list, and the key of each; None where they have none."""
    listed = list(jobs)
    if keys is None:
        return listed, [None] * len(listed)
    if len(keys) != len(listed):
        raise ValueError(f"{len(keys)} keys for {len(listed)} jobs")
    return listed, list(keys)


class SerialExecutor:
    """Runs jobs one after the other in this process, which no limit can end."""

    workers = 1
    limits = NO_LIMITS

    def map(
        self,
        function: Callable[[Job], Answer],
        jobs: Iterable[Job],
        keys: Sequence[str] | None = None,
        lost: Callable[[Job, str], Answer] | None = None,
        told: Callable[[Job, Any], None] | None = None,
    ) -> Iterator[Answer]:
        def done(job: Job) -> Answer:
            with reporting_to(None if told is None else partial(told, job)):
                return function(job)

        return map(done, paired(jobs, keys)[0])

    def threads_for(self, jobs: int) -> int:
        return usable_cores()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        return None
