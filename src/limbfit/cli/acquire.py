"""Indentations on a device: record them, look at a record, and a device that is a program."""

from __future__ import annotations

import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from importlib.util import find_spec
from pathlib import Path
from queue import SimpleQueue
from typing import Annotated, Any

import typer

import limbfit

from ..acquire import DEFAULT_ADDRESS, DEFAULT_PORT, Event, prioritise
from ..acquire.events import Abort
from ..acquire.virtual import Serving, read_faults
from ..errors import InputError
from .commands import StudyPath
from .console import STDERR, STDOUT, AsJson, print_json
from .live import Live, PlainLines, read_keys

MOST_SPEED = 1000  # of an accelerated clock


def acquire(
    study: StudyPath,
    site: Annotated[
        str | None, typer.Option(help="site, or record such as 01-2; default: all not made yet")
    ] = None,
    device: Annotated[
        str, typer.Option(help="tcp://HOST[:PORT] or serial:PATH[@BAUD]", metavar="ADDRESS")
    ] = DEFAULT_ADDRESS,
    depth: Annotated[
        float | None, typer.Option(help="mm from touch at which the depth search ends by itself")
    ] = None,
    unattended: Annotated[
        bool,
        typer.Option(
            "--unattended",
            help="no operator: the limb counts as in place, and the program holds the key until --depth "
            "(default: the site's depth) or acquire.search_force_N; for scripts and virtual devices",
        ),
    ] = False,
    again: Annotated[
        bool, typer.Option("--again", help="record again where a record exists, and keep the old one")
    ] = False,
    as_json: AsJson = False,
) -> None:
    """Record indentations on a device: clamp, find the depth, ramp, release.

    The space bar is the key to be held in the depth search; any other key stops and retracts.
    Exit code 0: all complete and good; 1: stopped, or not good.
    """
    if not unattended and not (sys.stdin.isatty() and find_spec("termios")):
        remedy = "run it in a terminal, or with --unattended"
        raise InputError("the operator's key needs a terminal", place="standard input", remedy=remedy)
    given = limbfit.load_study(study, recorded=False)
    names = [site] if site else [one.name for one in limbfit.waiting(given)]
    if not names:
        raise InputError("every record is made", file=given.file, remedy="give --site and --again")
    for name in names:  # all of them, before the first is made
        limbfit.check_recording(given, name, depth_mm=depth, unattended=unattended, replace_record=again)
    rows = []
    for name in names:
        tool = given.indentation(name).indenter
        if tool is not None:
            STDERR.print(f"{name} is made with the indenter {tool!r}", soft_wrap=True)
        rows.append(_acquire_one(given, name, device, depth, unattended, again))
        if not as_json:
            _show(rows[-1])
        if not rows[-1]["completed"]:
            break
    if as_json:
        print_json({"sites": rows})
    if not all(row["completed"] and row["verdict"]["good"] for row in rows):
        raise typer.Exit(1)


def _acquire_one(
    study: limbfit.Study, name: str, device: str, depth: float | None, unattended: bool, again: bool
) -> dict[str, Any]:
    events: SimpleQueue[Event] = SimpleQueue()
    prioritise()  # before the threads of the display and the keys start
    shown = Live(name, study.acquire) if STDERR.is_terminal else PlainLines(name)
    operated = nullcontext() if unattended else read_keys(events, study.acquire.key_gap_ms / 1000)
    with _stop_on_signals(events), operated, shown:
        return limbfit.acquire_site(
            study,
            name,
            address=device,
            operator=None if unattended else events,
            stops=events,
            depth_mm=depth,
            replace_record=again,
            listener=shown.listen,
        )


@contextmanager
def _stop_on_signals(events: SimpleQueue[Event]) -> Iterator[None]:
    """Interrupt, hang-up and termination stop the session, which then retracts; none of them kills it."""

    def stop(number: int, frame: Any) -> None:
        events.put(Abort(f"signal {signal.Signals(number).name}"))

    kinds = [getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)]
    wakeup = signal.set_wakeup_fd(-1)  # whose watch would end the process in the middle of a retraction
    before = [(kind, signal.signal(kind, stop)) for kind in kinds]
    try:
        yield
    finally:
        for kind, handler in before:
            signal.signal(kind, handler)
        signal.set_wakeup_fd(wakeup)


