"""Lines on the wire: numbers, checksums, and what is refused.

A line is ``<number> <body>*<crc>`` and a newline: the sequence number in decimal, a body of printable ASCII,
the CRC-32 (IEEE 802.3, eight hexadecimal digits) of all before the asterisk.  The CRC starts from the
session's *salt*, so a line of another session fails it, and numbers only rise, so a line that comes again or
out of order is refused.  Nothing here protects against an attacker on the wire: it is no authentication.

`docs/device-protocol.md` is the reference for whoever writes the other end.
"""

from __future__ import annotations

import re
from binascii import crc32
from dataclasses import dataclass, field

VERSION = 1
HOST_LINE = 128  # bytes, newline included: the longest that a device must take
DEVICE_LINE = 768  # the longest that limbfit takes
MAX_NUMBER = 2**31 - 1
_LINE = re.compile(rb"([0-9]{1,10}) ([\x20-\x29\x2b-\x7e]+)\*([0-9A-F]{8})\Z")


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
            line = self._end(part)
            if line is not None:
                found.append(line)
        self._keep(rest)
        return found

    def restart(self, salt: int) -> None:
        """A new session begins with the next line."""
        self.salt, self.last, self.numbered = salt, 0, True

    def _keep(self, part: bytes) -> None:
        if self._skipping:
            return
        if len(self._rest) + len(part) >= self.limit:
            self._rest.clear()
            self._skipping = True
            return
        self._rest += part

    def _end(self, part: bytes) -> Line | None:
        self._keep(part)
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
