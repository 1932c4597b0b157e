"""FEBio as a program: where it is, one run in a folder of its own, its verdict and its log tables."""

from __future__ import annotations

import os
import re
import shutil
import signal
import subprocess
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from ..arrays import Array
from ..errors import InputError, ProblemError, RunError
from ..fe import Problem, Result, System
from .preparation import Preparation

PROGRAM_VARIABLE = "FEBIO_CMD"
PROGRAM_NAMES = ("febio4", "febio")
INPUT, OUTPUT, LOG = "model.feb", "stdout.txt", "model.log"
_MAX_MESSAGE_BYTES = 32 * 2**20  # of FEBio's first and last words, bytes
INSTALL_REMEDY = (
    f"install FEBio 4 (https://febio.org/downloads); put febio4 on the path or set {PROGRAM_VARIABLE} to it"
)
NORMAL_TERMINATION = "N O R M A L   T E R M I N A T I O N"
ERROR_TERMINATION = "E R R O R   T E R M I N A T I O N"
_VERSION = re.compile(r"^\s*version\s+(\d+(?:\.\w+)+)", re.MULTILINE)
_CONVERGED = re.compile(r"------- converged at time : ([-+.\deE]+)")
_FAILED = re.compile(r"------- failed to converge at time : ([-+.\deE]+)")
_BOX = re.compile(r"^ \*+\n \*\s+(?:FATAL )?ERROR\s+\*\n((?: \*.*\n?)+)", re.MULTILINE)
TIME_TOLERANCE = 1e-5  # of the end time: FEBio prints six digits, 10.0223 for 10.022314


@dataclass(frozen=True)
class FebioRun:
    """One run: the verdict by FEBio's own messages, its table of the indenter, if any, and its time."""

    verdict: RunVerdict
    log: FebioLog | None
    seconds: float


def find_febio(program: str | Path | None = None, folder: Path = Path()) -> Path:
    """Find the FEBio program: the one given, from ``folder`` or on the path, that of ``FEBIO_CMD``, or febio4
    or febio on the path. Raises `InputError` if there is none, with how to get it.
    """
    program = program and (shutil.which(folder / program) or program)
    for name, given in (("febio.program", program), (PROGRAM_VARIABLE, os.environ.get(PROGRAM_VARIABLE))):
        if given:
            found = shutil.which(str(given))
            if found is None:
                what = "is not a program that can be run"
                raise InputError(what, file=given, place=name, remedy=INSTALL_REMEDY)
            return Path(found).absolute()  # it is run in another folder
    for candidate in filter(None, map(shutil.which, PROGRAM_NAMES)):
        return Path(candidate)
    raise InputError("FEBio is not installed here", remedy=INSTALL_REMEDY)


def run_febio(
    program: Path, folder: Path, end_s: float, table: str, *, threads: int = 1, time_limit_s: float = 3600.0
) -> FebioRun:
    """Run FEBio on ``model.feb`` in ``folder``; what an earlier run left there is removed first.

    Raises `RunError` if the program cannot be started, or the folder cannot be written.

    ``end_s``: the time that the input asks for, s; ``table``: name of the log-file table that holds the
    indenter's force.
    """
    output = folder / OUTPUT
    try:
        for left in (table, OUTPUT, LOG, "model.xplt"):
            (folder / left).unlink(missing_ok=True)
        started = time.perf_counter()
        with output.open("wb") as stream:
            code, timed_out = _run_process(program, folder, stream, threads, time_limit_s)
    except OSError as error:
        raise RunError(f"{program}: {error.strerror or error}") from error
    seconds = time.perf_counter() - started
    messages = _read_messages(output)
    verdict = judge_run(messages, code, end_s, timed_out=timed_out, limit_s=time_limit_s)
    try:
        log = read_log(folder / table)
    except ProblemError as error:
        log = None
        if verdict.is_completed:
            verdict = replace(verdict, kind="no output", reason=f"FEBio ended normally, but {error}")
    return FebioRun(verdict, log, seconds)


def _read_messages(file: Path) -> str:
    """Read FEBio's messages; of very long ones the first part (its version) and the last (its end)."""
    with file.open("rb") as stream:
        found = stream.read(_MAX_MESSAGE_BYTES)
        left = file.stat().st_size - len(found)
        if left > 0:
            stream.seek(-min(left, _MAX_MESSAGE_BYTES), os.SEEK_END)
            found += b"\n" + stream.read()
    return found.decode("utf-8", "replace")


