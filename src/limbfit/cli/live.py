"""A session as it runs: force against displacement and time in the terminal, or plain lines; and the keys."""

from __future__ import annotations

import os
import select
import sys
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
from queue import SimpleQueue
from threading import Event as Flag
from threading import Thread
from time import monotonic
from typing import Any

from rich.console import Group
from rich.live import Live as RichLive
from rich.panel import Panel
from rich.text import Text

from ..acquire import Event, Keyboard, LiveUpdate, PhaseUpdate, Update
from ..study.tables import AcquireTable
from .console import STDERR

WIDTH, HEIGHT = 60, 12
KEPT = 3000  # samples shown: two minutes
HINTS = {
    "position": "put the limb in place, the test pin at its site; then Enter",
    "ready": "hold the space bar to push in, let go at the limit of comfort",
    "search": "let go of the space bar to stop",
}


class PlainLines:
    """Phases as lines on standard error, with the time since the first."""

    def __init__(self, site: str) -> None:
        self.site = site
        self._began: float | None = None

    def __enter__(self) -> PlainLines:
        return self

    def __exit__(self, *what: object) -> None:
        """Nothing to take down."""

    def listen(self, update: Update) -> None:
        if isinstance(update, PhaseUpdate):
            self._began = update.time_s if self._began is None else self._began
            cycle = f" (ramp {update.cycle})" if update.phase in ("load", "hold", "unload") else ""
            reason = f": {update.reason}" if update.reason else ""
            since = update.time_s - self._began
            STDERR.print(f"[{since:8.3f} s] site {self.site}: {update.phase}{cycle}{reason}", soft_wrap=True)


class Live:
    """Two plots drawn with characters, eight times a second, by a thread of rich's."""

    def __init__(self, site: str, settings: AcquireTable) -> None:
        self.site, self.settings = site, settings
        self._phase = PhaseUpdate("idle", 0.0)
        self._samples: deque[LiveUpdate] = deque(maxlen=KEPT)
        self._shown = RichLive(console=STDERR, refresh_per_second=8, get_renderable=self._draw)

    def __enter__(self) -> Live:
        self._shown.start()
        return self

    def __exit__(self, *what: object) -> None:
        self._shown.stop()

    def listen(self, update: Update) -> None:
        if isinstance(update, PhaseUpdate):
            self._phase = update
        else:
            self._samples.append(update)

    def _draw(self) -> Any:
        samples = list(self._samples)
        phase = self._phase
        head = Text(f"site {self.site}   {phase.phase}   ", style="bold")
        if samples:
            last = samples[-1]
            head.append(
                f"{last.displacement_mm:7.2f} mm {last.force_N:7.2f} N {last.capacitance_pF:6.1f} pF   "
                f"clamps {last.clamp_N:5.1f} N"
            )
        hint = phase.reason or HINTS.get(phase.phase, "any other key: emergency stop")
        touched = [s for s in samples if s.phase in ("search", "return", "load", "hold", "unload")]
        plots = [
            Panel(
                plot([s.displacement_mm for s in touched], [s.force_N for s in touched]),
                title="N over mm",
                width=66,
            ),
            Panel(
                plot([s.time_s for s in samples], [s.force_N for s in samples]), title="N over s", width=66
            ),
        ]
        return Group(head, Text(hint), *plots)


def plot(x: list[float], y: list[float], width: int = WIDTH, height: int = HEIGHT) -> str:
    """Points in a field of characters, the least and the largest of both axes beside it."""
    if len(x) < 2:
        return "\n" * (height + 1)
    low, high, bottom, top = min(x), max(x), min(0.0, *y), max(*y, 1.0)
    field = [[" "] * width for _ in range(height)]
    for one, other in zip(x, y):
        column = round((one - low) / ((high - low) or 1.0) * (width - 1))
        row = round((other - bottom) / (top - bottom) * (height - 1))
        field[height - 1 - row][column] = "•"
    lines = ["".join(row).rstrip() for row in field]
    lines[0] = f"{top:.1f}".ljust(6) + lines[0][6:]
    foot = f"{low:.1f}".ljust(width - 8) + f"{high:.1f}".rjust(8)
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
