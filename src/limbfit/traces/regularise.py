"""Smooth curves counted from touch-down."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import BSpline, make_smoothing_spline

from ..errors import TraceError
from .displacement import BrokenLine, broken_line
from .numerics import Array, bins, rms
from .record import Trace
from .touchdown import TouchDown


@dataclass(frozen=True)
class Regularised:
    """Curves from touch-down: (n,) arrays that start at time 0, displacement 0, force 0.

    ``knots_s`` and ``knots_mm`` are the corners of the displacement (start, peak, end; more for a hold or a
    speed that changes); ``corners_s`` are the ends of the parts that were smoothed apart. ``noise_N`` and
    ``noise_mm`` are standard deviations of what was smoothed away. ``speed_unload_mm_s`` is nan where nothing
    was unloaded.
    """

    time_s: Array
    displacement_mm: Array
    force_N: Array
    knots_s: Array
    knots_mm: Array
    corners_s: Array
    noise_N: float
    noise_mm: float
    speed_load_mm_s: float
    speed_unload_mm_s: float

    @property
    def peak_index(self) -> int:
        """Index of the largest force."""
        return int(np.argmax(self.force_N))

    @property
    def peak_force_N(self) -> float:
        return float(self.force_N.max())

    @property
    def depth_mm(self) -> float:
        return float(self.knots_mm.max())

    def resample(self, points: int) -> Regularised:
        """The same curves at about ``points`` times, spread evenly in time, every corner among them."""
        time = _grid(np.union1d(self.corners_s, self.knots_s), points)
        return Regularised(
            time,
            np.interp(time, self.knots_s, self.knots_mm),
            np.interp(time, self.time_s, self.force_N),
            self.knots_s,
            self.knots_mm,
            self.corners_s,
            self.noise_N,
            self.noise_mm,
            self.speed_load_mm_s,
            self.speed_unload_mm_s,
        )


_BINS = 200  # per part: a smoothing spline of so many averages equals that of all samples
_PINNED = 1e3  # weight of a shared end point, in weights of its whole part


def regularise(
    trace: Trace, touch_down: TouchDown, smoothing: float | None = None, peak_s: float | None = None
) -> Regularised:
    """The record as smooth curves counted from touch-down.

    Parameters
    ----------
    smoothing : penalty on the squared second derivative of force, s^3 (``lam`` of
        ``scipy.interpolate.make_smoothing_spline`` on the samples as recorded); by default generalised
        cross-validation chooses it for loading and unloading each.
    peak_s : when the way in ends, as someone states it; found where it is not given.

    Raises
    ------
    TraceError
        Where fewer than 8 samples lie between touch-down and the peak, or no smoothing can be chosen, or
        the way in cannot end where it is stated to.
    """
    line = broken_line(trace.time_s, trace.displacement_mm, peak_s)
    start = touch_down.time_s
    corners = _corners(line, start, touch_down.displacement_mm)
    force = trace.force_N - touch_down.baseline_N
    parts = [(trace.time_s >= a) & (trace.time_s <= b) for a, b in pairwise(corners)]
    if parts[0].sum() < 8:
        raise TraceError("fewer than 8 samples between touch-down and peak", remedy="check the record")
    curve = _smooth_force(trace.time_s, force, parts, corners, smoothing)
    inside = (trace.time_s >= start) & (trace.time_s <= corners[-1])
    knots = np.union1d(corners, line.times[(line.times > start) & (line.times < corners[-1])])
    knots_mm = line(knots) - touch_down.displacement_mm
    time = _grid(knots, 1000)
    speeds = np.diff(line(corners)) / np.diff(corners)
    return Regularised(
        time_s=time - start,
        displacement_mm=np.interp(time, knots, knots_mm),
        force_N=np.maximum(curve(time), 0.0),  # a dry indenter cannot pull
        knots_s=knots - start,
        knots_mm=knots_mm,
        corners_s=corners - start,
        noise_N=rms(force[inside] - curve(trace.time_s[inside])),
        noise_mm=rms(trace.displacement_mm[inside] - line(trace.time_s[inside])),
        speed_load_mm_s=float(speeds[0]),
        speed_unload_mm_s=float(-speeds[-1]) if line.unloads else float("nan"),
    )


def _corners(line: BrokenLine, start: float, touch_mm: float) -> Array:
    """Touch-down, end of loading, start of unloading after a hold, and lift-off or the end of the record."""
    corners = [start, line.peak_s]
    if line.unload_s > line.peak_s:
        corners.append(line.unload_s)
    if line.unloads:
        corners.append(line.time_at(touch_mm, back=True))
    return np.array(corners)


def _smooth_force(
    time: Array, force: Array, parts: list[NDArray[np.bool_]], corners: Array, smoothing: float | None
) -> Callable[[Array], Array]:
    """Splines per part that meet at the corners; the first starts from zero at touch-down."""
    data = [bins(time[part], force[part], _BINS) for part in parts if part.sum() >= 5]
    corners = corners[: len(data) + 1]
    free = [_spline(*d, smoothing, {}) for d in data]
    shared = {float(corners[0]): 0.0}
    # The way up to a corner is smooth; the way from it starts with the fastest relaxation, which a spline
    # blunts.
    shared |= {float(at): float(before(at)) for at, before in zip(corners[1:], free)}
    splines = []
    for k, d in enumerate(data):
        ends = {float(c): shared[float(c)] for c in corners[k : k + 2]}
        splines.append(_spline(*d, smoothing, ends))

    def curve(at: Array) -> Array:
        part = np.clip(np.searchsorted(corners, at, side="left") - 1, 0, len(splines) - 1)
        return np.choose(part, [spline(at) for spline in splines])

    return curve


def _spline(time: Array, force: Array, weight: Array, smoothing: float | None, pinned: dict) -> BSpline:
    keep = ~np.isin(time, list(pinned))
    x = np.r_[time[keep], list(pinned)]
    y = np.r_[force[keep], list(pinned.values())]
    w = np.r_[weight[keep], np.full(len(pinned), _PINNED * weight.sum())]
    order = np.argsort(x)
    try:
        return make_smoothing_spline(x[order], y[order], w=w[order], lam=smoothing)
    except ValueError:
        what = "cross-validation finds no smoothing for so short or so rough a record"
        raise TraceError(what, remedy="give traces.smoothing in the study") from None


def _grid(corners: Array, points: int) -> Array:
    """About ``points`` times, evenly spread between the corners in proportion, corners included."""
    share = np.maximum(np.round((points - 1) * np.diff(corners) / np.ptp(corners)).astype(int), 2)
    pieces = [np.linspace(a, b, n + 1)[:-1] for (a, b), n in zip(pairwise(corners), share)]
    return np.r_[np.concatenate(pieces), corners[-1]]
