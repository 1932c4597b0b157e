"""Indentations on a device: recorded, shown while they run, judged; and a device that is a program."""

import json
import os
import select
import signal
import sys
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext, suppress
from importlib.util import find_spec
from pathlib import Path
from queue import SimpleQueue
from threading import Event as Flag
from threading import Thread
from time import monotonic
from typing import Annotated, Any

from rich.console import Group
from rich.live import Live as RichLive
from rich.panel import Panel
from rich.text import Text
from typer import Argument, Exit, Option, prompt

import limbfit

from ..acquire import (
    DEFAULT_ADDRESS,
    DEFAULT_PORT,
    Event,
    Keyboard,
    LiveUpdate,
    PhaseUpdate,
    Update,
    prioritise,
)
from ..acquire.protocol import Abort
from ..acquire.virtual import Endpoint, read_faults
from ..errors import InputError
from ..pipeline.records.traces import describe_record
from ..results.limb import RecordVerdict
from .commands import StudyPath
from .console import STDERR, AsJson, print_aside, print_json, print_line, print_result

MAX_SPEED = 1000  # of an accelerated clock
WIDTH, HEIGHT = 60, 12
MAX_SAMPLES = 3000  # samples shown: two minutes
HINTS = {
    "position": "put the limb in place, the test pin at its site; then Enter",
    "ready": "hold the space bar to push in, let go at the limit of comfort",
    "search": "let go of the space bar to stop",
}


def acquire(
    study: StudyPath,
    site: Annotated[str | None, Option(help="site, or record such as 01-2; default: all not made")] = None,
    device: Annotated[
        str, Option(help="tcp://HOST[:PORT], serial:PATH[@BAUD], or rig:FILE of a rig of your own")
    ] = DEFAULT_ADDRESS,
    depth: Annotated[float | None, Option(help="mm from touch at which the depth search ends")] = None,
    unattended: Annotated[
        bool,
        Option(
            "--unattended",
            help="no operator: the limb counts as in place, and the program holds the key until --depth "
            "(default: the site's depth) or acquire.search_force_N; for scripts and virtual devices",
        ),
    ] = False,
    again: Annotated[bool, Option("--again", help="record again; an old record is kept")] = False,
    as_json: AsJson = False,
) -> None:
    """Record indentations on a device: clamp, find the depth, ramp, release.

    The space bar is the key to be held in the depth search; any other key stops and retracts.
    Exit code 0: all complete and good; 1: stopped, or not good.
    """
    if not unattended and not (sys.stdin.isatty() and find_spec("termios")):
        remedy = "run it in a terminal, or with --unattended"
        raise InputError("the operator's key needs a terminal", place="standard input", remedy=remedy)
    checked = limbfit.load_study(study, recorded=False)
    names = [site] if site else [record.name for record in limbfit.waiting(checked)]
    if not names:
        raise InputError("every record is made", file=checked.file, remedy="give --site and --again")
    for name in names:  # all of them, before the first is made
        limbfit.check_recording(checked, name, depth_mm=depth, unattended=unattended, replace_record=again)
    rows = []
    for name in names:
        tool = checked.indentation(name).indenter
        if tool is not None:
            print_aside(f"{name} is made with the indenter {tool!r}")
        events: SimpleQueue[Event] = SimpleQueue()
        prioritise()  # before the threads of the display and the keys start
        shown = draw_session(name) if STDERR.is_terminal else nullcontext(print_phases(name))
        operated = nullcontext() if unattended else read_keys(events, checked.acquire.key_gap_ms / 1000)
        with _stop_on_signals(events), operated, shown as listen:
            row = limbfit.acquire_site(
                checked,
                name,
                address=device,
                operator=None if unattended else events,
                stops=events,
                depth_mm=depth,
                replace_record=again,
                listener=listen,
            )
        rows.append(row)
        if not as_json:
            _show(row)
        if not row["completed"]:
            break
    if as_json:
        print_json({"sites": rows})
    if not all(row["completed"] and row["verdict"]["good"] for row in rows):
        raise Exit(1)


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
        print_aside(f"stopped: site {row['name']}: {row['reason']} ({row['phase']}{out})")
    else:
        good = "good" if row["verdict"]["good"] else "not good: record it again (--site, --again)"
        print_line(f"site {row['name']}: {row['depth_mm']:.2f} mm deep, record {good}")
        _show_checks(row["verdict"])
    print_line(f"record: {row['files']['record']}")
    if row["files"]["trace"]:
        print_line(f"trace: {row['files']['trace']}")
    elif row["completed"]:
        print_line("trace: none; no ramp counts, or the study names no file for it (sites.trace)")


