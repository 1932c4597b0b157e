"""Both ends on real sockets and terminals: sessions, kills (of processes), hostile devices."""

import json
import os
import pty
import random
import re
import select
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path
from queue import SimpleQueue
from threading import Thread

import numpy as np
import pytest
from in_process import settings

import limbfit
from acquiring import SPEED, fitsocket, start
from editing import append, edit
from limbfit.acquire import LineDevice, LiveUpdate, Session, connect, read_recording, run_session
from limbfit.acquire.line_protocol import Encoder, Flags, Sample, SetLimits
from limbfit.acquire.protocol import Abort, Phase, Signal
from limbfit.acquire.virtual import Endpoint, Fault, read_faults
from limbfit.errors import RunError
from limbfit.pipeline.records.traces import read_record
from limbfit.study import load_study


@pytest.fixture(autouse=True)
def usual_priority() -> Iterator[None]:
    """A session in this process asks for real time, which the other tests do not need."""
    yield
    if hasattr(os, "sched_setscheduler"):
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))


def acquire(study, address: str, *words: object) -> tuple[int, dict, str]:
    process = start("acquire", study, "--device", address, "--json", *words)
    out, err = process.communicate(timeout=300)
    assert "Traceback" not in err
    return process.returncode, json.loads(out) if out else {}, err


@pytest.mark.slow
def test_both_sites_are_acquired_into_the_study(ready) -> None:
    # The device runs for longer than an operator may take: each session has a time of its own.
    append(ready, "operator_limit_s = 10.0\n")
    with fitsocket(ready, "--speed", SPEED) as (address, _):
        code, found, err = acquire(ready, address, "--unattended", "--depth", 4.0)
        assert code == 0, err
        again = acquire(ready, address, "--unattended", "--site", "1")
        assert again[0] == 2
        assert "--again" in again[2]
    study = load_study(ready)
    for one, row in zip(study.recorded, found["sites"], strict=True):
        assert row["completed"]
        assert row["verdict"]["good"]
        assert row["lost"] == 0
        assert sum(row["refused"].values()) == 0
        assert row["depth_mm"] == pytest.approx(4.0, abs=0.15)
        trace, _, facts = read_record(study, one)
        assert 3.0 < facts.depth_mm < 4.1  # after a short pause the tissue is not quite back
        assert facts.speed_load_mm_s == pytest.approx(1.4, abs=0.01)
        assert np.allclose(np.diff(trace.time_s), 0.002)
        record = read_recording(row["files"]["record"])
        assert record.lost_bytes == 0
        assert record.head["device"]["model"] == "VirtualFitSocket"
        assert record.head["settings"]["ramp_speed_mm_s"] == 1.4
        assert str(ready) not in json.dumps(record.head)
    assert {p.name for p in ready.iterdir()} == {
        *("study.toml", "skin.stl", "tibia.stl", "results", "acquired", "1.csv", "2.csv")
    }


@pytest.mark.slow
def test_the_records_of_a_site_are_made_each_in_its_own_way(ready) -> None:
    """Two records of a site, one of them fast and held, as a designed protocol states them."""
    file = ready / "study.toml"
    text = file.read_text().replace('trace = "1.csv"\n', "")
    for name, speed, hold in (("slow", 1.4, 0.0), ("held", 4.0, 3.0)):
        text += f'[[records]]\nsite = "1"\nname = "{name}"\ntrace = "records/1-{name}.csv"\n'
        text += f"depth_mm = 3.5\nspeed_mm_s = {speed}\nhold_s = {hold}\n"
    file.write_text(text)
    with fitsocket(ready, "--speed", SPEED) as (address, _):
        code, found, err = acquire(ready, address, "--unattended", "--depth", 3.5)
    assert code == 0, err
    assert [row["name"] for row in found["sites"]] == ["1-slow", "1-held", "2"]
    study = load_study(ready)
    for one, speed, kinds in zip(
        study.recorded, (1.4, 4.0), (["load", "unload"], ["load", "hold", "unload"])
    ):
        _, curve, facts = read_record(study, one)
        assert facts.speed_load_mm_s == pytest.approx(speed, rel=0.02)
        assert [phase.kind for phase in curve.phases] == kinds


