"""What ultrasound elastography reads under the indenter: speeds of shear waves in tissues."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..errors import TraceError
from .formats import TIME
from .numerics import Array
from .reading import read_columns

MAX_POINTS = 20  # of comparison at a place; more readings are averaged
SPEED_M_S = (0.2, 30.0)
_COLUMN = re.compile(r"(?P<tissue>.+?)(?:_(?P<depth>\d+(?:\.\d+)?)mm)?_m_s")


@dataclass(frozen=True)
class WaveSpeeds:
    """Speeds (n,) m/s of shear waves at one place, at times (n,) s of the record; as many as were read.

    ``column`` names the place in its file: the ``tissue``, and its ``depth_mm`` below the skin at rest (None:
    the tissue's middle).
    """

    column: str
    tissue: str
    depth_mm: float | None
    time_s: Array
    speed_m_s: Array

    @property
    def name(self) -> str:
        """Of the place, in files and tables."""
        return self.column.removesuffix("_m_s")

    def means(self, touch_down_s: float, end_s: float) -> WaveMeans:
        """Over at most `MAX_POINTS` spans of time until ``end_s``, counted from touch-down; two before that.

        Raises
        ------
        TraceError
            Where there are not two readings until then.
        """
        before = np.flatnonzero(self.time_s < touch_down_s)
        inside = np.flatnonzero((self.time_s >= touch_down_s) & (self.time_s <= end_s))
        if len(before) + len(inside) < 2:
            raise TraceError(
                f"{len(before) + len(inside)} readings until the indenter lets go ({end_s:.2f} s)",
                place=self.column,
                remedy="give two or more, at times of the record's own clock",
            )
        both = (before, 2), (inside, MAX_POINTS)
        parts = [part for of, most in both if len(of) for part in np.array_split(of, min(len(of), most))]
        time = np.maximum([self.time_s[part].mean() - touch_down_s for part in parts], 0.0)
        speed = np.array([self.speed_m_s[part].mean() for part in parts])
        return WaveMeans(time, speed, np.array([float(len(part)) for part in parts]))


@dataclass(frozen=True)
class WaveMeans:
    """Means (n,) m/s of ``samples`` (n,) readings each, at times (n,) s from touch-down; before it 0."""

    time_s: Array
    speed_m_s: Array
    samples: Array

    def covariance(self, sd_m_s: float, bias_m_s: float) -> Array:
        """Of the means (n, n), m^2/s^2: each reading is off by itself, and all of the place together."""
        return np.diag(sd_m_s**2 / self.samples) + bias_m_s**2


def read_wave_speeds(path: str | Path, time_name: str) -> tuple[WaveSpeeds, ...]:
    """Read a table with a column of times and one for each place, such as ``skin_m_s``, ``muscle_12mm_m_s``.

    A cell may be empty.

    Raises
    ------
    TraceError
        With the file, the column and the remedy.
    """
    file = Path(path)
    columns = read_columns(file, {TIME: time_name}, wanted=lambda name: name.endswith("_m_s"), gaps=True)
    time = columns.pop(time_name)
    if not columns:
        raise TraceError(
            "no speed of a wave", file=file, place="header", remedy="name columns such as muscle_m_s"
        )
    if not np.isfinite(time).all() or np.any(np.diff(time) <= 0.0):
        raise TraceError("time does not increase", file=file, place=time_name, remedy="sort the readings")
    return tuple(_place(file, name, time, values) for name, values in columns.items())


def _place(file: Path, name: str, time: Array, values: Array) -> WaveSpeeds:
    known = _COLUMN.fullmatch(name)
    seen = ~np.isnan(values)
    low, high = SPEED_M_S
    if known is None or not seen.any():
        raise TraceError(
            "no speed is given", file=file, place=name, remedy="fill some of its cells, or take it out"
        )
    if values[seen].min() < low or values[seen].max() > high:
        what = f"{values[seen].min():.3g} to {values[seen].max():.3g} m/s is no soft tissue's speed"
        raise TraceError(
            f"{what} ({low:g} to {high:g})", file=file, place=name, remedy="give metres per second"
        )
    depth = known["depth"]
    return WaveSpeeds(name, known["tissue"], float(depth) if depth else None, time[seen], values[seen])
