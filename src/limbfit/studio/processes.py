"""``limbfit`` commands as processes of their own: started, found again after a restart, and stopped.

A run is ``limbfit run STUDY``, or one of ``limbfit socket``. The study's lock tells whether one runs, whoever
started it, and the study's log tells what it does. A simulation of one site is
``limbfit simulate STUDY --animation --site NAME``: it is found by its command line, and the files that it
writes after every step tell how far it is.
"""

import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from threading import Thread
from typing import IO

import psutil

from ..errors import RunError
from ..execution import SAFE_PATH
from ..pipeline.commands.run import select_stages_to_redo
from ..pipeline.engine.context import redact_paths
from ..pipeline.engine.store import find_holder, is_held
from ..study import load_study
from .folder import Json, StudyFolder

PROGRAM = ("-m", "limbfit")  # for this Python
VERBS = (("run",), ("socket", "fit"), ("socket", "design"))  # that are started here
STARTING_S = 2.0  # a process that is younger has begun nothing that would have to be kept
MAX_ERROR_LENGTH = 400  # characters of the error of a failed simulation that are shown
_HOLDER = re.compile(r"process (\d+) \(since ([^)]*)\)")


def find_running(folder: StudyFolder) -> Json | None:
    """``process`` and ``since`` of the run that holds the study; None where none does."""
    holder = _HOLDER.match(find_holder(folder.results))
    if holder is None or not psutil.pid_exists(int(holder[1])) or not is_held(folder.results):
        return None
    return {"process": int(holder[1]), "since": holder[2]}


def find_starting(folder: StudyFolder) -> int | None:
    """The process that was started here for a run and does not hold the study yet; None where none is."""
    commands = (find_command(_build_run_words(folder, *verb)) for verb in VERBS)
    return next((command[0] for command in commands if command is not None), None)


def _build_run_words(folder: StudyFolder, *verb: str) -> list[str]:
    return [*PROGRAM, *verb, str(folder.file.absolute())]  # not what a link names: results are beside it


def start_run(folder: StudyFolder, until: str | None, start: str | None, force: Sequence[str]) -> Json:
    """Start ``limbfit run`` on the study; what it reports goes to the study's log, as always. Raises
    `InputError` where the study cannot be read, a record is yet to be made, or a stage does not exist or
    comes after the last, and `RunError` where a run holds the study.
    """
    _refuse_busy(folder)
    select_stages_to_redo(folder.load(), until, start, force)
    options = [*(["--until", until] if until else []), *(["--from", start] if start else [])]
    options += [word for name in force for word in ("--force", name)]
    return {"process": start_command([*_build_run_words(folder, "run"), *options], folder.folder)}


def start_socket(folder: StudyFolder, *, design: bool) -> Json:
    """Start ``limbfit socket fit`` or ``limbfit socket design`` on the study; the errors of `start_run`."""
    _refuse_busy(folder)
    words = _build_run_words(folder, "socket", "design" if design else "fit")
    return {"process": start_command(words, folder.folder)}


def _refuse_busy(folder: StudyFolder) -> None:
    load_study(folder.file)
    holder = find_running(folder)
    busy = find_starting(folder) if holder is None else holder["process"]
    if busy is not None:
        raise RunError(f"process {busy} is running this study; stop it first, or wait for it")


def stop_run(folder: StudyFolder) -> Json:
    """Interrupt the run, as Ctrl-C would; `RunError` where none holds the study, or no ``limbfit`` does."""
    holder = find_running(folder)
    if holder is None and (early := find_starting(folder)) is not None:
        holder = {"process": early}
    if holder is None:
        raise RunError("no run holds this study: there is nothing to stop")
    try:
        process = psutil.Process(holder["process"])
        words = process.cmdline()
        if not any(Path(word).name in ("limbfit", "limbfit.exe") for word in words[:4]):
            what = f"process {process.pid}, which holds this study, is no limbfit command"
            raise RunError(f"{what}; end it where it runs")
        interrupt_process(process.pid)
    except psutil.Error:
        raise RunError(f"process {holder['process']} cannot be interrupted; end it where it runs") from None
    return holder


