"""Random sequences of faults, operators and hanging ends against the real session and the real device.

On every millisecond: no motion towards the limb with a stop active, no force over its limit for longer than
20 ms; in the end retracted or reported as out of reach.  A pin that is jammed or without power cannot be
moved by anybody: its force is not counted, but the end must say that it is out of reach.
"""

from copy import deepcopy
from functools import cache

import pytest
from hypothesis import HealthCheck, settings
from hypothesis import Phase as Stage
from hypothesis import strategies as st
from hypothesis.stateful import (
    RuleBasedStateMachine,
    initialize,
    precondition,
    rule,
    run_state_machine_as_test,
)
from in_process import Bench

from limbfit.acquire.line_protocol import PINS
from limbfit.acquire.protocol import Abort, LinkLoss, Phase, Signal
from limbfit.acquire.virtual import FAULT_KINDS, Fault

WAY = [
    *(Phase.CLAMP, Phase.SETTLE, Phase.APPROACH, Phase.READY, Phase.SEARCH, Phase.RETURN, Phase.PAUSE),
    *(Phase.LOAD, Phase.DWELL, Phase.UNLOAD, Phase.RETRACT, Phase.RELEASE),
]
CHANNELS = [kind for kind in FAULT_KINDS if kind != "limb"]


@cache
def prepared(seed: int, phase: Phase, depth: float, repeats: int) -> Bench:
    """A session that has come to a phase without trouble."""
    bench = Bench(seed, depth_mm=depth, repeats=repeats, hold_s=0.2)
    bench.until(phase)
    assert bench.phase is phase
    return bench


class Sequences(RuleBasedStateMachine):
    """One session, disturbed."""

    @initialize(
        seed=st.integers(0, 3),
        phase=st.sampled_from(WAY),
        depth=st.sampled_from([1.5, 3.0, 5.5]),
        repeats=st.sampled_from([1, 2]),
    )
    def start(self, seed: int, phase: Phase, depth: float, repeats: int) -> None:
        self.bench = deepcopy(prepared(seed, phase, depth, repeats))
        self.limb_moved = False

    def fault(self, kind: str, pin: int, ms: int, value: float) -> None:
        clock = self.bench.device.faults
        new = Fault(kind=kind, at_s=clock.now_us / 1e6, duration_s=ms / 1000, pin=pin, value=value)
        clock.faults = (*clock.faults, new)

    @rule(
        kind=st.sampled_from(CHANNELS),
        pin=st.integers(1, PINS),
        ms=st.integers(1, 6000),
        value=st.floats(0, 60),
    )
    def something_fails(self, kind: str, pin: int, ms: int, value: float) -> None:
        self.fault(kind, pin, ms, value)

    @precondition(lambda self: not self.limb_moved)
    @rule(pin=st.integers(1, PINS), mm=st.floats(-3, 3), ms=st.integers(100, 500))
    def limb_moves(self, pin: int, mm: float, ms: int) -> None:
        self.limb_moved = True
        self.fault("limb", pin, ms, mm)

    @rule(ms=st.integers(1, 400))
    def time_passes(self, ms: int) -> None:
        for _ in range(ms):
            self.bench.millisecond()
            self.bench.operate()

    @rule(ms=st.integers(1, 60))
    def host_hangs(self, ms: int) -> None:
        for _ in range(ms):
            self.bench.millisecond(host=False)

    @rule(ms=st.integers(1, 60))
    def device_hangs(self, ms: int) -> None:
        for _ in range(ms):
            self.bench.millisecond(device=False)

    @rule(event=st.sampled_from([Signal.KEY_DOWN, Signal.KEY_UP, Abort("the operator"), LinkLoss("cut")]))
    def operator(self, event) -> None:
        self.bench.session.handle(event, self.bench.now)
        if isinstance(event, LinkLoss):
            self.bench.device.disconnect()

    @rule(which=st.integers(0, 10_000), noise=st.binary(max_size=200))
    def somebody_else_talks(self, which: int, noise: bytes) -> None:
        """Old lines again, and noise: refused, and nothing moves for it."""
        bench, motors = self.bench, self.bench.device.motors
        old = bench.link.sent[which % len(bench.link.sent)]
        before = motors.driving.tolist(), motors._target.tolist(), bench.device.stopped
        bench.device.feed(b"\n" + old + noise.replace(b"\n", b" ") + b"\n")
        assert (motors.driving.tolist(), motors._target.tolist(), bench.device.stopped) == before

    def teardown(self) -> None:
        if hasattr(self, "bench"):
            self.bench.settle()
            self.bench.check_end()


@pytest.mark.slow
def test_two_thousand_sequences() -> None:
    run_state_machine_as_test(
        Sequences,
        settings=settings(
            max_examples=2000,
            stateful_step_count=8,
            deadline=None,
            derandomize=True,
            phases=[Stage.explicit, Stage.generate],  # a failure is told as it is found: shrinking takes long
            suppress_health_check=list(HealthCheck),
        ),
    )
