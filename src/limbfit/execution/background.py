"""One piece of work in a process of its own, while the caller goes on."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from ..errors import RunError
from .worker import GRACE_S, JobOutcome, Worker


@contextmanager
def meanwhile(function: Callable[[Any], Any], job: Any) -> Iterator[Callable[[], Any]]:
    """Does ``function(job)`` beside the block, which gets a function that waits for the answer.

    An exception of the job is raised where it is waited for. What is not done when the block ends, is ended.

    Raises
    ------
    RunError
        Where the process died.
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
