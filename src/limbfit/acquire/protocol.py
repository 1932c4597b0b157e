"""The protocol of a session: its phases as a table, and the state machine that goes through them.

Events come in and actions go out; there is no clock, no wire and no file. One `Protocol` is one session.
`Protocol.handle` takes an event and the time in s, of whatever clock its caller has, and returns what is to
be done. `TRANSITIONS` alone says where a session can go.
"""

from dataclasses import dataclass
from enum import Enum, StrEnum

from ..study import AcquireTable
from . import line_protocol as wire
from .line_protocol import PINS, Flags, Sample, to_thousandths
from .safety import ClampWatch, Guard, check_device_flags, check_sensitivity, make_session_limits

COMMAND_DELAY_S = 0.05  # a pin may stand still for so long before a command reaches it
ARRIVAL_TOLERANCE_UM = 60  # a pin that is so near to its target has arrived
MAX_CLAMP_ROUNDS = 30
MAX_SILENCE_S = 5.0  # a device that says nothing for so long after a stop is out of reach
MAX_STOP_S = 15.0  # and so is one that has not come home by then


class Signal(Enum):
    """What happens besides samples and ends."""

    BEGIN = "the operator starts the session"
    CONFIRM = "the operator says that the limb is in place, the test pin at its site"
    KEY_DOWN = "the operator holds the key of the depth search"
    KEY_UP = "the operator lets it go"
    TICK = "time passes without a sample"


@dataclass(frozen=True, slots=True)
class Abort:
    """Somebody or something ends the session: a key, a signal, a limit, the watchdog."""

    reason: str


@dataclass(frozen=True, slots=True)
class LinkLoss:
    """Nothing will come from the device any more."""

    reason: str


Event = Sample | Signal | Abort | LinkLoss


class Settings(AcquireTable):
    """The study's table ``[acquire]``, and which pins hold the limb."""

    @property
    def clamps(self) -> tuple[int, ...]:
        """The pins that hold the limb; the two beside the test pin stay off the skin so that it can bulge."""
        near = [(self.pin - 1 + step) % PINS + 1 for step in (-1, 0, 1)]
        return tuple(pin for pin in range(1, PINS + 1) if pin not in near)


class Phase(StrEnum):
    """Where a session is."""

    IDLE = "idle"
    POSITION = "position"  # all pins home, the operator puts the limb in place
    CLAMP = "clamp"
    SETTLE = "settle"
    APPROACH = "approach"
    BACK = "back"  # from the skin to the start of the ramps
    READY = "ready"  # waits for the operator's key
    SEARCH = "search"  # the depth search, while the key is held
    RETURN = "return"
    PAUSE = "pause"
    LOAD = "load"
    DWELL = "hold"  # at the deepest point
    UNLOAD = "unload"
    RETRACT = "retract"
    RELEASE = "release"
    DONE = "done"
    STOPPING = "stopping"
    STOPPED = "stopped"
    UNREACHABLE = "unreachable"


FINAL = frozenset({Phase.DONE, Phase.STOPPED, Phase.UNREACHABLE})
WAITS_FOR_OPERATOR = frozenset({Phase.POSITION, Phase.READY})
_PHASES = list(Phase)
CLAMPED = frozenset(_PHASES[_PHASES.index(Phase.APPROACH) : _PHASES.index(Phase.RETRACT)])

_PROTOCOL_STEPS: dict[Phase, tuple[Phase, ...]] = {
    Phase.IDLE: (Phase.POSITION,),
    Phase.POSITION: (Phase.CLAMP, Phase.SETTLE),  # a device of one pin holds no limb
    Phase.CLAMP: (Phase.SETTLE,),
    Phase.SETTLE: (Phase.APPROACH, Phase.CLAMP),  # once more where the limb has slackened
    Phase.APPROACH: (Phase.BACK,),
    Phase.BACK: (Phase.READY,),
    Phase.READY: (Phase.SEARCH,),
    Phase.SEARCH: (Phase.RETURN, Phase.BACK),  # back where the depth found is too small
    Phase.RETURN: (Phase.PAUSE,),
    Phase.PAUSE: (Phase.LOAD,),
    Phase.LOAD: (Phase.UNLOAD, Phase.DWELL),
    Phase.DWELL: (Phase.UNLOAD,),
    Phase.UNLOAD: (Phase.LOAD, Phase.PAUSE, Phase.RETRACT),
    Phase.RETRACT: (Phase.RELEASE, Phase.DONE),
    Phase.RELEASE: (Phase.DONE,),
}
# A stop is possible everywhere but where it has happened or nothing is left to stop.
TRANSITIONS = {phase: (*after, Phase.STOPPING) for phase, after in _PROTOCOL_STEPS.items()} | {
    Phase.STOPPING: (Phase.STOPPED, Phase.UNREACHABLE)
}