def is_home(address: str) -> bool:
    """Greets the device until it takes a session, which it does only once everything is home."""
    for _ in range(40):
        time.sleep(0.25)
        try:
            device = LineDevice(connect(address))
        except RunError:
            continue
        device.send(SetLimits(1, 25_000, 25_000, 60_000, 8000, 500), 0.0)
        until = time.monotonic() + 2
        while time.monotonic() < until:
            for report in device.receive(0.05):
                if isinstance(report, Sample) and report.flags & Flags.HOME:
                    device.close()
                    return True
        device.close()
    return False


def wait_for_record(study, samples: int) -> Path:
    """Until the record that a session is writing has so many rows."""
    for _ in range(1200):
        files = list(study.glob("acquired/*/*/record.csv"))
        if files and files[0].read_bytes().count(b"\n") > samples:
            return files[0]
        time.sleep(0.05)
    raise AssertionError("no record is written")


@contextmanager
def device_here(study, *, faults: tuple[Fault, ...] = (), speed: float = float(SPEED)):
    """A virtual FitSocket on a port, in a thread of this process; its address and that thread."""
    device = limbfit.virtual_fitsocket(load_study(study, recorded=False), faults=faults, paced=speed > 1)
    serving = Endpoint.listen_on_port("127.0.0.1", 0)
    how = {"speed": speed, "tell": lambda line: None}
    thread = Thread(target=limbfit.serve_fitsocket, args=(device, serving), kwargs=how)
    thread.start()
    try:
        yield serving.address, thread
    finally:
        serving.stop()
        thread.join(20)


@contextmanager
def once_recorded(study, samples: int, act: Callable[[], object]):
    """``act`` is done in a thread once the record of a session has so many rows."""

    def wait() -> None:
        wait_for_record(study, samples)
        act()

    thread = Thread(target=wait)
    thread.start()
    yield
    thread.join(60)


SESSION = ("--unattended", "--site", "1", "--depth", 4.0)


def kill_the_host(ready, limbfit, samples: int) -> None:
    with device_here(ready) as (address, device):
        host = start("acquire", ready, "--device", address, *SESSION)
        file = wait_for_record(ready, samples)
        host.kill()
        host.communicate()
        assert is_home(address)
        assert device.is_alive()
    found = read_recording(file)
    rows = sum(line[:1].isdigit() for line in file.read_bytes().split(b"\n"))
    assert rows - len(found.number) <= 50
    assert np.all(np.diff(found.device_us) == 2000)


def kill_the_device(ready, limbfit, samples: int) -> None:
    with fitsocket(ready, "--speed", SPEED) as (address, device), once_recorded(ready, samples, device.kill):
        assert address.startswith("tcp://127.0.0.1:")  # unless another is asked for
        code, _, err = limbfit("acquire", ready, "--device", address, *SESSION)
    assert code == 1
    assert "whether the device has retracted is not known" in err
    assert "Traceback" not in err
    found = read_recording(wait_for_record(ready, samples))
    assert found.lost_bytes == 0
    assert found.phases()[-1][0] == "unreachable"
    assert not (ready / "1.csv").exists()


def test_a_killed_host_leaves_a_readable_record_and_a_retracted_device(ready, limbfit) -> None:
    kill_the_host(ready, limbfit, 600)


def test_a_killed_device_ends_the_session_with_a_reason(ready, limbfit) -> None:
    kill_the_device(ready, limbfit, 600)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(8))
@pytest.mark.parametrize("end", [kill_the_host, kill_the_device])
def test_both_ends_killed_at_random_moments(ready, limbfit, end, seed: int) -> None:
    end(ready, limbfit, random.Random(seed).randrange(60, 8000))


