"""The line protocol: lines on the wire, and the messages that they carry.

A line is ``<number> <body>*<crc>`` and a newline: the sequence number in decimal, a body of printable ASCII,
the CRC-32 (IEEE 802.3, eight hexadecimal digits) of all before the asterisk. The CRC starts from the
session's *salt*, so a line of another session fails it, and numbers only rise, so a line that comes again or
out of order is refused. Nothing here protects against an attacker on the wire: it is no authentication.

Each message is a type. A body that is not exactly one of these is no message: `parse_command` and
`parse_report` return None, and the line is counted as unknown and not acted on.

`docs/device-protocol.md` is the reference for whoever writes the other end.
"""

from __future__ import annotations

import re
from binascii import crc32
from dataclasses import dataclass, field
from typing import ClassVar

from .events import PINS, Fence, Hold, Move, Sample, Stop

VERSION = 1
HOST_LINE = 128  # bytes, newline included: the longest that a device must take
DEVICE_LINE = 768  # the longest that limbfit takes
MAX_NUMBER = 2**31 - 1
_LINE = re.compile(rb"([0-9]{1,10}) ([\x20-\x29\x2b-\x7e]+)\*([0-9A-F]{8})\Z")
WORD = r"[A-Za-z0-9][A-Za-z0-9_.-]{0,39}"
_WORD = re.compile(rf"{WORD}\Z", re.ASCII)
_INTEGER = re.compile(r"-?[0-9]{1,9}\Z", re.ASCII)
_NONCE = re.compile(r"[0-9a-f]{16}\Z")
_SAMPLE = re.compile(
    rf"S ([0-9]{{1,15}}),([0-9]{{1,4}}),([0-9]{{1,5}})((?:,-?[0-9]{{1,8}}){{{3 * PINS}}})\Z", re.ASCII
)
MAX_VALUE = 1_000_000  # no length, speed or force of this device is larger (um, um/s, mN)


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
        found = []
        *ended, rest = data.split(b"\n")
        for part in ended:
            line = self._end_line(part)
            if line is not None:
                found.append(line)
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
        if not self.numbered:
            return Line(count, body.decode("ascii"))
        if count <= self.last or count > MAX_NUMBER:
            self.refused.replayed += 1
            return None
        self.refused.missing += count - self.last - 1
        self.last = count
        return Line(count, body.decode("ascii"))


class Message:
    """A verb and its words: the fields in their order."""

    __slots__ = ()
    verb: ClassVar[str]

    @property
    def body(self) -> str:
        words = (str(getattr(self, name)) for name in self.__match_args__)  # type: ignore[attr-defined]
        return " ".join((self.verb, *words))


# -- from limbfit to the device


@dataclass(frozen=True, slots=True)
class Hello:
    """Opens a session; the only line without salt."""

    nonce: str
    version: int = VERSION

    @property
    def body(self) -> str:
        return f"HELLO {self.version} {self.nonce}"


@dataclass(frozen=True, slots=True)
class SetLimits(Message):
    """The device's own limits for this session: it takes the lower of these and those built in."""

    verb: ClassVar[str] = "LIMITS"
    pin: int
    force_mN: int
    clamp_mN: int
    position_um: int
    speed_um_s: int
    watchdog_ms: int


@dataclass(frozen=True, slots=True)
class NoteCommand:
    """What the session is at, for the device's display and log: ``SITE`` or ``PHASE`` and a word."""

    kind: str
    word: str

    @property
    def body(self) -> str:
        return f"{self.kind} {self.word}"


@dataclass(frozen=True, slots=True)
class Heartbeat(Message):
    """limbfit lives, and has dealt with the sample of this number."""

    verb: ClassVar[str] = "BEAT"
    number: int


@dataclass(frozen=True, slots=True)
class Bye:
    """Ends the session."""

    body = "BYE"


Command = Hello | SetLimits | NoteCommand | Heartbeat | Bye | Move | Hold | Stop | Fence


def format_command(command: Command) -> str:
    """The body of a command; the reason of a stop becomes a word, since reasons hold what devices said."""
    match command:
        case Move(pin, target, speed, halt):
            return f"MOVE {pin} {target} {speed} {halt}"
        case Hold(pin):
            return f"HOLD {pin}"
        case Fence(pin, position):
            return f"FENCE {pin} {position}"
        case Stop():
            return "STOP"
    return command.body


