"""The record of the indentation robot: a clean force history becomes a noisy 500 Hz record with slack.

The robot starts clear of the skin, moves at constant speed to its depth, straight back to where it started,
and records a little longer. Its displacement counts from the start, not from touch-down.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ..arrays import Array
from ..errors import SiteError

RATE_HZ = 500.0
AFTER_S = 0.4
CLEARANCE_MM = (0.3, 0.6)
FORCE_NOISE_N = (0.03, 0.05)
ULTRASOUND_HZ, ULTRASOUND_NOISE_MM = 20.0, 0.1
SURFACE_HZ, SURFACE_NOISE_MM = 5.0, 0.05
WAVES_HZ, WAVES_NOISE_M_S, WAVES_BIAS_M_S = 1.0, 0.1, 0.1
DISPLACEMENT_NOISE_MM = 0.005
HEADER = "time_s,displacement_mm,force_N"


class SecondaryMeasurements(NamedTuple):
    """What is measured of an indentation beside its force."""

    ultrasound: bool = False
    surface: bool = False
    shear_waves: bool = False


NOTHING = SecondaryMeasurements()


@dataclass(frozen=True)
class Ramp:
    """A constant-speed indentation: ``depth`` mm under touch-down at ``speed`` mm/s, and back."""

    depth: float
    speed: float

    def __post_init__(self) -> None:
        if not (self.depth > 0 and self.speed > 0):
            raise SiteError(
                f"cannot indent {self.depth:g} mm at {self.speed:g} mm/s", remedy="give positive numbers"
            )

    @property
    def peak_s(self) -> float:
        """Seconds from touch-down to the peak."""
        return self.depth / self.speed

    @property
    def knots(self) -> tuple[tuple[float, float, float], tuple[float, float, float]]:
        """Times (s) and displacements (mm) from touch-down: start, peak, back."""
        return (0.0, self.peak_s, 2 * self.peak_s), (0.0, self.depth, 0.0)


@dataclass(frozen=True)
class RobotRecord:
    """A record: ``time`` (n,) s, ``displacement`` (n,) mm, ``force`` (n,) N, and what it was made with."""

    time: Array
    displacement: Array
    force: Array
    clearance: float
    touch_s: float
    force_noise: float

    def write(self, path: Path) -> None:
        """Write the CSV as the robot does."""
        table = np.column_stack([self.time, self.displacement, self.force])
        np.savetxt(path, table, fmt=("%.3f", "%.4f", "%.4f"), delimiter=",", header=HEADER, comments="")


def record(ramp: Ramp, force: Callable[[Array], Array], random: np.random.Generator) -> RobotRecord:
    """Record an indentation.

    Parameters
    ----------
    ramp : depth and speed from touch-down.
    force : force (n,) in N at times (n,) from touch-down, within ``[0, 2 ramp.peak_s]``.
    random : source of clearance and noise.
    """
    clearance = random.uniform(*CLEARANCE_MM)
    sd = random.uniform(*FORCE_NOISE_N)
    touch = clearance / ramp.speed
    half = touch + ramp.peak_s
    time = np.arange(0.0, 2 * half + AFTER_S, 1 / RATE_HZ)
    displacement = np.interp(time, [0, half, 2 * half], [0, clearance + ramp.depth, 0])
    since = time - touch
    touching = (since > 0) & (since < 2 * ramp.peak_s)
    clean = np.zeros_like(time)
    clean[touching] = force(since[touching])
    return RobotRecord(
        time=time,
        displacement=displacement + DISPLACEMENT_NOISE_MM * random.standard_normal(time.size),
        force=clean + sd * random.standard_normal(time.size),
        clearance=clearance,
        touch_s=touch,
        force_noise=sd,
    )


def write_ultrasound(
    path: Path,
    made: RobotRecord,
    layers: Mapping[str, tuple[float, Callable[[Array], Array]]],
    random: np.random.Generator,
) -> None:
    """Write what ultrasound through the indenter saw of a record: thickness of tissues, mm, at 20 Hz.

    Parameters
    ----------
    layers : by tissue its thickness at rest, mm, and its compression, mm, at times (n,) from touch-down.
    """
    time = np.arange(0.0, made.time[-1], 1 / ULTRASOUND_HZ)
    since = time - made.touch_s
    columns = {"time_s": time}
    for tissue, (thickness, compression) in layers.items():
        clean = thickness - np.where(since > 0.0, compression(np.maximum(since, 0.0)), 0.0)
        columns[f"{tissue}_mm"] = clean + ULTRASOUND_NOISE_MM * random.standard_normal(time.size)
    _write_table(path, columns)


def write_surface(
    path: Path,
    made: RobotRecord,
    points: Array,
    moves: Callable[[Array], Array],
    random: np.random.Generator,
) -> None:
    """Write what cameras saw of the skin around the indenter: positions at rest and displacements, at 5 Hz.

    Parameters
    ----------
    points : (k, 3) mm at rest.
    moves : of all points (k, 3, n), mm, at times (n,) from touch-down.
    """
    time = np.arange(0.0, made.time[-1], 1 / SURFACE_HZ)
    since = time - made.touch_s
    moved = np.where(since > 0.0, moves(np.maximum(since, 0.0)), 0.0)
    moved = moved + SURFACE_NOISE_MM * random.standard_normal(moved.shape)
    columns = {"time_s": np.repeat(time, len(points))}
    columns |= dict(zip(("x_mm", "y_mm", "z_mm"), np.tile(points, (len(time), 1)).T))
    columns |= dict(zip(("ux_mm", "uy_mm", "uz_mm"), moved.transpose(1, 2, 0).reshape(3, -1)))
    _write_table(path, columns)


def write_waves(
    path: Path,
    made: RobotRecord,
    speeds: Mapping[str, Callable[[Array], Array]],
    random: np.random.Generator,
) -> None:
    """Write what elastography through the indenter read of a record: speeds of shear waves, m/s, at 1 Hz.

    All of a tissue's readings are off together, and each by itself.

    Parameters
    ----------
    speeds : by tissue the speed, m/s, at times (n,) from touch-down.
    """
    time = np.arange(0.0, made.time[-1], 1 / WAVES_HZ)
    since = np.maximum(time - made.touch_s, 0.0)
    columns = {"time_s": time}
    for tissue, speed in speeds.items():
        off = WAVES_BIAS_M_S * random.standard_normal() + WAVES_NOISE_M_S * random.standard_normal(time.size)
        columns[f"{tissue}_m_s"] = speed(since) + off
    _write_table(path, columns)


def _write_table(path: Path, columns: Mapping[str, Array]) -> None:
    table = np.column_stack(list(columns.values()))
    np.savetxt(path, table, fmt="%.3f", delimiter=",", header=",".join(columns), comments="")