def test_termination_retracts(ready, limbfit) -> None:
    before = signal.signal(
        signal.SIGTERM, signal.SIG_IGN
    )  # of the tests, which only the session's may replace
    terminate = partial(os.kill, os.getpid(), signal.SIGTERM)
    with device_here(ready) as (address, _), once_recorded(ready, 600, terminate):
        code, _, err = limbfit("acquire", ready, "--device", address, *SESSION)
    signal.signal(signal.SIGTERM, before)
    assert code == 1
    assert "signal SIGTERM (stopped)" in err
    assert read_recording(wait_for_record(ready, 600)).phases()[-1][0] == "stopped"


def test_faults_on_demand_stop_the_session(ready, limbfit, tmp_path) -> None:
    file = tmp_path / "faults.toml"
    file.write_text('[[faults]]\nkind = "button"\nphase = "clamp"\nat_s = 0.2\nduration_s = 0.5\n')
    with device_here(ready, faults=read_faults(file)) as (address, _):
        code, out, err = limbfit(
            "acquire", ready, "--device", address, "--json", "--unattended", "--depth", 4.0
        )
    assert code == 1
    (row,) = json.loads(out)["sites"]  # the second site is not begun
    assert "button" in row["reason"], err
    assert row["phase"] == "stopped"


def _let_it_fall_silent(address: str) -> None:
    """Read what a session before left on the wire: the next would refuse and count it."""
    link = connect(address)
    while select.select([link.fileno()], [], [], 1.0)[0]:
        link.read()
    link.close()


def test_two_sessions_over_one_serial_port(ready) -> None:
    pytest.importorskip("serial", reason="needs pyserial")
    with fitsocket(ready, "--speed", SPEED, "--terminal") as (address, _):
        for _ in range(2):
            _let_it_fall_silent(address)
            device = LineDevice(connect(address))
            events: SimpleQueue = SimpleQueue()

            def listen(told, events=events) -> None:
                if told.phase == "position":
                    events.put(Signal.CONFIRM)
                elif isinstance(told, LiveUpdate) and told.phase == "clamp":
                    events.put(Abort("enough"))

            session = Session(settings(), device, site="1", listener=listen)
            ending = run_session(session, events)
            assert (ending.phase, ending.reason) == (Phase.STOPPED, "enough")
            assert session.samples > 20
            assert device.refusals.total == 0


@pytest.mark.slow
def test_a_whole_session_over_a_serial_port(ready) -> None:
    pytest.importorskip("serial", reason="needs pyserial")
    with fitsocket(ready, "--speed", SPEED, "--terminal") as (address, _):
        assert re.fullmatch(r"serial:/dev/pts/\d+", address)
        for words in ((), ("--again",)):  # one session after the other on the same wire
            code, found, err = acquire(ready, address, "--unattended", "--site", "1", "--depth", 3.0, *words)
            assert code == 0, err
            assert found["sites"][0]["verdict"]["good"]
    assert len(list(ready.glob("1.until-*.csv"))) == 1


@pytest.mark.slow
def test_the_operator_s_keys_in_a_terminal(ready) -> None:
    """Enter, then the space bar held until 3 mm: as at a keyboard that repeats 30 times a second."""
    with fitsocket(ready, "--speed", "2") as (address, _):
        near, far = pty.openpty()
        words = ["acquire", str(ready), "--device", address, "--site", "1"]
        host = subprocess.Popen(
            [sys.executable, "-m", "limbfit", *words],
            stdin=far,
            stdout=far,
            stderr=far,
            env={**os.environ, "TERM": "xterm"},
        )
        os.close(far)
        shown, held, confirmed = "", 0, False
        end = time.monotonic() + 200
        while time.monotonic() < end:
            ready_to_read, _, _ = select.select([near], [], [], 0.03)
            if ready_to_read:
                try:
                    shown += os.read(near, 65536).decode(errors="replace")
                except OSError:
                    break
            if not confirmed and "then Enter" in shown:
                os.write(near, b"\n")
                confirmed = True
            if "hold the space bar" in shown and held < 25:
                os.write(near, b" ")
                held += 1
        code = host.wait(timeout=20)
        os.close(near)
    assert code == 0, shown[-2000:]
    assert "N over mm" in shown
    assert "•" in shown
    depth = float(re.search(r"site 1: ([0-9.]+) mm deep", shown)[1])
    assert 1.0 < depth < 15.0


