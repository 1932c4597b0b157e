"""Jobs on a Dask cluster: a scheduler that runs already, workers queued on a batch system, or local ones.

The study's folder must be on a file system that the workers share, under the same path, and limbfit must be
installed for them. Every Dask worker does its jobs in a process of its own (`processes`), which pins threads
and can be ended, as a thread of Dask cannot.
"""

import math
import threading
import time
import uuid
from collections.abc import Callable, Iterator
from contextlib import suppress
from queue import Empty, SimpleQueue
from typing import Any, Self

from ..errors import InputError, RunError
from ..extensions import import_extra
from .processes import NO_LIMITS, Batch, Executor, Limits, ProcessExecutor

QUEUES = {
    "slurm": "SLURMCluster",
    "pbs": "PBSCluster",
    "sge": "SGECluster",
    "lsf": "LSFCluster",
    "oar": "OARCluster",
    "htcondor": "HTCondorCluster",
}
LOCAL_QUEUE = "local"
_SCHEDULER_GONE = "the Dask scheduler is gone; run again: finished work is kept"
_CONNECT_S = 20.0
_JOBS_PER_WORKER = 2  # jobs at the scheduler for every worker: one at work, one that waits
_POLL_S = 1.0  # between two looks at which workers there are
_DEFAULT_MEMORY_GB = 4.0  # asked of the batch system for a worker where the study sets no limit


class _LostJob(str):
    """The reason why a job had no answer."""

    __slots__ = ()


_local = threading.local()  # of a Dask worker: the process that does the jobs of each of its threads


def _run_contained(
    function: Callable, job: Any, limits: Limits, contained: bool, number: int, topic: str
) -> Any:
    """Do a job in a process of its own on a Dask worker; if ``contained``, the answer says why it was lost.

    What it reports goes to those who listen to the ``topic``, with its ``number``.
    """
    executor: ProcessExecutor | None = getattr(_local, "executor", None)
    if executor is None:
        executor = _local.executor = ProcessExecutor(1)
    executor.limits = limits
    on_lost = (lambda _, reason: _LostJob(reason)) if contained else None
    worker = import_extra("distributed", "dask").get_worker()
    on_report = (lambda _, message: worker.log_event(topic, (number, message))) if topic else None
    return next(executor.map(function, [job], on_lost=on_lost, on_report=on_report))


