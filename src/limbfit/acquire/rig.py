"""A laboratory's own rig as a device of one pin: a linear stage and a force sensor that answer lines of text.

What is sent and how answers are read is stated in a TOML file (docs/device-protocol.md), so that a stage with
an ASCII or SCPI protocol needs no code. Each sample asks the sensor, then the stage. Towards the limb the
stage is sent on by `LOOKAHEAD_S` of travel at a time, and only after limbfit has dealt with a fresh force: a
host that dies leaves a stage that stops by itself. Away from the limb it is sent at once.
"""

import json
import math
import time
from contextlib import suppress
from hashlib import sha256
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, model_validator

from ..errors import InputError, RunError
from ..extensions import import_extra
from ..study.tables import Positive, TomlTable
from . import line_protocol as wire
from .device import Link, connect, parse_address, read_model
from .line_protocol import Flags, Sample

LOOKAHEAD_S = 0.1
ARRIVAL_TOLERANCE_UM = 20
HOME_UM = 100
STUCK_S = 0.5  # a driven stage that stands for so long is stuck
RETRACT_UM_S = 20_000
GRAVITY_N_KG = 9.80665
MAX_RATIO_ERROR = 0.05  # of a known weight
CHECK_AGE_S = 24 * 3600.0
# Of Zaber's ASCII protocol: positions in microsteps, speeds in microsteps a second times a factor.
ZABER = {
    "position": "get pos",
    "move": "move abs {position:.0f} {speed:.0f}",
    "stop": "stop",
    "speed_factor": 1.6384,
}
NOT_HOMED = ("WR", "WH")  # flags of a stage that does not know where it is


class _Table(TomlTable):
    address: str
    timeout_ms: Positive = 50.0


class StageTable(_Table):
    """The stage: its commands, in which ``{position}`` and ``{speed}`` are numbers in its own units.

    ``position`` is answered by a number; ``answers``: the other commands are answered by a line, too. A
    ``move`` replaces the one before it. ``mm_per_unit`` is negative where its numbers fall towards the limb,
    and ``home`` is its number when it is withdrawn. ``speed_factor`` is that of its speeds over units a
    second. With a vendor's ``library`` its commands are known, and say which ``device`` and ``axis``.
    """

    library: Literal["zaber-motion"] | None = None
    device: Annotated[int, Field(ge=1, le=99)] = 1
    axis: Annotated[int, Field(ge=1, le=9)] = 1
    position: str
    move: str
    stop: str
    answers: bool = True
    mm_per_unit: float = 1.0
    speed_factor: Positive = 1.0
    home: float = 0.0
    stroke_mm: Positive

    @model_validator(mode="before")
    @classmethod
    def add_commands(cls, stated: Any) -> Any:
        """Add those of a library."""
        return {**ZABER, **stated} if isinstance(stated, dict) and stated.get("library") else stated


class ForceTable(_Table):
    """The force sensor: ``read`` is answered by a number; positive when the limb pushes back."""

    read: str
    N_per_unit: float = 1.0
    range_N: Positive
    resolution_N: Positive
    noise_N: Annotated[float, Field(ge=0)] = 0.0


class RigTable(TomlTable):
    """The file of a rig."""

    name: Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]{0,39}$")]
    rate_hz: Annotated[int, Field(ge=20, le=500)] = 100
    stage: StageTable
    force: ForceTable


def read_rig(file: Path) -> RigTable:
    """Read the file of a rig. Raises `InputError` with the key and the remedy."""
    page = "docs/device-protocol.md"
    return read_model(RigTable, file, f"give the TOML file of a rig ({page})", f"see {page}")


class Instrument:
    """Lines of text to and from one instrument; `RunError` where it is gone or does not answer in time."""

    def __init__(self, name: str, table: _Table) -> None:
        self.name, self._timeout_s = name, table.timeout_ms / 1000
        self._link: Link = connect(table.address)
        self._rest = b""

    def write(self, text: str) -> None:
        self._link.write(text.encode("ascii") + b"\n")

    def ask(self, text: str) -> str:
        """The line that answers a line; what came late from before is dropped."""
        self._link.read()
        self._rest = b""
        self.write(text)
        end = time.monotonic() + self._timeout_s
        while b"\n" not in self._rest:
            left = end - time.monotonic()
            if left <= 0:
                raise RunError(f"{self.name} does not answer within {1000 * self._timeout_s:g} ms")
            self._link.wait(left)
            self._rest += self._link.read()
        return self._rest.split(b"\n")[0].decode("ascii", "replace").strip()

    def ask_number(self, text: str) -> float:
        answer = self.ask(text)
        try:
            value = float(answer)
        except ValueError:
            raise RunError(f"{self.name} answered {answer[:40]!r} instead of a number") from None
        if not math.isfinite(value):
            raise RunError(f"{self.name} answered {answer[:40]!r}, which is no measurement")
        return value

    def close(self) -> None:
        self._link.close()


