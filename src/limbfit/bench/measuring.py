"""Time and memory of single simulations, each in a process of its own."""

from __future__ import annotations

import resource
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from ..execution import ProcessExecutor
from ..fe import Problem, Result, StepControl, solve
from .blocks import build_punched_block

Job = TypeVar("Job")
Answer = TypeVar("Answer")
MIB = 1024.0


def run_in_fresh_process(function: Callable[[Job], Answer], job: Job, threads: int) -> Answer:
    """``function(job)`` in a new process with that many threads: its largest memory is its own."""
    with ProcessExecutor(1, threads) as executor:
        return next(executor.map(function, [job]))


def measure_max_rss_MB() -> float:
    """Largest resident memory of this process so far, MiB."""
    status = Path("/proc/self/status")
    if status.is_file():  # the resource usage of a young process includes what its parent held
        lines = status.read_text().splitlines()
        return next(float(line.split()[1]) for line in lines if line.startswith("VmHWM")) / MIB
    usage = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return usage / (MIB * MIB if sys.platform == "darwin" else MIB)


def warm_up(element: str, sensitivities: bool) -> None:
    """Compile, or load from the cache, all kernels of an element with a problem of a few cells."""
    solve(build_punched_block(element, 4), StepControl(load_steps=2, unload_steps=2), sensitivities)


def solve_timed(problem: Problem, control: StepControl, sensitivities: bool) -> dict[str, Any]:
    """Solve and say what it took; kernels are warmed up before the clock starts."""
    warm_up(problem.formulation.name, sensitivities)
    return collect_facts(solve(problem, control, sensitivities, store="none"))


def collect_facts(result: Result) -> dict[str, Any]:
    """Sizes, seconds by part, largest memory of this process, and how far it came."""
    statistics = dict(result.statistics)
    seconds = dict(statistics.pop("seconds"))
    return {
        **{key: statistics[key] for key in ("unknowns", "element", "steps", "newton_iterations")},
        **{key: statistics[key] for key in ("factorisations", "linear_solver")},
        "seconds": seconds.pop("total"),
        "peak_force_N": float(np.max(result.force)),
        "max_rss_MB": measure_max_rss_MB(),
        "seconds_by_part": seconds,
        "completed": result.completed,
        "reason": result.reason,
    }