def _show(row: dict[str, Any]) -> None:
    if not row["completed"]:
        out = f"; pins out of reach: {', '.join(map(str, row['unreachable']))}" if row["unreachable"] else ""
        STDERR.print(f"stopped: site {row['name']}: {row['reason']} ({row['phase']}{out})", soft_wrap=True)
    else:
        good = "good" if row["verdict"]["good"] else "not good: record it again (--site, --again)"
        STDOUT.print(f"site {row['name']}: {row['depth_mm']:.2f} mm deep, record {good}", soft_wrap=True)
        _show_checks(row["verdict"])
    STDOUT.print(f"record: {row['files']['record']}", soft_wrap=True)
    if row["files"]["trace"]:
        STDOUT.print(f"trace: {row['files']['trace']}", soft_wrap=True)
    elif row["completed"]:
        STDOUT.print(
            "trace: none; no ramp counts, or the study names no file for it (sites.trace)", soft_wrap=True
        )


def _show_checks(verdict: dict[str, Any]) -> None:
    words = {True: "good", False: "BAD", None: "-"}
    for check in verdict["checks"]:
        remedy = f"; {check['remedy']}" if check["passed"] is False and check["remedy"] else ""
        STDOUT.print(
            f"  {words[check['passed']]:<5} {check['name']}: {check['found']}{remedy}", soft_wrap=True
        )


def recording(
    file: Annotated[Path, typer.Argument(help="record.csv of a session", show_default=False)],
    as_json: AsJson = False,
) -> None:
    """Judge the record of a session, even one that a crash cut short."""
    found = limbfit.judge_recording(file)
    if as_json:
        print_json(found)
        return
    cut = f", {found['lost_bytes']} bytes after the last whole block" if found["lost_bytes"] else ""
    STDOUT.print(f"site {found['site']}: {found['samples']} samples in {found['seconds']:.1f} s{cut}")
    STDOUT.print("phases: " + ", ".join(found["phases"]), soft_wrap=True)
    _show_checks(found["verdict"])


def virtual_fitsocket(
    study: StudyPath,
    seed: Annotated[int, typer.Option(help="seed of the limb's place and the sensors' noise", min=0)] = 0,
    faults: Annotated[Path | None, typer.Option(help="TOML file of faults (docs/acquire.md)")] = None,
    host: Annotated[
        str, typer.Option(help="address to listen at; whoever reaches it can move the pins")
    ] = "127.0.0.1",
    port: Annotated[int, typer.Option(help="TCP port; 0: a free one", min=0, max=65535)] = DEFAULT_PORT,
    terminal: Annotated[bool, typer.Option("--terminal", help="a pseudo terminal instead of a port")] = False,
    speed: Annotated[
        float,
        typer.Option(
            help="how many times faster than real time the clock may run, 1 to 1000; it waits for limbfit"
        ),
    ] = 1.0,
) -> None:
    """Run a virtual FitSocket around the study's simulated limb; Ctrl-C ends it."""
    if not 1 <= speed <= MOST_SPEED:
        remedy = f"1 is the wall's clock, up to {MOST_SPEED} an accelerated one"
        raise InputError(f"{speed:g} is no speed of the clock", place="--speed", remedy=remedy)
    given = limbfit.load_study(study, recorded=False)
    wrong = read_faults(faults) if faults is not None else ()
    device = limbfit.virtual_fitsocket(given, seed=seed, faults=wrong, paced=speed > 1)
    serving = Serving.on_terminal() if terminal else Serving.on_port(host, port)
    wakeup = signal.set_wakeup_fd(-1)
    for kind in (signal.SIGINT, signal.SIGTERM):
        signal.signal(kind, lambda number, frame: serving.stop())
    for name, surrogate in device.limb.sites.items():
        STDERR.print(f"site {name}: {surrogate.error_percent:.2f} % from its simulation", soft_wrap=True)
    STDOUT.print(f"device: {serving.address}", soft_wrap=True)
    sys.stdout.flush()
    limbfit.serve_fitsocket(
        device, serving, speed=speed, tell=lambda line: STDERR.print(line, soft_wrap=True)
    )
    signal.set_wakeup_fd(wakeup)


VERBS = (acquire, recording, virtual_fitsocket)
