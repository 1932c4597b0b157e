"""How time and memory grow with the number of unknowns, on structured blocks under the square punch."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ..fe import StepControl
from .blocks import build_punched_block, choose_divisions
from .measuring import run_in_fresh_process, solve_timed
from .reference import Tell

UNKNOWNS = (20_000, 45_000, 80_000)
# The paper's model of one site: about 150,000 linear tetrahedra.
PAPER_ELEMENT, PAPER_DIVISIONS = "tet4", 37
CONTROL = StepControl()


@dataclass(frozen=True)
class BlockJob:
    """A block to be timed in a process of its own."""

    element: str
    divisions: int
    control: StepControl


def bench_scaling(
    element: str = "tet10",
    unknowns: Sequence[int] = UNKNOWNS,
    threads: int = 1,
    paper_divisions: int = PAPER_DIVISIONS,
    *,
    tell: Tell,
    control: StepControl = CONTROL,
) -> dict[str, Any]:
    """Seconds and memory over unknowns, the exponent of their power law, and a model of the paper's size.

    Parameters
    ----------
    element : name in the element table.
    unknowns : about how many, two sizes or more.
    paper_divisions : cells along the side of the model of the paper's size.

    Raises
    ------
    InputError
        For an element that is not in the table.
    """
    control = replace(control, threads=threads)
    jobs = [BlockJob(element, choose_divisions(element, size), control) for size in unknowns]
    jobs.append(BlockJob(PAPER_ELEMENT, paper_divisions, control))
    rows = []
    for i, job in enumerate(jobs):
        tell(i, len(jobs), f"{job.element}, {job.divisions} cells along 60 mm")
        rows.append(run_in_fresh_process(run_block, job, threads))
    tell(len(jobs), len(jobs), "done")
    *curve, paper = rows
    return {
        "element": element,
        "threads": threads,
        "sizes": curve,
        "seconds_exponent": fit_exponent(curve, "seconds"),
        "memory_exponent": fit_exponent(curve, "max_rss_MB"),
        "paper_sized": paper,
    }


def run_block(job: BlockJob) -> dict[str, Any]:
    problem = build_punched_block(job.element, job.divisions)
    return {"cells": len(problem.mesh.cells), **solve_timed(problem, job.control, sensitivities=False)}


def fit_exponent(rows: list[dict[str, Any]], key: str) -> float:
    """Slope of the least-squares line of log ``key`` over log unknowns."""
    x = np.log([row["unknowns"] for row in rows])
    slope, _ = np.polyfit(x, np.log([row[key] for row in rows]), 1)
    return float(slope)
