"""A rig of one's own: each hazard of docs/device-protocol.md is stopped, on a rig that is a process."""

import json
import os
import re
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from lab_rig import compute_force

from acquiring import start as start_command
from editing import append
from limbfit import InputError, acquire_site, check_rig, judge_recording, load_study
from limbfit.acquire.rig import LOOKAHEAD_S, find_check, read_rig, store_check
from limbfit.errors import RunError
from limbfit.traces import find_touch_down, read_trace

ACQUIRE = """
[acquire]
settle_s = 0.2
start_gap_mm = 1.0
pause_s = 0.6
approach_speed_mm_s = 3.0
ramp_speed_mm_s = 4.0
search_speed_mm_s = 4.0
search_depth_mm = 4.0
force_limit_N = 8.0
search_force_N = 6.0
depth_limit_mm = 6.0
time_limit_s = 10.0
watchdog_ms = 100.0
"""
DEPTH_MM, SPEED_MM_S, LIMIT_N = 4.0, 8.0, 8.0
Start = Callable[..., Path]


@pytest.fixture
def start(tmp_path: Path) -> Iterator[Start]:
    """``start(fault=1, ...)``: the file of a rig that runs until the test ends."""
    running = []

    def begin(**options: float) -> Path:
        file = tmp_path / "rig.toml"
        words = [f"{name}={value}" for name, value in options.items()]
        command = [sys.executable, str(Path(__file__).with_name("lab_rig.py")), str(file), *words]
        process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        running.append(process)
        assert process.stdout is not None
        assert process.stdout.readline() == "ready\n"
        return file

    yield begin
    for process in running:
        process.kill()
        process.wait()


def hang(file: Path, weight_kg: float) -> None:
    """What a person does: a weight is hung on the sensor, or taken away."""
    port = int(read_rig(file).force.address.rsplit(":", 1)[1])
    with socket.create_connection(("127.0.0.1", port)) as wire:
        wire.sendall(f"HANG {weight_kg}\n".encode())
        wire.recv(16)


def check(file: Path) -> None:
    check_rig(file, 0.5, lambda: hang(file, 0.5))
    hang(file, 0.0)


@pytest.fixture
def planned(study: Path) -> Path:
    """A study whose site 1 is yet to be recorded."""
    (study / "1.csv").unlink()
    append(study, ACQUIRE)
    return study


def record(study: Path, file: Path) -> dict[str, Any]:
    return acquire_site(load_study(study, recorded=False), "1", address=f"rig:{file}", depth_mm=DEPTH_MM)


def read_log(file: Path) -> np.ndarray:
    """Time, position and true force of each advance towards the limb."""
    return np.loadtxt(f"{file}.log", delimiter=",", ndmin=2)


def is_home(file: Path) -> bool:
    port = int(read_rig(file).stage.address.rsplit(":", 1)[1])
    with socket.create_connection(("127.0.0.1", port)) as wire:
        wire.settimeout(1.0)
        wire.sendall(b"/1 1 00 get pos:2C\n" if read_rig(file).stage.library else b"POS?\n")
        return float(wire.recv(64).split(b":")[0].split()[-1]) < 150.0


def test_a_site_is_recorded_and_the_record_is_the_tissue(planned: Path, start: Start) -> None:
    file = start()
    check(file)
    found = record(planned, file)
    assert (found["phase"], found["completed"]) == ("done", True), found["reason"]
    trace = read_trace(planned / "1.csv")
    met = find_touch_down(trace)
    depth = trace.displacement_mm - met.displacement_mm
    force = np.array([compute_force(one) for one in depth])
    assert depth.max() == pytest.approx(DEPTH_MM, abs=0.4)
    assert np.abs(trace.force_N - force).max() < 0.1 * force.max()  # force and position are asked one by one
    (recording,) = planned.glob("acquired/1/*/record.csv")
    assert judge_recording(recording)["samples"] > 100
    assert is_home(file)


# of each hazard: what the rig does, what the session says, and how far it may be beyond its limits
HAZARDS = {
    "stuck sensor": ({"dead": 1, "at_s": 2.4}, "feels no force|shows the same"),
    "NaN": ({"nan": 1, "at_s": 2.4}, "stopped by itself: sensor"),
    "lost link to the sensor": ({"lost": 1, "at_s": 2.4}, "stopped by itself: sensor"),
    "late samples": ({"late": 1, "at_s": 2.4}, "stopped by itself: sensor|no fresh sample"),
    "stuck stage": ({"stuck": 1, "at_s": 0.5}, "stopped by itself: stuck"),
    "lost link to the stage": ({"stage": 1, "at_s": 2.4}, "the stage does not answer"),
}


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=[pytest.mark.slow] * (name in ("late samples", "lost link to the sensor")))
        for name in HAZARDS
    ],
)
def test_each_hazard_ends_the_session_before_the_force_is_over_its_limit(
    name: str, planned: Path, start: Start
) -> None:
    options, reason = HAZARDS[name]
    file = start(**options)
    store_check(file, 1.0)
    found = record(planned, file)
    assert not found["completed"]
    assert re.search(reason, found["reason"]), found["reason"]
    assert not (planned / "1.csv").exists()
    log = read_log(file)
    assert log[:, 2].max() < LIMIT_N
    if "stage" in name:
        assert found["phase"] == "unreachable"
    else:
        assert found["phase"] == "stopped"
        assert is_home(file)


