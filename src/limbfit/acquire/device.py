"""The device as a session sees it: the line protocol over a wire.

A wire is a TCP connection, or a serial port (with ``pip install 'limbfit[serial]'``).
"""

import errno
import os
import re
import secrets
import select
import socket
import time
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Protocol, TypeVar

from pydantic import ValidationError

from ..errors import InputError, RunError
from ..extensions import import_extra
from ..study.loading import read_toml
from ..study.tables import TomlTable
from . import line_protocol as wire

Model = TypeVar("Model", bound=TomlTable)
DEFAULT_PORT = 7714
DEFAULT_ADDRESS = f"tcp://127.0.0.1:{DEFAULT_PORT}"
BAUD = 2_000_000
_TCP = re.compile(r"tcp://(\[[0-9A-Fa-f:.]+\]|[A-Za-z0-9.-]+)(?::([0-9]{1,5}))?\Z")
_SERIAL = re.compile(r"serial:(/[\x21-\x3f\x41-\x7e]+)(?:@([0-9]{3,7}))?\Z")
_READ_BYTES = 1 << 16
_PORT_ERRORS: tuple[type[Exception], ...] = (OSError, ValueError)  # what opening a port may raise
with suppress(ImportError):  # Windows
    import termios

    _PORT_ERRORS = (*_PORT_ERRORS, termios.error)
GREETING_S = 3.0
GREETING_INTERVAL_S = 0.5  # between greetings: a device on a serial port may still be coming home
ANSWER_S = 0.006  # a command is answered at once: after so long it is sent again
PACED_ANSWER_S = 0.5  # where the device's clock, which runs ahead of its ears, is the one that counts
MAX_ATTEMPTS = 6


class Link:
    """A wire: never waits; a wire that is gone raises `RunError`."""

    gone: ClassVar[str]  # what is said then

    def __init__(self, port: Any) -> None:
        self._port = port

    def fileno(self) -> int:
        """For ``select``."""
        return int(self._port.fileno())

    def wait(self, timeout_s: float) -> None:
        """Wait for something to read, at most so long."""
        select.select([self], [], [], timeout_s)

    def read(self) -> bytes:
        """What has come, or nothing."""
        try:
            return self._receive()
        except BlockingIOError:
            return b""
        except OSError:
            raise RunError(self.gone) from None

    def write(self, data: bytes) -> None:
        """All of it, or the wire counts as gone."""
        try:
            sent = self._send(data)
        except OSError:
            sent = -1
        if sent != len(data):
            raise RunError(f"{self.gone}, or the other end does not read")

    def close(self) -> None:
        with suppress(OSError):
            self._port.close()

    def _receive(self) -> bytes:
        return self._port.read(_READ_BYTES) or b""

    def _send(self, data: bytes) -> int | None:
        return self._port.write(data)


class TcpLink(Link):
    """A connected socket."""

    gone = "the connection is broken"

    def __init__(self, connection: socket.socket) -> None:
        connection.setblocking(False)
        if connection.family in (socket.AF_INET, socket.AF_INET6):
            connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        super().__init__(connection)

    def _receive(self) -> bytes:
        data = self._port.recv(_READ_BYTES)
        if not data:
            raise RunError("the other end has closed the connection")
        return data

    def _send(self, data: bytes) -> int:
        return self._port.send(data)


class SerialLink(Link):
    """A serial port, 8N1, without flow control."""

    gone = "the serial port is gone"

    def __init__(self, port: str, baud: int) -> None:
        remedy = "pip install 'limbfit[serial]'"
        refusal = InputError("serial ports need pyserial", place="--device", remedy=remedy)
        serial = import_extra("serial", "serial", refusal)
        try:
            super().__init__(serial.Serial(port, baud, timeout=0, write_timeout=0, exclusive=True))
        except _PORT_ERRORS as error:
            raise RunError(f"{port} cannot be opened: {_explain_port_error(error, baud)}") from None
        self._port.reset_input_buffer()