def test_the_server_takes_one_host_that_greets_it(ready) -> None:
    with device_here(ready, speed=1.0) as (address, device):
        host, port = re.fullmatch(r"tcp://(127\.0\.0\.1):(\d+)", address).groups()
        first = LineDevice(connect(address))
        second = socket.create_connection((host, int(port)))
        second.settimeout(10)
        assert second.recv(100) == b""  # closed at once
        first.close()
        silent = socket.create_connection((host, int(port)))
        silent.settimeout(30)
        assert silent.recv(100) == b""  # closed for want of a greeting
        noisy = socket.create_connection((host, int(port)))
        noisy.settimeout(30)
        noisy.sendall(b"\x00\xff" * 200_000 + b"\n" + Encoder().encode("MOVE 1 50000 8000 0")[1])
        assert noisy.recv(100) == b""
        for closed in (second, silent, noisy):
            closed.close()
        assert device.is_alive()
        assert is_home(address)


def identity(model: str) -> bytes:
    body = f"ID 1 {'0' * 16} 14 500 60000 50000 12500 real {model} S1 2024-01-01"
    return Encoder(first=0).encode(body)[1]


@pytest.mark.parametrize(
    "answer",
    [
        b"\x1b[2J\x1b[31mowned\n" * 50,
        b"A" * 3_000_000,
        identity("Fit Socket"),
        identity("FitSocket").replace(b"ID 1", b"ID 2"),
    ],
    ids=["ansi", "endless", "space", "spoilt"],
)
def test_a_hostile_device_gets_one_clean_line(ready, limbfit, answer: bytes) -> None:
    listener = socket.create_server(("127.0.0.1", 0))
    address = f"tcp://127.0.0.1:{listener.getsockname()[1]}"

    def answer_once() -> None:
        connection, _ = listener.accept()
        with connection, suppress(OSError):  # the host hangs up on a device that talks too much
            connection.sendall(answer)
            connection.recv(100)

    device = Thread(target=answer_once)
    device.start()
    code, _, err = limbfit("acquire", ready, "--device", address, *SESSION)
    listener.close()
    device.join()
    assert code == 1
    assert err.startswith("error: no greeting from the device")
    assert len(err.splitlines()) == 1
    assert err.strip().isprintable()
    assert not list(ready.glob("acquired/*"))


def test_nothing_is_written_outside_the_study(ready, limbfit) -> None:
    edit(ready, "1.csv", "../1.csv")
    code, _, err = limbfit("acquire", ready, "--device", "tcp://127.0.0.1:1", *SESSION)
    assert code == 2
    assert "outside the study's folder" in err


@pytest.mark.parametrize(
    ("content", "said"),
    [
        ("[[faults]]\nkind = 'fire'\n", "faults.0.kind"),
        ("[[faults]]\nkind = 'stuck'\npin = 15\n", "faults.0.pin"),
        ("faults = [", "TOML"),
        ("", "faults"),
    ],
)
def test_bad_fault_files_are_refused(ready, limbfit, tmp_path, content: str, said: str) -> None:
    file = tmp_path / "faults.toml"
    file.write_text(content)
    code, _, err = limbfit("virtual-fitsocket", ready, "--port", 0, "--faults", file)
    assert code == 2
    assert said in err
