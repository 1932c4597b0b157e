"""One session: the protocol, the watchdog, the record, the operator and whoever watches, around a device.

`Session` reads no clock and waits for nothing: `run_session` does, in one tight loop.  The beat that it sends
after each sample tells the device which sample has been dealt with, so that the device can judge the whole
way round, not only whether something arrives.
"""

import gc
import os
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from queue import Empty, SimpleQueue
from typing import Any

from ..errors import RunError
from . import line_protocol as wire
from .device import Device
from .line_protocol import Sample, to_thousandths
from .protocol import Abort, Event, LinkLoss, Phase, Protocol, Settings, Signal
from .recording import Recorder

SAMPLES_PER_LIVE_UPDATE = 20  # the listener gets 25 updates a second
PACED_SILENCE_S = 20.0  # wall time, where the device's clock waits for limbfit's
LOOP_TIMEOUT_S = 0.002
FIRST_SAMPLE_S = 1.0  # the first sample may take longer than those after it
CLOCK_DRIFT_S = 1e-6  # per sample: two clocks may run apart by 500 ppm without making samples look late
# What the words of a device mean; it may have others.
_CODE_MEANINGS = {
    "watchdog": "it heard from limbfit too late: check the wire, and what else runs on this machine",
    "stuck": "a driven pin does not move",
    "sensor": "its force sensor does not answer in time, or with no number",
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
FIRST_REPEAT_S = 0.75  # a keyboard waits before a held key repeats


def _explain_code(code: str) -> str:
    return f" ({_CODE_MEANINGS[code]})" if code in _CODE_MEANINGS else ""


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


class Session:
    """A protocol bound to a device, a record and a listener; times are s of a clock that never goes back.

    ``samples`` and ``lost`` say how many came, and how many never did; ``unreachable`` pins did not come
    home.
    """

    def __init__(
        self,
        settings: Settings,
        device: Device,
        *,
        site: str,
        recorder: Recorder | None = None,
        listener: Listener | None = None,
    ) -> None:
        self.settings, self.device, self.recorder, self.listener = settings, device, recorder, listener
        self.protocol = Protocol(settings, device.identity, device.resolution_mN)
        self._period_us = 1_000_000 // device.identity.rate_hz
        self.samples = self.lost = 0
        self.unreachable: tuple[int, ...] = ()
        self._site = site
        self._last_sample: Sample | None = None
        self._smallest_lead_s = float("inf")  # the least of arrival minus device time
        self._last_fresh_s = 0.0
        self._reported_phase = Phase.IDLE

    # -- in

    def begin(self, now: float) -> None:
        """Give the device its limits and start."""
        settings, identity = self.settings, self.device.identity
        force, clamp = to_thousandths(settings.force_limit_N), to_thousandths(settings.clamp_limit_N)
        speed, watchdog = to_thousandths(settings.speed_limit_mm_s), max(round(settings.watchdog_ms), 1)
        limits = wire.SetLimits(settings.pin, force, clamp, identity.stroke_um, speed, watchdog)
        self._last_fresh_s = now + FIRST_SAMPLE_S
        with self._guard_link(now):
            self.device.send(limits, now)
            self.device.send(wire.NoteSite(self._site), now)
        self.handle(Signal.BEGIN, now)

    def handle_reports(self, reports: list[wire.Notice], now: float) -> None:
        """Pass what the device said on to the protocol, the record and the counts."""
        newest = None
        for report in reports:
            match report:
                case Sample():
                    newest = report
                    self._handle_sample(report, now)
                case wire.Rejection(code=code):
                    self._record("declined", now, code=code)
                    if not self.protocol.is_over and self.protocol.phase is not Phase.STOPPING:
                        self.handle(Abort(f"the device declined a command: {code}{_explain_code(code)}"), now)
                case wire.LimitTrip(code=code, pin=pin):
                    self._record("fault", now, code=code, pin=pin)
                    where = f", pin {pin}" if pin else ""
                    reason = f"the device stopped by itself: {code}{where}{_explain_code(code)}"
                    self.handle(Abort(reason), now)
                case wire.StuckPins(pins=pins):
                    self.unreachable = tuple(k + 1 for k in range(pins.bit_length()) if pins >> k & 1)
                    self._record("unreachable", now, pins=list(self.unreachable))
        if newest is not None:
            with self._guard_link(now):
                self.device.send(wire.Heartbeat(newest.number), now)

    def handle(self, event: Event, now: float) -> None:
        """Give an event to the protocol, and its actions to the device."""
        self._execute(self.protocol.handle(event, now), now)
        if self.protocol.phase is not self._reported_phase:
            self._reported_phase = self.protocol.phase
            self._report_phase(now)

    def tick(self, now: float) -> None:
        """Check the watchdog, and repeat commands that went unanswered."""
        protocol = self.protocol
        has_ended = protocol.is_over or protocol.phase is Phase.STOPPING
        if not (has_ended or self.device.identity.is_paced):
            silent = now - self._last_fresh_s
            if silent * 1000 > self.settings.watchdog_ms:
                self.handle(Abort(f"no fresh sample for {silent * 1000:.0f} ms"), now)
        self.handle(Signal.TICK, now)
        with self._guard_link(now):
            if reason := self.device.resend(now):
                self.handle(Abort(reason), now)

    # -- out

    def _handle_sample(self, sample: Sample, now: float) -> None:
        if self.recorder is not None:
            self.recorder.sample(sample, round(now * 1e6))
        self.samples += 1
        if self._last_sample is not None:
            self.lost += max((sample.time_us - self._last_sample.time_us) // self._period_us - 1, 0)
        self._last_sample = sample
        lead = now - sample.time_us / 1e6
        self._smallest_lead_s = min(self._smallest_lead_s + CLOCK_DRIFT_S, lead)
        if (lead - self._smallest_lead_s) * 1000 <= self.settings.watchdog_ms:
            self._last_fresh_s = now
        self.handle(sample, now)
        if self.listener is not None and self.samples % SAMPLES_PER_LIVE_UPDATE == 0:
            self.listener(self._make_live_update(sample, now))

    def _make_live_update(self, sample: Sample, now: float) -> LiveUpdate:
        k = self.settings.pin - 1
        clamps = [sample.force_mN[pin - 1] for pin in self.protocol.clamps] or [0]
        return LiveUpdate(
            phase=str(self.protocol.phase),
            time_s=now,
            displacement_mm=(sample.position_um[k] - self.protocol.touch_um) / 1000,
            force_N=sample.force_mN[k] / 1000,
            capacitance_pF=sample.capacitance_fF[k] / 1000,
            clamp_N=sum(clamps) / len(clamps) / 1000,
        )

    def _report_phase(self, now: float) -> None:
        protocol = self.protocol
        phase = str(protocol.phase)
        facts: dict[str, Any] = {"phase": phase, "cycle": protocol.cycle}
        places = {"touch_um": protocol.touch_um, "start_um": protocol.start_um, "depth_um": protocol.depth_um}
        facts |= {name: place for name, place in places.items() if place}
        if protocol.reason:
            facts["reason"] = protocol.reason
        self._record("phase", now, **facts)
        if not protocol.is_over:
            with self._guard_link(now):
                self.device.send(wire.NotePhase(phase), now)
        if self.listener is not None:
            self.listener(PhaseUpdate(phase, now, protocol.reason, protocol.cycle))

    def _record(self, name: str, now: float, **facts: Any) -> None:
        if self.recorder is not None:
            self.recorder.event(name, round(now * 1e6), **facts)

    def _execute(self, actions: tuple[wire.Action, ...], now: float) -> None:
        with self._guard_link(now):
            for action in actions:
                self.device.send(action, now)
                match action:
                    case wire.Move(pin=pin, target_um=target, speed_um_s=speed):
                        self._record("move", now, pin=pin, target_um=target, speed_um_s=speed)
                    case wire.Hold(pin=pin):
                        self._record("hold", now, pin=pin)
                    case wire.Stop(reason=reason):
                        self._record("stop", now, reason=reason)

    @contextmanager
    def _guard_link(self, now: float) -> Iterator[None]:
        """A block in which the device may turn out to be gone, which ends the session."""
        try:
            yield
        except RunError as error:
            self.handle(LinkLoss(str(error)), now)


def prioritise() -> str:
    """Ask that this thread, and those it starts, run at once: ``real-time`` where allowed, else ``normal``.

    The other threads too: one that the system puts aside while it holds the interpreter holds up all.
    """
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(1))
    except (AttributeError, OSError):
        return "normal"
    return "real-time"


def run_session(session: Session, operator: SimpleQueue[Event]) -> Protocol:
    """Run a session to its end in this thread; returns its protocol, which says how it ended.

    ``operator``: events of the operator, put there by any thread. Other threads may hold the interpreter for
    the switch interval, so that is set to 0.2 ms meanwhile; the collector of garbage is off.
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
            session.device.send(wire.Bye(), 0.0)
        session.device.close()
    return session.protocol


def _run_loop(session: Session, operator: SimpleQueue[Event]) -> None:
    device, paced = session.device, session.device.identity.is_paced
    now = 0.0 if paced else time.monotonic()
    heard = time.monotonic()
    origin: float | None = None  # a paced device may have been running for long
    session.begin(now)
    while not session.protocol.is_over:
        try:
            reports = device.receive(LOOP_TIMEOUT_S)
        except RunError as error:
            session.handle(LinkLoss(str(error)), now)
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
            session.handle_reports(reports, now)
        elif paced and wall - heard > PACED_SILENCE_S:
            session.handle(LinkLoss(f"the device has been silent for {PACED_SILENCE_S:g} s"), now)
            return
        with suppress(Empty):
            while True:
                session.handle(operator.get_nowait(), now)
        session.tick(now)


class Keyboard:
    """Characters of a terminal to events: Enter confirms, the space bar is the key, anything else stops.

    A terminal tells of no release: a key that is held repeats, one that is released does not. The key counts
    as held from its second character on, so that a touch moves nothing, and as released once ``gap_s`` has
    passed without another.
    """

    def __init__(self, gap_s: float) -> None:
        self.gap_s = gap_s
        self.is_held = False
        self._last: float | None = None

    def read(self, characters: bytes, now: float) -> list[Event]:
        found: list[Event] = []
        for one in characters:
            if one in b"\r\n":
                found.append(Signal.CONFIRM)
            elif one == 0x20:
                before, self._last = self._last, now
                if not self.is_held and before is not None and now - before <= FIRST_REPEAT_S:
                    self.is_held = True
                    found.append(Signal.KEY_DOWN)
            else:
                found.append(Abort("the operator stopped it by a key"))
        return found

    def check_release(self, now: float) -> list[Event]:
        """The release of the key, reported once; ask often."""
        if self._last is None or not self.is_held or now - self._last <= self.gap_s:
            return []
        self.is_held, self._last = False, None
        return [Signal.KEY_UP]


class NoOperator:
    """No operator: the limb counts as in place, and the key as held until the search ends by itself."""

    def __init__(self, events: SimpleQueue[Event]) -> None:
        self.events = events
        self._has_searched = False

    def __call__(self, update: Update) -> None:
        if not isinstance(update, PhaseUpdate):
            return
        if update.phase == Phase.POSITION:
            self.events.put(Signal.CONFIRM)
        elif update.phase == Phase.READY and self._has_searched:  # it would end there again, and again
            reason = "the depth search ended at acquire.search_force_N before acquire.min_depth_mm"
            self.events.put(Abort(f"{reason}; change one of them"))
        elif update.phase == Phase.READY:
            self._has_searched = True
            self.events.put(Signal.KEY_DOWN)
