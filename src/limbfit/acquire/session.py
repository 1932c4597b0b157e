"""One session: the protocol, the watchdog, the record and whoever watches, around a device.

`Session` reads no clock and waits for nothing: `run_session` does, in one tight loop.  The beat that it sends
after each sample tells the device which sample has been dealt with, so that the device can judge the whole
way round, not only whether something arrives.
"""

from __future__ import annotations

import gc
import os
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from queue import Empty, SimpleQueue
from typing import Any

from ..errors import RunError
from .device import Device
from .events import (
    PERIOD_US,
    Abort,
    Action,
    Begin,
    Event,
    Hold,
    LinkLost,
    Move,
    Sample,
    Settings,
    Stop,
    Tick,
    to_thousandths,
)
from .line_protocol import (
    Bye,
    Declined,
    Heartbeat,
    Identity,
    LimitTripped,
    NoteCommand,
    OutOfReach,
    SetLimits,
)
from .protocol import DeviceFacts, Phase, Protocol
from .recording import Recorder

LIVE_EVERY = 20  # samples between two that are told: 25 a second
PACED_SILENCE_S = 20.0  # wall time, where the device's clock waits for limbfit's
LOOP_S = 0.002
FIRST_S = 1.0  # the first sample may take longer than those after it
DRIFT_S = 1e-6  # per sample: two clocks may run apart by 500 ppm without making samples look late


# What the words of a device mean; it may have others.
_MEANINGS = {
    "watchdog": "it heard from limbfit too late: check the wire, and what else runs on this machine",
    "stuck": "a driven pin does not move",
    "power": "the actuators have no power",
    "button": "its emergency stop was pressed",
    "force": "over its limit there",
    "depth": "over its limit there",
    "speed": "over its limit there",
    "saturated": "that force sensor is at its end",
    "dead": "that force sensor repeats itself",
    "stopped": "its last stop is not over: wait until all pins are home",
    "armed": "it has a session",
    "unknown-site": "it has no such site",
}


def _describe_why(code: str) -> str:
    return f" ({_MEANINGS[code]})" if code in _MEANINGS else ""


@dataclass(frozen=True)
class PhaseUpdate:
    """The session is in another phase; ``reason`` where it was stopped, ``cycle`` of the ramps."""

    phase: str
    time_s: float
    reason: str = ""
    cycle: int = 0


@dataclass(frozen=True)
class LiveUpdate:
    """The test pin as it is: depth from the touch (or position, before), force, capacitance."""

    phase: str
    time_s: float
    displacement_mm: float
    force_N: float
    capacitance_pF: float
    clamp_N: float


Update = PhaseUpdate | LiveUpdate
Listener = Callable[[Update], None]


@dataclass(frozen=True)
class Ending:
    """How a session ended."""

    phase: Phase
    reason: str
    touch_um: int
    start_um: int
    depth_um: int
    samples: int
    unreachable: tuple[int, ...]

    @property
    def completed(self) -> bool:
        return self.phase is Phase.DONE


@dataclass
class Counts:
    """What is counted while a session runs."""

    samples: int = 0
    lost: int = 0
    declined: dict[str, int] = field(default_factory=dict)


