"""``limbfit`` commands as processes of their own: found by their command line, started, interrupted."""

from __future__ import annotations

import os
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

from ..execution import SAFE_PATH

PROGRAM = ("-m", "limbfit")  # for this Python
STARTING_S = 2.0  # a process that is younger has begun nothing that would have to be kept


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
    process = subprocess.Popen(
        [sys.executable, *words],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=stderr,
        cwd=folder,
        env=os.environ | SAFE_PATH,
        start_new_session=True,
    )
    while process.poll() is None and not _is_known(process.pid):
        time.sleep(0.001)
    Thread(target=process.wait, daemon=True).start()  # so that it leaves the table of processes
    return process.pid


def _is_known(process: int) -> bool:
    """Whether its command line can be read, by which it is found: at first it has none."""
    try:
        return bool(psutil.Process(process).cmdline())
    except psutil.NoSuchProcess:  # ended meanwhile
        return True


def interrupt_process(process: int) -> None:
    """What Ctrl-C in its terminal would do.

    A process that only starts is terminated too: Python may lose an interrupt then.

    Raises
    ------
    psutil.Error
        Where there is no such process, or it belongs to somebody else.
    """
    found = psutil.Process(process)
    starts = time.time() - found.create_time() < STARTING_S
    found.send_signal(signal.SIGINT)
    if starts:
        with suppress(psutil.NoSuchProcess):
            found.terminate()
