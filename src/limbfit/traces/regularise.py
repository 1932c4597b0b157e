"""Smooth curves counted from touch-down."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
from scipy.interpolate import BSpline, make_smoothing_spline

from ..errors import TraceError
from .displacement import BrokenLine, broken_line
from .numerics import Array, Bools, bins, rms, straight
from .record import Trace
from .touchdown import TouchDown


@dataclass(frozen=True)
class Regularised:
    """Curves from touch-down: (n,) arrays that start at time 0, displacement 0, force 0.

    ``knots_s`` and ``knots_mm`` are the corners of the displacement (start, peak, end; more for a hold or a
    speed that changes); ``corners_s`` are the ends of the parts that were smoothed apart. ``noise_N`` and
    ``noise_mm`` are standard deviations of what was smoothed away. ``speed_unload_mm_s`` is nan where nothing
    was unloaded. ``curve`` is the force as the splines that it is made of.
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
    curve: SmoothCurve = field(repr=False)

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
            self.curve,
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
    curve = SmoothCurve(trace.time_s - start, force, parts, corners - start, smoothing)
    inside = (trace.time_s >= start) & (trace.time_s <= corners[-1])
    knots = np.union1d(corners, line.times[(line.times > start) & (line.times < corners[-1])])
    knots_mm = line(knots) - touch_down.displacement_mm
    time = _grid(knots, 1000)
    speeds = np.diff(line(corners)) / np.diff(corners)
    return Regularised(
        time_s=time - start,
        displacement_mm=np.interp(time, knots, knots_mm),
        force_N=np.maximum(curve(time - start), 0.0),  # a dry indenter cannot pull
        knots_s=knots - start,
        knots_mm=knots_mm,
        corners_s=corners - start,
        noise_N=rms(force[inside] - curve(trace.time_s[inside] - start)),
        noise_mm=rms(trace.displacement_mm[inside] - line(trace.time_s[inside])),
        speed_load_mm_s=float(speeds[0]),
        speed_unload_mm_s=float(-speeds[-1]) if line.unloads else float("nan"),
        curve=curve,
    )


def _corners(line: BrokenLine, start: float, touch_mm: float) -> Array:
    """Touch-down, end of loading, start of unloading after a hold, and lift-off or the end of the record."""
    corners = [start, line.peak_s]
    if line.unload_s > line.peak_s:
        corners.append(line.unload_s)
    if line.unloads:
        corners.append(line.time_at(touch_mm, back=True))
    return np.array(corners)


class SmoothCurve:
    """Force over time: smoothing splines per part that meet at the corners; the first starts from zero.

    Called with times (n,) s from touch-down on it gives forces (n,) N.  Once the penalties are chosen it is
    linear in the record: ``response`` says what the same smoothing makes of another force.
    """

    def __init__(
        self, time: Array, force: Array, parts: list[Bools], corners: Array, smoothing: float | None
    ) -> None:
        self._bins = [bins(time[part], force[part], _BINS) for part in parts if part.sum() >= 5]
        self._corners = corners[: len(self._bins) + 1]
        given = [(smoothing, smoothing)] * len(self._bins)
        self._splines, self._penalties = self._fitted([averages for _, averages, _ in self._bins], given)

    def __call__(self, at: Array) -> Array:
        return self._joined(self._splines, at)

    def response(self, at: Array) -> Array:
        """What smoothing makes of a force given at times (n,) s, straight between: a matrix (n, n).

        That force is averaged over the same times as the samples of the record, and smoothed by as much.
        """
        given = [straight(x, at) for x, _, _ in self._bins]
        splines, _ = self._fitted(given, self._penalties)
        return self._joined(splines, at)

    def _joined(self, splines: Sequence[BSpline], at: Array) -> Array:
        """At each of the times (n,) the spline of its part (n, ...)."""
        part = np.clip(np.searchsorted(self._corners, at, side="left") - 1, 0, len(splines) - 1)
        values: Array = np.stack([spline(at) for spline in splines])
        return values[part, np.arange(len(at))]

    def _fitted(
        self, values: list[Array], penalties: Sequence[tuple[float | None, float | None]]
    ) -> tuple[list[BSpline], list[tuple[float, float]]]:
        """Splines of averages (bins of a part, ...) per part; their penalties, free and with ends given."""
        data = [(x, y, w) for (x, _, w), y in zip(self._bins, values)]
        free = [_spline(*d, penalty, {}) for d, (penalty, _) in zip(data, penalties)]
        ends = dict.fromkeys(map(float, self._corners), np.zeros(values[0].shape[1:]))
        # The way up to a corner is smooth; the way from it starts with the fastest relaxation, which a spline
        # blunts.
        ends |= {float(at): before(at) for at, (before, _) in zip(self._corners[1:], free)}
        pinned = []
        for k, (d, (_, penalty)) in enumerate(zip(data, penalties)):
            own = {float(c): ends[float(c)] for c in self._corners[k : k + 2]}
            pinned.append(_spline(*d, penalty, own))
        return [spline for spline, _ in pinned], [(f, p) for (_, f), (_, p) in zip(free, pinned)]


def _spline(
    time: Array, values: Array, weight: Array, penalty: float | None, pinned: dict[float, Array]
) -> tuple[BSpline, float]:
    """A smoothing spline of values (n, ...) and its penalty; cross-validation chooses it where it is None."""
    keep = ~np.isin(time, list(pinned))
    x = np.r_[time[keep], list(pinned)]
    y = np.concatenate([values[keep], *(np.asarray(v)[None] for v in pinned.values())])
    w = np.r_[weight[keep], np.full(len(pinned), _PINNED * weight.sum())]
    order = np.argsort(x)
    x, y, w = x[order], y[order], w[order]
    try:
        spline = make_smoothing_spline(x, y, w=w, lam=penalty)
    except ValueError:
        what = "cross-validation finds no smoothing for so short or so rough a record"
        raise TraceError(what, remedy="give traces.smoothing in the study") from None
    return spline, _penalty(spline, x, y, w) if penalty is None else penalty


def _penalty(spline: BSpline, x: Array, y: Array, w: Array) -> float:
    """The penalty of a smoothing spline: what makes its misfit and its roughness stationary along itself."""
    bend = spline.derivative(2)(x)
    rough = float(np.sum(np.diff(x) * (bend[1:] ** 2 + bend[1:] * bend[:-1] + bend[:-1] ** 2))) / 3.0
    smooth = spline(x)
    return max(float(np.sum(w * smooth * (y - smooth))), 0.0) / max(rough, 1e-300)


def _grid(corners: Array, points: int) -> Array:
    """About ``points`` times, evenly spread between the corners in proportion, corners included."""
    share = np.maximum(np.round((points - 1) * np.diff(corners) / np.ptp(corners)).astype(int), 2)
    pieces = [np.linspace(a, b, n + 1)[:-1] for (a, b), n in zip(pairwise(corners), share)]
    return np.r_[np.concatenate(pieces), corners[-1]]