class Protocol:
    """One session's state, changed by `handle` alone.

    ``phase``: where the session is; ``reason``: why it was stopped, empty where it was not. ``clamps``: the
    pins that hold the limb; none where the device has one pin. ``touch_um``, ``start_um``, ``depth_um``:
    positions of the test pin, as they are found. ``cycle``: ramps begun so far, those of preconditioning
    included. ``resolution_mN`` is the step of a force sensor too coarse to show its noise; 0: it shows it.
    """

    def __init__(self, settings: Settings, device: wire.Identity, resolution_mN: int = 0) -> None:
        self.settings, self.device = settings, device
        self.phase, self.reason = Phase.IDLE, ""
        self.touch_um = self.start_um = self.depth_um = self.cycle = 0
        self.clamps = settings.clamps if device.pins > 1 else ()
        self.guard = Guard(make_session_limits(settings, device, resolution_mN))
        self._clamp_watch = ClampWatch(self.clamps)
        self._phase_start_s = self._last_sample_s = 0.0
        self._rounds = 0
        self._is_confirmed = False
        self._tare_samples: list[int] = []
        self._contact_um: int | None = None  # where the capacitance first said so, or the force last did not
        self._clear_um = 0

    @property
    def is_over(self) -> bool:
        return self.phase in FINAL

    @property
    def is_completed(self) -> bool:
        return self.phase is Phase.DONE

    def handle(self, event: Event, now: float) -> tuple[wire.Action, ...]:
        """Return the actions that an event leads to; ``now``: s, never less than in the call before."""
        if isinstance(event, Sample):
            self._last_sample_s = now
            return self._handle_sample(event, now)
        if self.is_over:
            return ()
        match event:
            case Signal.BEGIN if self.phase is Phase.IDLE:
                self._last_sample_s = now
                return self._transition(Phase.POSITION, now)
            case Abort(reason=reason):
                return self._stop(reason, now)
            case LinkLoss(reason=reason):
                self.reason = f"{self.reason}; {reason}" if self.reason else reason
                if self.phase is not Phase.STOPPING:
                    self._transition(Phase.STOPPING, now)
                why = "whether the device has retracted is not known"
                return self._transition(self._report_unreachable(why), now)
            case Signal.CONFIRM if self.phase is Phase.POSITION:
                self._is_confirmed = True
            case Signal.CONFIRM:  # no longer what is asked for: a key like any other
                return self._stop("the operator stopped it by a key", now)
            case Signal.KEY_DOWN if self.phase is Phase.READY:
                return self._transition(Phase.SEARCH, now)
            case Signal.KEY_UP if self.phase is Phase.SEARCH:
                self._is_confirmed = False
                return (wire.Hold(self.settings.pin),)
        return self._check_time(now)

    # -- whatever the phase

    def _handle_sample(self, sample: Sample, now: float) -> tuple[wire.Action, ...]:
        if self.phase in FINAL or self.phase is Phase.IDLE:
            return ()
        if self.phase is not Phase.STOPPING:
            violation = self.guard.check(sample)
            wrong = check_device_flags(sample.flags) or (violation.text if violation else "")
            if wrong := wrong or self._check_phase_limits(sample):
                return self._stop(wrong, now)
        following = self._find_next_phase(sample, now)
        return self._transition(following, now) if following else self._check_time(now)

    def _check_phase_limits(self, sample: Sample) -> str:
        """Check the limits that hold in some phases only."""
        if self.phase in CLAMPED and (wrong := self._clamp_watch.check(sample)):
            return wrong
        pin, touch_mN = self.settings.pin, to_thousandths(self.settings.touch_N)
        if self.phase is Phase.APPROACH and self._compute_net_force(sample) < -touch_mN:
            return f"pin {pin} feels a pull as it comes near the skin: the sign of its force is reversed"
        if self.phase is Phase.APPROACH and self._contact_um is not None:
            force_mN, travel = self._compute_net_force(sample), sample.position_um[pin - 1] - self._contact_um
        elif self.phase is Phase.SEARCH:  # the first push: on a ramp the tissue may not be back yet
            force_mN, travel = self._compute_net_force(sample), sample.position_um[pin - 1] - self.touch_um
        else:
            return ""
        return check_sensitivity(travel, force_mN, touch_mN // 2, pin)

    def _check_time(self, now: float) -> tuple[wire.Action, ...]:
        """Stop, or give up, where a phase takes longer than it may."""
        if self.phase in FINAL or self.phase is Phase.IDLE:
            return ()
        if self.phase is Phase.STOPPING:
            if now - self._last_sample_s > MAX_SILENCE_S:
                why = f"silence for {MAX_SILENCE_S:g} s: whether the device has retracted is not known"
                return self._transition(self._report_unreachable(why), now)
            if now - self._phase_start_s > MAX_STOP_S:
                why = f"not every pin is home {MAX_STOP_S:g} s later"
                return self._transition(self._report_unreachable(why), now)
            return ()
        waits = self.phase in WAITS_FOR_OPERATOR
        limit = self.settings.operator_limit_s if waits else self.settings.time_limit_s
        if now - self._phase_start_s > limit:
            return self._stop(f"{self.phase} took longer than {limit:g} s", now)
        return ()

    def _stop(self, reason: str, now: float) -> tuple[wire.Action, ...]:
        if Phase.STOPPING not in TRANSITIONS.get(self.phase, ()):
            return ()
        self.reason = reason
        return self._transition(Phase.STOPPING, now)

    def _transition(self, phase: Phase, now: float) -> tuple[wire.Action, ...]:
        if phase not in TRANSITIONS[self.phase]:
            raise ValueError(f"no session goes from {self.phase} to {phase}")
        self.phase = phase
        self._phase_start_s = now
        return self._enter()

    # -- moves

    def _drive(self, target_um: int, speed_mm_s: float, halt_mN: int = 0) -> tuple[wire.Action, ...]:
        return (wire.Move(self.settings.pin, target_um, to_thousandths(speed_mm_s), halt_mN),)

    def _drive_home(self, pins: tuple[int, ...]) -> tuple[wire.Action, ...]:
        return tuple(wire.Move(pin, 0, to_thousandths(self.settings.retract_speed_mm_s)) for pin in pins)

    def _enter(self) -> tuple[wire.Action, ...]:
        """Return the actions with which a phase begins."""
        settings, stroke_um = self.settings, self.device.stroke_um
        match self.phase:
            case Phase.POSITION:
                self._is_confirmed = False
                return self._drive_home(tuple(range(1, len(self.guard.limits.force_mN) + 1)))
            case Phase.CLAMP:
                self._rounds += 1
                speed = to_thousandths(settings.clamp_speed_mm_s / (1 if self._rounds == 1 else 5))
                halt = to_thousandths(settings.clamp_N)
                return tuple(wire.Move(pin, stroke_um, speed, halt) for pin in self.clamps)
            case Phase.APPROACH:
                self._contact_um = None
                halt = self._compute_tare() + to_thousandths(settings.touch_N)
                return self._drive(stroke_um, settings.approach_speed_mm_s, max(halt, 1))
            case Phase.BACK | Phase.RETURN:
                fence = wire.Fence(settings.pin, self._compute_deepest_um())
                return (fence, *self._drive(self.start_um, settings.retract_speed_mm_s))
            case Phase.SEARCH:
                self._is_confirmed, self.depth_um = True, 0
                deepest = min(self.touch_um + to_thousandths(settings.search_depth_mm), stroke_um)
                halt = self._compute_tare() + to_thousandths(settings.search_force_N)
                return self._drive(deepest, settings.search_speed_mm_s, halt)
            case Phase.LOAD:
                self.cycle += 1
                return self._drive(self.depth_um, settings.ramp_speed_mm_s)
            case Phase.UNLOAD:
                return self._drive(self.start_um, settings.ramp_speed_mm_s)
            case Phase.RETRACT:
                return self._drive_home((settings.pin,))
            case Phase.RELEASE:
                return self._drive_home(self.clamps)
            case Phase.STOPPING:
                return (wire.Stop(self.reason),)
        return ()

    # -- how phases end

    def _compute_tare(self) -> int:
        """The mean force of the test pin off the skin, mN."""
        return sum(self._tare_samples) // len(self._tare_samples) if self._tare_samples else 0

    def _compute_deepest_um(self) -> int:
        return min(self.touch_um + to_thousandths(self.settings.depth_limit_mm), self.device.stroke_um)

    def _compute_net_force(self, sample: Sample) -> int:
        return sample.force_mN[self.settings.pin - 1] - self._compute_tare()

    def _is_at_rest(self, sample: Sample, now: float, pins: tuple[int, ...]) -> bool:
        return now - self._phase_start_s > COMMAND_DELAY_S and not any(sample.is_moving(pin) for pin in pins)

    def _has_arrived(self, sample: Sample, now: float, target_um: int) -> bool:
        pin = self.settings.pin
        near = abs(sample.position_um[pin - 1] - target_um) < ARRIVAL_TOLERANCE_UM
        return near and self._is_at_rest(sample, now, (pin,))

    def _find_next_phase(self, sample: Sample, now: float) -> Phase | None:
        """The phase that follows if this sample ends the present one, else None."""
        settings, passed_s = self.settings, now - self._phase_start_s
        is_home = bool(sample.flags & Flags.HOME)
        match self.phase:
            case Phase.POSITION if self._is_confirmed and is_home:
                return Phase.CLAMP if self.clamps else Phase.SETTLE
            case Phase.CLAMP if self._is_at_rest(sample, now, self.clamps):
                return Phase.SETTLE
            case Phase.SETTLE:
                return self._find_phase_after_settling(sample, now)
            case Phase.APPROACH:
                return self._find_phase_after_approach(sample, now)
            case Phase.BACK | Phase.RETURN if self._has_arrived(sample, now, self.start_um):
                return Phase.READY if self.phase is Phase.BACK else Phase.PAUSE
            case Phase.SEARCH:
                self.depth_um = max(self.depth_um, sample.position_um[settings.pin - 1])
                if self._is_at_rest(sample, now, (settings.pin,)):
                    enough = self.depth_um - self.touch_um >= to_thousandths(settings.min_depth_mm)
                    return Phase.RETURN if enough else Phase.BACK
            case Phase.PAUSE if passed_s >= settings.pause_s:
                return Phase.LOAD
            case Phase.LOAD if self._has_arrived(sample, now, self.depth_um):
                is_held = settings.hold_s > 0.0 and self.cycle > settings.precondition
                return Phase.DWELL if is_held else Phase.UNLOAD
            case Phase.DWELL if passed_s >= settings.hold_s:
                return Phase.UNLOAD
            case Phase.UNLOAD if self._has_arrived(sample, now, self.start_um):
                if self.cycle == settings.precondition + settings.repeats:
                    return Phase.RETRACT
                return Phase.LOAD if self.cycle < settings.precondition else Phase.PAUSE
            case Phase.RETRACT if self._has_arrived(sample, now, 0):
                return Phase.RELEASE if self.clamps else Phase.DONE
            case Phase.RELEASE if is_home and passed_s > COMMAND_DELAY_S:
                return Phase.DONE
            case Phase.STOPPING if sample.flags & Flags.GIVEN_UP:
                return self._report_unreachable("the device cannot bring every pin home")
            case Phase.STOPPING if sample.flags & Flags.STOPPED and is_home:
                return Phase.STOPPED
        return None

    def _find_phase_after_settling(self, sample: Sample, now: float) -> Phase | None:
        self._tare_samples.append(sample.force_mN[self.settings.pin - 1])
        if now - self._phase_start_s < self.settings.settle_s:
            return None
        if not self.clamps:
            return Phase.APPROACH
        least = to_thousandths(self.settings.clamp_N - self.settings.clamp_tolerance_N)
        force, pin = min((sample.force_mN[pin - 1], pin) for pin in self.clamps)
        if force >= least:
            return Phase.APPROACH
        if self._rounds < MAX_CLAMP_ROUNDS:
            return Phase.CLAMP
        return self._fail(f"pin {pin} clamps with {force / 1000:.1f} N only, after {MAX_CLAMP_ROUNDS} rounds")

    def _find_phase_after_approach(self, sample: Sample, now: float) -> Phase | None:
        pin = self.settings.pin
        touch_mN, force_mN = to_thousandths(self.settings.touch_N), self._compute_net_force(sample)
        touches = is_felt = force_mN >= touch_mN // 2
        if self.device.touch_fF:
            touches = sample.capacitance_fF[pin - 1] >= self.device.touch_fF
        elif force_mN <= max(touch_mN // 10, 2 * self.guard.limits.resolution_mN):
            self._clear_um = sample.position_um[pin - 1]
        if touches and self._contact_um is None:
            self._contact_um = sample.position_um[pin - 1] if self.device.touch_fF else self._clear_um
        if not self._is_at_rest(sample, now, (pin,)):
            return None
        if is_felt and self._contact_um is not None:
            self.touch_um = self._contact_um
            self.start_um = max(self.touch_um - to_thousandths(self.settings.start_gap_mm), 0)
            self.guard.set_depth(pin, self._compute_deepest_um())
            return Phase.BACK
        if touches:
            return None  # the limb gave way: the limits of deafness and time decide
        if is_felt:
            return self._fail(f"pin {pin} feels a force where its capacitance sees no skin")
        return self._fail(f"pin {pin} met nothing up to the end of its stroke")

    def _report_unreachable(self, why: str) -> Phase:
        self.reason = f"{self.reason}; {why}; use the device's own release"
        return Phase.UNREACHABLE

    def _fail(self, reason: str) -> Phase:
        self.reason = reason
        return Phase.STOPPING
