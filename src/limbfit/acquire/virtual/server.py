"""The virtual FitSocket on a wire: a TCP port or a pseudo terminal, in real time or paced by its host."""

from __future__ import annotations

import errno
import os
import select
import socket
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from ...errors import InputError, RunError
from ..device import Link, TcpLink
from ..line_protocol import PERIOD_US
from .fitsocket import STEPS_PER_SAMPLE, VirtualFitSocket

MAX_LEAD_US = 4 * PERIOD_US  # how far a paced device runs ahead of what its host has dealt with
MAX_HOST_SILENCE_S = 10.0  # wall time after which a paced device takes its host for gone
GREETING_S = 5.0  # a connection that does not become a session is closed
MAX_CATCH_UP_S = 0.25  # a device that could not run for so long does not make up for it
IDLE_S = 0.02


class PtyLink(Link):
    """The master of a pseudo terminal; its slave looks like a serial port."""

    gone = "the terminal is gone"

    def __init__(self) -> None:
        try:
            import tty
        except ImportError:
            raise InputError("this system has no pseudo terminals", place="--terminal") from None
        master, self._slave = os.openpty()
        tty.setraw(self._slave)
        os.set_blocking(master, False)
        super().__init__(os.fdopen(master, "r+b", buffering=0))
        self.name = os.ttyname(self._slave)

    def write(self, data: bytes) -> None:
        """What does not fit is lost, as on a serial line that nobody reads."""
        self._port.write(data)

    def close(self) -> None:
        super().close()
        os.close(self._slave)


@dataclass
class Endpoint:
    """Where a device can be reached; ``stop`` ends `serve` (from a signal handler or another thread)."""

    listener: socket.socket | None = None
    pty: PtyLink | None = None
    stopping: bool = False

    @classmethod
    def listen_on_port(cls, host: str, port: int) -> Endpoint:
        """Listen on a TCP port; 0 takes a free one. Raises `InputError` where the address is none of this
        machine's, or the port is taken.
        """
        family = socket.AF_INET6 if ":" in host else socket.AF_INET
        listener = socket.socket(family, socket.SOCK_STREAM)
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            listener.bind((host, port))
            listener.listen(1)
        except (OSError, OverflowError) as error:
            listener.close()
            if isinstance(error, socket.gaierror) or getattr(error, "errno", 0) == errno.EADDRNOTAVAIL:
                raise InputError(f"{host} is no address of this machine", place="--host") from None
            reason = getattr(error, "strerror", None) or "no such port"
            remedy = "give another, or 0 for a free one"
            what = f"port {port} cannot be taken: {reason}"
            raise InputError(what, place="--port", remedy=remedy) from None
        listener.setblocking(False)
        return cls(listener=listener)

    @classmethod
    def open_terminal(cls) -> Endpoint:
        return cls(pty=PtyLink())

    @property
    def address(self) -> str:
        """As `limbfit acquire --device` takes it."""
        if self.pty is not None:
            return f"serial:{self.pty.name}"
        assert self.listener is not None
        host, port = self.listener.getsockname()[:2]
        return f"tcp://[{host}]:{port}" if ":" in host else f"tcp://{host}:{port}"

    def stop(self) -> None:
        self.stopping = True

    def close(self) -> None:
        if self.pty is not None:
            self.pty.close()
        if self.listener is not None:
            self.listener.close()


def serve(
    device: VirtualFitSocket,
    serving: Endpoint,
    *,
    speed: float = 1.0,
    tell: Callable[[str], None] = lambda _: None,
) -> None:
    """Run a device until `Endpoint.stop`; ``tell`` is called with a line for each session and each stop.

    ``speed``: how much faster than the wall's the device's clock may go; only a paced device waits for its
    host.
    """
    _Server(device, serving, speed, tell).run()
    serving.close()


class _Server:
    def __init__(
        self, device: VirtualFitSocket, serving: Endpoint, speed: float, tell: Callable[[str], None]
    ) -> None:
        self.device, self.serving, self.tell = device, serving, tell
        self.period_s = PERIOD_US / 1e6 / speed
        self.paced = device.clock == "paced"
        self.link: Link | None = serving.pty
        self.stopped = ""
        self.next_step_s = self.last_heard_s = time.monotonic()

    def run(self) -> None:
        while not self.serving.stopping:
            self._wait()
            self._read_host()
            self._step_device()
            self._check_session()
        if self.link is not None and self.serving.pty is None:
            self.link.close()

    def _is_running(self) -> bool:
        """True if there is anything to step: a session, or pins that are not home."""
        return self.device.is_armed or not self.device.is_home

    def _is_waiting(self) -> bool:
        """True if a paced device has to wait for its host."""
        device = self.device
        return (
            self.paced
            and self.link is not None
            and device.is_armed
            and time.monotonic() - self.last_heard_s < MAX_HOST_SILENCE_S
            and device.time_us - device.acknowledged_us >= MAX_LEAD_US
        )

    def _wait(self) -> None:
        now = time.monotonic()
        due = self.next_step_s - now if self._is_running() and not self._is_waiting() else IDLE_S
        watched: list[Any] = [self.link] if self.link is not None else []
        if self.serving.listener is not None:
            watched.append(self.serving.listener)
        if due > 0:
            select.select(watched, [], [], due)

    def _read_host(self) -> None:
        self._accept()
        if self.link is None:
            return
        try:
            data = self.link.read()
            if data:
                self.last_heard_s = time.monotonic()
                self.link.write(self.device.feed(data))
        except RunError as error:
            self._drop(str(error))

    def _accept(self) -> None:
        if self.serving.listener is None:
            return
        try:
            connection, _ = self.serving.listener.accept()
        except OSError:
            return
        if self.link is not None:
            connection.close()
            return
        self.link = TcpLink(connection)
        self.last_heard_s = time.monotonic()
        self.device.connect()
        self.tell("a host is connected")

    def _step_device(self) -> None:
        now = time.monotonic()
        if not self._is_running():
            self.next_step_s = now
            return
        if now - self.next_step_s > MAX_CATCH_UP_S:
            self.next_step_s = now
        while self.next_step_s <= now and self._is_running() and not self._is_waiting():
            out = b"".join([self.device.step() for _ in range(STEPS_PER_SAMPLE)])
            self.next_step_s += self.period_s
            if out and self.link is not None:
                try:
                    self.link.write(out)
                except RunError as error:
                    self._drop(str(error))

    def _check_session(self) -> None:
        """Deal with hosts that hang and sessions that are over, and report stops."""
        device, silent = self.device, time.monotonic() - self.last_heard_s
        if self.paced and device.is_armed and silent > MAX_HOST_SILENCE_S:
            device.stop_without_host()
        if device.stopped != self.stopped:
            self.stopped = device.stopped
            self.tell(f"stop: {self.stopped}" if self.stopped else "ready")
        if self.link is None:
            return
        over = device.stopped and device.is_home and silent > 1.0
        if self.serving.pty is not None:
            ended = device.host_has_left and device.is_home
            if ended or (over and device.has_session):
                device.disconnect()
                device.connect()
        elif (not device.is_armed and silent > GREETING_S) or over:
            self._drop("no session")

    def _drop(self, reason: str) -> None:
        if self.link is not None and self.serving.pty is None:
            self.link.close()
            self.link = None
        self.device.disconnect()
        self.tell(f"the host is gone: {reason}")
