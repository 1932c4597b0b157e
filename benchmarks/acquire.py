"""500 Hz held over loopback, and the time from a force over its limit to the stop command.

    python benchmarks/acquire.py STUDY [--minutes 10] [--trials 3000] [--normal]

STUDY has stored simulations.  First a virtual FitSocket (a process of its own, real time) and a session that
ramps up and down for the minutes asked for, recorded: how late each sample was dealt with, by the device's
own schedule, and how many never came.  Then a device that does nothing but show, now and then, a force over
the limit, and waits for the stop: each trial a session of its own through the same loop.  ``--normal`` asks
for no real-time priority at limbfit's end.
"""

import argparse
import json
import multiprocessing
import os
import select
import socket
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path
from queue import SimpleQueue
from typing import Any

import numpy as np
from scipy.ndimage import minimum_filter1d

from limbfit.acquire import (
    LineDevice,
    NoOperator,
    Recorder,
    Session,
    Settings,
    connect,
    read_recording,
    run_session,
)
from limbfit.acquire.line_protocol import (
    HOST_LINE,
    PINS,
    Acceptance,
    Bye,
    Decoder,
    Encoder,
    Flags,
    Heartbeat,
    Hello,
    Identity,
    Sample,
    SetLimits,
    Stop,
    derive_salt,
    format_sample,
    parse_command,
)
from limbfit.acquire.protocol import Abort, Event
from limbfit.acquire.session import prioritise

SITE = "bench"
WATCHDOG_S = 60.0  # a machine that stalls is to be measured, not to end the measurement