def _run_process(program: Path, folder: Path, stream: Any, threads: int, limit_s: float) -> tuple[int, bool]:
    """Run the program; return its exit code, and True if the time limit ended it and its children."""
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
            if hasattr(os, "killpg"):
                os.killpg(process.pid, signal.SIGKILL)
            else:  # Windows has no process groups of this kind
                process.kill()
            process.wait()


def build_result(problem: Problem, log: FebioLog | None, verdict: RunVerdict, seconds: float = 0.0) -> Result:
    """Build a `Result` of FEBio's force over time, complete or not.

    FEBio's table does not contain penetration and area. Forces across the axis, moments and coordinates are
    not read. All of these are NaN, and there are no states. Raises `ProblemError` if the table holds no force
    along the indenter's axis (or no place, where a force drives it), or goes beyond the history.
    """
    forced, times, force, moved = problem.history.forced, np.zeros(0), np.zeros(0), np.zeros(0)
    if log is not None:
        begun = Preparation.from_problem(problem).seconds
        own = log.times >= begun * (1.0 - TIME_TOLERANCE)
        times, force = np.maximum(log.times[own] - begun, 0.0), compute_axial_force(problem, log)[own]
        if forced and (start := System(problem).indenter):
            moved = _project_on_axis(problem, log, ("x", "y", "z"), np.asarray(start.centre))[own]
    if not len(times) or times[0] > 0.0:  # FEBio did not come so far, or has not written the beginning
        times, force, moved = (np.append(0.0, column) for column in (times, force, moved))
    if times[-1] > problem.history.times[-1] * (1.0 + TIME_TOLERANCE):
        what = f"the table goes on to {times[-1]:.4g} s, the indentation to {problem.history.times[-1]:.4g} s"
        raise ProblemError(what, remedy="give the table of the same indentation")
    unknown, reactions = np.full(len(times), np.nan), np.full((len(times), 1, 6), np.nan)
    reactions[:, 0, 2] = force
    return Result(
        problem=problem,
        times=times,
        displacement=moved if forced else problem.history.at(times),
        force=force,
        force_sensitivity=None,
        parameter_names=problem.parameter_names,
        penetration=unknown,
        contact_area=unknown,
        reactions=reactions,
        coordinates=np.full((len(times), 1, 6), np.nan),
        displacement_sensitivity=None,
        states=(),
        completed=verdict.is_completed,
        reason=verdict.reason,
        statistics={
            "steps": len(times) - 1,
            "linear_solver": f"FEBio {verdict.version}".strip(),
            "element": problem.formulation.name,
            "unknowns": 3 * (len(problem.mesh.points) - len(problem.fixed)),
            "seconds": {"total": seconds},
        },
    )


def compute_axial_force(problem: Problem, log: FebioLog) -> Array:
    """Return the force (n,) of the indenter on the tissue along its axis, N. Raises `ProblemError` if the
    table lacks a component of it.
    """
    return _project_on_axis(problem, log, ("Fx", "Fy", "Fz"), np.zeros(3))


def _project_on_axis(problem: Problem, log: FebioLog, names: tuple[str, ...], origin: Array) -> Array:
    """Return columns of three components, less an origin (3,), along the indenter's axis (n,)."""
    assert problem.indenter is not None
    found = np.zeros(len(log.times))
    for name, share, zero in zip(names, problem.indenter.frame[2], origin):
        if name in log.names:
            found += share * (log.column(name) - zero)
        elif abs(share) > 1e-3:
            raise ProblemError(f"the table has no {name}, along which the indenter moves")
    return found


@dataclass(frozen=True)
class RunVerdict:
    """The verdict over one run: its ``kind``, and the ``reason`` in one line, which is empty if all is well.

    ``kind`` is normal, partial, error, input, killed, time limit, no output or crashed. ``reached_s`` is the
    last time that converged; ``version`` is that of FEBio, empty if it did not say.
    """

    kind: str
    reason: str
    reached_s: float
    version: str

    @property
    def is_completed(self) -> bool:
        return self.kind == "normal"


