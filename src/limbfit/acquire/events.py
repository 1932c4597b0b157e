"""What happens and what is done about it: the types that protocol, safety, device and record share."""

from dataclasses import dataclass
from enum import Enum, IntFlag
from typing import Annotated, Any, ClassVar, dataclass_transform, get_origin, get_type_hints

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


MAX_VALUE = 1_000_000  # no length, speed or force of this device is larger (um, um/s, mN)
# Types of the words of messages, with the values that have a meaning.
Pin = Annotated[int, range(1, PINS + 1)]
Whole = Annotated[int, range(MAX_VALUE + 1)]
Positive = Annotated[int, range(1, MAX_VALUE + 1)]


@dataclass_transform(frozen_default=True)
class Message:
    """What a line of the wire says: a verb and its words.

    ``words`` are the fields of a kind whose type says what values they have, in their order, and these
    values: a range, or a pattern.
    """

    verb: ClassVar[str]
    words: ClassVar[dict[str, Any]]

    def __init_subclass__(cls, verb: str) -> None:
        types = get_type_hints(cls, include_extras=True)
        cls.verb = verb
        cls.words = {name: of.__metadata__[0] for name, of in types.items() if get_origin(of) is Annotated}
        dataclass(frozen=True)(cls)

    @property
    def body(self) -> str:
        return " ".join((self.verb, *(str(getattr(self, name)) for name in self.words)))


class Move(Message, verb="MOVE"):
    """Drive a pin (1 to 14) to a position; it halts by itself at a force (0: at none)."""

    pin: Pin
    target_um: Whole
    speed_um_s: Positive
    halt_mN: Whole = 0


class Hold(Message, verb="HOLD"):
    """Halt a pin where it is."""

    pin: Pin


class Stop(Message, verb="STOP"):
    """Halt everything at once, then bring every pin home; stays until the session ends.

    The reason holds what devices said, and stays off the wire.
    """

    reason: str = ""


class Fence(Message, verb="FENCE"):
    """From now on a pin may not go beyond a position."""

    pin: Pin
    position_um: Positive


Action = Move | Hold | Stop | Fence


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