class Session:
    """A protocol bound to a device, a record and a listener; times are s of a clock that never goes back."""

    def __init__(
        self,
        settings: Settings,
        device: Device,
        *,
        site: str,
        recorder: Recorder | None = None,
        listener: Listener | None = None,
    ) -> None:
        identity: Identity = device.identity
        self.settings, self.device, self.recorder, self.listener = settings, device, recorder, listener
        self.protocol = Protocol(
            settings, DeviceFacts(identity.stroke_um, identity.range_mN, identity.touch_fF)
        )
        self.counts = Counts()
        self.unreachable: tuple[int, ...] = ()
        self._paced = identity.clock == "paced"
        self._site = site
        self._last: Sample | None = None
        self._lead = float("inf")  # least of (arrival - device time): a sample that leads no other is fresh
        self._fresh = 0.0
        self._told = Phase.IDLE

    # -- in

    def begin(self, now: float) -> None:
        """Give the device its limits and start."""
        settings, identity = self.settings, self.device.identity
        force, clamp = to_thousandths(settings.force_limit_N), to_thousandths(settings.clamp_limit_N)
        speed, watchdog = to_thousandths(settings.speed_limit_mm_s), max(round(settings.watchdog_ms), 1)
        limits = SetLimits(settings.pin, force, clamp, identity.stroke_um, speed, watchdog)
        self._fresh = now + FIRST_S
        with self._wire(now):
            self.device.send(limits, now)
            self.device.send(NoteCommand("SITE", self._site), now)
        self.handle(Begin(), now)

    def reports(self, reports: list[Sample | Declined | LimitTripped | OutOfReach], now: float) -> None:
        """What the device said."""
        newest = None
        for report in reports:
            match report:
                case Sample():
                    newest = report
                    self._sample(report, now)
                case Declined(code=code):
                    self.counts.declined[code] = self.counts.declined.get(code, 0) + 1
                    self._record("declined", now, code=code)
                    if not self.protocol.is_over and self.protocol.phase is not Phase.STOPPING:
                        self.handle(Abort(f"the device declined a command: {code}{_describe_why(code)}"), now)
                case LimitTripped(code=code, pin=pin):
                    self._record("fault", now, code=code, pin=pin)
                    where = f", pin {pin}" if pin else ""
                    self.handle(
                        Abort(f"the device stopped by itself: {code}{where}{_describe_why(code)}"), now
                    )
                case OutOfReach(pins=pins):
                    self.unreachable = tuple(k + 1 for k in range(pins.bit_length()) if pins >> k & 1)
                    self._record("unreachable", now, pins=list(self.unreachable))
        if newest is not None:
            with self._wire(now):
                self.device.send(Heartbeat(newest.number), now)

    def handle(self, event: Event, now: float) -> None:
        """An event to the protocol, its actions to the device."""
        self._do(self.protocol.handle(event, now), now)
        if self.protocol.phase is not self._told:
            self._told = self.protocol.phase
            self._tell_phase(now)

    def tick(self, now: float) -> None:
        """Time passes: the watchdog, and commands that went unanswered."""
        protocol = self.protocol
        if not self._paced and protocol.phase is not Phase.STOPPING and not protocol.is_over:
            silent = now - self._fresh
            if silent * 1000 > self.settings.watchdog_ms:
                self.handle(Abort(f"no fresh sample for {silent * 1000:.0f} ms"), now)
        self.handle(Tick(), now)
        with self._wire(now):
            if reason := self.device.resend(now):
                self.handle(Abort(reason), now)

    def lost(self, reason: str, now: float) -> None:
        """The wire is gone."""
        self.handle(LinkLost(reason), now)

    def ending(self) -> Ending:
        p = self.protocol
        return Ending(
            p.phase, p.reason, p.touch_um, p.start_um, p.depth_um, self.counts.samples, self.unreachable
        )

    # -- out

    def _sample(self, sample: Sample, now: float) -> None:
        if self.recorder is not None:
            self.recorder.sample(sample, round(now * 1e6))
        counts = self.counts
        counts.samples += 1
        if self._last is not None:
            counts.lost += max((sample.time_us - self._last.time_us) // PERIOD_US - 1, 0)
        self._last = sample
        lead = now - sample.time_us / 1e6
        self._lead = min(self._lead + DRIFT_S, lead)
        if (lead - self._lead) * 1000 <= self.settings.watchdog_ms:
            self._fresh = now
        self.handle(sample, now)
        if self.listener is not None and counts.samples % LIVE_EVERY == 0:
            self.listener(self._live(sample, now))

    def _live(self, sample: Sample, now: float) -> LiveUpdate:
        k = self.settings.pin - 1
        clamps = [sample.force_mN[pin - 1] for pin in self.settings.clamps]
        return LiveUpdate(
            phase=str(self.protocol.phase),
            time_s=now,
            displacement_mm=(sample.position_um[k] - self.protocol.touch_um) / 1000,
            force_N=sample.force_mN[k] / 1000,
            capacitance_pF=sample.capacitance_fF[k] / 1000,
            clamp_N=sum(clamps) / len(clamps) / 1000,
        )

    def _tell_phase(self, now: float) -> None:
        protocol = self.protocol
        phase = str(protocol.phase)
        facts: dict[str, Any] = {"phase": phase, "cycle": protocol.cycle}
        places = {"touch_um": protocol.touch_um, "start_um": protocol.start_um, "depth_um": protocol.depth_um}
        facts |= {name: place for name, place in places.items() if place}
        if protocol.reason:
            facts["reason"] = protocol.reason
        self._record("phase", now, **facts)
        if not protocol.is_over:
            with self._wire(now):
                self.device.send(NoteCommand("PHASE", phase), now)
        if self.listener is not None:
            self.listener(PhaseUpdate(phase, now, protocol.reason, protocol.cycle))

    def _record(self, name: str, now: float, **facts: Any) -> None:
        if self.recorder is not None:
            self.recorder.event(name, round(now * 1e6), **facts)

    def _do(self, actions: tuple[Action, ...], now: float) -> None:
        with self._wire(now):
            for action in actions:
                self.device.send(action, now)
                match action:
                    case Move(pin=pin, target_um=target, speed_um_s=speed):
                        self._record("move", now, pin=pin, target_um=target, speed_um_s=speed)
                    case Hold(pin=pin):
                        self._record("hold", now, pin=pin)
                    case Stop(reason=reason):
                        self._record("stop", now, reason=reason)

    @contextmanager
    def _wire(self, now: float) -> Iterator[None]:
        """A block in which the device may turn out to be gone."""
        try:
            yield
        except RunError as error:
            self.lost(str(error), now)


def prioritise() -> str:
    """Ask that this thread, and those it starts, run at once: ``real-time`` where allowed, else ``normal``.

    The other threads too: one that the system puts aside while it holds the interpreter holds up all.
    """
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(1))
    except (AttributeError, OSError):
        return "normal"
    return "real-time"


