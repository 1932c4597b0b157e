"""What ultrasound through the indenter sees: tissues that become thinner from touch-down on."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..errors import TraceError
from .formats import TIME
from .numerics import Array
from .reading import read_columns

SUFFIX = "_mm"
MIN_SAMPLES = 5
MAX_POINTS = 81  # of comparison; more samples are averaged
THICKNESS_MM = (0.2, 200.0)


@dataclass(frozen=True)
class Layers:
    """Thickness (n,) mm of tissues under the indenter, by name, at times (n,) s of the record."""

    time_s: Array
    thickness_mm: Mapping[str, Array]


@dataclass(frozen=True)
class Thinning:
    """How much thinner a tissue is than at rest, from touch-down on.

    ``time_s``, ``compression_mm`` (n,) are means of ``samples`` (n,) readings each, whose standard deviation
    is ``sd_mm``; the thickness at rest is the mean of ``before`` readings, an error that all share.
    """

    tissue: str
    thickness_mm: float
    time_s: Array
    compression_mm: Array
    samples: Array
    before: int
    sd_mm: float

    @property
    def covariance(self) -> Array:
        """Of the compressions (n, n) by the readings' noise, mm^2."""
        variance = self.sd_mm**2
        return np.diag(variance / self.samples) + variance / self.before

    @property
    def is_seen(self) -> bool:
        """Whether the tissue gives way by more than three deviations of what is compared."""
        return bool(self.compression_mm.max() > 3.0 * np.sqrt(np.diag(self.covariance).mean()))


def read_layers(path: str | Path, time_name: str) -> Layers:
    """Read a table with a column of times and, for each tissue, a column such as ``muscle_mm``.

    Raises
    ------
    TraceError
        With the file, the column and the remedy.
    """
    file = Path(path)
    columns = read_columns(file, {TIME: time_name}, wanted=lambda name: name.endswith(SUFFIX))
    time = columns.pop(time_name)
    if not columns:
        raise TraceError(
            "no thickness of a tissue", file=file, place="header", remedy="name columns such as muscle_mm"
        )
    if np.any(np.diff(time) <= 0.0):
        raise TraceError("time does not increase", file=file, place=time_name, remedy="sort the samples")
    for name, values in columns.items():
        bad = np.flatnonzero(~np.isfinite(values))
        if bad.size:
            raise TraceError(f"{values[bad[0]]} in sample {bad[0] + 1}", file=file, place=name)
        low, high = THICKNESS_MM
        if values.min() < low or values.max() > high:
            what = f"{values.min():.3g} to {values.max():.3g} mm is no tissue's thickness"
            raise TraceError(
                f"{what} ({low:g} to {high:g})", file=file, place=name, remedy="give millimetres"
            )
    return Layers(time, {name.removesuffix(SUFFIX): values for name, values in columns.items()})


def compute_thinnings(
    layers: Layers, touch_down_s: float, end_s: float, sd_mm: float
) -> tuple[Thinning, ...]:
    """How each tissue gives way between touch-down and ``end_s``, times of the record.

    The thickness at rest is the mean of all readings before touch-down.

    Raises
    ------
    TraceError
        Where there is none, or hardly any reading in contact.
    """
    before = layers.time_s < touch_down_s
    inside = np.flatnonzero((layers.time_s >= touch_down_s) & (layers.time_s <= end_s))
    if not before.any():
        raise TraceError(
            "no reading before touch-down, so the thickness at rest is not known",
            remedy="start the ultrasound before the indenter, on the same clock",
        )
    if len(inside) < MIN_SAMPLES:
        raise TraceError(
            f"only {len(inside)} readings in contact",
            remedy=f"give at least {MIN_SAMPLES}, at times of the record's own clock",
        )
    parts = np.array_split(inside, min(len(inside), MAX_POINTS))
    samples = np.array([float(len(part)) for part in parts])
    time = np.array([layers.time_s[part].mean() for part in parts]) - touch_down_s
    found = []
    for tissue, values in layers.thickness_mm.items():
        rest = float(values[before].mean())
        lost = rest - np.array([values[part].mean() for part in parts])
        found.append(Thinning(tissue, rest, time, lost, samples, int(before.sum()), sd_mm))
    return tuple(found)