def _explain_port_error(error: Exception, baud: int) -> str:
    """Why a port does not open: pyserial wraps the system's reason in words of its own."""
    if isinstance(error, ValueError):
        return f"it does not support {baud} baud; give another after @"
    number = getattr(error, "errno", None)
    if number in (errno.EAGAIN, errno.EBUSY):
        return "another program uses it; end that first"
    if number == errno.EACCES:
        return "no permission; on most systems the group dialout has it"
    return f"{os.strerror(number)}; see which ports there are" if number else "it is no serial port"


def connect(address: str, timeout_s: float = 5.0) -> Link:
    """Open the wire of an address: ``tcp://HOST[:PORT]`` or ``serial:PATH[@BAUD]``. Raises `InputError` for
    an address of neither form, and `RunError` where nobody listens, or the port cannot be opened.
    """
    is_tcp, place, number = parse_address(address)
    if not is_tcp:
        return SerialLink(place, number)
    try:
        return TcpLink(socket.create_connection((place, number), timeout=timeout_s))
    except (OSError, OverflowError) as error:
        reason = getattr(error, "strerror", None) or "no answer"
        what = f"no device at {place}, port {number}: {reason}; start it, or see limbfit virtual-fitsocket"
        raise RunError(what) from None


def parse_address(address: str) -> tuple[bool, str, int]:
    """True with host and port, or False with the path and baud rate of a serial port. Errors as `connect`."""
    if match := _TCP.match(address):
        port = int(match[2] or DEFAULT_PORT)
        if not 0 < port < 1 << 16:
            raise InputError(f"there is no port {port}", place="--device", remedy="ports are 1 to 65535")
        return True, match[1].strip("[]"), port
    if match := _SERIAL.match(address):
        return False, match[1], int(match[2] or BAUD)
    remedy = f"give tcp://HOST:PORT ({DEFAULT_ADDRESS}) or serial:PATH@BAUD (serial:/dev/ttyUSB0@{BAUD})"
    raise InputError("not an address of a device", place="--device", remedy=remedy)


class Device(Protocol):
    """What a session needs of a device; times are s of the caller's clock.

    ``resolution_mN`` is the step of a force sensor too coarse to show its noise; 0: it shows it. Its methods
    raise `RunError` where the device is gone.
    """

    identity: wire.Identity
    resolution_mN: int

    @property
    def refusals(self) -> wire.Refusals:
        """Lines that were refused."""

    def send(self, command: wire.Command, now: float) -> None:
        """Give a command."""

    def receive(self, timeout_s: float = 0.0) -> list[wire.Notice]:
        """Return what the device says, in order."""

    def resend(self, now: float) -> str:
        """Repeat what went unanswered; returns what to stop for, or nothing."""

    def close(self) -> None:
        """End."""


@dataclass
class _PendingCommand:
    command: wire.Command
    due: float
    attempts: int = 1


