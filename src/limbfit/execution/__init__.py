"""Executors that run jobs: in this process, in worker processes, or on a Dask cluster.

A job is anything that can be pickled, and the function that does it is importable. Answers come back in the
order of the jobs whatever runs them, so a caller cannot tell one executor from another except by the time.
"""

from typing import Any

from ..renamed import find_renamed
from .base import (
    SAFE_PATH,
    THREAD_VARIABLES,
    Executor,
    Limits,
    SerialExecutor,
    count_usable_cores,
    report_progress,
)
from .cluster import QUEUES, DaskExecutor
from .factory import Placement, make_executor, place_jobs, share_executor
from .processes import ProcessExecutor
from .worker import run_in_background

__all__ = [
    "QUEUES",
    "SAFE_PATH",
    "THREAD_VARIABLES",
    "DaskExecutor",
    "Executor",
    "Limits",
    "Placement",
    "ProcessExecutor",
    "SerialExecutor",
    "count_usable_cores",
    "make_executor",
    "place_jobs",
    "report_progress",
    "run_in_background",
    "share_executor",
]


def __getattr__(name: str) -> Any:
    return find_renamed(__name__, name, {"placed": "place_jobs", "sharing": "share_executor"})
