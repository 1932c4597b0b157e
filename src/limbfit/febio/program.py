"""FEBio as a program: where it is, one run in a folder of its own, and what came of it."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError, ProblemError, RunError
from ..fe import Problem, Result
from .beginning import Beginning
from .logs import Log, read_log
from .verdict import SLACK, RunVerdict, judge

Array = NDArray[np.float64]
VARIABLE = "FEBIO_CMD"
NAMES = ("febio4", "febio")
INPUT, OUTPUT, LOG = "model.feb", "stdout.txt", "model.log"
_MOST_MESSAGES = 32 * 2**20  # of FEBio's first and last words, bytes
GET_IT = f"install FEBio 4 (https://febio.org/downloads); put febio4 on the path or set {VARIABLE} to it"


@dataclass(frozen=True)
class FebioRun:
    """One run: FEBio's own words as a verdict, its table of the indenter, if there is any, and its time."""

    verdict: RunVerdict
    log: Log | None
    seconds: float
    folder: Path


def find_febio(program: str | Path | None = None) -> Path:
    """The FEBio program: the one given, that of ``FEBIO_CMD``, or febio4 or febio on the path.

    Raises
    ------
    InputError
        Where there is none, with how to get it.
    """
    for name, given in (("febio.program", program), (VARIABLE, os.environ.get(VARIABLE))):
        if given:
            found = shutil.which(str(given))
            if found is None:
                raise InputError("is not a program that can be run", file=given, place=name, remedy=GET_IT)
            return Path(found)
    for candidate in NAMES:
        found = shutil.which(candidate)
        if found is not None:
            return Path(found)
    raise InputError("FEBio is not installed here", remedy=GET_IT)


def run_febio(
    program: Path, folder: Path, end_s: float, table: str, *, threads: int = 1, time_limit_s: float = 3600.0
) -> FebioRun:
    """Run FEBio on ``model.feb`` in ``folder``; what an earlier run left there is removed first.

    Parameters
    ----------
    end_s : the time that the input asks for, s.
    table : name of the log-file table that holds the indenter's force.

    Raises
    ------
    RunError
        Where the program cannot be started, or the folder cannot be written.
    """
    words = folder / OUTPUT
    try:
        for left in (table, OUTPUT, LOG, "model.xplt"):
            (folder / left).unlink(missing_ok=True)
        started = time.perf_counter()
        with words.open("wb") as stream:
            code, timed_out = _call(program, folder, stream, threads, time_limit_s)
    except OSError as error:
        raise RunError(f"{program}: {error.strerror or error}") from error
    seconds = time.perf_counter() - started
    messages = _messages(words)
    verdict = judge(messages, code, end_s, timed_out=timed_out, limit_s=time_limit_s)
    try:
        log = read_log(folder / table)
    except ProblemError as error:
        log = None
        if verdict.completed:
            verdict = replace(verdict, kind="no output", reason=f"FEBio ended normally, but {error}")
    return FebioRun(verdict, log, seconds, folder)


def _messages(file: Path) -> str:
    """FEBio's words; of very many the first (its version) and the last (its end)."""
    with file.open("rb") as said:
        found = said.read(_MOST_MESSAGES)
        left = file.stat().st_size - len(found)
        if left > 0:
            said.seek(-min(left, _MOST_MESSAGES), os.SEEK_END)
            found += b"\n" + said.read()
    return found.decode("utf-8", "replace")


def _call(program: Path, folder: Path, stream: Any, threads: int, limit_s: float) -> tuple[int, bool]:
    """Exit code, and whether the time limit ended it; its children end with it."""
    environment = {**os.environ, "OMP_NUM_THREADS": str(threads), "MKL_NUM_THREADS": str(threads)}
    process = subprocess.Popen(
        [str(program), "-i", INPUT, "-o", LOG],
        cwd=folder,
        stdin=subprocess.DEVNULL,
        stdout=stream,
        stderr=subprocess.STDOUT,
        env=environment,
        start_new_session=True,
    )
    try:
        return process.wait(limit_s), False
    except subprocess.TimeoutExpired:
        return -signal.SIGKILL, True
    finally:
        if process.poll() is None:
            _end(process)


def _end(process: subprocess.Popen) -> None:
    if hasattr(os, "killpg"):
        os.killpg(process.pid, signal.SIGKILL)
    else:  # Windows has no process groups of this kind
        process.kill()
    process.wait()


def result_of_log(problem: Problem, log: Log | None, verdict: RunVerdict, seconds: float = 0.0) -> Result:
    """FEBio's force over time as a `Result`, complete or not.

    FEBio's table says nothing of penetration and area; forces across the axis, moments and coordinates are
    not read: all are NaN;
    there are no states.

    Raises
    ------
    ProblemError
        Where the table holds no force along the indenter's axis, or goes beyond the history.
    """
    times, force = np.zeros(1), np.zeros(1)
    if log is not None:
        begun = Beginning.of(problem).seconds
        own = log.times >= begun * (1.0 - SLACK)
        times, force = np.maximum(log.times[own] - begun, 0.0), axial_force(problem, log)[own]
    if not len(times):  # FEBio did not come so far
        times, force = np.zeros(1), np.zeros(1)
    if times[0] > 0.0:
        times, force = np.concatenate([[0.0], times]), np.concatenate([[0.0], force])
    if times[-1] > problem.history.times[-1] * (1.0 + SLACK):
        raise ProblemError(
            f"the table goes on to {times[-1]:.4g} s, the indentation to {problem.history.times[-1]:.4g} s",
            remedy="give the table of the same indentation",
        )
    unknown, reactions = np.full(len(times), np.nan), np.full((len(times), 1, 6), np.nan)
    reactions[:, 0, 2] = force
    return Result(
        problem=problem,
        times=times,
        displacement=problem.history.at(times),
        force=force,
        force_sensitivity=None,
        parameter_names=problem.parameter_names,
        penetration=unknown,
        contact_area=unknown,
        reactions=reactions,
        coordinates=np.full((len(times), 1, 6), np.nan),
        displacement_sensitivity=None,
        states=(),
        completed=verdict.completed,
        reason=verdict.reason,
        statistics={
            "steps": len(times) - 1,
            "linear_solver": f"FEBio {verdict.version}".strip(),
            "element": problem.formulation.name,
            "unknowns": 3 * (len(problem.mesh.points) - len(problem.fixed)),
            "seconds": {"total": seconds},
        },
    )


def axial_force(problem: Problem, log: Log) -> Array:
    """Force (n,) of the indenter on the tissue along its axis, N.

    Raises
    ------
    ProblemError
        Where the table lacks a component of it.
    """
    assert problem.indenter is not None
    force = np.zeros(len(log.times))
    for name, share in zip(("Fx", "Fy", "Fz"), problem.indenter.frame[2]):
        if name in log.names:
            force += share * log.column(name)
        elif abs(share) > 1e-3:
            raise ProblemError(f"the table has no {name}, along which the indenter moves")
    return force
