"""Faults on demand: what goes wrong, when, for how long."""

import tomllib
from pathlib import Path
from typing import Annotated, Literal, get_args

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from ...errors import InputError
from ..events import PINS

Kind = Literal[
    "lost",  # lines of the device do not arrive
    "deaf",  # lines of limbfit do not arrive
    "late",  # lines of the device arrive `value` ms late
    "corrupt",  # a byte of each line of the device is another
    "stuck",  # a pin does not move
    "saturated",  # a force sensor shows its end of scale
    "dead",  # a force sensor shows the same for ever
    "limb",  # the limb moves by `value` mm towards a pin
    "power",  # the actuators have no power
    "button",  # the device's emergency stop is pressed
]
FAULT_KINDS: tuple[str, ...] = get_args(Kind)


class Fault(BaseModel):
    """One fault; its time counts from the session's start, or from its first entry into a phase."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    kind: Kind
    at_s: Annotated[float, Field(ge=0, le=1e5)] = 0.0
    phase: str = ""
    duration_s: Annotated[float, Field(gt=0, le=1e5)] = 1e5
    pin: Annotated[int, Field(ge=1, le=PINS)] = 1
    value: Annotated[float, Field(ge=-100, le=10_000)] = 0.0


class _FaultFile(BaseModel):
    model_config = ConfigDict(extra="forbid")

    faults: tuple[Fault, ...]


def read_faults(file: Path) -> tuple[Fault, ...]:
    """Read a TOML file of ``[[faults]]``.

    Raises
    ------
    InputError
        With the file and the key.
    """
    if not file.is_file():
        raise InputError("no such file", file=file, remedy="give a TOML file with [[faults]]")
    try:
        return _FaultFile(**tomllib.loads(file.read_text(encoding="utf-8"))).faults
    except (tomllib.TOMLDecodeError, UnicodeDecodeError, RecursionError) as error:
        raise InputError(f"not valid TOML: {error}", file=file) from None
    except ValidationError as error:
        first = error.errors()[0]
        place = ".".join(str(part) for part in first["loc"]) or None
        remedy = "see docs/acquire.md for the kinds of faults"
        raise InputError(first["msg"], file=file, place=place, remedy=remedy) from None


class FaultClock:
    """Which faults are on, as time goes and phases are entered."""

    def __init__(self, faults: tuple[Fault, ...]) -> None:
        self.faults = faults
        self._entered: dict[str, int] = {}
        self.now_us = 0

    def enter(self, phase: str) -> None:
        self._entered.setdefault(phase, self.now_us)

    def find_active(self, kind: str) -> list[Fault]:
        """The faults of a kind that are on."""
        return [fault for fault in self.faults if fault.kind == kind and self._is_on(fault)]

    def compute_progress(self, fault: Fault) -> float:
        """How much of a fault's time has passed, 0 to 1."""
        start = self._start(fault)
        return 0.0 if start is None else min(max((self.now_us - start) / 1e6 / fault.duration_s, 0.0), 1.0)

    def _start(self, fault: Fault) -> float | None:
        if fault.phase and fault.phase not in self._entered:
            return None
        return self._entered.get(fault.phase, 0) + fault.at_s * 1e6

    def _is_on(self, fault: Fault) -> bool:
        start = self._start(fault)
        return start is not None and start <= self.now_us < start + fault.duration_s * 1e6