class ZaberStage(Instrument):
    """A stage of Zaber's through the vendor's own library; errors as `Instrument`, and for a stage at fault.

    The library adds addresses, numbers and checksums of messages. It is asked nothing for which it would look
    a device up, so that nothing leaves the machine.
    """

    def __init__(self, table: StageTable) -> None:
        self._errors = import_extra("zaber_motion", "zaber").MotionLibException
        connection = import_extra("zaber_motion.ascii", "zaber").Connection
        self._to = {"device": table.device, "axis": table.axis, "timeout": math.ceil(table.timeout_ms)}
        is_tcp, place, number = parse_address(table.address)
        try:
            self._connection = (connection.open_tcp if is_tcp else connection.open_serial_port)(place, number)
        except self._errors as error:
            raise RunError(f"no stage at {table.address}: {error}") from None

    def write(self, text: str) -> None:
        self.ask(text)

    def ask(self, text: str) -> str:
        try:
            reply = self._connection.generic_command(text, **self._to)
        except self._errors as error:
            raise RunError(f"the stage does not answer as it should: {error}") from None
        if reply.warning_flag in NOT_HOMED:
            raise RunError(f"the stage does not know where it is ({reply.warning_flag}): home it first")
        if reply.warning_flag.startswith("F"):
            raise RunError(f"the stage reports the fault {reply.warning_flag}: see the vendor's program")
        return str(reply.data)

    def close(self) -> None:
        self._connection.close()


class Rig:
    """A stage and a sensor as a session's device (`Device`); its samples have times of this machine's clock.

    A sensor that fails stops it, and it withdraws by itself. A stage that fails ends the session: nothing can
    move it then. Raises `RunError` where one of the two cannot be reached.
    """

    def __init__(self, table: RigTable, checked: str = "never") -> None:
        self.table, self.refusals = table, wire.Refusals()
        stage, force = table.stage, table.force
        self.resolution_mN = round(1000 * force.resolution_N) if force.noise_N < force.resolution_N else 0
        self.identity = wire.Identity(
            version=wire.VERSION,
            nonce="0" * 16,
            pins=1,
            rate_hz=table.rate_hz,
            stroke_um=round(1000 * stage.stroke_mm),
            range_mN=round(1000 * force.range_N),
            touch_fF=0,
            clock="real",
            model="rig",
            serial=table.name,
            calibrated=checked,
        )
        self._stage = ZaberStage(stage) if stage.library else Instrument("the stage", stage)
        try:
            self._sensor = Instrument("the force sensor", force)
        except (InputError, RunError):
            self._stage.close()
            raise
        self._notices: list[wire.Notice] = []
        self._move: wire.Move | None = None
        self._stopped = self._given_up = False
        self._sent_um: int | None = None
        self._position_um = self._force_mN = self._number = 0
        self._fence_um = self.identity.stroke_um
        self._start_s = self._due_s = self._moved_s = time.monotonic()

    def measure_force(self) -> float:
        """The force in N."""
        return self._sensor.ask_number(self.table.force.read) * self.table.force.N_per_unit

    def measure_position(self) -> float:
        """The position from home in mm, positive towards the limb."""
        stage = self.table.stage
        return (self._stage.ask_number(stage.position) - stage.home) * stage.mm_per_unit

    def send(self, command: wire.Command, now: float) -> None:
        """See `Device.send`; ``now`` is not used: what is sent is sent at once."""
        match command:
            case wire.Move() if self._stopped:
                self._notices.append(wire.Rejection(0, "stopped"))
            case wire.Move(target_um=target) if target > self._fence_um:
                self._notices.append(wire.Rejection(0, "position"))
            case wire.Move():
                self._move, self._sent_um, self._moved_s = command, None, time.monotonic()
            case wire.Fence(position_um=position):
                self._fence_um = min(position, self._fence_um)
            case wire.Hold():
                self._halt()
            case wire.Stop() | wire.Bye():
                self._withdraw()
            case wire.Heartbeat(number=number) if number == self._number:
                self._advance()

    def receive(self, timeout_s: float = 0.0) -> list[wire.Notice]:
        """See `Device.receive`: waits for the next sample, however short ``timeout_s`` is."""
        time.sleep(max(self._due_s - time.monotonic(), 0.0))
        now = time.monotonic()
        self._due_s = max(self._due_s + 1 / self.table.rate_hz, now)
        try:
            self._force_mN = round(1000 * self.measure_force())
        except RunError:
            self._trip("sensor")
        asked = time.monotonic()
        position_um = round(1000 * self.measure_position())
        now = (asked + time.monotonic()) / 2
        if self._move is None or abs(position_um - self._position_um) > ARRIVAL_TOLERANCE_UM / 4:
            self._moved_s = now
        self._position_um, self._number = position_um, self._number + 1
        self._check_move(now)
        notices, self._notices = [*self._notices, self._make_sample(now)], []
        return notices

    def resend(self, now: float) -> str:
        return ""

    def close(self) -> None:
        with suppress(RunError):
            if not self._is_home():
                self._withdraw()
        self._stage.close()
        self._sensor.close()

    def _make_sample(self, now: float) -> Sample:
        move, flags = self._move, Flags(0)
        if self._stopped:
            flags |= Flags.STOPPED
        if self._is_home() and (move is None or move.target_um <= HOME_UM):
            flags |= Flags.HOME
        if self._given_up:
            flags |= Flags.GIVEN_UP
        time_us = round(1e6 * (now - self._start_s)) + 1
        return Sample(
            self._number,
            time_us,
            int(flags),
            int(move is not None),
            (self._position_um,),
            (self._force_mN,),
            (0,),
        )

    def _is_home(self) -> bool:
        return self._position_um <= HOME_UM

    def _check_move(self, now: float) -> None:
        """End a move that has arrived or met its force; stop where the stage stands although it is driven."""
        move = self._move
        if move is None:
            return
        is_met = move.halt_mN and self._force_mN >= move.halt_mN and move.target_um > self._position_um
        if abs(self._position_um - move.target_um) <= ARRIVAL_TOLERANCE_UM or (
            self._stopped and self._is_home()
        ):
            self._move = None
        elif is_met:
            self._halt()
        elif now - self._moved_s > STUCK_S and self._stopped:
            self._given_up = True
        elif now - self._moved_s > STUCK_S:
            self._trip("stuck")

    def _advance(self) -> None:
        """Send the stage on: towards the limb by a short way, away from it the whole."""
        move = self._move
        if move is None:
            return
        ahead = self._position_um + max(round(move.speed_um_s * LOOKAHEAD_S), 2 * ARRIVAL_TOLERANCE_UM)
        target = min(move.target_um, ahead)
        if target != self._sent_um:
            self._sent_um = target
            self._command_move(target, move.speed_um_s)

    def _command_move(self, target_um: int, speed_um_s: int) -> None:
        stage = self.table.stage
        position = stage.home + target_um / 1000 / stage.mm_per_unit
        speed = stage.speed_factor * abs(speed_um_s / 1000 / stage.mm_per_unit)
        self._command(stage.move.format(position=position, speed=speed))

    def _command(self, text: str) -> None:
        if self.table.stage.answers:
            self._stage.ask(text)
        else:
            self._stage.write(text)

    def _halt(self) -> None:
        self._move = None
        self._command(self.table.stage.stop)

    def _withdraw(self) -> None:
        """Stop, and go home without asking for a force."""
        if not self._stopped:
            self._stopped, self._moved_s = True, time.monotonic()
            self._command(self.table.stage.stop)
            self._command_move(0, RETRACT_UM_S)
            self._move = wire.Move(1, 0, RETRACT_UM_S)

    def _trip(self, code: str) -> None:
        if not self._stopped:
            self._notices.append(wire.LimitTrip(code, 1))
            self._withdraw()


