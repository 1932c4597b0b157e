"""Records are judged as a rig writes them."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from editing import append
from limbfit import InputError, load_study, watch_records

HEAD = "time_s,displacement_mm,force_N"


def make_record(first_s: float = 0.0, noise_N: float = 0.01) -> list[str]:
    """A ramp of 5 mm at 1 mm/s and back at 500 Hz, whose skin is met after 0.5 mm."""
    time_s = np.arange(first_s, 11.0, 0.002)
    depth = np.clip(np.minimum(time_s, 11.0 - time_s), 0, 5.5)
    force = 0.15 * np.clip(depth - 0.5, 0, None) ** 2 + np.random.default_rng(0).normal(
        0, noise_N, len(time_s)
    )
    return [HEAD, *(f"{t:.3f},{u:.4f},{F:.4f}" for t, u, F in zip(time_s, depth, force))]


def write(file: Path, lines: list[str]) -> None:
    file.write_text("\n".join(lines) + "\n")


def test_each_kind_of_record_gets_its_verdict_and_remedy(tmp_path: Path) -> None:
    write(tmp_path / "clean.csv", make_record())
    write(tmp_path / "noisy.csv", make_record(noise_N=0.6))
    write(tmp_path / "drowned.csv", make_record(noise_N=1.5))
    write(tmp_path / "starts-in-contact.csv", make_record(first_s=2.5))
    write(tmp_path / "no-columns.csv", ["a,b", "1,2"])
    write(tmp_path / ".hidden.csv", ["a,b"])
    (tmp_path / "empty.csv").touch()
    found = {one.file: one for one in watch_records(tmp_path, once=True)}
    assert {file: one.verdict for file, one in found.items()} == {
        "clean.csv": "good",
        "noisy.csv": "bad",
        "drowned.csv": "bad",
        "starts-in-contact.csv": "bad",
        "no-columns.csv": "bad",
    }
    facts = found["clean.csv"].facts
    assert facts is not None
    assert facts.touch_down_mm == pytest.approx(0.5, abs=0.1)
    assert facts.peak_force_N == pytest.approx(0.15 * 25, rel=0.03)
    assert "the touch-down is known within" in found["noisy.csv"].reasons[-1]
    assert "noise" in found["drowned.csv"].reasons[0]
    assert "in contact" in found["starts-in-contact.csv"].reasons[0]
    assert all("; " in one.reasons[-1] for one in found.values() if one.verdict == "bad")  # with a remedy


def test_a_study_names_columns_sites_and_what_is_no_record(study: Path) -> None:
    loaded = load_study(study, recorded=False)
    found = {one.file: one.record for one in watch_records(study, loaded, once=True)}
    assert found == {"1.csv": "1", "2.csv": "2"}
    renamed = study / "1.csv"
    renamed.write_text(renamed.read_text().replace("force_N", "load cell (N)"))
    append(study, '[traces]\nforce_N = "load cell (N)"\n')
    found = {
        one.record: one.verdict for one in watch_records(study, load_study(study, recorded=False), once=True)
    }
    assert found["1"] != "bad"
    assert found["2"] == "bad"  # it has the old name


def test_a_folder_that_is_not_there_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"no such folder; name the folder"):
        next(watch_records(tmp_path / "rig"))


def test_a_record_is_judged_when_it_is_whole_and_within_two_seconds(tmp_path: Path) -> None:
    """A rig writes in bursts while the command runs: one verdict, after the last of them; then one anew."""
    command = [sys.executable, "-m", "limbfit", "watch", str(tmp_path), "--json"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as watching:
        assert watching.stdout is not None
        assert watching.stderr is not None
        assert "watching" in watching.stderr.readline()
        lines = make_record()
        with (tmp_path / "site-1.csv").open("w") as file:
            for start in range(0, len(lines), 1000):
                file.write("\n".join(lines[start : start + 1000]) + "\n")
                file.flush()
                os.fsync(file.fileno())
                time.sleep(0.2)
        whole = time.monotonic()
        first = json.loads(watching.stdout.readline())
        assert time.monotonic() - whole < 2.0
        assert (first["file"], first["verdict"]) == ("site-1.csv", "good")
        assert first["facts"]["depth_mm"] == pytest.approx(5.0, abs=0.1)
        write(tmp_path / "site-1.csv", make_record(first_s=2.5))  # made again, and worse
        assert json.loads(watching.stdout.readline())["verdict"] == "bad"
        watching.send_signal(signal.SIGINT)
        assert watching.wait(10) == 0
        assert watching.stdout.read() == ""
