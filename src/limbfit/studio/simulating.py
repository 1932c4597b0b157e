"""Simulations of one site as processes of their own: started, found again after a restart, and stopped.

Such a process is ``limbfit simulate STUDY --animation --site NAME``. It is found by its command line, and
what it has reached by the files that it writes after every step.
"""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path
from typing import Any

import psutil

from ..errors import RunError
from ..pipeline.engine.journal import redact_paths
from .commands import PROGRAM, find_command, interrupt_process, start_command
from .folder import StudyFolder
from .processes import find_running

_SAID = 400  # characters of what a failed simulation said that are told


def find_simulating(folder: StudyFolder) -> dict[str, Any] | None:
    """``process`` and ``site`` of the simulation that this study has running; None where it has none."""
    begin = _read_words(folder)
    found = find_command(begin)
    return None if found is None else {"process": found[0], "site": found[1][len(begin)]}


def _read_words(folder: StudyFolder) -> list[str]:
    return [*PROGRAM, "simulate", str(folder.file.resolve()), "--animation", "--site"]


def start_simulation(folder: StudyFolder, site: str) -> dict[str, Any]:
    """Simulate a site with the fields of every step.

    Raises
    ------
    InputError
        For a site that the study does not have.
    RunError
        Where the study is being run or a simulation goes on.
    """
    name = folder.load().indentation(site).name
    holder = find_running(folder) or find_simulating(folder)
    if holder is not None:
        raise RunError(f"process {holder['process']} works on this study; stop it first, or wait for it")
    _find_output_file(folder, name).parent.mkdir(parents=True, exist_ok=True)
    with _find_output_file(folder, name).open("wb") as said:
        process = start_command([*_read_words(folder), name], folder.folder, said)
    return {"process": process, "site": name}


def _find_output_file(folder: StudyFolder, site: str) -> Path:
    return folder.results / "simulate" / f".{site}.said"


def stop_simulation(folder: StudyFolder) -> dict[str, Any]:
    """Interrupt the simulation, as Ctrl-C would; the steps it has stored stay.

    Raises
    ------
    RunError
        Where none goes on.
    """
    found = find_simulating(folder)
    if found is None:
        raise RunError("no simulation is running: there is nothing to stop")
    with suppress(psutil.NoSuchProcess):  # it has ended meanwhile
        interrupt_process(found["process"])
    return found


def read_failure(folder: StudyFolder, site: str) -> str | None:
    """The error with which the last simulation of a site ended; None where it ended well or goes on."""
    file = _find_output_file(folder, folder.load().indentation(site).name)
    if not file.is_file():
        return None
    lines = [line.strip() for line in file.read_text(encoding="utf-8", errors="replace").splitlines()]
    told = [line for line in lines if line.startswith("error:")]
    return redact_paths(told[-1], folder.load())[:_SAID] if told else None
