"""The device's end of the line protocol, stepped in time, without a wire and without a clock.

`VirtualFitSocket.step` is one millisecond of the device: motors, limb, sensors, its own limits and watchdog,
and every second time a sample.  `VirtualFitSocket.feed` takes what came from limbfit.  Both return
what goes out.  Faults come on demand: what goes wrong, when, for how long.
"""

import secrets
from collections import deque
from pathlib import Path
from typing import Annotated, Literal, get_args

import numpy as np
from pydantic import Field

from ...study.tables import TomlTable
from .. import line_protocol as wire
from ..device import read_model
from ..line_protocol import PINS, RATE_HZ, Flags, Sample
from ..safety import FROZEN_S, FROZEN_SAMPLES, Guard, SafetyLimits
from .parts import STEP_S, STROKE_MM, Motors, Sensors, VirtualLimb

STEP_US = round(1e6 * STEP_S)
STEPS_PER_SAMPLE = 1_000_000 // RATE_HZ // STEP_US  # steps per sample
# Built in: no session's limits go beyond them.
MAX_FORCE_MN = 45_000
MAX_SPEED_UM_S = 12_000
MAX_RETRACT_UM_S = 100_000
MAX_WATCHDOG_MS = 500
MAX_LAG_US = 50_000  # a driven pin that stands for so long is stuck
MAX_HOMING_US = 3_000_000  # pins that are not home so long after a stop are out of reach
Kind = Literal[
    "lost",  # lines of the device do not arrive
    "deaf",  # lines of limbfit do not arrive
    "late",  # lines of the device arrive `value` ms late
    "corrupt",  # a byte of each line of the device is another
    "stuck",  # a pin does not move
    "saturated",  # a force sensor shows its end of scale
    "dead",  # a force sensor shows the same for ever
    "limb",  # the limb moves by `value` mm towards a pin
    "power",  # the actuators have no power
    "button",  # the device's emergency stop is pressed
]
FAULT_KINDS: tuple[str, ...] = get_args(Kind)


class Fault(TomlTable):
    """One fault; its time counts from the session's start, or from its first entry into a phase."""

    kind: Kind
    at_s: Annotated[float, Field(ge=0, le=1e5)] = 0.0
    phase: str = ""
    duration_s: Annotated[float, Field(gt=0, le=1e5)] = 1e5
    pin: Annotated[int, Field(ge=1, le=PINS)] = 1
    value: Annotated[float, Field(ge=-100, le=10_000)] = 0.0


class _FaultFile(TomlTable):
    faults: tuple[Fault, ...]


def read_faults(file: Path) -> tuple[Fault, ...]:
    """Read a TOML file of ``[[faults]]``. Raises `InputError` with the file and the key."""
    remedy = "see docs/acquire.md for the kinds of faults"
    return read_model(_FaultFile, file, "give a TOML file with [[faults]]", remedy).faults


class FaultClock:
    """Which faults are on, as time goes and phases are entered."""

    def __init__(self, faults: tuple[Fault, ...]) -> None:
        self.faults = faults
        self._entered: dict[str, int] = {}
        self.now_us = 0

    def enter(self, phase: str) -> None:
        self._entered.setdefault(phase, self.now_us)

    def find_active(self, kind: str) -> list[Fault]:
        """The faults of a kind that are on."""
        now, alike = self.now_us, (fault for fault in self.faults if fault.kind == kind)
        return [one for one in alike if (start := self._start(one)) <= now < start + one.duration_s * 1e6]

    def compute_progress(self, fault: Fault) -> float:
        """How much of a fault's time has passed, 0 to 1."""
        return min(max((self.now_us - self._start(fault)) / 1e6 / fault.duration_s, 0.0), 1.0)

    def _start(self, fault: Fault) -> float:
        """Infinite while its phase has not been entered."""
        return self._entered.get(fault.phase, np.inf if fault.phase else 0) + fault.at_s * 1e6


