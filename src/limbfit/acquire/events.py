"""What happens: the types that protocol, safety, device and record share, and the settings of a session."""

from dataclasses import dataclass
from enum import Enum, IntFlag

from ..study import AcquireTable

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
class LinkLost:
    """Nothing will come from the device any more."""

    reason: str


Event = Sample | Signal | Abort | LinkLost


class Settings(AcquireTable):
    """The study's table ``[acquire]``, and which pins hold the limb."""

    @property
    def withdrawn(self) -> tuple[int, ...]:
        """The two neighbours of the test pin, which stay off the skin so that it can bulge."""
        return tuple((self.pin - 1 + step) % PINS + 1 for step in (-1, 1))

    @property
    def clamps(self) -> tuple[int, ...]:
        """The pins that hold the limb."""
        return tuple(pin for pin in range(1, PINS + 1) if pin != self.pin and pin not in self.withdrawn)


def to_thousandths(value: float) -> int:
    """mm as um, N as mN, s as ms: a thousandth."""
    return round(1000 * value)