def measure_mean_force(rig: Rig) -> float:
    """The mean force in N over a second."""
    values = []
    end = time.monotonic() + 1.0
    while time.monotonic() < end:
        values.append(rig.measure_force())
    return sum(values) / len(values)


def judge_weight(idle_N: float, loaded_N: float, weight_kg: float) -> tuple[float, str]:
    """What a known weight shows, as a share of what it should; and what is wrong, or nothing."""
    ratio = (loaded_N - idle_N) / (weight_kg * GRAVITY_N_KG)
    if abs(ratio - 1) <= MAX_RATIO_ERROR:
        return ratio, ""
    causes = {-1.0: "its sign is reversed", 0.1: "it is 10 times too small", 10.0: "it is 10 times too large"}
    causes |= {
        1 / GRAVITY_N_KG: "it is in kgf: N_per_unit 9.80665",
        0.0: "the sensor does not answer to the weight",
    }
    near = min(causes, key=lambda known: abs(ratio - known) / max(abs(known), 0.1))
    likely = f": {causes[near]}" if abs(ratio - near) <= 0.03 * max(abs(near), 1 / 3) else ""
    return ratio, f"the weight of {weight_kg:g} kg shows {ratio:.3g} times its force{likely}"


def _find_check_file(file: Path) -> Path:
    return file.with_suffix(".check.json")


def store_check(file: Path, ratio: float) -> None:
    """Keep that a rig has shown a known weight."""
    content = {"rig": sha256(file.read_bytes()).hexdigest(), "at": time.time(), "ratio": ratio}
    _find_check_file(file).write_text(json.dumps(content), encoding="utf-8")


def find_check(file: Path) -> str:
    """The day on which a rig, as its file now is, was checked with a weight.

    Raises `InputError` where that is more than a day ago, or was another rig.
    """
    remedy = "hang a known weight on the sensor: limbfit rig FILE --weight-kg 0.5"
    try:
        stored: dict[str, Any] = json.loads(_find_check_file(file).read_text(encoding="utf-8"))
        is_same, age_s = stored["rig"] == sha256(file.read_bytes()).hexdigest(), time.time() - stored["at"]
    except (OSError, ValueError, KeyError, TypeError):
        raise InputError("its force has never been checked", file=file, remedy=remedy) from None
    if not is_same:
        raise InputError("it was changed after its force was checked", file=file, remedy=remedy)
    if not 0 <= age_s <= CHECK_AGE_S:
        raise InputError("its force was checked more than a day ago", file=file, remedy=remedy)
    return time.strftime("%Y-%m-%d", time.gmtime(stored["at"]))
