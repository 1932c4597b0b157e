"""A laboratory's rig as a program: a stage and a force sensor that answer lines of text, and tissue.

    python lab_rig.py FILE [NAME=VALUE ...]

It writes ``FILE``, the TOML file of the rig, and steps the stage every millisecond of this machine's clock.
Names of faults are those of ``FAULTS``; their time counts from the first move towards the limb. Every
millisecond in which the stage advances towards the limb goes to ``FILE.log``: time, position, true force.
"""

import contextlib
import os
import re
import select
import socket
import sys
import time
from pathlib import Path

SKIN_MM = 6.0
ACCELERATION_MM_S2 = 400.0
# With `zaber` the stage speaks Zaber's ASCII protocol. From `at_s` on the sensor answers nan, the same
# (dead), nothing (lost), or after `late_s` (late); the stage answers nothing, stands (stuck), refuses to move
# (reject) or reports a stall (stalled). `scale` is that of all readings.
FAULTS = {
    "at_s": 1.0,
    "nan": 0,
    "dead": 0,
    "lost": 0,
    "late": 0,
    "late_s": 0.2,
    "stage": 0,
    "stuck": 0,
    "reject": 0,
    "stalled": 0,
    "zaber": 0,
    "scale": 1.0,
}
TOML = """
name = "bench"
rate_hz = 100
[stage]
address = "tcp://127.0.0.1:{stage}"
{commands}
mm_per_unit = 0.001
stroke_mm = 40
[force]
address = "tcp://127.0.0.1:{force}"
read = "READ?"
range_N = 50
resolution_N = {resolution}
"""


COMMANDS = """position = "POS?"
move = "MOVE {position:.4f},{speed:.4f}"
stop = "STOP\""""
LIBRARY = 'library = "zaber-motion"'
ZABER = re.compile(r"/1 1 (\d\d) ([^:]*):[0-9A-F]{2}\r?")
SPEED_FACTOR = 1.6384  # of Zaber's speeds over microsteps a second


def compute_force(depth_mm: float) -> float:
    """The tissue's, in N."""
    depth = max(depth_mm, 0.0)
    return 0.3 * depth + 0.1 * depth**2


class Bench:
    """Stage, tissue and weight."""

    def __init__(self, options: dict[str, float], log) -> None:
        self.options, self.log = options, log
        self.position = self.target = self.speed = self.limit = self.weight_N = 0.0
        self.begun: float | None = None
        self.last = time.monotonic()

    def has_fault(self, name: str) -> bool:
        is_on = self.begun is not None and time.monotonic() - self.begun >= self.options["at_s"]
        return bool(self.options[name]) and is_on

    def force(self) -> float:
        return compute_force(self.position - SKIN_MM) + self.weight_N

    def step(self) -> None:
        now = time.monotonic()
        span, self.last = min(now - self.last, 0.05), now
        way = self.target - self.position
        reach = (2 * ACCELERATION_MM_S2 * abs(way)) ** 0.5
        wanted = min(self.limit, reach) * (1 if way > 0 else -1)
        change = ACCELERATION_MM_S2 * span
        self.speed += min(max(wanted - self.speed, -change), change)
        if self.has_fault("stuck"):
            self.speed = 0.0
        moved = self.speed * span
        moved = way if abs(moved) > abs(way) and moved * way > 0 else moved
        self.position += moved
        if moved > 0:
            self.log.write(f"{now},{self.position},{self.force()}\n")
            self.log.flush()

    def answer_stage(self, text: str) -> str | None:
        if self.has_fault("stage"):
            return None
        verb, _, words = text.partition(" ")
        if verb == "MOVE":
            self.target, self.limit = (float(word) / 1000 for word in words.split(","))
            if self.target > self.position and self.begun is None:
                self.begun = time.monotonic()
        elif verb == "STOP":
            self.target = self.position + self.speed * abs(self.speed) / (2 * ACCELERATION_MM_S2)
        return f"{1000 * self.position:.1f}" if verb == "POS?" else "OK"

    def answer_zaber(self, text: str) -> str | None:
        """As Zaber's protocol manual has it: what was asked, a number of the message, a checksum."""
        found = ZABER.fullmatch(text)
        if found is None:
            return None
        number, asked = found.groups()
        verb, _, words = asked.partition(" ")
        refused, data = verb == "move" and self.has_fault("reject"), "0"
        if asked == "get pos":
            data = self.answer_stage("POS?")
        elif verb == "stop":
            data = self.answer_stage("STOP") and "0"
        elif verb == "move" and not refused:
            _, position, speed = words.split()
            data = self.answer_stage(f"MOVE {position},{float(speed) / SPEED_FACTOR}") and "0"
        if data is None:
            return None
        flag = "FS" if self.has_fault("stalled") else "--"
        status = "BUSY" if abs(self.speed) > 0 else "IDLE"
        said = f"01 1 {number} {'RJ' if refused else 'OK'} {status} {flag} {'BADDATA' if refused else data}"
        return f"@{said}:{-sum(said.encode()) & 0xFF:02X}\r"

    def answer_force(self, text: str) -> str | None:
        if text.startswith("HANG "):  # what a person does with a weight
            self.weight_N = float(text[5:]) * 9.80665
            return "OK"
        if self.has_fault("lost"):
            return None
        if self.has_fault("nan"):
            return "nan"
        if not self.has_fault("dead"):
            step = self.options["resolution"]
            self.shown = round(self.options["scale"] * self.force() / step) * step
        return f"{self.shown:.4f}"


def main(file: Path, options: dict[str, float]) -> None:
    with contextlib.suppress(OSError):  # hardware does not wait for other programs
        os.sched_setscheduler(0, os.SCHED_RR, os.sched_param(10))
    listeners = [socket.create_server(("127.0.0.1", 0)) for _ in range(2)]
    stage, force = (one.getsockname()[1] for one in listeners)
    with Path(f"{file}.log").open("w") as log:
        bench = Bench(options, log)
        answer_stage = bench.answer_zaber if options["zaber"] else bench.answer_stage
        answers = dict(zip(listeners, (answer_stage, bench.answer_force), strict=True))
        open_now: dict[socket.socket, list] = {}
        late: list[tuple[float, socket.socket]] = []  # answers that are due later
        late_answer = b""
        ports = {"stage": stage, "force": force, "commands": LIBRARY if options["zaber"] else COMMANDS}
        file.write_text(TOML.format(resolution=options["resolution"], **ports))
        print("ready", flush=True)
        while True:
            ready, _, _ = select.select([*listeners, *open_now], [], [], 0.001)
            bench.step()
            while late and late[0][0] <= time.monotonic():
                late.pop(0)[1].sendall(late_answer)
            for one in ready:
                if one in answers:
                    open_now[one.accept()[0]] = [answers[one], b""]
                    continue
                known = open_now[one]
                data = one.recv(4096)
                known[1] += data
                *lines, known[1] = known[1].split(b"\n")
                for line in lines:
                    said = known[0](line.decode())
                    if said is not None and known[0] == bench.answer_force and bench.has_fault("late"):
                        late_answer = said.encode() + b"\n"
                        late.append((time.monotonic() + bench.options["late_s"], one))
                    elif said is not None:
                        one.sendall(said.encode() + b"\n")
                if not data:
                    del open_now[one]


if __name__ == "__main__":
    given = {name: float(value) for name, value in (word.split("=") for word in sys.argv[2:])}
    main(Path(sys.argv[1]), {**FAULTS, "resolution": 0.005, **given})
