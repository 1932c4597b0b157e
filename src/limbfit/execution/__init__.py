"""One face for running jobs: in this process, in worker processes, or on a Dask cluster.

A job is anything that can be pickled, and the function that does it is importable; answers come back in the
order of the jobs whatever runs them, so a caller cannot tell one executor from another but by the clock.
"""

from .background import meanwhile
from .choice import Placement, make_executor, placed, sharing
from .cluster import QUEUES, DaskExecutor
from .face import (
    SAFE_PATH,
    THREAD_VARIABLES,
    Executor,
    Limits,
    SerialExecutor,
    report_progress,
    usable_cores,
)
from .processes import ProcessExecutor

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
    "make_executor",
    "meanwhile",
    "placed",
    "report_progress",
    "sharing",
    "usable_cores",
]
