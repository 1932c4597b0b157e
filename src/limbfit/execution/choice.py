"""Which executor a run gets: what its study says, unless the caller says otherwise."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from typing import Any, Self

from ..errors import InputError
from .cluster import DaskExecutor
from .face import NO_LIMITS, Answer, Executor, Job, Limits, SerialExecutor, usable_cores
from .processes import ProcessExecutor


@dataclass(frozen=True)
class Placement:
    """What a caller wants instead of what studies say.

    ``workers``: how many; ``scheduler``: address of a Dask scheduler; ``dask``: a batch system for workers.
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


_wanted: ContextVar[Placement | None] = ContextVar("_wanted", default=None)
_shared: ContextVar[Executor | None] = ContextVar("_shared", default=None)


@contextmanager
def placed(placement: Placement) -> Iterator[None]:
    """Executors made in this block are where ``placement`` says."""
    token = _wanted.set(placement)
    try:
        yield
    finally:
        _wanted.reset(token)


@contextmanager
def sharing(executor: Executor) -> Iterator[None]:
    """`make_executor` gives ``executor`` in this block, and whoever asked for it leaves it running."""
    token = _shared.set(executor)
    try:
        yield
    finally:
        _shared.reset(token)


def make_executor(workers: int = 0, limits: Limits = NO_LIMITS) -> Executor:
    """An executor with that many workers, one thread each; 0 means one worker per usable core.

    One worker means this process itself. `placed` and `sharing` take precedence.

    Raises
    ------
    InputError
        For a scheduler or a batch system that cannot be used.
    """
    shared, wanted = _shared.get(), _wanted.get() or Placement()
    if shared is not None:
        return _Lent(shared, limits)
    if wanted.scheduler is not None:
        return DaskExecutor.at(wanted.scheduler, limits)
    count = (workers if wanted.workers is None else wanted.workers) or usable_cores()
    if wanted.dask is not None:
        return DaskExecutor.queued(wanted.dask, count, limits)
    return ProcessExecutor(count, limits=limits) if count > 1 else SerialExecutor()


class _Lent:
    """Another's executor with limits of one's own: leaving it does not end it."""

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
        lost: Callable[[Job, str], Answer] | None = None,
        told: Callable[[Job, Any], None] | None = None,
    ) -> Iterator[Answer]:
        return self._executor.map(function, jobs, keys, lost, told)

    def threads_for(self, jobs: int) -> int:
        return self._executor.threads_for(jobs)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        return None
