"""One simulation of a reference case, plain and with sensitivities, beside FEBio's time for it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from ..errors import InputError
from .measuring import run_in_fresh_process, solve_timed
from .reference import PUNCHED, ReferenceCase, Tell, find_reference, load_case

# FEBio 4.11 with PARDISO, alone on 2 cores (Intel Xeon, 2.5 GHz), 2 threads.
FEBIO_SECONDS = {"residuum/posterior_tet10": 144.8, "residuum/posterior_tet4": 10.6}
CASES = {case.name: case for case in PUNCHED}


@dataclass(frozen=True)
class ForwardJob:
    """A simulation to be timed in a process of its own."""

    case: ReferenceCase
    folder: Path
    sensitivities: bool


def bench_forward(
    reference: Path | None = None,
    case: str = "residuum/posterior_tet10",
    element: str = "",
    threads: int = 1,
    as_febio: bool = False,
    *,
    tell: Tell,
) -> dict[str, Any]:
    """Time a reference case on FEBio's mesh and steps, with limbfit's own contact or FEBio's.

    Parameters
    ----------
    reference : folder of FEBio's results; None: ``shared/reference``, here or above.
    case : a case with an indenter in it.
    element : name in the element table; empty: that of the mesh.
    threads : of assembly and linear algebra.
    as_febio : with the element's quadrature and the contact penalty of the parity table.

    Raises
    ------
    InputError
        Where the case is missing or the element does not fit its mesh.
    """
    if case not in CASES:
        raise InputError(f"unknown case {case!r}", remedy=f"use one of {', '.join(CASES)}")
    folder = reference or find_reference(Path.cwd())
    named = CASES[case] if as_febio else replace(CASES[case], problem={}, control={})
    problem = {**named.problem, "element": element} if element else named.problem
    control = {**named.control, "threads": threads}
    job = ForwardJob(replace(named, problem=problem, control=control), folder, False)
    tell(0, 2, f"{case}, plain")
    plain = run_in_fresh_process(run_forward, job, threads)
    tell(1, 2, f"{plain['seconds']:.1f} s plain; with sensitivities")
    full = run_in_fresh_process(run_forward, replace(job, sensitivities=True), threads)
    tell(2, 2, f"{full['seconds']:.1f} s with sensitivities")
    febio = FEBIO_SECONDS.get(case)
    return {
        "case": case,
        **plain,
        "seconds_with_sensitivities": full["seconds"],
        "sensitivities_over_plain": full["seconds"] / plain["seconds"],
        "max_rss_with_sensitivities_MB": full["max_rss_MB"],
        "seconds_by_part_with_sensitivities": full["seconds_by_part"],
        "threads": threads,
        "as_febio": as_febio,
        "febio_seconds": febio,
        "ratio": None if febio is None else febio / plain["seconds"],
    }


def run_forward(job: ForwardJob) -> dict[str, Any]:
    problem, control, _ = load_case(job.case, job.folder)
    return solve_timed(problem, control, job.sensitivities)