def find_simulating(folder: StudyFolder) -> Json | None:
    """``process`` and ``site`` of the simulation that this study has running; None where it has none."""
    begin = _build_simulation_words(folder)
    command = find_command(begin)
    return None if command is None else {"process": command[0], "site": command[1][len(begin)]}


def _build_simulation_words(folder: StudyFolder) -> list[str]:
    return [*_build_run_words(folder, "simulate"), "--animation", "--site"]


def start_simulation(folder: StudyFolder, site: str) -> Json:
    """Simulate a site with all fields; `InputError` for an unknown one, `RunError` where another goes on."""
    name = folder.load().indentation(site).name
    holder = find_running(folder) or find_simulating(folder)
    if holder is not None:
        raise RunError(f"process {holder['process']} works on this study; stop it first, or wait for it")
    file = _find_output_file(folder, name)
    file.parent.mkdir(parents=True, exist_ok=True)
    with file.open("wb") as stderr:
        process = start_command([*_build_simulation_words(folder), name], folder.folder, stderr)
    return {"process": process, "site": name}


def _find_output_file(folder: StudyFolder, site: str) -> Path:
    return folder.results / "simulate" / f".{site}.said"


def stop_simulation(folder: StudyFolder) -> Json:
    """Interrupt the simulation; the steps it has stored stay. Raises `RunError` where none goes on."""
    simulation = find_simulating(folder)
    if simulation is None:
        raise RunError("no simulation is running: there is nothing to stop")
    with suppress(psutil.NoSuchProcess):  # it has ended meanwhile
        interrupt_process(simulation["process"])
    return simulation


def read_failure(folder: StudyFolder, site: str) -> str | None:
    """The error with which the last simulation of a site ended; None where it ended well or goes on."""
    file = _find_output_file(folder, folder.load().indentation(site).name)
    if not file.is_file():
        return None
    lines = [line.strip() for line in file.read_text(encoding="utf-8", errors="replace").splitlines()]
    errors = [line for line in lines if line.startswith("error:")]
    return redact_paths(errors[-1], folder.load())[:MAX_ERROR_LENGTH] if errors else None


def find_command(begin: Sequence[str]) -> tuple[int, list[str]] | None:
    """The process whose words after the interpreter begin with ``begin``, and those words; None if none."""
    for process in psutil.process_iter(["pid", "cmdline", "status"]):
        words = (process.info["cmdline"] or [])[1:]
        if words[: len(begin)] == list(begin) and process.info["status"] != psutil.STATUS_ZOMBIE:
            return process.info["pid"], words
    return None


def start_command(words: Sequence[str], folder: Path, stderr: int | IO[bytes] = subprocess.DEVNULL) -> int:
    """Start this Python with ``words`` in a session of its own, so that it lives on when the server ends.

    It is started in ``folder``, but takes no code from there. Returns its process number.
    """
    process = psutil.Popen(
        [sys.executable, *words],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=stderr,
        cwd=folder,
        env=os.environ | SAFE_PATH,
        start_new_session=True,
    )
    with suppress(psutil.NoSuchProcess):  # it has ended
        while not process.cmdline():  # by which it is found, and which at first is empty
            time.sleep(0.001)
    Thread(target=process.wait, daemon=True).start()  # so that it leaves the table of processes
    return process.pid


def interrupt_process(process: int) -> None:
    """Do what Ctrl-C in its terminal would do.

    A process that only starts is terminated too: Python may lose an interrupt then. Raises `psutil.Error`
    where there is no such process, or it belongs to somebody else.
    """
    running = psutil.Process(process)
    starts = time.time() - running.create_time() < STARTING_S
    running.send_signal(signal.SIGINT)
    if starts:
        with suppress(psutil.NoSuchProcess):
            running.terminate()
