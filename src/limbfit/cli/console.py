"""What the commands print with: results on standard output, progress and errors on standard error."""

from __future__ import annotations

import json
import os
import signal
import socket
import sys
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, nullcontext
from threading import Event, Thread
from time import perf_counter, sleep
from types import FrameType
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.progress import (
    BarColumn,
    Progress,
    SpinnerColumn,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)

import limbfit

from ..laws import split_key

INTERRUPTED = "interrupted; run the same command again to continue"
_PATIENCE_S = 3.0  # for an interrupt to be heard
_CLEARING_S = 15.0  # for what heard it to end its workers and files
STDOUT = Console(highlight=False, markup=False)
STDERR = Console(stderr=True, highlight=False, markup=False)
AsJson = Annotated[bool, typer.Option("--json", help="print JSON and nothing else")]


def print_json(content: Any) -> None:
    sys.stdout.write(json.dumps(content, indent=1, allow_nan=False) + "\n")


def tell_stored(found: dict[str, Any], show: Callable[[dict[str, Any]], None], as_json: bool) -> None:
    """What an experiment found: as JSON and nothing else, or in words with where it is stored."""
    if as_json:
        print_json(found)
        return
    show(found)
    shown = f"report: {found['report']}" if "report" in found else "limbfit report shows it"
    STDOUT.print(f"stored in {found['folder']}; {shown}", soft_wrap=True)


@contextmanager
def listen_on_console() -> Iterator[Callable[[limbfit.Progress], None]]:
    """A listener that draws bars on a terminal and prints plain lines elsewhere, on standard error.

    An interrupt ends here: typer would turn it into an exit without a word.
    """
    try:
        with draw_bars() if STDERR.is_terminal else nullcontext(build_plain_listener()) as listener:
            yield listener
    except KeyboardInterrupt:
        fail(INTERRUPTED, 130)


@contextmanager
def draw_bars() -> Iterator[Callable[[limbfit.Progress], None]]:
    columns = (
        SpinnerColumn(),
        TextColumn("{task.description:<10}"),
        BarColumn(),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
        TextColumn("{task.fields[text]}"),
    )
    with Progress(*columns, console=STDERR) as shown:
        tasks: dict[str, Any] = {}
        fits: dict[str, str] = {}

        def listen(event: limbfit.Progress) -> None:
            if event.stage not in tasks:
                tasks[event.stage] = shown.add_task(event.stage, text="", total=None)
            text = event.text
            if event.fit:  # stays in sight while simulations come and go
                fits[event.stage] = text
            elif event.stage in fits:
                text = f"{fits[event.stage]} ({text})" if event.done < 1 else text
            shown.update(tasks[event.stage], completed=event.done, total=event.total or None, text=text)

        yield listen


def build_plain_listener() -> Callable[[limbfit.Progress], None]:
    start = perf_counter()

    def listen(event: limbfit.Progress) -> None:
        share = f" {round(event.done, 1):g}/{event.total:g}" if event.total else ""
        text = f": {event.text}" if event.text else ""
        STDERR.print(f"[{perf_counter() - start:7.1f} s] {event.stage}{share}{text}", soft_wrap=True)

    return listen


@contextmanager
def prompt_interrupt() -> Iterator[None]:
    """A second way out for Ctrl-C: a solver's library does not come back to be interrupted while it works.

    What is on disk is whole at every moment, so that ending at once loses no more than the work in progress.
    """
    near, far = socket.socketpair()
    for end in (near, far):
        end.setblocking(False)
    wakeup = signal.set_wakeup_fd(far.fileno(), warn_on_full_buffer=False)
    near.setblocking(True)
    heard = Event()

    def hear(number: int, frame: FrameType | None) -> None:
        heard.set()
        raise KeyboardInterrupt

    def watch() -> None:
        while numbers := near.recv(64):
            if signal.SIGINT in numbers:
                if heard.wait(_PATIENCE_S):
                    sleep(_CLEARING_S)
                os.write(2, f"error: {INTERRUPTED}\n".encode())
                os._exit(130)

    Thread(target=watch, daemon=True).start()
    handler = signal.signal(signal.SIGINT, hear)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, handler)
        signal.set_wakeup_fd(wakeup)
        far.close()  # which ends the watch


def format_parameter_heads(keys: Iterable[str]) -> list[str]:
    """Parameters as heads of columns: ``tau_s`` is ``tau (s)``."""
    split = [split_key(key) for key in keys]
    return [f"{name} ({unit})" if unit else name for name, unit in split]


def fail(text: str, code: int) -> None:
    """One line on standard error, without control characters, then the exit."""
    line = "".join(c if c.isprintable() else " " for c in " ".join(text.split()))
    STDERR.print(f"error: {line}", soft_wrap=True)
    sys.exit(code)
