"""Jobs side by side in worker processes of this machine."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from multiprocessing.connection import wait
from types import TracebackType
from typing import Any, Self

from ..errors import RunError
from .base import NO_LIMITS, Answer, Job, Limits, zip_jobs
from .worker import GRACE_S, READY, JobOutcome, JobReport, Worker

MAX_TRIES = 2
_POLL_S = 0.25  # between two looks at what jobs take
_DEATH = "a worker process died: out of memory, killed or crashed"


class ProcessExecutor:
    """Worker processes that live as long as the executor, each with ``threads`` threads.

    They start when first needed, and never run the caller's script again, guarded or not. A worker that dies
    (killed, out of memory, crashed) or exceeds the ``limits`` is replaced, and its job is tried once more.
    """

    def __init__(self, workers: int, threads: int = 1, limits: Limits = NO_LIMITS) -> None:
        if workers < 1 or threads < 1:
            raise ValueError("workers and threads must be at least 1")
        self.workers, self.threads, self.limits = workers, threads, limits
        self._seats: list[Worker | None] = [None] * workers
        self._home: dict[str, int] = {}
        self._mapping = False

    def map(
        self,
        function: Callable[[Job], Answer],
        jobs: Iterable[Job],
        keys: Sequence[str] | None = None,
        on_lost: Callable[[Job, str], Answer] | None = None,
        on_report: Callable[[Job, Any], None] | None = None,
    ) -> Iterator[Answer]:
        return self._yield_answers(function, *zip_jobs(jobs, keys), on_lost, on_report)

    def threads_for(self, jobs: int) -> int:
        return max(self.workers * self.threads // max(jobs, 1), self.threads)

    def _yield_answers(
        self,
        function: Callable,
        jobs: list,
        keys: Sequence[str | None],
        on_lost: Callable | None,
        on_report: Callable | None,
    ) -> Iterator[Any]:
        if self._mapping:
            raise RuntimeError("the executor is already mapping: take all answers of one map before the next")
        self._mapping = True
        waiting, busy, tries = list(range(len(jobs))), dict[int, int](), [0] * len(jobs)
        limits = self.limits if on_lost is not None else NO_LIMITS
        answers: dict[int, JobOutcome] = {}
        try:
            for index in range(len(jobs)):
                while index not in answers:
                    for seat, job in self._assign_jobs(waiting, busy, keys):
                        tries[job] += 1
                        busy[seat] = job
                        self._get_worker(seat).send(function, jobs[job])
                    for seat, outcome in self._collect(busy, limits):
                        if isinstance(outcome, JobReport):
                            if on_report is not None:
                                on_report(jobs[busy[seat]], outcome.message)
                            continue
                        job = busy.pop(seat)
                        if isinstance(outcome, JobOutcome):
                            answers[job] = outcome
                        elif tries[job] < MAX_TRIES:
                            waiting.insert(0, job)
                        elif on_lost is not None:
                            answers[job] = JobOutcome(on_lost(jobs[job], f"{outcome}, twice"))
                        else:
                            raise RunError(_describe_death(function, job, keys[job]))
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
            seat = free[0] if key is None else self._home.setdefault(key, free[0])
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
            yield seat, outcome or _DEATH
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

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        staff, self._seats = [worker for worker in self._seats if worker], [None] * self.workers
        for worker in staff:
            worker.dismiss(at_once=error is not None)
        until = time.monotonic() + GRACE_S  # for all of them together
        for worker in staff:
            worker.end(until)


def _describe_death(function: Callable, job: int, key: str | None) -> str:
    name = f"{key!r}" if key is not None else f"number {job + 1}"
    return f"a worker process died twice in {function.__name__} of {name}: out of memory, killed or crashed"
