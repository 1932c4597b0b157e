"""What the commands print with: results on standard output, progress and errors on standard error."""

import json
import os
import signal
import socket
import sys
from collections.abc import Callable, Container, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from pathlib import Path
from threading import Event, Thread
from time import perf_counter, sleep
from types import FrameType
from typing import Annotated, Any

from rich import progress
from rich.console import Console
from rich.table import Table
from typer import Option

import limbfit

from ..errors import InputError
from ..laws import split_key

INTERRUPTED = "interrupted; run the same command again to continue"
HEARING_TIME_S = 3.0  # for an interrupt to be heard
CLEARING_TIME_S = 15.0  # for what heard it to end its workers and files
STDOUT = Console(highlight=False, markup=False, emoji=False)
STDERR = Console(stderr=True, highlight=False, markup=False, emoji=False)
FILE_WIDTH = 10_000  # characters
Show = Callable[[Any], None]
Column = str | tuple[str, str] | Callable[[Any], str]
AsJson = Annotated[bool, Option("--json", help="print JSON and nothing else")]


def print_json(content: Any) -> None:
    sys.stdout.write(json.dumps(content, indent=1, allow_nan=False) + "\n")


def print_result(content: Any, show: Show, as_json: bool) -> None:
    """Print what a command found: as JSON and nothing else, or as ``show`` prints it."""
    if as_json:
        print_json(content)
    else:
        show(content)


def print_stored(content: dict[str, Any], name: str, show: Show, as_json: bool) -> None:
    """Print a result, stored by ``name``: as JSON, or as ``show`` prints what is stored, and where it is."""
    if as_json:
        print_json(content)
        return
    show(getattr(limbfit.StudyResults(Path(content["folder"]).parent), name))
    place = f"report: {content['report']}" if "report" in content else "limbfit report shows it"
    print_line(f"stored in {content['folder']}; {place}")


def print_line(text: str) -> None:
    """Print a line on standard output; a terminal wraps it, rich does not."""
    STDOUT.print(text, soft_wrap=True)


def print_aside(text: str) -> None:
    """Print a line on standard error: a note, or an error that does not end the program."""
    STDERR.print(text, soft_wrap=True)


def print_warning(text: str) -> None:
    print_aside(f"warning: {text}")


def print_warnings(texts: Iterable[str]) -> None:
    for text in texts:
        print_warning(text)


def print_table(
    rows: Iterable[Any], columns: Mapping[str, Column], *, dash: str = "-", unwrapped: Container[str] = ()
) -> None:
    """Print rows as a table of columns by their heads, each with what stands below it.

    A column is an attribute or key of the rows, one with a format, or a function of the row. A value that is
    not there is a ``dash``. Cells of ``unwrapped`` columns stay on one line, in files and pipes all do.
    """
    if not STDOUT.is_terminal:
        STDOUT.width = FILE_WIDTH
    table = Table(box=None)
    for head in columns:
        whole = head in unwrapped
        table.add_column(head, no_wrap=whole, overflow="ellipsis" if whole else "fold")
    for row in rows:
        table.add_row(*(_format_cell(row, column, dash) for column in columns.values()))
    STDOUT.print(table)


def _format_cell(row: Any, column: Column, dash: str) -> str:
    if callable(column):
        return column(row)
    key, form = (column, "") if isinstance(column, str) else column
    value = row.get(key) if isinstance(row, Mapping) else getattr(row, key)
    return dash if value is None else format(value, form)


def format_use(row: Any) -> str:
    """The words for a site or record that was fitted, or held out."""
    fitted = row["fitted"] if isinstance(row, Mapping) else row.fitted
    return "fitted" if fitted else "held out"


@contextmanager
def listen_on_console() -> Iterator[Callable[[limbfit.Progress], None]]:
    """A listener that draws bars on a terminal and prints plain lines elsewhere, on standard error.

    An interrupt ends here: typer would turn it into an exit without a word.
    """
    try:
        with _draw_bars() if STDERR.is_terminal else nullcontext(_build_plain_listener()) as listener:
            yield listener
    except KeyboardInterrupt:
        fail(INTERRUPTED, 130)


def call_with_progress(function: Callable[..., Any], *arguments: Any, **options: Any) -> Any:
    """Call a function of the library, and show its progress."""
    with listen_on_console() as listener:
        return function(*arguments, listener=listener, **options)


@contextmanager
def _draw_bars() -> Iterator[Callable[[limbfit.Progress], None]]:
    columns = (
        progress.SpinnerColumn(),
        progress.TextColumn("{task.description:<10}"),
        progress.BarColumn(),
        progress.TimeElapsedColumn(),
        progress.TimeRemainingColumn(),
        progress.TextColumn("{task.fields[text]}"),
    )
    with progress.Progress(*columns, console=STDERR) as shown:
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


def _build_plain_listener() -> Callable[[limbfit.Progress], None]:
    start = perf_counter()

    def listen(event: limbfit.Progress) -> None:
        share = f" {round(event.done, 1):g}/{event.total:g}" if event.total else ""
        text = f": {event.text}" if event.text else ""
        print_aside(f"[{perf_counter() - start:7.1f} s] {event.stage}{share}{text}")

    return listen


@contextmanager
def prompt_interrupt() -> Iterator[None]:
    """A second way out for Ctrl-C: a solver's library does not come back to be interrupted while it works.

    What is on disk is whole at every moment, so that ending at once loses no more than the work in progress.
    """
    reader, writer = socket.socketpair()
    writer.setblocking(False)
    wakeup = signal.set_wakeup_fd(writer.fileno(), warn_on_full_buffer=False)
    heard = Event()

    def hear(number: int, frame: FrameType | None) -> None:
        heard.set()
        raise KeyboardInterrupt

    def watch() -> None:
        while numbers := reader.recv(64):
            if signal.SIGINT in numbers:
                if heard.wait(HEARING_TIME_S):
                    sleep(CLEARING_TIME_S)
                os.write(2, f"error: {INTERRUPTED}\n".encode())
                os._exit(130)

    Thread(target=watch, daemon=True).start()
    handler = signal.signal(signal.SIGINT, hear)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, handler)
        signal.set_wakeup_fd(wakeup)
        writer.close()  # which ends the watch


def build_parameter_columns(keys: Iterable[str]) -> dict[str, Column]:
    """A column for each parameter; the head of ``tau_s`` is ``tau (s)``."""
    split = {key: split_key(key) for key in keys}
    return {f"{name} ({unit})" if unit else name: (key, ".3g") for key, (name, unit) in split.items()}


def format_ends(interval: Sequence[float] | None, form: str = ".3g") -> str:
    """Both ends of an interval; nothing where there is none."""
    return "" if interval is None else " to ".join(format(end, form) for end in interval)


def parse_numbers(text: str, least: float, most: float) -> list[float]:
    """Numbers with commas between them; none at all where one is none, or out of range."""
    try:
        values = [float(part) for part in text.split(",")]
    except ValueError:
        return []
    return values if all(least <= value <= most for value in values) else []


def refuse_idle_options(options: Mapping[str, Any], when: str) -> None:
    """Refuse options, by name, that are given (not None) where they have no effect."""
    for name, value in options.items():
        if value is not None:
            raise InputError(f"has no effect {when}", place=f"--{name}", remedy="leave it out")


def fail(text: str, code: int) -> None:
    """One line on standard error, without control characters, then the exit."""
    line = "".join(c if c.isprintable() else " " for c in " ".join(text.split()))
    print_aside(f"error: {line}")
    sys.exit(code)
