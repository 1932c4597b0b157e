"""The state machine: the paper's order, what each limit leads to, and that every stop has its reason."""

from queue import SimpleQueue

import numpy as np
import pytest
from in_process import FAST, Bench, session_in, settings

from limbfit.acquire.line_protocol import Sample
from limbfit.acquire.protocol import FINAL, TRANSITIONS, Abort, Phase, Signal
from limbfit.acquire.safety import Guard, make_session_limits
from limbfit.acquire.session import NoOperator, PhaseUpdate
from limbfit.acquire.virtual import Fault


def phases(bench: Bench) -> list[str]:
    return [told.phase for told in bench.told if isinstance(told, PhaseUpdate)]


def test_every_phase_can_be_reached_left_and_stopped() -> None:
    assert {after for ways in TRANSITIONS.values() for after in ways} == set(Phase) - {Phase.IDLE}
    assert set(TRANSITIONS) == set(Phase) - FINAL
    for phase, ways in TRANSITIONS.items():
        assert len(ways) >= 2
        assert Phase.STOPPING in ways or phase is Phase.STOPPING


def test_the_paper_s_order_in_which_each_ramp_that_counts_is_held() -> None:
    bench = session_in(Phase.DONE)
    order = [p for p in phases(bench) if p not in ("clamp", "settle")]
    assert order == [
        *("position", "approach", "back", "ready", "search", "return", "pause"),
        *("load", "unload"),  # preconditioning is not held
        *("pause", "load", "hold", "unload", "retract", "release", "done"),
    ]
    protocol = bench.session.protocol
    assert protocol.depth_um - protocol.touch_um == pytest.approx(3000, abs=150)
    true_gap = bench.device.limb._gap[0]
    assert protocol.touch_um / 1000 == pytest.approx(true_gap, abs=0.08)
    assert bench.device.is_home


def test_neighbours_stay_off_while_eleven_clamp() -> None:
    bench = Bench(pin=14)
    bench.until(Phase.APPROACH)
    force, position = bench.device.limb.force_N, bench.device.motors.position_mm
    clamps = [pin - 1 for pin in bench.settings.clamps]
    assert len(clamps) == 11
    assert (force[clamps] > 15 - 9).all()
    assert (position[[12, 0]] == 0).all()
    assert (force[[12, 0]] == 0).all()


def test_letting_go_halts_at_once_and_a_shallow_search_is_none() -> None:
    bench = session_in(Phase.SEARCH)
    bench.depth_mm = 0.3
    bench.until(Phase.BACK)
    assert bench.phase is Phase.BACK  # 0.3 mm are too shallow: back to the start, to try again
    bench.depth_mm = 2.0
    bench.until(Phase.RETURN)
    protocol = bench.session.protocol
    assert (protocol.depth_um - protocol.touch_um) / 1000 == pytest.approx(2.0, abs=0.15)


def test_the_key_moves_nothing_in_other_phases() -> None:
    bench = session_in(Phase.CLAMP)
    for event in (Signal.KEY_DOWN, Signal.KEY_UP):
        bench.session.handle(event, bench.now)
    assert bench.phase is Phase.CLAMP
    assert bench.device.motors.position_mm[0] == 0


def test_enter_is_an_emergency_stop_once_the_limb_is_in_place() -> None:
    bench = session_in(Phase.LOAD)
    bench.session.handle(Signal.CONFIRM, bench.now)
    assert bench.phase is Phase.STOPPING
    assert "by a key" in bench.session.protocol.reason


def test_a_search_that_nobody_watches_is_not_repeated_where_the_force_ends_it_too_early() -> None:
    bench, events = Bench(search_force_N=0.6, min_depth_mm=3.0), SimpleQueue()
    bench.session.listener = NoOperator(events)
    while not bench.session.protocol.is_over and bench.ms < 10_000:
        bench.millisecond()
        while not events.empty():
            bench.session.handle(events.get(), bench.now)
    assert bench.phase is Phase.STOPPED
    assert "acquire.search_force_N before acquire.min_depth_mm" in bench.session.protocol.reason


@pytest.mark.parametrize("sign", [1, -1])
def test_a_force_over_its_limit_stops_whichever_sign_its_sensor_gives(sign: int) -> None:
    guard = Guard(make_session_limits(settings(), Bench().session.device.identity))
    strong = Sample(1, 2000, 0, 0, (0,) * 14, (sign * 30_000,) + (0,) * 13, (0,) * 14)
    wrong = guard.check(strong)
    assert wrong is not None
    assert (wrong.code, wrong.pin) == ("force", 1)


