"""The choice of an executor: what the study says, unless the caller says otherwise."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from typing import Any, Self

from ..errors import InputError
from .base import NO_LIMITS, Answer, Executor, Job, Limits, SerialExecutor, count_usable_cores
from .cluster import DaskExecutor
from .processes import ProcessExecutor


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


_placement: ContextVar[Placement | None] = ContextVar("_wanted", default=None)
_shared: ContextVar[Executor | None] = ContextVar("_shared", default=None)


@contextmanager
def place_jobs(placement: Placement) -> Iterator[None]:
    """Make executors that are created in this block run where ``placement`` says."""
    token = _placement.set(placement)
    try:
        yield
    finally:
        _placement.reset(token)


@contextmanager
def share_executor(executor: Executor) -> Iterator[None]:
    """Make `make_executor` return ``executor`` in this block; whoever asks for it leaves it running."""
    token = _shared.set(executor)
    try:
        yield
    finally:
        _shared.reset(token)


def make_executor(workers: int = 0, limits: Limits = NO_LIMITS) -> Executor:
    """Make an executor with that many workers, one thread each; 0 means one worker per usable core.

    One worker means this process itself. `place_jobs` and `share_executor` take precedence.

    Raises
    ------
    InputError
        For a scheduler or a batch system that cannot be used.
    """
    shared, wanted = _shared.get(), _placement.get() or Placement()
    if shared is not None:
        return _SharedExecutor(shared, limits)
    if wanted.scheduler is not None:
        return DaskExecutor.connect(wanted.scheduler, limits)
    count = (workers if wanted.workers is None else wanted.workers) or count_usable_cores()
    if wanted.dask is not None:
        return DaskExecutor.from_queue(wanted.dask, count, limits)
    return ProcessExecutor(count, limits=limits) if count > 1 else SerialExecutor()


class _SharedExecutor:
    """Another's executor with limits of one's own; leaving its context does not end it."""

    def __init__(self, executor: Executor, limits: Limits) -> None:
        self._executor, self.limits = executor, limits
        executor.limits = limits

    @property
    def workers(self) -> int:
        return self._executor.workers

    def map(
        self,
        function: Callable[[Job], Answer],
        jobs: Iterable[Job],
        keys: Sequence[str] | None = None,
        on_lost: Callable[[Job, str], Answer] | None = None,
        on_report: Callable[[Job, Any], None] | None = None,
    ) -> Iterator[Answer]:
        return self._executor.map(function, jobs, keys, on_lost, on_report)

    def threads_for(self, jobs: int) -> int:
        return self._executor.threads_for(jobs)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        return None
