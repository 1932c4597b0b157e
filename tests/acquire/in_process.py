"""Both ends in one process: the real session and the real device code on one injected clock, no wire.

What must never happen is checked on every millisecond of the device (`Bench.millisecond`).
"""

from copy import deepcopy
from functools import cache

import numpy as np

from acquiring import indentation
from limbfit.acquire.device import LineDevice
from limbfit.acquire.line_protocol import PINS
from limbfit.acquire.protocol import Phase, Settings, Signal
from limbfit.acquire.session import Session
from limbfit.acquire.virtual import Fault, VirtualFitSocket, VirtualLimb, fit_surrogate
from limbfit.acquire.virtual.parts import BRAKING

FAST = {
    "clamp_speed_mm_s": 8.0,
    "approach_speed_mm_s": 4.0,
    "settle_s": 0.1,
    "pause_s": 0.1,
    "ramp_speed_mm_s": 6.0,
    "retract_speed_mm_s": 50.0,
    "search_depth_mm": 6.0,
    "clamp_tolerance_N": 6.0,
    "time_limit_s": 5.0,
    "operator_limit_s": 1.0,
}
SENSOR_MN = 250  # zero, drift and noise: a force is known to the device no better
OVER_MS = 20


def settings(**changes: float) -> Settings:
    return Settings(**(FAST | changes))


SURROGATE = fit_surrogate(*indentation())


def device(seed: int = 0, faults: tuple[Fault, ...] = (), gap_mm=(3.5, 5.0)) -> VirtualFitSocket:
    limb = VirtualLimb({"1": SURROGATE}, np.random.default_rng(seed), gap_mm)
    return VirtualFitSocket(limb, seed=seed, faults=faults)


class Direct:
    """A wire on which bytes are handed over instead of sent."""

    def __init__(self, far: VirtualFitSocket) -> None:
        self.far = far
        self.inbox = b""
        self.sent: list[bytes] = []

    def wait(self, timeout_s: float) -> None:
        """Answers are there at once."""

    def read(self) -> bytes:
        data, self.inbox = self.inbox, b""
        return data

    def write(self, data: bytes) -> None:
        self.sent.append(data)
        self.inbox += self.far.feed(data)

    def close(self) -> None:
        """Nothing to close."""


def connect(far: VirtualFitSocket) -> LineDevice:
    return LineDevice(Direct(far))


class Bench:
    """A session and a device on a clock of milliseconds; `depth_mm` is where the operator lets the key go."""

    def __init__(
        self, seed: int = 0, faults: tuple[Fault, ...] = (), depth_mm: float = 3.0, **changes
    ) -> None:
        self.settings = settings(**changes)
        self.device = device(seed, faults)
        self.wire = connect(self.device)
        self.link = self.wire._link
        self.told: list = []
        self.session = Session(self.settings, self.wire, site="1", listener=self.told.append)
        self.depth_mm, self.ms = depth_mm, 0
        self._over = np.zeros(PINS, dtype=int)
        self._stopped: tuple[int, np.ndarray] | None = None
        limit = np.full(PINS, self.settings.clamp_limit_N)
        limit[self.settings.pin - 1] = self.settings.force_limit_N
        self._limit_N = limit + SENSOR_MN / 1000
        self.session.begin(0.0)
        self.session.handle(Signal.CONFIRM, 0.0)

    @property
    def now(self) -> float:
        return self.ms / 1000

    @property
    def phase(self) -> Phase:
        return self.session.protocol.phase

    def millisecond(self, *, host: bool = True, device: bool = True) -> None:
        """A millisecond passes; an end that hangs does nothing in it."""
        self.ms += 1
        if device:
            self.link.inbox += self.device.step()
            self._check()
        if host:
            reports = self.wire.receive()
            if reports:
                self.session.handle_reports(reports, self.now)
            self.session.tick(self.now)

    def operate(self) -> None:
        """What the operator does by himself: holds the key when it is time, and lets it go at the depth."""
        protocol = self.session.protocol
        if protocol.phase is Phase.READY:
            self.session.handle(Signal.KEY_DOWN, self.now)
        elif protocol.phase is Phase.SEARCH and protocol.depth_um - protocol.touch_um > 1000 * self.depth_mm:
            self.session.handle(Signal.KEY_UP, self.now)

    def until(self, phase: Phase | None = None, most_ms: int = 60_000) -> None:
        """Run to a phase, or to the end."""
        while not self.session.protocol.is_over and self.phase is not phase and self.ms < most_ms:
            self.millisecond()
            if self.phase is not phase:
                self.operate()

    def settle(self, most_ms: int = 25_000) -> None:
        """Let both ends come to their end: the session over, the device home or given up."""
        end = self.ms + most_ms
        while self.ms < end and not (
            self.session.protocol.is_over and (self.device.is_home or self.has_given_up)
        ):
            self.millisecond()

    @property
    def has_given_up(self) -> bool:
        return self.device._given_up

    def _check(self) -> None:
        motors, faults = self.device.motors, self.device.faults
        if self.device.stopped:
            if self._stopped is None:
                self._stopped = self.ms, np.maximum(motors.speed_mm_s, 0).copy()
            at, speed = self._stopped
            allowed = np.maximum(speed - BRAKING * (self.ms - at) / 1000, 0) + 1e-9
            assert (motors.speed_mm_s <= allowed).all(), "motion towards the limb with a stop active"
        jammed = {fault.pin - 1 for fault in faults.find_active("stuck")}
        free = np.array([k not in jammed for k in range(PINS)]) & (not faults.find_active("power"))
        over = self.device.limb.force_N > self._limit_N
        self._over = np.where(over & free, self._over + 1, 0)
        assert self._over.max() <= OVER_MS, f"over the limit of force for {self._over.max()} ms"

    def check_end(self) -> None:
        """Retracted, or reported as out of reach; a stop has a reason."""
        assert self.session.protocol.is_over, f"still in {self.phase}"
        if self.phase in (Phase.DONE, Phase.STOPPED):
            assert self.device.is_home
        else:
            assert self.phase is Phase.UNREACHABLE
            assert self.device.is_home or self.has_given_up
            assert "release" in self.session.protocol.reason  # what is left to do
        if self.phase is not Phase.DONE:
            assert self.session.protocol.reason


@cache
def _course() -> dict[Phase, Bench]:
    """A session of two ramps, the second held, as it was when it first came to each of its phases."""
    bench, found = Bench(hold_s=0.2, precondition=1, search_force_N=8.0), {}
    while not bench.session.protocol.is_over:
        found.setdefault(bench.phase, deepcopy(bench))
        before = bench.phase
        while bench.phase is before:
            bench.millisecond()
            if bench.phase is before:
                bench.operate()
    return found | {bench.phase: bench}


def session_in(phase: Phase, *faults: Fault) -> Bench:
    """A session that has just come to a phase, with a device that will have those faults."""
    bench = deepcopy(_course()[phase])
    bench.device.faults.faults = faults
    return bench