class LineDevice:
    """A device that speaks the line protocol (docs/device-protocol.md); times are s of the caller's clock.

    A command that the device does not answer is sent again under a new number; one that is replaced by a
    newer one for the same pin is not. Raises `RunError` where nobody answers, or it is another version, has
    other pins or another rate than limbfit knows; from each of its methods, where the device is gone.
    """

    resolution_mN = 0

    def __init__(self, link: Link) -> None:
        self._link, self._nonce = link, secrets.token_hex(8)
        self._encoder = wire.Encoder(first=0)
        self._decoder = wire.Decoder(wire.DEVICE_LINE, numbered=False)
        self._pending: dict[int, _PendingCommand] = {}
        self.identity = self._greet()
        self._answer_time_s = PACED_ANSWER_S if self.identity.is_paced else ANSWER_S

    @property
    def refusals(self) -> wire.Refusals:
        return self._decoder.refused

    def _greet(self) -> wire.Identity:
        end = time.monotonic() + GREETING_S
        try:
            while time.monotonic() < end:
                self._link.write(self._encoder.encode(wire.Hello(wire.VERSION, self._nonce).body)[1])
                self._link.wait(GREETING_INTERVAL_S)
                if identity := self._find_identity(self._link.read()):
                    return identity
        except RunError as error:
            self._link.close()
            what = f"no greeting from the device: {error}; it takes one host at a time: does another have it?"
            raise RunError(what) from None
        self._link.close()
        what = f"no greeting from the device within {GREETING_S:g} s; does it speak docs/device-protocol.md?"
        raise RunError(what)

    def _find_identity(self, data: bytes) -> wire.Identity | None:
        """Who the device is, once it has said so; from then on lines are numbered and salted."""
        for line in self._decoder.feed(data):
            report = wire.parse_report(line.body, line.number)
            if isinstance(report, wire.Identity):
                _check_identity(report)
                salt = wire.derive_salt(self._nonce, report.nonce)
                self._encoder = wire.Encoder(salt)
                self._decoder.restart(salt)
                return report
            self.refusals.unknown += 1
        return None

    def send(self, command: wire.Command, now: float) -> None:
        """Give a command; one that needs an answer is remembered until it comes."""
        match command:  # what a newer command makes void: the older ones for its pin; a stop, all
            case wire.Stop():
                self._pending.clear()
            case wire.Move(pin=pin) | wire.Hold(pin=pin):
                for older, waiting in list(self._pending.items()):
                    if isinstance(waiting.command, (wire.Move, wire.Hold)) and waiting.command.pin == pin:
                        del self._pending[older]
        self._write(command, now, attempts=1)

    def _write(self, command: wire.Command, now: float, attempts: int) -> None:
        number, line = self._encoder.encode(command.body)
        if not isinstance(command, (wire.Heartbeat, wire.Bye)):
            self._pending[number] = _PendingCommand(command, now + self._answer_time_s, attempts)
        self._link.write(line)

    def receive(self, timeout_s: float = 0.0) -> list[wire.Notice]:
        """Wait for the device for at most so long; what it says that concerns the session, in order."""
        self._link.wait(timeout_s)
        found: list[wire.Notice] = []
        for line in self._decoder.feed(self._link.read()):
            report: wire.Report | None = wire.parse_report(line.body, line.number)
            match report:
                case None | wire.Identity():
                    self.refusals.unknown += 1
                case wire.Acceptance(number=number):
                    self._pending.pop(number, None)
                case wire.Rejection(number=number):
                    if self._pending.pop(number, None) is not None:
                        found.append(report)
                case _:
                    found.append(report)
        return found

    def resend(self, now: float) -> str:
        """Repeat commands that went unanswered; where one did too often, what to stop for, or nothing."""
        reason = ""
        for number, waiting in list(self._pending.items()):
            if now < waiting.due:
                continue
            del self._pending[number]
            if waiting.attempts >= MAX_ATTEMPTS and not isinstance(waiting.command, wire.Stop):
                reason = "the device does not answer commands"
            else:
                self._write(waiting.command, now, waiting.attempts + 1)
        return reason

    def close(self) -> None:
        self._link.close()


def _check_identity(identity: wire.Identity) -> None:
    if identity.version != wire.VERSION:
        raise RunError(
            f"the device speaks version {identity.version} of the protocol, limbfit {wire.VERSION}; "
            "see docs/device-protocol.md"
        )
    if (identity.pins, identity.rate_hz) != (wire.PINS, wire.RATE_HZ):
        found = f"{identity.pins} pins at {identity.rate_hz} Hz"
        raise RunError(f"the device has {found}; limbfit knows {wire.PINS} at {wire.RATE_HZ} Hz")


def read_model(model: type[Model], file: Path, missing: str, wrong: str) -> Model:
    """Read the TOML file of a device or of its faults.

    Raises `InputError` with the file, the key and the remedy for a ``missing`` file or a ``wrong`` key.
    """
    if not file.is_file():
        raise InputError("no such file", file=file, remedy=missing)
    try:
        return model.model_validate(read_toml(file))
    except ValidationError as error:
        first = error.errors()[0]
        place = ".".join(str(part) for part in first["loc"]) or None
        raise InputError(first["msg"], file=file, place=place, remedy=wrong) from None