def _show_checks(verdict: dict[str, Any]) -> None:
    words = {True: "good", False: "BAD", None: "-"}
    for check in verdict["checks"]:
        remedy = f"; {check['remedy']}" if check["passed"] is False and check["remedy"] else ""
        print_line(f"  {words[check['passed']]:<5} {check['name']}: {check['found']}{remedy}")


def recording(
    file: Annotated[Path, Argument(help="record.csv of a session", show_default=False)],
    as_json: AsJson = False,
) -> None:
    """Judge the record of a session, even one that a crash cut short."""
    print_result(limbfit.judge_recording(file), _show_recording, as_json)


def _show_recording(result: dict[str, Any]) -> None:
    cut = f", {result['lost_bytes']} bytes after the last whole block" if result["lost_bytes"] else ""
    print_line(f"site {result['site']}: {result['samples']} samples in {result['seconds']:.1f} s{cut}")
    print_line("phases: " + ", ".join(result["phases"]))
    _show_checks(result["verdict"])


def watch(
    folder: Annotated[Path, Argument(help="folder into which a rig writes records", show_default=False)],
    study: Annotated[
        Path | None, Option(help="study whose [traces] names the columns, and whose sites the records are of")
    ] = None,
    once: Annotated[bool, Option("--once", help="judge what is there, and end")] = False,
    as_json: Annotated[
        bool, Option("--json", help="print one line of JSON a record, and nothing else")
    ] = False,
) -> None:
    """Judge each record as a rig writes it, and say which to make again; Ctrl-C ends it."""
    loaded = None if study is None else limbfit.load_study(study, recorded=False)
    verdicts: set[str] = set()
    if not once:
        print_aside(f"watching {folder}; Ctrl-C ends it")
    with suppress(KeyboardInterrupt):
        for found in limbfit.watch_records(folder, loaded, once=once):
            verdicts.add(found.verdict)
            if as_json:
                print_line(json.dumps(found.to_plain(), allow_nan=False))
            else:
                _show_verdict(found)
            sys.stdout.flush()
    if once and "bad" in verdicts:
        raise Exit(1)


def _show_verdict(found: RecordVerdict) -> None:
    word = "BAD" if found.verdict == "bad" else found.verdict
    name = f"{found.file} (site {found.record})" if found.record else found.file
    print_line(f"{word:<5}{name}" + (f": {describe_record(found.facts)}" if found.facts else ""))
    for reason in found.reasons:
        print_line(f"     {reason}")


def rig(
    file: Annotated[
        Path, Argument(help="TOML file of the rig (docs/device-protocol.md)", show_default=False)
    ],
    weight_kg: Annotated[
        float, Option(help="known mass that is hung on the sensor", min=0.01, show_default=False)
    ],
) -> None:
    """Check the force of a rig of your own with a known weight, as a session needs every day."""
    print_line("leave the force sensor unloaded")
    ask = f"hang {weight_kg:g} kg on it, wait until it hangs still, and press Enter"
    found = limbfit.check_rig(file, weight_kg, lambda: prompt(ask, default="", show_default=False))
    print_line(
        f"the weight shows {found['ratio']:.3f} times its force; next: limbfit acquire --device rig:{file}"
    )


def virtual_fitsocket(
    study: StudyPath,
    seed: Annotated[int, Option(help="seed of the limb's place and the sensors' noise", min=0)] = 0,
    faults: Annotated[Path | None, Option(help="TOML file of faults (docs/acquire.md)")] = None,
    host: Annotated[str, Option(help="address; whoever reaches it can move the pins")] = "127.0.0.1",
    port: Annotated[int, Option(help="TCP port; 0: a free one", min=0, max=65535)] = DEFAULT_PORT,
    terminal: Annotated[bool, Option("--terminal", help="a pseudo terminal instead of a port")] = False,
    speed: Annotated[float, Option(help="how many times faster than real time its clock may run")] = 1.0,
) -> None:
    """Run a virtual FitSocket around the study's simulated limb; Ctrl-C ends it."""
    if not 1 <= speed <= MAX_SPEED:
        remedy = f"1 is the wall's clock, up to {MAX_SPEED} an accelerated one"
        raise InputError(f"{speed:g} is no speed of the clock", place="--speed", remedy=remedy)
    checked = limbfit.load_study(study, recorded=False)
    wrong = read_faults(faults) if faults is not None else ()
    device = limbfit.virtual_fitsocket(checked, seed=seed, faults=wrong, paced=speed > 1)
    serving = Endpoint.open_terminal() if terminal else Endpoint.listen_on_port(host, port)
    wakeup = signal.set_wakeup_fd(-1)
    for kind in (signal.SIGINT, signal.SIGTERM):
        signal.signal(kind, lambda number, frame: serving.stop())
    for name, surrogate in device.limb.sites.items():
        print_aside(f"site {name}: {surrogate.error_percent:.2f} % from its simulation")
    print_line(f"device: {serving.address}")
    sys.stdout.flush()
    limbfit.serve_fitsocket(device, serving, speed=speed, tell=print_aside)
    signal.set_wakeup_fd(wakeup)