def run_session(session: Session, operator: SimpleQueue[Event]) -> Ending:
    """Run a session to its end in this thread.

    Parameters
    ----------
    operator : events of the operator, put there by any thread.

    Notes
    -----
    Other threads may hold the interpreter for the switch interval, so that is set to 0.2 ms meanwhile; the
    collector of garbage is off.
    """
    interval = sys.getswitchinterval()
    sys.setswitchinterval(0.0002)
    gc.collect()
    gc.disable()
    try:
        _run_loop(session, operator)
    finally:
        gc.enable()
        sys.setswitchinterval(interval)
        with suppress(RunError):
            session.device.send(Bye(), 0.0)
        session.device.close()
    return session.ending()


def _run_loop(session: Session, operator: SimpleQueue[Event]) -> None:
    device, paced = session.device, session._paced
    now = 0.0 if paced else time.monotonic()
    heard = time.monotonic()
    origin: float | None = None  # a paced device may have been running for long
    session.begin(now)
    while not session.protocol.is_over:
        try:
            reports = device.receive(LOOP_S)
        except RunError as error:
            session.lost(str(error), now)
            return
        wall = time.monotonic()
        if not paced:
            now = wall
        if reports:
            heard = wall
            times = [r.time_us / 1e6 for r in reports if isinstance(r, Sample)] if paced else []
            if times:
                origin = times[0] if origin is None else origin
                now = max(now, max(times) - origin)
            session.reports(reports, now)
        elif paced and wall - heard > PACED_SILENCE_S:
            session.lost(f"the device has been silent for {PACED_SILENCE_S:g} s", now)
            return
        with suppress(Empty):
            while True:
                session.handle(operator.get_nowait(), now)
        session.tick(now)