class DaskExecutor(Executor):
    """Runs jobs through a ``distributed.Client``, which it owns, with the cluster behind it if that is given.

    The jobs of a worker that dies are tried again elsewhere, as often as the scheduler allows
    (``distributed.scheduler.allowed-failures``).
    """

    def __init__(
        self, client: Any, limits: Limits = NO_LIMITS, cluster: Any = None, workers: int = 0
    ) -> None:
        self._client, self._cluster, self.limits = client, cluster, limits
        self._requested = workers
        self._worker_of_key: dict[str, str] = {}

    @classmethod
    def connect(cls, address: str, limits: Limits = NO_LIMITS) -> Self:
        """Use the workers of the scheduler at ``address`` (``tcp://host:8786``). Raises `InputError` if Dask
        is not installed, or no scheduler answers.
        """
        try:
            if not address.rpartition(":")[2].isdigit():  # Dask's half-made client would end after 40 s
                raise ValueError("no port")
            client = import_extra("distributed", "dask").Client(
                address, timeout=_CONNECT_S, set_as_default=False
            )
        except (OSError, ValueError, TypeError) as error:
            raise InputError(
                f"no Dask scheduler answers at {address!r}",
                place="--scheduler",
                remedy="start one with `dask scheduler`, and give the address that it prints",
            ) from error
        return cls(client, limits)

    @classmethod
    def from_queue(cls, queue: str, workers: int, limits: Limits = NO_LIMITS) -> Self:
        """Use ``workers`` jobs of a batch system (`QUEUES`), or local processes (``local``).

        What else the batch system wants (queue, account, walltime) stands in Dask's ``jobqueue.yaml``. Raises
        `InputError` for an unknown batch system, or one that cannot be used as configured.
        """
        if queue == LOCAL_QUEUE:
            cluster = import_extra("distributed", "dask").LocalCluster(
                n_workers=workers, threads_per_worker=1, dashboard_address=None, memory_limit=0
            )
        elif queue in QUEUES:
            memory = f"{limits.memory_GB or _DEFAULT_MEMORY_GB:g}GB"
            try:
                kind = getattr(import_extra("dask_jobqueue", "dask"), QUEUES[queue])
                cluster = kind(cores=1, processes=1, memory=memory)
                cluster.scale(jobs=workers)
            except (OSError, ValueError, TypeError, RuntimeError) as error:
                raise InputError(
                    f"{queue} cannot be used: {error}",
                    place="--dask",
                    remedy="configure it in ~/.config/dask/jobqueue.yaml",
                ) from error
        else:
            raise InputError(
                f"no batch system is named {queue!r}",
                place="--dask",
                remedy=f"use {', '.join((*QUEUES, LOCAL_QUEUE))}",
            )
        client = import_extra("distributed", "dask").Client(cluster, set_as_default=False)
        return cls(client, limits, cluster, workers)

    @property
    def workers(self) -> int:
        """The number of workers that are there, or that were asked for while they wait in a queue."""
        return max(len(self._addresses()), self._requested, 1)

    def _addresses(self) -> list[str]:
        try:
            return sorted(self._client.scheduler_info(n_workers=-1)["workers"])
        except OSError as error:
            raise RunError(_SCHEDULER_GONE) from error

    def threads_for(self, jobs: int) -> int:
        return 1

    def _run_jobs(self, batch: Batch) -> Iterator[Any]:
        """Yield answers in order, with no more jobs at the scheduler than keep its workers busy.

        The scheduler blames a dead worker's jobs for the death, also those that only waited there. With a
        long queue, it would give up jobs that never began.
        """
        name, contained = f"{batch.function.__name__}-{uuid.uuid4().hex}", batch.on_lost is not None
        futures: dict[int, Any] = {}  # whose answers were not given yet
        news: SimpleQueue[Any] = SimpleQueue()  # None: a job has ended; else its number and what it reports
        topic = "" if batch.on_report is None else name
        submitted, looked, present = 0, -math.inf, list[str]()
        if topic:
            self._client.subscribe_topic(topic, lambda event: news.put(event[1]))
        try:
            for i, job in enumerate(batch.jobs):
                while True:
                    under_way = sum(not future.done() for future in futures.values())
                    if time.monotonic() > looked + _POLL_S:
                        present, looked = self._addresses(), time.monotonic()
                    room = _JOBS_PER_WORKER * max(len(present), self._requested, 1) - under_way
                    for j in range(submitted, min(submitted + room, len(batch.jobs))):
                        place = self._choose_workers(batch.keys[j], present)
                        futures[j] = self._client.submit(
                            _run_contained, batch.function, batch.jobs[j], self.limits, contained, j, topic,
                            key=f"{name}-{j}", pure=False, workers=place,
                            allow_other_workers=place is not None,
                        )  # fmt: skip
                        futures[j].add_done_callback(lambda _: news.put(None))
                        submitted = j + 1
                    if futures[i].done():
                        break
                    with suppress(Empty):
                        report = news.get(timeout=_POLL_S)
                        if report is not None and batch.on_report is not None:
                            batch.on_report(batch.jobs[report[0]], report[1])
                answer = self._result(futures.pop(i), contained)
                if isinstance(answer, _LostJob) and batch.on_lost is not None:
                    answer = batch.on_lost(job, str(answer))
                yield answer
        finally:
            with suppress(Exception):  # the scheduler may be gone
                self._client.cancel([future for future in futures.values() if not future.done()])
                if topic:
                    self._client.unsubscribe_topic(topic)

    def _choose_workers(self, key: str | None, present: list[str]) -> list[str] | None:
        """Where jobs of a key went before, if that worker lives; else the next worker in turn."""
        if key is None or not present:
            return None
        if self._worker_of_key.get(key) not in present:
            self._worker_of_key[key] = present[len(self._worker_of_key) % len(present)]
        return [self._worker_of_key[key]]

    def _result(self, future: Any, contained: bool) -> Any:
        distributed = import_extra("distributed", "dask")
        try:
            return future.result()
        except distributed.KilledWorker as error:
            if contained:
                return _LostJob("every Dask worker that tried it died: out of memory, killed or crashed")
            raise RunError(f"every Dask worker that tried a job died: {error}") from error
        except (distributed.CancelledError, distributed.comm.CommClosedError) as error:
            raise RunError(_SCHEDULER_GONE) from error

    def end(self, at_once: bool) -> None:
        for one in (self._client, self._cluster):
            with suppress(Exception):  # nothing more is wanted of either, and there may be no cluster
                one.close(timeout=2)