def hold(study: Path, minutes: float, site: str) -> dict[str, Any]:
    """Ramps without end for some minutes."""
    command = [sys.executable, "-m", "limbfit", "virtual-fitsocket", str(study), "--port", "0"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        address = process.stdout.readline().removeprefix("device: ").strip()
        try:
            return _held(address, minutes, site)
        finally:
            process.terminate()


def _held(address: str, minutes: float, site: str) -> dict[str, Any]:
    settings = Settings(repeats=50, search_depth_mm=4.0)
    settings = settings.model_copy(update={"watchdog_ms": 1000 * WATCHDOG_S})
    events: SimpleQueue[Event] = SimpleQueue()
    file = Path(tempfile.mkdtemp()) / "record.csv"
    device = LineDevice(connect(address))
    recorder = Recorder(file, {"site": site})
    session = Session(settings, device, site=site, recorder=recorder, listener=NoOperator(events))
    end = threading.Timer(60 * minutes, lambda: events.put(Abort("the time is over")))
    end.start()
    cpu = time.process_time()
    ending = run_session(session, events)
    cpu = time.process_time() - cpu
    end.cancel()
    recorder.close()
    record = read_recording(file)
    seconds = float(np.ptp(record.device_us)) / 1e6
    late = late_ms(record.host_us, record.device_us)
    return {
        "ended": ending.reason,
        "seconds": round(seconds, 1),
        "samples": len(late),
        "lost": session.lost,
        "late_2ms_percent": round(100 * float((late > 2).mean()), 4),
        "late_10ms_percent": round(100 * float((late > 10).mean()), 4),
        "late_20ms": int((late > 20).sum()),
        "stalls_over_20ms": int((np.diff((late > 20).astype(int)) == 1).sum()),
        "latest_ms": round(float(late.max()), 2),
        "median_ms": round(float(np.median(late)), 3),
        "cpu_percent": round(100 * cpu / seconds, 1),
        "record_MB_per_min": round(file.stat().st_size / 1e6 / seconds * 60, 1),
        "bytes_lost_of_record": record.lost_bytes,
    }


def late_ms(host_us: np.ndarray, device_us: np.ndarray) -> np.ndarray:
    """How much later than the promptest sample of the 2.5 s around it each was dealt with.

    Both clocks are this machine's; a device that stood still for long does not make up for it: its time is
    behind from then on.
    """
    lead = host_us - device_us
    return (lead - minimum_filter1d(lead, 1251)) / 1000


def react(trials: int) -> dict[str, Any]:
    """Times from a sample over the limit leaving the device to the stop arriving there."""
    here, there = multiprocessing.get_context("spawn").Pipe()
    process = multiprocessing.get_context("spawn").Process(target=peer, args=(there, trials))
    process.start()
    address = here.recv()
    settings = Settings()
    for _ in range(trials):
        session = Session(settings, LineDevice(connect(address)), site=SITE)
        run_session(session, SimpleQueue())
    times = np.array(here.recv()) * 1000
    process.join()
    return {
        "trials": len(times),
        "median_ms": round(float(np.median(times)), 3),
        "p99_ms": round(float(np.percentile(times, 99)), 3),
        "p99.9_ms": round(float(np.percentile(times, 99.9)), 3),
        "largest_ms": round(float(times.max()), 3),
    }


def peer(pipe: Any, trials: int) -> None:
    """A device that only shows: some ordinary samples, one over the limit, and what follows a stop."""
    listener = socket.create_server(("127.0.0.1", 0))
    pipe.send(f"tcp://127.0.0.1:{listener.getsockname()[1]}")
    prioritise()
    random = np.random.default_rng(0)
    found = []
    for _ in range(trials):
        connection, _ = listener.accept()
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        with connection:
            found.append(_trial(connection, random))
    pipe.send(found)


def _trial(connection: socket.socket, random: np.random.Generator) -> float:
    decoder, encoder = Decoder(HOST_LINE, numbered=False), Encoder()
    over_at, start = 5 + int(random.integers(10)), time.monotonic()
    shown, stopped_at, over = 0, 0.0, 0.0
    armed = False
    while True:
        due = start + shown * 0.002
        ready, _, _ = select.select([connection], [], [], max(due - time.monotonic(), 0))
        if ready:
            data = connection.recv(65536)
            if not data:
                return stopped_at - over
            arrived = time.monotonic()
            for line in decoder.feed(data):
                command = parse_command(line.body)
                if isinstance(command, Hello):
                    who = Identity(
                        1, "0" * 16, PINS, 500, 60_000, 50_000, 12_500, "real", "Peer", "1", "2000-01-01"
                    )
                    connection.sendall(Encoder(first=0).encode(who.body)[1])
                    salt = derive_salt(command.nonce, who.nonce)
                    encoder = Encoder(salt)
                    decoder.restart(salt)
                elif isinstance(command, Bye):
                    return stopped_at - over
                elif not isinstance(command, Heartbeat):
                    if isinstance(command, SetLimits):
                        armed, start, shown = True, time.monotonic(), 0
                    if isinstance(command, Stop) and not stopped_at:
                        stopped_at = arrived
                    connection.sendall(encoder.encode(Acceptance(line.number).body)[1])
        elif armed:
            shown += 1
            force = random.integers(-90, 90, PINS)
            if shown == over_at:
                force[0] = 40_000
            flags = int(Flags.STOPPED | Flags.HOME) if stopped_at else 0
            sample = Sample(0, shown * 2000, flags, 0, (0,) * PINS, tuple(force.tolist()), (100,) * PINS)
            line = encoder.encode(format_sample(sample))[1]
            if shown == over_at:
                over = time.monotonic()
            connection.sendall(line)


def stolen_s() -> float:
    """Seconds that a virtual machine's host has taken from its processors so far; 0 where nobody tells."""
    file = Path("/proc/stat")
    return (
        int(file.read_text().split("\n")[0].split()[8]) / os.sysconf("SC_CLK_TCK") if file.exists() else 0.0
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("study", type=Path)
    parser.add_argument("--site", default="1")
    parser.add_argument("--minutes", type=float, default=10.0)
    parser.add_argument("--trials", type=int, default=3000)
    parser.add_argument("--normal", action="store_true", help="no real-time priority at limbfit's end")
    given = parser.parse_args()
    found: dict[str, Any] = {"cores": os.cpu_count(), "load": [round(x, 1) for x in os.getloadavg()]}
    found["priority"] = "normal" if given.normal else prioritise()
    stolen = stolen_s()
    if given.minutes:
        found["held"] = hold(given.study, given.minutes, given.site)
    if given.trials:
        found["reaction"] = react(given.trials)
    found["stolen_s"] = round(stolen_s() - stolen, 2)
    found["load_after"] = [round(x, 1) for x in os.getloadavg()]
    sys.stdout.write(json.dumps(found, indent=1) + "\n")


if __name__ == "__main__":
    main()
