"""What happens and what is done about it: the types that protocol, safety, device and record share."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntFlag

PINS = 14
RATE_HZ = 500
PERIOD_US = 1_000_000 // RATE_HZ


class Flags(IntFlag):
    """State bits of a sample, as the device sets them."""

    STOPPED = 1  # a stop is latched: no pin moves towards the limb
    BUTTON = 2  # the device's own emergency stop is pressed
    NO_POWER = 4  # the actuators have no power
    HOME = 8  # every pin is home
    GIVEN_UP = 16  # a stop is latched, and some pins do not come home


@dataclass(frozen=True, slots=True)
class Sample:
    """One sample of all channels.

    ``moving`` has bit k set while pin k + 1 is being driven; the tuples are by pin.  ``number`` is the number
    of the line in which the device sent it.
    """

    number: int
    time_us: int
    flags: int
    moving: int
    position_um: tuple[int, ...]
    force_mN: tuple[int, ...]
    capacitance_fF: tuple[int, ...]

    def is_moving(self, pin: int) -> bool:
        return bool(self.moving >> (pin - 1) & 1)


@dataclass(frozen=True, slots=True)
class Begin:
    """The operator starts the session."""


@dataclass(frozen=True, slots=True)
class Confirm:
    """The operator says that the limb is in place, the test pin at its site."""


@dataclass(frozen=True, slots=True)
class KeyDown:
    """The operator holds the key of the depth search."""


@dataclass(frozen=True, slots=True)
class KeyUp:
    """The operator lets it go."""


@dataclass(frozen=True, slots=True)
class Abort:
    """Somebody or something ends the session: a key, a signal, a limit, the watchdog."""

    reason: str


@dataclass(frozen=True, slots=True)
class LinkLost:
    """Nothing will come from the device any more."""

    reason: str


@dataclass(frozen=True, slots=True)
class Tick:
    """Time passes without a sample."""


Event = Sample | Begin | Confirm | KeyDown | KeyUp | Abort | LinkLost | Tick


@dataclass(frozen=True, slots=True)
class Move:
    """Drive a pin (1 to 14) to a position; it halts by itself at a force (0: at none)."""

    pin: int
    target_um: int
    speed_um_s: int
    halt_mN: int = 0


@dataclass(frozen=True, slots=True)
class Hold:
    """Halt a pin where it is."""

    pin: int


@dataclass(frozen=True, slots=True)
class Stop:
    """Halt everything at once, then bring every pin home; stays until the session ends."""

    reason: str


@dataclass(frozen=True, slots=True)
class Fence:
    """From now on a pin may not go beyond a position."""

    pin: int
    position_um: int


Action = Move | Hold | Stop | Fence


@dataclass(frozen=True)
class Settings:
    """Speeds mm/s, forces N, lengths mm, times s; documented with the study's table ``[acquire]``."""

    pin: int
    clamp_N: float
    clamp_tolerance_N: float
    clamp_speed_mm_s: float
    settle_s: float
    approach_speed_mm_s: float
    touch_N: float
    start_gap_mm: float
    search_speed_mm_s: float
    search_force_N: float
    search_depth_mm: float
    min_depth_mm: float
    pause_s: float
    precondition: int
    repeats: int
    ramp_speed_mm_s: float
    hold_s: float
    retract_speed_mm_s: float
    force_limit_N: float
    clamp_limit_N: float
    depth_limit_mm: float
    speed_limit_mm_s: float
    time_limit_s: float
    operator_limit_s: float
    watchdog_ms: float
    key_gap_ms: float

    @property
    def withdrawn(self) -> tuple[int, ...]:
        """The two neighbours of the test pin, which stay off the skin so that it can bulge."""
        return tuple((self.pin - 1 + step) % PINS + 1 for step in (-1, 1))

    @property
    def clamps(self) -> tuple[int, ...]:
        """The pins that hold the limb."""
        return tuple(pin for pin in range(1, PINS + 1) if pin != self.pin and pin not in self.withdrawn)

    @property
    def cycles(self) -> int:
        """Ramps in all, those of preconditioning included."""
        return self.precondition + self.repeats


def to_thousandths(value: float) -> int:
    """mm as um, N as mN, s as ms: a thousandth."""
    return round(1000 * value)
