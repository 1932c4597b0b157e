"""Wires: TCP, and a serial port (with ``pip install 'limbfit[serial]'``)."""

from __future__ import annotations

import errno
import os
import re
import socket
from contextlib import suppress
from typing import Any, Protocol

from ..errors import InputError, RunError

DEFAULT_PORT = 7714
DEFAULT_ADDRESS = f"tcp://127.0.0.1:{DEFAULT_PORT}"
BAUD = 2_000_000
_TCP = re.compile(r"tcp://(\[[0-9A-Fa-f:.]+\]|[A-Za-z0-9.-]+)(?::([0-9]{1,5}))?\Z")
_SERIAL = re.compile(r"serial:(/[\x21-\x3f\x41-\x7e]+)(?:@([0-9]{3,7}))?\Z")
_CHUNK = 1 << 16
_REFUSALS: tuple[type[Exception], ...] = (OSError, ValueError)  # what opening a port may raise
with suppress(ImportError):  # Windows
    import termios

    _REFUSALS = (*_REFUSALS, termios.error)


class Link(Protocol):
    """A wire: never waits; a wire that is gone raises `RunError`."""

    def fileno(self) -> int:
        """For ``select``."""

    def read(self) -> bytes:
        """What has come, or nothing."""

    def write(self, data: bytes) -> None:
        """All of it, or the wire counts as gone."""

    def close(self) -> None: ...


class TcpLink:
    """A connected socket."""

    def __init__(self, connection: socket.socket) -> None:
        connection.setblocking(False)
        if connection.family in (socket.AF_INET, socket.AF_INET6):
            connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._socket = connection

    def fileno(self) -> int:
        return self._socket.fileno()

    def read(self) -> bytes:
        try:
            data = self._socket.recv(_CHUNK)
        except BlockingIOError:
            return b""
        except OSError:
            raise RunError("the connection is broken") from None
        if not data:
            raise RunError("the other end has closed the connection")
        return data

    def write(self, data: bytes) -> None:
        try:
            sent = self._socket.send(data)
        except OSError:
            sent = -1
        if sent != len(data):
            raise RunError("the connection is broken, or the other end does not read")

    def close(self) -> None:
        with suppress(OSError):
            self._socket.close()


class SerialLink:
    """A serial port, 8N1, without flow control."""

    def __init__(self, port: str, baud: int) -> None:
        try:
            import serial
        except ImportError:
            remedy = "pip install 'limbfit[serial]'"
            raise InputError("serial ports need pyserial", place="--device", remedy=remedy) from None
        try:
            self._port: Any = serial.Serial(port, baud, timeout=0, write_timeout=0, exclusive=True)
        except _REFUSALS as error:
            raise RunError(f"{port} cannot be opened: {_describe_why(error, baud)}") from None
        self._port.reset_input_buffer()

    def fileno(self) -> int:
        return int(self._port.fileno())

    def read(self) -> bytes:
        try:
            return bytes(self._port.read(_CHUNK))
        except OSError:
            raise RunError("the serial port is gone") from None

    def write(self, data: bytes) -> None:
        try:
            sent = self._port.write(data)
        except OSError:
            sent = -1
        if sent != len(data):
            raise RunError("the serial port is gone, or the other end does not read")

    def close(self) -> None:
        with suppress(OSError):
            self._port.close()


def _describe_why(error: Exception, baud: int) -> str:
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
    """Open the wire of an address: ``tcp://HOST[:PORT]`` or ``serial:PATH[@BAUD]``.

    Raises
    ------
    InputError
        For an address of neither form.
    RunError
        Where nobody listens, or the port cannot be opened.
    """
    if match := _TCP.match(address):
        host, port = match[1].strip("[]"), int(match[2] or DEFAULT_PORT)
        if not 0 < port < 1 << 16:
            raise InputError(f"there is no port {port}", place="--device", remedy="ports are 1 to 65535")
        try:
            return TcpLink(socket.create_connection((host, port), timeout=timeout_s))
        except (OSError, OverflowError) as error:
            reason = getattr(error, "strerror", None) or "no answer"
            raise RunError(
                f"no device at {host}, port {port}: {reason}; start it, or see limbfit virtual-fitsocket"
            ) from None
    if match := _SERIAL.match(address):
        return SerialLink(match[1], int(match[2] or BAUD))
    raise InputError(
        "not an address of a device",
        place="--device",
        remedy=f"give tcp://HOST:PORT ({DEFAULT_ADDRESS}) or serial:PATH@BAUD (serial:/dev/ttyUSB0@{BAUD})",
    )
