"""The device as a session sees it, and the one driver there is: the line protocol over a wire."""

from __future__ import annotations

import select
import time
from typing import Protocol

from ..errors import RunError
from .events import Sample
from .hostend import HostEnd
from .links import Link
from .messages import Command, Declined, Identity, OutOfReach, Tripped
from .wire import Refusals

GREETING_S = 3.0
AGAIN_S = 0.5  # between greetings: a device on a serial port may still be coming home


class Device(Protocol):
    """What a session needs of a device; times are s of the caller's clock."""

    @property
    def identity(self) -> Identity: ...

    @property
    def refused(self) -> Refusals: ...

    def send(self, command: Command, now: float) -> None:
        """Give a command; raises `RunError` where the device is gone."""

    def receive(self, timeout_s: float) -> list[Sample | Declined | Tripped | OutOfReach]:
        """Wait for the device for at most so long; raises `RunError` where it is gone."""

    def again(self, now: float) -> str:
        """Repeat commands that went unanswered; a reason to stop, or nothing."""

    def close(self) -> None: ...


class LineDevice:
    """A device that speaks the line protocol (docs/device-protocol.md)."""

    def __init__(self, link: Link) -> None:
        self._link, self._end = link, HostEnd()
        self.identity = self._greet()

    @property
    def refused(self) -> Refusals:
        return self._end.refused

    def _greet(self) -> Identity:
        end = time.monotonic() + GREETING_S
        try:
            while time.monotonic() < end:
                self._link.write(self._end.hello())
                select.select([self._link], [], [], AGAIN_S)
                if identity := self._end.greet(self._link.read()):
                    return identity
        except RunError as error:
            self._link.close()
            raise RunError(
                f"no greeting from the device: {error}; it takes one host at a time: does another have it?"
            ) from None
        self._link.close()
        raise RunError(
            f"no greeting from the device within {GREETING_S:g} s; does it speak docs/device-protocol.md?"
        )

    def send(self, command: Command, now: float) -> None:
        self._link.write(self._end.send(command, now))

    def receive(self, timeout_s: float) -> list[Sample | Declined | Tripped | OutOfReach]:
        select.select([self._link], [], [], timeout_s)
        return self._end.feed(self._link.read())

    def again(self, now: float) -> str:
        lines, reason = self._end.again(now)
        if lines:
            self._link.write(lines)
        return reason

    def close(self) -> None:
        self._link.close()