def parse_command(body: str) -> Command | None:
    """The command that a body states, or None."""
    verb, *words = body.split(" ")
    if verb in ("SITE", "PHASE") and len(words) == 1:
        return NoteCommand(verb, words[0]) if _WORD.match(words[0]) else None
    if verb == "HELLO" and len(words) == 2:
        version = _read_integers(words[:1])
        return Hello(words[1], version[0]) if version and _NONCE.match(words[1]) else None
    numbers = _read_integers(words)
    if numbers is None or any(abs(n) > MAX_VALUE for n in numbers if verb != "BEAT"):
        return None
    match verb, numbers:
        case "BEAT", [number]:
            return Heartbeat(number)
        case "MOVE", [pin, target, speed, halt] if _is_pin(pin) and target >= 0 < speed and halt >= 0:
            return Move(pin, target, speed, halt)
        case "HOLD", [pin] if _is_pin(pin):
            return Hold(pin)
        case "FENCE", [pin, position] if _is_pin(pin) and position > 0:
            return Fence(pin, position)
        case "STOP", []:
            return Stop("")
        case "BYE", []:
            return Bye()
        case "LIMITS", [pin, force, clamp, position, speed, watchdog] if _is_pin(pin) and min(numbers) > 0:
            return SetLimits(pin, force, clamp, position, speed, watchdog)
    return None


def _is_pin(pin: int) -> bool:
    return 1 <= pin <= PINS


def _read_integers(words: list[str]) -> list[int] | None:
    return [int(word) for word in words] if all(_INTEGER.match(word) for word in words) else None


# -- from the device to limbfit


@dataclass(frozen=True, slots=True)
class Identity:
    """What a device says of itself when greeted.

    ``clock`` is ``real``, or ``paced``: the device's time waits for limbfit, which then lives by it.
    ``touch_fF`` is the capacitance of a head that touches skin; ``calibrated`` the day of its calibration.
    """

    nonce: str
    pins: int
    rate_hz: int
    stroke_um: int
    range_mN: int
    touch_fF: int
    clock: str
    model: str
    serial: str
    calibrated: str
    version: int = VERSION

    @property
    def body(self) -> str:
        return (
            f"ID {self.version} {self.nonce} {self.pins} {self.rate_hz} {self.stroke_um} {self.range_mN} "
            f"{self.touch_fF} {self.clock} {self.model} {self.serial} {self.calibrated}"
        )


@dataclass(frozen=True, slots=True)
class Accepted(Message):
    """The command of this number is being done."""

    verb: ClassVar[str] = "OK"
    number: int


@dataclass(frozen=True, slots=True)
class Declined(Message):
    """The command of this number is not done, and why, in a word."""

    verb: ClassVar[str] = "NO"
    number: int
    code: str


@dataclass(frozen=True, slots=True)
class LimitTripped(Message):
    """The device stopped by itself: why, in a word, and at which pin (0: none)."""

    verb: ClassVar[str] = "FAULT"
    code: str
    pin: int


@dataclass(frozen=True, slots=True)
class OutOfReach(Message):
    """After a stop these pins (a bit each) do not come home."""

    verb: ClassVar[str] = "STUCK"
    pins: int


Report = Identity | Accepted | Declined | LimitTripped | OutOfReach | Sample


def format_sample(sample: Sample) -> str:
    channels = (*sample.position_um, *sample.force_mN, *sample.capacitance_fF)
    return f"S {sample.time_us},{sample.flags},{sample.moving}," + ",".join(map(str, channels))


def parse_report(body: str, number: int) -> Report | None:
    """The report that a body states, or None; ``number`` is its line's."""
    if body.startswith("S "):
        match = _SAMPLE.match(body)
        if match is None:
            return None
        time, flags, moving = (int(word) for word in match.groups()[:3])
        values = tuple(map(int, match[4][1:].split(",")))
        position, force, capacitance = values[:PINS], values[PINS : 2 * PINS], values[2 * PINS :]
        return Sample(number, time, flags, moving, position, force, capacitance)
    verb, *words = body.split(" ")
    if verb == "ID" and len(words) == 11:
        return _read_identity(words)
    if verb == "NO" and len(words) == 2 and _INTEGER.match(words[0]) and _WORD.match(words[1]):
        return Declined(int(words[0]), words[1])
    if verb == "FAULT" and len(words) == 2 and _WORD.match(words[0]) and _INTEGER.match(words[1]):
        pin = int(words[1])
        return LimitTripped(words[0], pin) if pin == 0 or _is_pin(pin) else None
    numbers = _read_integers(words)
    match verb, numbers:
        case "OK", [done]:
            return Accepted(done)
        case "STUCK", [pins] if 0 <= pins < 1 << PINS:
            return OutOfReach(pins)
    return None


def _read_identity(words: list[str]) -> Identity | None:
    numbers = _read_integers([words[0], *words[2:7]])
    names = words[8:]
    if numbers is None or not _NONCE.match(words[1]) or not all(map(_WORD.match, names)):
        return None
    if min(numbers) <= 0 or words[7] not in ("real", "paced"):
        return None
    version, pins, rate, stroke, range_mN, touch = numbers
    model, serial, calibrated = names
    return Identity(
        words[1], pins, rate, stroke, range_mN, touch, words[7], model, serial, calibrated, version
    )
