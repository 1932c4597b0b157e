"""Runs of the study as processes of their own: started, found again after a restart, and stopped.

A run is ``limbfit run STUDY``, or one of ``limbfit socket``. Whether one runs is what the study's lock says,
whoever started it; what it does is what its log says.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import psutil

from ..errors import InputError, RunError
from ..pipeline import STAGE_NAMES
from ..pipeline.engine.store import find_holder, is_held
from ..study import load_study
from .commands import PROGRAM, find_command, interrupt_process, start_command
from .folder import StudyFolder

VERBS = (("run",), ("socket", "fit"), ("socket", "design"))  # that are started here
_HOLDER = re.compile(r"process (\d+) \(since ([^)]*)\)")


def find_running(folder: StudyFolder) -> dict[str, Any] | None:
    """``process`` and ``since`` of the run that holds the study; None where none does."""
    found = _HOLDER.match(find_holder(folder.results))
    if found is None or not psutil.pid_exists(int(found[1])) or not is_held(folder.results):
        return None
    return {"process": int(found[1]), "since": found[2]}


def find_starting(folder: StudyFolder) -> int | None:
    """The process that was started here for a run and does not hold the study yet; None where none is."""
    found = (find_command(_read_command(folder, *verb)) for verb in VERBS)
    return next((one[0] for one in found if one is not None), None)


def _read_command(folder: StudyFolder, *verb: str) -> list[str]:
    return [*PROGRAM, *verb, str(folder.file.resolve())]


def start_run(
    folder: StudyFolder, until: str | None = None, start: str | None = None, force: Sequence[str] = ()
) -> dict[str, Any]:
    """Start ``limbfit run`` on the study; what it says goes to the study's log, as always.

    Raises
    ------
    InputError
        Where the study cannot be read, a record is yet to be made, or a stage does not exist.
    RunError
        Where a run holds the study.
    """
    _refuse_busy(folder)
    for name in (until, start, *force):
        if name is not None and name not in STAGE_NAMES:
            raise InputError(f"no stage is named {name!r}", remedy="stages are " + ", ".join(STAGE_NAMES))
    options = [*(["--until", until] if until else []), *(["--from", start] if start else [])]
    options += [word for name in force for word in ("--force", name)]
    return {"process": start_command([*_read_command(folder, "run"), *options], folder.folder)}


def start_socket(folder: StudyFolder, *, design: bool) -> dict[str, Any]:
    """Start ``limbfit socket fit`` or ``limbfit socket design`` on the study; the errors of `start_run`."""
    _refuse_busy(folder)
    return {
        "process": start_command(
            _read_command(folder, "socket", "design" if design else "fit"), folder.folder
        )
    }


def _refuse_busy(folder: StudyFolder) -> None:
    load_study(folder.file)
    holder = find_running(folder)
    busy = find_starting(folder) if holder is None else holder["process"]
    if busy is not None:
        raise RunError(f"process {busy} is running this study; stop it first, or wait for it")


def stop_run(folder: StudyFolder) -> dict[str, Any]:
    """Interrupt the run that holds the study, as Ctrl-C would; finished work is kept.

    Raises
    ------
    RunError
        Where no run holds the study, or it is no ``limbfit`` command.
    """
    holder = find_running(folder)
    if holder is None and (early := find_starting(folder)) is not None:
        holder = {"process": early}
    if holder is None:
        raise RunError("no run holds this study: there is nothing to stop")
    try:
        process = psutil.Process(holder["process"])
        words = process.cmdline()
        if not any(Path(word).name in ("limbfit", "limbfit.exe") for word in words[:4]):
            raise RunError(
                f"process {process.pid}, which holds this study, is no limbfit command; end it where it runs"
            )
        interrupt_process(process.pid)
    except psutil.Error:
        raise RunError(f"process {holder['process']} cannot be interrupted; end it where it runs") from None
    return holder