# of a stage driven by its vendor's library
ZABER_HAZARDS = {
    "none": ({}, ""),
    "stuck stage": ({"stuck": 1, "at_s": 0.5}, "stopped by itself: stuck"),
    "stuck sensor": ({"dead": 1, "at_s": 2.4}, "feels no force|shows the same"),
    "lost link to the stage": ({"stage": 1, "at_s": 2.4}, "the stage does not answer"),
    "rejected command": ({"reject": 1, "at_s": 2.4}, "BADDATA"),
    "stall": ({"stalled": 1, "at_s": 2.4}, "the stage reports the fault FS"),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", list(ZABER_HAZARDS))
def test_a_stage_of_zabers_is_driven_and_each_of_its_hazards_ends_the_session(
    name: str, planned: Path, start: Start
) -> None:
    """Its library speaks to a process that answers in the protocol."""
    pytest.importorskip("zaber_motion", reason="zaber-motion is not installed (limbfit[zaber])")
    options, reason = ZABER_HAZARDS[name]
    file = start(zaber=1, **options)
    store_check(file, 1.0)
    found = record(planned, file)
    log = read_log(file)
    assert log[:, 2].max() < LIMIT_N
    assert found["completed"] == (name == "none"), found["reason"]
    assert re.search(reason, found["reason"]), found["reason"]
    assert (planned / "1.csv").exists() == (name == "none")
    if name in ("none", "stuck sensor"):
        assert is_home(file)


@pytest.mark.parametrize(
    ("scale", "cause"),
    [
        (-1.0, "its sign is reversed"),
        (0.1, "it is 10 times too small"),
        (10.0, "it is 10 times too large"),
        (0.0, "does not answer to the weight"),
    ],
)
def test_a_wrong_force_is_found_by_a_weight_before_any_session(
    scale: float, cause: str, planned: Path, start: Start
) -> None:
    file = start(scale=scale)
    with pytest.raises(RunError, match=cause):
        check(file)
    hang(file, 0.0)
    with pytest.raises(InputError, match=r"its force has never been checked; hang a known weight"):
        record(planned, file)


def test_a_reversed_sign_is_met_at_the_skin_even_if_nobody_checked(planned: Path, start: Start) -> None:
    file = start(scale=-1.0)
    store_check(file, 1.0)
    found = record(planned, file)
    assert "the sign of its force is reversed" in found["reason"]
    assert read_log(file)[:, 2].max() < 1.0
    assert is_home(file)


def test_a_check_holds_for_a_day_and_for_the_rig_that_was_checked(start: Start) -> None:
    file = start()
    store_check(file, 1.0)
    kept = file.with_suffix(".check.json")
    content = json.loads(kept.read_text())
    assert find_check(file) == time.strftime("%Y-%m-%d", time.gmtime(content["at"]))
    for shift in (-25 * 3600, +3600):  # a clock that jumped is no check either
        kept.write_text(json.dumps(content | {"at": content["at"] + shift}))
        with pytest.raises(InputError, match="checked more than a day ago"):
            find_check(file)
    kept.write_text(json.dumps(content))
    file.write_text(file.read_text().replace("stroke_mm = 40", "stroke_mm = 41"))
    with pytest.raises(InputError, match="changed after its force was checked"):
        find_check(file)


def test_a_host_that_is_killed_leaves_a_stage_that_stops_by_itself(planned: Path, start: Start) -> None:
    file = start()
    store_check(file, 1.0)
    session = ("--site", "1", "--device", f"rig:{file}", "--unattended", "--depth", "4")
    process = start_command("acquire", planned, *session)
    assert process.stderr is not None
    for line in process.stderr:
        if ": search" in line:
            break
    time.sleep(0.4)
    os.kill(process.pid, signal.SIGKILL)
    killed = time.monotonic()
    process.wait()
    time.sleep(1.0)
    log = read_log(file)
    before = log[log[:, 0] <= killed]
    assert len(before)
    assert log[-1, 1] - before[-1, 1] < 1.5 * SPEED_MM_S * LOOKAHEAD_S  # mm beyond where it was
    assert log[:, 2].max() < LIMIT_N


@pytest.mark.slow
def test_a_coarse_sensor_is_not_taken_for_a_dead_one(planned: Path, start: Start) -> None:
    """Steps of 0.05 N repeat themselves for seconds; a touch must then be larger than three of them."""
    file = start(resolution=0.05)
    store_check(file, 1.0)
    found = record(planned, file)
    assert found["completed"], found["reason"]
    coarse = start(resolution=0.1)
    store_check(coarse, 1.0)
    with pytest.raises(InputError, match=r"too coarse for acquire.touch_N; state touch_N = 0.3"):
        acquire_site(
            load_study(planned, recorded=False), "1", address=f"rig:{coarse}", depth_mm=4, replace_record=True
        )


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("stroke_mm = 40", "", "stage.stroke_mm: Field required"),
        ("stroke_mm = 40", "stroke_mm = -1", "stage.stroke_mm: Input should be greater than 0"),
        ("rate_hz = 100", "rate_Hz = 100", "rate_Hz: Extra inputs are not permitted"),
        ('name = "bench"', 'name = "bench', "not valid TOML"),
        ("rate_hz = 100", "rate_hz = 5000", "rate_hz: Input should be less than or equal to 500"),
    ],
)
def test_a_wrong_file_is_refused_with_its_key(start: Start, old: str, new: str, words: str) -> None:
    file = start()
    file.write_text(file.read_text().replace(old, new))
    with pytest.raises(InputError, match=words):
        read_rig(file)
