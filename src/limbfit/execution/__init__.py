"""Executors that run jobs: in this process, in worker processes, or on a Dask cluster; and the choice of one.

A job is anything that can be pickled, and the function that does it is importable. Answers come back in the
order of the jobs whatever runs them, so a caller cannot tell one executor from another except by the time.
"""

from collections.abc import Iterator
from contextlib import AbstractContextManager
from contextvars import ContextVar
from dataclasses import dataclass
from typing import Any

from ..errors import InputError
from ..renamed import find_renamed
from .cluster import QUEUES, DaskExecutor
from .processes import (
    NO_LIMITS,
    SAFE_PATH,
    THREAD_VARIABLES,
    Batch,
    Executor,
    Limits,
    ProcessExecutor,
    SerialExecutor,
    count_usable_cores,
    limit_cores,
    report_progress,
    run_in_background,
    set_in_block,
)


@dataclass(frozen=True)
class Placement:
    """Where a caller wants jobs to run instead of what studies say.

    ``workers`` is their number, ``scheduler`` the address of a Dask scheduler, ``dask`` a batch system for
    workers.
    """

    workers: int | None = None
    scheduler: str | None = None
    dask: str | None = None

    def __post_init__(self) -> None:
        if self.scheduler is not None and (self.dask is not None or self.workers is not None):
            raise InputError(
                "a scheduler has its own workers",
                place="--scheduler",
                remedy="leave out --workers and --dask",
            )


_placement: ContextVar[Placement | None] = ContextVar("_placement", default=None)
_shared: ContextVar[Executor | None] = ContextVar("_shared", default=None)


def place_jobs(placement: Placement) -> AbstractContextManager[None]:
    """Make executors that are created in this block run where ``placement`` says."""
    return set_in_block(_placement, placement)


def share_executor(executor: Executor) -> AbstractContextManager[None]:
    """Make `make_executor` return ``executor`` in this block; whoever asks for it leaves it running."""
    return set_in_block(_shared, executor)


def make_executor(workers: int = 0, limits: Limits = NO_LIMITS, renew: bool = False) -> Executor:
    """Make an executor with that many workers, one thread each; 0 means one worker per usable core.

    One worker means this process itself, unless every job is to have a new process (``renew``). `place_jobs`
    and `share_executor` take precedence. Raises `InputError` for a scheduler or a batch system that cannot be
    used.
    """
    shared, placement = _shared.get(), _placement.get() or Placement()
    if shared is not None:
        return _SharedExecutor(shared, limits)
    if placement.scheduler is not None:
        return DaskExecutor.connect(placement.scheduler, limits)
    count = (workers if placement.workers is None else placement.workers) or count_usable_cores()
    if placement.dask is not None:
        return DaskExecutor.from_queue(placement.dask, count, limits)
    if count > 1 or renew:
        return ProcessExecutor(count, limits=limits, renew=renew)
    return SerialExecutor()


class _SharedExecutor(Executor):
    """Another's executor with limits of one's own; leaving its context does not end it."""

    def __init__(self, executor: Executor, limits: Limits) -> None:
        self._executor, self.limits = executor, limits
        executor.limits = limits

    @property
    def workers(self) -> int:
        return self._executor.workers

    def threads_for(self, jobs: int) -> int:
        return self._executor.threads_for(jobs)

    def _run_jobs(self, batch: Batch) -> Iterator[Any]:
        return self._executor.map(batch.function, batch.jobs, batch.keys, batch.on_lost, batch.on_report)


def __getattr__(name: str) -> Any:
    return find_renamed(__name__, name, {"placed": "place_jobs", "sharing": "share_executor"})