@pytest.mark.parametrize("key", ["pause_s", "settle_s", "hold_s"])
def test_a_wait_as_long_as_a_phase_may_take_is_refused(key: str) -> None:
    with pytest.raises(ValueError, match=f"{key} is not below time_limit_s"):
        settings(**{key: FAST["time_limit_s"]})


def test_the_comfortable_force_ends_the_search_whoever_holds_the_key() -> None:
    bench = session_in(Phase.SEARCH)
    bench.depth_mm = 99.0
    bench.until(Phase.RETURN)
    assert bench.device.limb.force_N[0] == pytest.approx(bench.settings.search_force_N, abs=0.5)


FAULTS = {
    "stuck": (Fault(kind="stuck", phase="load", at_s=0.1, duration_s=1.0, pin=1), "stuck"),
    "saturated": (Fault(kind="saturated", phase="load", at_s=0.1, pin=5), "saturated"),
    "dead": (Fault(kind="dead", phase="search", at_s=0.05, pin=1), "dead"),
    "limb": (Fault(kind="limb", phase="pause", pin=3, value=-4, duration_s=0.3), "limb"),
    "button": (Fault(kind="button", phase="unload", at_s=0.1, duration_s=0.5), "button"),
    "power": (Fault(kind="power", phase="load", at_s=0.1, duration_s=0.5), "power"),
    "lost": (Fault(kind="lost", phase="load", at_s=0.1, duration_s=0.2), "no fresh sample"),
    "late": (Fault(kind="late", phase="load", at_s=0.1, duration_s=0.5, value=40), "fresh|watchdog"),
    "deaf": (Fault(kind="deaf", phase="load", at_s=0.1, duration_s=0.2), "watchdog|answer"),
    "corrupt": (Fault(kind="corrupt", phase="load", at_s=0.1, duration_s=0.2), "no fresh sample"),
}


@pytest.mark.parametrize("kind", FAULTS)
def test_each_fault_ends_retracted_with_its_reason(kind: str) -> None:
    fault, _ = FAULTS[kind]
    bench = session_in(Phase(fault.phase), fault)
    bench.until()
    bench.settle()
    bench.check_end()
    assert bench.phase is Phase.STOPPED
    reason = bench.session.protocol.reason
    assert any(word in reason for word in FAULTS[kind][1].split("|")), reason


@pytest.mark.parametrize("ms", [2, 10])
def test_a_short_disturbance_is_outlived(ms: int) -> None:
    fault = Fault(kind="lost", phase="load", at_s=0.1, duration_s=ms / 1000)
    bench = session_in(Phase.LOAD, fault)
    bench.until()
    assert bench.phase is Phase.DONE
    assert bench.session.lost == pytest.approx(ms / 2, abs=1)


def test_a_pin_that_stays_stuck_is_reported() -> None:
    bench = session_in(Phase.LOAD, Fault(kind="stuck", phase="load", at_s=0.1, pin=1))
    bench.until()
    assert bench.phase is Phase.UNREACHABLE
    assert bench.session.unreachable == (1,)
    reason = bench.session.protocol.reason
    assert "stuck, pin 1 (a driven pin does not move)" in reason
    assert "cannot bring every pin home; use the device's own release" in reason
    others = np.delete(bench.device.motors.position_mm, 0)
    assert (others < 0.1).all()  # the others went home


def test_a_device_that_falls_silent_after_a_stop_is_reported() -> None:
    bench = session_in(Phase.LOAD)
    bench.session.handle(Abort("for the test"), bench.now)
    for _ in range(5100):
        bench.millisecond(device=False)
    assert bench.phase is Phase.UNREACHABLE
    assert bench.session.protocol.reason.startswith("for the test; silence for 5 s")


@pytest.mark.parametrize("phase", [p for p in Phase if p not in FINAL | {Phase.IDLE, Phase.STOPPING}])
def test_an_abort_in_any_phase_retracts(phase: Phase) -> None:
    bench = session_in(phase)
    bench.session.handle(Abort("for the test"), bench.now)
    bench.settle()
    bench.check_end()
    assert bench.session.protocol.reason == "for the test"


def test_an_operator_who_does_not_come_is_not_waited_for_forever() -> None:
    bench = session_in(Phase.READY)
    bench.settle()
    assert "ready took longer" in bench.session.protocol.reason
    bench.check_end()


def test_a_host_that_hangs_is_noticed_by_the_device() -> None:
    bench = session_in(Phase.LOAD)
    for _ in range(25):
        bench.millisecond(host=False)
    assert bench.device.stopped == "watchdog"
    for _ in range(500):
        bench.millisecond(host=False)
    assert bench.device.is_home
