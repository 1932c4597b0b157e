"""What workers do for `runs.py`: functions of a script's own module cannot travel to them."""

import os
import resource
from pathlib import Path
from typing import Any

import numpy as np

from limbfit.bench.timing import measure_max_rss_MB
from limbfit.indentation import (
    Simulation,
    SimulationJob,
    SiteModel,
    simulate,
    simulate_fields,
    to_parameters,
)

TISSUES = ("skin", "muscle")


def nothing(job: Any) -> None:
    """The smallest job."""


def bind(core: int) -> None:
    """This worker on one core alone: a busy machine puts two of them on the same one."""
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {sorted(os.sched_getaffinity(0))[core]})


def answer(job: SimulationJob) -> Simulation:
    """What a simulation returns, without simulating."""
    n = len(job.times_s)
    facts = {"linear_solver": "pardiso", "element": "tet10", "steps": 38, "newton_iterations": 150}
    return Simulation(job.model.name, np.ones(n), np.ones((n, len(job.parameters))), True, "", 0.1, facts)


def stored_fields(job: tuple[SiteModel, tuple[float, ...], Path]) -> None:
    """The fields at the deepest point, as the stage ``predict`` stores them."""
    model, parameters, file = job
    simulate_fields(model, to_parameters(np.array(parameters), TISSUES), file)


def measured(job: SimulationJob) -> tuple[Simulation, dict[str, float]]:
    """A simulation, and what this process has taken for it and so far."""
    before = resource.getrusage(resource.RUSAGE_SELF)
    made = simulate(job)
    after = resource.getrusage(resource.RUSAGE_SELF)
    cpu = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return made, {"cpu_s": cpu, "largest_memory_MB": measure_max_rss_MB() * 1.048576}
