"""Every limit of the experiment, in one place: checked on each sample by limbfit and again by the device.

`Guard` is what both ends run; `SafetyLimits` are the numbers.  What only one end can know - that the limb has
moved in the clamps, that a sensor does not answer to a push, that a step takes too long - stands below it.
"""

from collections import deque
from dataclasses import dataclass, replace

from ..study import AcquireTable
from .line_protocol import Flags, Identity, Sample, to_thousandths

FROZEN_S = 0.010  # a sensor whose last digit has not changed for so long, and so many samples, is dead
FROZEN_SAMPLES = 8
SPEED_WINDOW_US = 10_000  # over which a speed is measured; more where samples are rare
SPEED_SAMPLES = 5
SPEED_MARGIN = 1.25  # of a measured speed over a limit: encoder noise, and the corner of a ramp
POSITION_MARGIN_UM = 100  # of a measured position over a limit: noise, and what braking takes
MIN_CLAMP_MN = 500  # a clamping pin that pushes less has lost the limb
MAX_CLAMP_JUMP_MN = 3000  # and so has one whose force changes by more, within the time below
CLAMP_JUMP_US = 200_000
MAX_UNFELT_TRAVEL_UM = 1500  # a push so far beyond touch must be felt
CONTACT_STEPS = 3  # of a coarse sensor: a force that is contact, and not its last digit


@dataclass(frozen=True)
class SafetyLimits:
    """Per pin: largest force (mN) and position (um).

    For all: speed towards the limb (um/s), sensor range (mN), how often a live sensor may repeat itself, the
    step of a sensor that is too coarse to show its noise (mN; 0: it shows it), and over which time (us) a
    speed is measured.
    """

    force_mN: tuple[int, ...]
    position_um: tuple[int, ...]
    speed_um_s: int
    range_mN: int
    max_unchanged_samples: int
    resolution_mN: int = 0
    speed_window_us: int = SPEED_WINDOW_US


@dataclass(frozen=True)
class Violation:
    """A limit that was passed; ``code`` is short and fixed, ``text`` is for people."""

    code: str
    pin: int
    text: str


