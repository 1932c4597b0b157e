"""The line protocol: lines on the wire, and the messages that they carry.

A line is ``<number> <body>*<crc>`` and a newline: the sequence number in decimal, a body of printable ASCII,
the CRC-32 (IEEE 802.3, eight hexadecimal digits) of all before the asterisk. The CRC starts from the
session's *salt*, so a line of another session fails it, and numbers only rise, so a line that comes again or
out of order is refused. Nothing here protects against an attacker on the wire: it is no authentication.

Each message is a type. A body that is not exactly one of these is no message: `parse_command` and
`parse_report` return None, and the line is counted as unknown and not acted on.

`docs/device-protocol.md` is the reference for whoever writes the other end.
"""

import re
from binascii import crc32
from dataclasses import dataclass, field
from enum import IntFlag
from typing import Annotated, Any, ClassVar, dataclass_transform, get_args, get_origin, get_type_hints

PINS = 14
RATE_HZ = 500
PERIOD_US = 1_000_000 // RATE_HZ
VERSION = 1
HOST_LINE = 128  # bytes, newline included: the longest that a device must take
DEVICE_LINE = 768  # the longest that limbfit takes
MAX_NUMBER = 2**31 - 1
_LINE = re.compile(rb"([0-9]{1,10}) ([\x20-\x29\x2b-\x7e]+)\*([0-9A-F]{8})\Z")
_INTEGER = re.compile(r"[0-9]{1,9}\Z", re.ASCII)
_SAMPLE = re.compile(
    rf"S ([0-9]{{1,15}}),([0-9]{{1,4}}),([0-9]{{1,5}})((?:,-?[0-9]{{1,8}}){{{3 * PINS}}})\Z", re.ASCII
)
MAX_VALUE = 1_000_000  # no length, speed or force of this device is larger (um, um/s, mN)
# Types of the words of messages, with the values that have a meaning.
Pin = Annotated[int, range(1, PINS + 1)]
Whole = Annotated[int, range(MAX_VALUE + 1)]
Positive = Annotated[int, range(1, MAX_VALUE + 1)]
Number = Annotated[int, range(MAX_NUMBER + 1)]  # of a line: may be larger than any length, speed or force
PinOrNone = Annotated[int, range(PINS + 1)]  # 0: none
PinBits = Annotated[int, range(1 << PINS)]  # a bit for each
Word = Annotated[str, re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,39}\Z", re.ASCII)]
Nonce = Annotated[str, re.compile(r"[0-9a-f]{16}\Z")]
Clock = Annotated[str, re.compile(r"(real|paced)\Z")]


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


def to_thousandths(value: float) -> int:
    """mm as um, N as mN, s as ms: a thousandth."""
    return round(1000 * value)


def derive_salt(host_nonce: str, device_nonce: str) -> int:
    """The salt of a session, from the nonces of both ends."""
    return crc32(f"{host_nonce}:{device_nonce}".encode("ascii"))


@dataclass(frozen=True, slots=True)
class Line:
    """A line that was accepted."""

    number: int
    body: str


@dataclass
class Refusals:
    """What was refused, and what never came, by cause."""

    malformed: int = 0
    checksum: int = 0
    replayed: int = 0  # or out of order: a number that is not above the last
    oversized: int = 0
    unknown: int = 0  # a sound line that says nothing known here
    missing: int = 0  # numbers skipped

    @property
    def total(self) -> int:
        """Lines refused; those that never came are none."""
        return self.malformed + self.checksum + self.replayed + self.oversized + self.unknown


class Encoder:
    """Bodies to lines, numbered from 1."""

    def __init__(self, salt: int = 0, first: int = 1) -> None:
        self.salt, self.next = salt, first

    def encode(self, body: str) -> tuple[int, bytes]:
        """The line of a body, and its number."""
        number = self.next
        self.next += 1
        content = f"{number} {body}".encode("ascii")
        return number, b"%s*%08X\n" % (content, crc32(content, self.salt))


@dataclass
class Decoder:
    """Bytes, in whatever pieces they come, to lines; holds at most ``limit`` bytes."""

    limit: int
    salt: int = 0
    last: int = 0
    numbered: bool = True  # before a session the numbers of lines mean nothing
    refused: Refusals = field(default_factory=Refusals)
    _rest: bytearray = field(default_factory=bytearray)
    _skipping: bool = False

    def feed(self, data: bytes) -> list[Line]:
        """The lines that end in these bytes and are accepted, in order."""
        *ended, rest = data.split(b"\n")
        found = [line for part in ended if (line := self._end_line(part)) is not None]
        self._buffer(rest)
        return found

    def restart(self, salt: int) -> None:
        """A new session begins with the next line."""
        self.salt, self.last, self.numbered = salt, 0, True

    def _buffer(self, part: bytes) -> None:
        if self._skipping:
            return
        if len(self._rest) + len(part) >= self.limit:
            self._rest.clear()
            self._skipping = True
            return
        self._rest += part

    def _end_line(self, part: bytes) -> Line | None:
        self._buffer(part)
        if self._skipping:
            self._skipping = False
            self.refused.oversized += 1
            return None
        content = bytes(self._rest)
        self._rest.clear()
        return self._accept(content) if content else None  # an empty line keeps a terminal awake

    def _accept(self, content: bytes) -> Line | None:
        match = _LINE.match(content.removesuffix(b"\r"))
        if match is None:
            self.refused.malformed += 1
            return None
        number, body, crc = match.groups()
        if crc32(b"%s %s" % (number, body), self.salt) != int(crc, 16):
            self.refused.checksum += 1
            return None
        count = int(number)
        if self.numbered:
            if count <= self.last or count > MAX_NUMBER:
                self.refused.replayed += 1
                return None
            self.refused.missing += count - self.last - 1
            self.last = count
        return Line(count, body.decode("ascii"))


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