def judge_run(
    messages: str, exit_code: int, end_s: float, *, timed_out: bool = False, limit_s: float = 0.0
) -> RunVerdict:
    """Judge a run by its exit, its messages and its log.

    ``messages``: what FEBio wrote on standard output (its log file says the same). ``exit_code``: of the
    process; negative or above 128 for a signal. ``end_s``: time that the input asks for. ``timed_out``,
    ``limit_s``: whether it was stopped by the time limit, and after how many seconds.
    """
    found = _VERSION.search(messages)
    version = found.group(1) if found else ""
    times = [float(t) for t in _CONVERGED.findall(messages)]
    reached = times[-1] if times else 0.0
    kind, what = _classify_run(messages, exit_code, reached, end_s, timed_out, limit_s)
    if kind == "normal":
        return RunVerdict(kind, "", reached, version)
    where = "" if kind in ("input", "no output") else f" at {reached:.4g} s of {end_s:.4g} s"
    return RunVerdict(kind, f"FEBio {what}{where}{_find_cause(messages, kind)}", reached, version)


def _classify_run(
    messages: str, exit_code: int, reached: float, end_s: float, timed_out: bool, limit_s: float
) -> tuple[str, str]:
    signal = -exit_code if exit_code < 0 else exit_code - 128
    if timed_out:
        return "time limit", f"was stopped by the time limit of {limit_s:g} s"
    if re.search(r"^Reading file .*FAILED!", messages, re.MULTILINE):
        return "input", "could not read its input"
    if ERROR_TERMINATION in messages:
        return "error", "stopped with an error" + ("" if exit_code else ", though it left with exit code 0")
    if 0 < signal < 65:
        memory = ", most often for lack of memory" if signal == 9 else ""
        return "killed", f"was killed by signal {signal}{memory},"
    if exit_code != 0:
        return "crashed", f"left with exit code {exit_code} without a message,"
    if not messages.strip():
        return "no output", "wrote nothing"
    if NORMAL_TERMINATION not in messages:
        return "crashed", "ended without a verdict,"
    if reached < end_s * (1.0 - TIME_TOLERANCE):
        return "partial", "ended, but stopped early,"
    return "normal", ""


def _find_cause(messages: str, kind: str) -> str:
    """Return the last error that FEBio framed, and where it did not converge."""
    if kind not in ("error", "input", "crashed"):
        return ""
    boxes = _BOX.findall(messages)
    lines = [line.strip(" *") for line in boxes[-1].split("\n")] if boxes else []
    words = " ".join(" ".join(lines).split()).rstrip(".")
    failed = _FAILED.findall(messages)
    parts = [words] if words else []
    if kind != "input" and failed:
        parts.append(f"no convergence at {float(failed[-1]):.4g} s")
    return ": " + "; ".join(parts) if parts else ""


@dataclass(frozen=True)
class FebioLog:
    """Values (n, i, k) of ``i`` items at ``n`` times (n,) s, in FEBio's units; ``names`` of the k columns."""

    times: Array
    names: tuple[str, ...]
    values: Array

    def column(self, name: str) -> Array:
        """Return the values (n,) of the first item."""
        return self.values[:, 0, self.names.index(name)]


def read_log(path: str | Path) -> FebioLog:
    """Read a log file of FEBio: ``*Step``, ``*Time``, ``*Data`` and one line per item, per step.

    A last step that was not written to its end is left out. Raises `ProblemError` if the file is missing,
    holds no complete step, or a line that is no number.
    """
    try:
        text = Path(path).read_text(encoding="utf-8", errors="replace")
    except OSError as error:
        raise ProblemError(error.strerror or "cannot be read", file=path) from error
    times: list[float] = []
    steps: list[list[list[float]]] = []
    names: tuple[str, ...] = ()
    for number, line in enumerate(text.split("\n")[:-1], 1):  # a line without end was cut short
        try:
            if line.startswith("*Time"):
                times.append(float(line.partition("=")[2]))
                steps.append([])
            elif line.startswith("*Data"):
                names = tuple(name.strip() for name in line.partition("=")[2].split(";"))
            elif line.strip() and not line.startswith("*"):
                steps[-1].append([float(value) for value in line.split(",")[1:]])
        except (ValueError, IndexError) as error:
            what = f"{line!r} is not a line of a FEBio log"
            raise ProblemError(what, file=path, place=str(number)) from error
    items = len(steps[0]) if steps else 0
    whole = [[len(row) for row in step] == [len(names)] * items for step in steps]
    count = whole.index(False) if False in whole else len(whole)
    if not count or not items:
        raise ProblemError("holds no complete step of FEBio", file=path)
    return FebioLog(np.array(times[:count]), names, np.array(steps[:count]))