def make_session_limits(settings: AcquireTable, device: Identity, resolution_mN: int = 0) -> SafetyLimits:
    """The limits of a session before the skin has been met; see `Guard.set_depth`.

    A sensor whose step ``resolution_mN`` hides its noise may repeat itself: of it is asked that it changes
    while the pin travels in contact.
    """
    force = [to_thousandths(settings.clamp_limit_N)] * device.pins
    force[settings.pin - 1] = to_thousandths(settings.force_limit_N)
    return SafetyLimits(
        force_mN=tuple(force),
        position_um=(device.stroke_um,) * device.pins,
        speed_um_s=to_thousandths(settings.speed_limit_mm_s),
        range_mN=device.range_mN,
        max_unchanged_samples=max(round(FROZEN_S * device.rate_hz), FROZEN_SAMPLES),
        resolution_mN=resolution_mN,
        speed_window_us=max(SPEED_WINDOW_US, SPEED_SAMPLES * 1_000_000 // device.rate_hz),
    )


class Guard:
    """Looks at every sample; remembers only what a limit in time needs."""

    def __init__(self, limits: SafetyLimits) -> None:
        self.limits = limits
        self._lowest_limit_mN = min(*limits.force_mN, limits.range_mN - 1)
        self._recent_samples: deque[Sample] = deque()
        self._last_forces: tuple[int, ...] = ()
        self._unchanged_samples = [0] * len(limits.force_mN)
        self._changed_at_um: list[int] = []  # where each pin was when its force last changed

    def set_depth(self, pin: int, position_um: int) -> None:
        """From now on a pin may not go beyond a position."""
        position = list(self.limits.position_um)
        position[pin - 1] = min(position_um, position[pin - 1])
        self.limits = replace(self.limits, position_um=tuple(position))

    def check(self, sample: Sample) -> Violation | None:
        """Return the first limit that the sample passes, if any."""
        most = self.limits
        # The common case at once; which pin it is matters only where one is over.
        strong = max(max(sample.force_mN), -min(sample.force_mN)) > self._lowest_limit_mN
        if strong and (wrong := self._check_forces(sample)):
            return wrong
        for pin, (position, far) in enumerate(zip(sample.position_um, most.position_um, strict=True), 1):
            if position > far + POSITION_MARGIN_UM:
                text = f"pin {pin}: {position / 1000:.2f} mm is over the limit of {far / 1000:.2f} mm"
                return Violation("depth", pin, text)
        return self._check_speeds(sample) or self._check_frozen_sensors(sample)

    def _check_forces(self, sample: Sample) -> Violation | None:
        limits = self.limits
        for pin, (force, most) in enumerate(zip(sample.force_mN, limits.force_mN, strict=True), 1):
            if abs(force) >= limits.range_mN:
                return Violation("saturated", pin, f"the force sensor of pin {pin} is saturated")
            if abs(force) > most:  # no limb pulls: a sensor that is wired the wrong way round
                text = f"pin {pin}: {force / 1000:.2f} N is over the limit of {most / 1000:g} N"
                return Violation("force", pin, text)
        return None

    def _check_speeds(self, sample: Sample) -> Violation | None:
        past = self._recent_samples
        past.append(sample)
        while len(past) > 2 and sample.time_us - past[1].time_us >= self.limits.speed_window_us:
            past.popleft()
        span = sample.time_us - past[0].time_us
        if span < self.limits.speed_window_us:
            return None
        most = SPEED_MARGIN * self.limits.speed_um_s * span / 1e6
        for pin, (now, then) in enumerate(zip(sample.position_um, past[0].position_um, strict=True), 1):
            if now - then > most:
                speed, limit = (now - then) / span * 1000, self.limits.speed_um_s / 1000
                text = f"pin {pin}: {speed:.1f} mm/s is over the limit of {limit:g} mm/s"
                return Violation("speed", pin, text)
        return None

    def _check_frozen_sensors(self, sample: Sample) -> Violation | None:
        """Find a sensor that repeats itself: a live one is noisy, or changes as its pin goes deeper."""
        if self.limits.resolution_mN:
            return self._check_coarse_sensors(sample)
        if self._last_forces:
            unchanged = self._unchanged_samples
            for k, (now, then) in enumerate(zip(sample.force_mN, self._last_forces, strict=True)):
                unchanged[k] = unchanged[k] + 1 if now == then else 0
                if unchanged[k] >= self.limits.max_unchanged_samples:
                    self._last_forces = sample.force_mN
                    text = f"the force sensor of pin {k + 1} is dead: it repeats itself"
                    return Violation("dead", k + 1, text)
        self._last_forces = sample.force_mN
        return None

    def _check_coarse_sensors(self, sample: Sample) -> Violation | None:
        last, places = self._last_forces or sample.force_mN, self._changed_at_um or list(sample.position_um)
        self._last_forces, self._changed_at_um = sample.force_mN, places
        for k, (now, then) in enumerate(zip(sample.force_mN, last, strict=True)):
            if now != then or now < CONTACT_STEPS * self.limits.resolution_mN:
                places[k] = sample.position_um[k]
            elif abs(sample.position_um[k] - places[k]) > MAX_UNFELT_TRAVEL_UM:
                text = f"the force sensor of pin {k + 1} is dead: it shows the same over "
                return Violation("dead", k + 1, f"{text}{MAX_UNFELT_TRAVEL_UM / 1000:g} mm in contact")
        return None


class ClampWatch:
    """Whether the held limb stays where it is: the forces of the pins that clamp it only relax, slowly."""

    def __init__(self, pins: tuple[int, ...]) -> None:
        self.pins = pins
        self._recent_samples: deque[Sample] = deque()

    def check(self, sample: Sample) -> str:
        """Return how the limb has moved, if it has."""
        past = self._recent_samples
        past.append(sample)
        while sample.time_us - past[0].time_us > CLAMP_JUMP_US:
            past.popleft()
        for pin in self.pins:
            now, then = sample.force_mN[pin - 1], past[0].force_mN[pin - 1]
            if now < MIN_CLAMP_MN:
                return f"the limb has moved: pin {pin} has lost contact"
            if abs(now - then) > MAX_CLAMP_JUMP_MN:
                return f"the limb has moved: the force of pin {pin} jumped by {(now - then) / 1000:+.1f} N"
        return ""


def check_device_flags(flags: int) -> str:
    """Return why the device says of itself that it has to stop, if it does."""
    if flags & Flags.BUTTON:
        return "the device's emergency stop was pressed"
    if flags & Flags.NO_POWER:
        return "the actuators have no power"
    return "the device stopped by itself" if flags & Flags.STOPPED else ""


def check_sensitivity(travel_um: int, force_mN: int, expected_mN: int, pin: int) -> str:
    """Refuse a force sensor that feels nothing of a push that the capacitance saw begin."""
    if travel_um > MAX_UNFELT_TRAVEL_UM and force_mN < expected_mN:
        return f"pin {pin} touches ({travel_um / 1000:.1f} mm ago) but feels no force: see its force sensor"
    return ""
