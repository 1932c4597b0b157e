"""A study whose records are yet to be made, and both ends of a session as their commands start them."""

import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import pytest

from editing import append
from limbfit.pipeline.engine.store import write_curves

SPEED = "40"  # an accelerated clock
ACQUIRE = """
[acquire]
clamp_speed_mm_s = 8.0
approach_speed_mm_s = 6.0
settle_s = 0.3
clamp_tolerance_N = 4.0
pause_s = 0.5
ramp_speed_mm_s = 1.4
"""


@pytest.fixture
def ready(study):
    """The stump with stored simulations of both sites, its records yet to be made."""
    folder = study / "results" / "simulate"
    folder.mkdir(parents=True)
    for name, peak in (("1", 6.0), ("2", 4.0)):
        time_s, displacement, force = indentation(peak=peak)
        write_curves(folder / f"{name}.csv", time_s=time_s, displacement_mm=displacement, force_N=force)
        (study / f"{name}.csv").unlink()
    append(study, ACQUIRE)
    return study


def start(*words: object, **options) -> subprocess.Popen:
    command = [sys.executable, "-m", "limbfit", *map(str, words)]
    return subprocess.Popen(command, text=True, stdout=subprocess.PIPE, stderr=subprocess.PIPE, **options)


@contextmanager
def fitsocket(study, *words: object) -> Iterator[tuple[str, subprocess.Popen]]:
    """A virtual FitSocket as a process, on a port of its own; its address and itself."""
    process = start("virtual-fitsocket", study, "--port", 0, *words)
    try:
        yield process.stdout.readline().removeprefix("device: ").strip(), process
    finally:
        process.terminate()
        process.communicate(timeout=20)


def indentation(depth: float = 5.0, peak: float = 6.0, speed: float = 0.96, power: float = 1.8):
    """A made-up simulation: times, displacements and forces of a quasi-linear tissue, in and out."""
    half = depth / speed
    fine = np.linspace(0, 2 * half, 4001)
    elastic = ((depth - np.abs(fine - half) * speed) / depth).clip(0) ** power
    fade = np.exp(-(fine[1] - fine[0]) / 0.7)
    kept = np.zeros_like(fine)
    for k in range(1, fine.size):
        kept[k] = fade * (kept[k - 1] + elastic[k] - elastic[k - 1])
    force = np.maximum(elastic + 1.5 * kept, 0)
    time = np.linspace(0, 2 * half, 81)
    return time, depth - np.abs(time - half) * speed, np.interp(time, fine, peak * force / force.max())