# -- from limbfit to the device


class Hello(Message, verb="HELLO"):
    """Opens a session; the only line without salt."""

    version: Positive
    nonce: Nonce


class SetLimits(Message, verb="LIMITS"):
    """The device's own limits for this session: it takes the lower of these and those built in."""

    pin: Pin
    force_mN: Positive
    clamp_mN: Positive
    position_um: Positive
    speed_um_s: Positive
    watchdog_ms: Positive


class NoteSite(Message, verb="SITE"):
    """The site at which the session is."""

    name: Word


class NotePhase(Message, verb="PHASE"):
    """The phase in which the session is, for the device's display and log."""

    name: Word


class Heartbeat(Message, verb="BEAT"):
    """limbfit lives, and has dealt with the sample of this number."""

    number: Number


class Bye(Message, verb="BYE"):
    """Ends the session."""


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


# -- from the device to limbfit


class Identity(Message, verb="ID"):
    """What a device says of itself when greeted.

    ``clock`` is ``real``, or ``paced``: the device's time waits for limbfit, which then lives by it.
    ``touch_fF`` is the capacitance of a head that touches skin (0: heads have none, the force alone tells);
    ``calibrated`` the day of its calibration.
    """

    version: Positive
    nonce: Nonce
    pins: Positive
    rate_hz: Positive
    stroke_um: Positive
    range_mN: Positive
    touch_fF: Whole
    clock: Clock
    model: Word
    serial: Word
    calibrated: Word

    @property
    def is_paced(self) -> bool:
        return self.clock == "paced"


class Acceptance(Message, verb="OK"):
    """The command of this number is being done."""

    number: Number


class Rejection(Message, verb="NO"):
    """The command of this number is not done, and why, in a word."""

    number: Number
    code: Word


class LimitTrip(Message, verb="FAULT"):
    """The device stopped by itself: why, in a word, and at which pin (0: none)."""

    code: Word
    pin: PinOrNone


class StuckPins(Message, verb="STUCK"):
    """After a stop these pins (a bit each) do not come home."""

    pins: PinBits


Action = Move | Hold | Stop | Fence
Command = Hello | SetLimits | NoteSite | NotePhase | Heartbeat | Bye | Action
Notice = Sample | Rejection | LimitTrip | StuckPins  # what concerns a session
Report = Identity | Acceptance | Notice
_COMMANDS: dict[str, Any] = {kind.verb: kind for kind in get_args(Command)}
_REPORTS: dict[str, Any] = {kind.verb: kind for kind in get_args(Report) if kind is not Sample}


def parse_command(body: str) -> Command | None:
    """The command that a body states, or None."""
    return _parse(body, _COMMANDS)


def parse_report(body: str, number: int) -> Report | None:
    """The report that a body states, or None; ``number`` is its line's."""
    return _parse_sample(body, number) if body.startswith("S ") else _parse(body, _REPORTS)


def _parse(body: str, kinds: dict[str, Any]) -> Any:
    """The message that a body states, of the kinds by their verbs; None where it is exactly none of them."""
    verb, *words = body.split(" ")
    kind = kinds.get(verb)
    if kind is None or len(words) != len(kind.words):
        return None
    values = [_parse_word(word, known) for word, known in zip(words, kind.words.values(), strict=True)]
    return None if None in values else kind(*values)


def _parse_word(word: str, known: range | re.Pattern[str]) -> str | int | None:
    """The value of a word, or None where its type has no such value."""
    if isinstance(known, re.Pattern):
        return word if known.match(word) else None
    number = int(word) if _INTEGER.match(word) else -1
    return number if number in known else None


def format_sample(sample: Sample) -> str:
    channels = (*sample.position_um, *sample.force_mN, *sample.capacitance_fF)
    return f"S {sample.time_us},{sample.flags},{sample.moving}," + ",".join(map(str, channels))


def _parse_sample(body: str, number: int) -> Sample | None:
    match = _SAMPLE.match(body)
    if match is None:
        return None
    time, flags, moving = (int(word) for word in match.groups()[:3])
    values = tuple(map(int, match[4][1:].split(",")))
    position, force, capacitance = values[:PINS], values[PINS : 2 * PINS], values[2 * PINS :]
    return Sample(number, time, flags, moving, position, force, capacitance)