def print_phases(site: str) -> Callable[[Update], None]:
    """A listener that prints phases as lines on standard error, with the time since the first."""
    began: list[float] = []

    def listen(update: Update) -> None:
        if isinstance(update, PhaseUpdate):
            began.append(update.time_s)
            cycle = f" (ramp {update.cycle})" if update.phase in ("load", "hold", "unload") else ""
            reason = f": {update.reason}" if update.reason else ""
            print_aside(f"[{update.time_s - began[0]:8.3f} s] site {site}: {update.phase}{cycle}{reason}")

    return listen


@contextmanager
def draw_session(site: str) -> Iterator[Callable[[Update], None]]:
    """A listener that draws two plots with characters, eight times a second, by a thread of rich's."""
    phases = [PhaseUpdate("idle", 0.0)]
    samples: deque[LiveUpdate] = deque(maxlen=MAX_SAMPLES)

    def listen(update: Update) -> None:
        if isinstance(update, PhaseUpdate):
            phases.append(update)
        else:
            samples.append(update)

    def draw() -> Group:
        return _draw_plots(site, phases[-1], list(samples))

    with RichLive(console=STDERR, refresh_per_second=8, get_renderable=draw):
        yield listen


def _draw_plots(site: str, phase: PhaseUpdate, samples: list[LiveUpdate]) -> Group:
    head = Text(f"site {site}   {phase.phase}   ", style="bold")
    if samples:
        last = samples[-1]
        head.append(f"{last.displacement_mm:7.2f} mm {last.force_N:7.2f} N {last.capacitance_pF:6.1f} pF   ")
        head.append(f"clamps {last.clamp_N:5.1f} N")
    hint = phase.reason or HINTS.get(phase.phase, "any other key: emergency stop")
    touched = [s for s in samples if s.phase in ("search", "return", "load", "hold", "unload")]
    over_mm = plot([s.displacement_mm for s in touched], [s.force_N for s in touched])
    over_s = plot([s.time_s for s in samples], [s.force_N for s in samples])
    plots = (Panel(over_mm, title="N over mm", width=66), Panel(over_s, title="N over s", width=66))
    return Group(head, Text(hint), *plots)


def plot(x: list[float], y: list[float]) -> str:
    """Points drawn with characters, with the smallest and largest value of both axes."""
    if len(x) < 2:
        return "\n" * (HEIGHT + 1)
    low, high, bottom, top = min(x), max(x), min(0.0, *y), max(*y, 1.0)
    field = [[" "] * WIDTH for _ in range(HEIGHT)]
    for at, value in zip(x, y):
        column = round((at - low) / ((high - low) or 1.0) * (WIDTH - 1))
        row = round((value - bottom) / (top - bottom) * (HEIGHT - 1))
        field[HEIGHT - 1 - row][column] = "•"
    lines = ["".join(row).rstrip() for row in field]
    lines[0] = f"{top:.1f}".ljust(6) + lines[0][6:]
    foot = f"{low:.1f}".ljust(WIDTH - 8) + f"{high:.1f}".rjust(8)
    return "\n".join([*lines, foot])


@contextmanager
def read_keys(events: SimpleQueue[Event], gap_s: float) -> Iterator[None]:
    """Read the terminal's keys, unbuffered and unechoed, in a thread; it is as before afterwards."""
    import termios
    import tty

    handle = sys.stdin.fileno()
    before = termios.tcgetattr(handle)
    over = Flag()

    def read() -> None:
        keyboard = Keyboard(gap_s)
        while not over.is_set():
            ready, _, _ = select.select([handle], [], [], 0.01)
            typed = os.read(handle, 64) if ready else b""
            for event in (*keyboard.read(typed, monotonic()), *keyboard.check_release(monotonic())):
                events.put(event)

    thread = Thread(target=read, name="keys", daemon=True)
    tty.setcbreak(handle)
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join()
        termios.tcsetattr(handle, termios.TCSADRAIN, before)


VERBS = (acquire, recording, watch, rig, virtual_fitsocket)