class VirtualFitSocket:
    """One device with one limb in it.

    ``time_us``: of the device; ``stopped``: the code of the stop that is latched, empty for none;
    ``is_armed``: a session runs, samples are sent, the watchdog watches; ``host_has_left``: the host has
    ended its session; ``acknowledged_us``: device time of the newest sample that limbfit has dealt with.
    """

    def __init__(
        self, limb: VirtualLimb, *, seed: int = 0, faults: tuple[Fault, ...] = (), clock: str = "real"
    ) -> None:
        self.limb, self.clock = limb, clock
        self._random = np.random.default_rng(seed)
        self.motors = Motors()
        self.sensors = Sensors(self._random)
        self.faults = FaultClock(faults)
        self._serial = f"V{seed:06d}"[:40]
        self.time_us = 0
        self.stopped, self.is_armed = "", False
        self.acknowledged_us = 0
        self._begun_us = self._stopped_us = 0
        self._watchdog_us = MAX_WATCHDOG_MS * 1000
        most = (MAX_FORCE_MN,) * PINS, (round(1000 * STROKE_MM),) * PINS, MAX_SPEED_UM_S
        self._guard = Guard(SafetyLimits(*most, range_mN=1 << 30, max_unchanged_samples=1 << 30))
        self._halt_forces_mN = [0] * PINS
        self._lag_times_us = np.zeros(PINS, dtype=int)
        self._forces_mN: tuple[int, ...] = (0,) * PINS
        self._given_up = False
        self._limb_shifts_mm: dict[Fault, float] = {}
        self._sent: deque[tuple[int, int]] = deque(maxlen=2000)
        self._delayed: deque[tuple[int, bytes]] = deque()
        self.connect()

    # -- sessions

    def connect(self) -> None:
        """Begin with a new host."""
        self._decoder = wire.Decoder(wire.HOST_LINE, numbered=False)
        self._encoder: wire.Encoder | None = None
        self.host_has_left = False

    @property
    def refusals(self) -> object:
        return self._decoder.refused

    def disconnect(self) -> None:
        """End with the host: whatever is not home goes home."""
        if self.is_armed:
            self._end_session()
        self._encoder = None

    @property
    def has_session(self) -> bool:
        """Whether a host has been greeted."""
        return self._encoder is not None

    @property
    def is_home(self) -> bool:
        return bool(self.motors.find_withdrawn().all())

    def feed(self, data: bytes) -> bytes:
        """Take bytes of the host; return the answer."""
        if self.faults.find_active("deaf"):
            return b""
        out = b""
        for line in self._decoder.feed(data):
            command = wire.parse_command(line.body)
            if command is None:
                self._decoder.refused.unknown += 1
                continue
            out += self._handle_command(command, line.number)
        return self._apply_faults(out)

    def _handle_command(self, command: wire.Command, number: int) -> bytes:
        if self._encoder is None:
            if isinstance(command, wire.Hello):
                return self._greet(command)
            self._decoder.refused.unknown += 1
            return b""
        match command:
            case wire.Heartbeat():
                self._acknowledge(command.number)
                return b""
            case wire.Bye():
                self._end_session()
                self.host_has_left = True
                return b""
        code = "greeted" if isinstance(command, wire.Hello) else self._execute(command)
        return self._encode(wire.Rejection(number, code).body if code else wire.Acceptance(number).body)

    def _greet(self, hello: wire.Hello) -> bytes:
        if hello.version != wire.VERSION:
            self._decoder.refused.unknown += 1
            return b""
        if self.is_home and not self.faults.find_active("button"):
            self.stopped, self._given_up = "", False
        identity = wire.Identity(
            version=wire.VERSION,
            nonce=secrets.token_hex(8),
            pins=PINS,
            rate_hz=RATE_HZ,
            stroke_um=round(1000 * STROKE_MM),
            range_mN=self.sensors.range_mN,
            touch_fF=self.sensors.touch_fF,
            clock=self.clock,
            model="VirtualFitSocket",
            serial=self._serial,
            calibrated="2000-01-01",
        )
        line = wire.Encoder(first=0).encode(identity.body)[1]
        salt = wire.derive_salt(hello.nonce, identity.nonce)
        self._encoder = wire.Encoder(salt)
        self._decoder.restart(salt)
        return line

    def _execute(self, command: wire.Command) -> str:
        """Carry out a command; return why not, in a word, or an empty text."""
        match command:
            case wire.SetLimits():
                return self._arm(command)
            case wire.NoteSite(name=site):
                return "" if self.limb.place_site(site, self._test_pin) else "unknown-site"
            case wire.NotePhase(name=phase):
                self.faults.enter(phase)
            case wire.Stop():
                self._stop("asked")
            case _ if not self.is_armed:
                return "not-armed"
            case wire.Hold(pin=pin):
                self.motors.halt(pin - 1)
            case wire.Fence(pin=pin, position_um=position):
                self._guard.set_depth(pin, position)
            case wire.Move():
                return self._move(command)
        return ""

    _test_pin = 1

    def _arm(self, limits: wire.SetLimits) -> str:
        if self.is_armed:
            return "armed"
        if self.stopped:
            return "stopped"
        force = [min(limits.clamp_mN, MAX_FORCE_MN)] * PINS
        force[limits.pin - 1] = min(limits.force_mN, MAX_FORCE_MN)
        most = min(limits.position_um, round(1000 * STROKE_MM))
        max_unchanged_samples = max(round(FROZEN_S * 1e6 / STEP_US), FROZEN_SAMPLES)
        speed = min(limits.speed_um_s, MAX_SPEED_UM_S)
        self._guard = Guard(
            SafetyLimits(tuple(force), (most,) * PINS, speed, self.sensors.range_mN, max_unchanged_samples)
        )
        self._watchdog_us = 1000 * min(limits.watchdog_ms, MAX_WATCHDOG_MS)
        self._test_pin = limits.pin
        self.is_armed = True
        self.faults = FaultClock(self.faults.faults)
        self._begun_us = self.acknowledged_us = self.time_us
        self._lag_times_us[:] = 0
        self._sent.clear()
        return ""

    def _move(self, move: wire.Move) -> str:
        k = move.pin - 1
        inward = move.target_um > 1000 * self.motors.position_mm[k]
        if self.stopped:
            return "stopped"
        if move.target_um > self._guard.limits.position_um[k]:
            return "position"
        if move.speed_um_s > (self._guard.limits.speed_um_s if inward else MAX_RETRACT_UM_S):
            return "speed"
        if move.halt_mN and self._forces_mN[k] >= move.halt_mN and inward:
            self.motors.halt(k)
            return ""
        self._halt_forces_mN[k] = move.halt_mN if inward else 0
        self._lag_times_us[k] = 0
        self.motors.drive(k, move.target_um / 1000, move.speed_um_s / 1000)
        return ""

    def _acknowledge(self, number: int) -> None:
        while self._sent and self._sent[0][0] <= number:
            sent, at = self._sent.popleft()
            if sent == number:
                self.acknowledged_us = max(self.acknowledged_us, at)

    def _end_session(self) -> None:
        if not self.is_home:
            self._stop("left")
        self.is_armed = False

    def stop_without_host(self) -> None:
        """Stop because the host has been silent, by a clock that is not the device's."""
        if self.is_armed and not self.stopped:
            self._stop("watchdog")

    # -- time

    def step(self) -> bytes:
        """Advance by a millisecond; return what the device sends at its end."""
        self.time_us += STEP_US
        self.faults.now_us = self.time_us - self._begun_us if self.is_armed else self.faults.now_us + STEP_US
        jammed = [fault.pin - 1 for fault in self.faults.find_active("stuck")]
        powered = not self.faults.find_active("power")
        self._move_limb()
        self.motors.step(jammed, powered)
        self.limb.step(self.motors.head_mm)
        sample = self._measure(powered)
        self._halt_at_forces()
        out = self._check_limits(sample, powered)
        out += self._check_home()
        if self.is_armed and self.time_us // STEP_US % STEPS_PER_SAMPLE == 0 and self._encoder is not None:
            number, line = self._encoder.encode(wire.format_sample(sample))
            self._sent.append((number, self.time_us))
            out += line
        return self._apply_faults(out)

    def _measure(self, powered: bool) -> Sample:
        faults = self.faults
        position, self._forces_mN, seen = self.sensors.read(
            self.motors.position_mm,
            self.motors.head_mm,
            self.limb.force_N,
            self.limb.gap_mm,
            [fault.pin - 1 for fault in faults.find_active("dead")],
            [fault.pin - 1 for fault in faults.find_active("saturated")],
        )
        flags = Flags.HOME * self.is_home | Flags.STOPPED * bool(self.stopped)
        flags |= Flags.NO_POWER * (not powered) | Flags.GIVEN_UP * self._given_up
        flags |= Flags.BUTTON * bool(faults.find_active("button"))
        moving = int(np.packbits(self.motors.driving, bitorder="little").view("<u2")[0])
        return Sample(0, self.time_us, int(flags), moving, position, self._forces_mN, seen)

    def _halt_at_forces(self) -> None:
        for k, most in enumerate(self._halt_forces_mN):
            if most and self._forces_mN[k] >= most:
                self._halt_forces_mN[k] = 0
                if not self.stopped:
                    self.motors.halt(k)

    def _check_limits(self, sample: Sample, powered: bool) -> bytes:
        """Stop at the device's own limits, and report that."""
        if self.stopped or not (self.is_armed or self.faults.find_active("button")):
            return b""
        code, pin = "", 0
        self._lag_times_us = np.where(self.motors.find_lagging(), self._lag_times_us + STEP_US, 0)
        if self.faults.find_active("button"):
            code = "button"
        elif not powered:
            code = "power"
        elif violation := self._guard.check(sample):
            code, pin = violation.code, violation.pin
        elif self._lag_times_us.max() > MAX_LAG_US:
            code, pin = "stuck", int(self._lag_times_us.argmax()) + 1
        elif self.time_us - self.acknowledged_us > self._watchdog_us:
            code = "watchdog"
        if not code:
            return b""
        self._stop(code)
        return self._encode(wire.LimitTrip(code, pin).body)

    def _stop(self, code: str) -> None:
        if not self.stopped:
            self.stopped, self._stopped_us = code, self.time_us
        self._halt_forces_mN = [0] * PINS
        self.motors.retract()

    def _check_home(self) -> bytes:
        """Bring all pins home after a stop, again and again; report those that stay out too long."""
        if not self.stopped:
            return b""
        if self.is_home:
            self._given_up = False
            return b""
        self.motors.retract()
        if self._given_up or self.time_us - self._stopped_us < MAX_HOMING_US:
            return b""
        self._given_up = True
        pins = sum(1 << int(k) for k in np.flatnonzero(~self.motors.find_withdrawn()))
        return self._encode(wire.StuckPins(pins).body)

    # -- what goes wrong

    def _move_limb(self) -> None:
        for fault in self.faults.faults:
            if fault.kind == "limb":
                moved = fault.value * self.faults.compute_progress(fault)
                self.limb.shift(fault.pin, moved - self._limb_shifts_mm.get(fault, 0.0))
                self._limb_shifts_mm[fault] = moved

    def _encode(self, body: str) -> bytes:
        return self._encoder.encode(body)[1] if self._encoder is not None else b""

    def _apply_faults(self, out: bytes) -> bytes:
        """Return what goes out now of the lines: faults lose, delay or corrupt them."""
        if self.faults.find_active("lost"):
            out = b""
        if out and self.faults.find_active("corrupt"):
            out = b"\n".join(self._corrupt(line) for line in out.split(b"\n")[:-1]) + b"\n"
        late = self.faults.find_active("late")
        if out and (late or self._delayed):
            due = self.time_us + round(1000 * max([fault.value for fault in late], default=0.0))
            self._delayed.append((max(due, self._delayed[-1][0] if self._delayed else 0), out))
            out = b""
        while self._delayed and self._delayed[0][0] <= self.time_us:
            out += self._delayed.popleft()[1]
        return out

    def _corrupt(self, line: bytes) -> bytes:
        at = int(self._random.integers(len(line)))
        return line[:at] + bytes([(line[at] + 1) % 256]) + line[at + 1 :]
