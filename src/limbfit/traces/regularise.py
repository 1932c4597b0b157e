"""Smooth curves counted from touch-down.

What is stated to the machine is piecewise straight, what answers is a smoothing spline for each phase: the
force under a stated displacement, the displacement under a stated force.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Self

import numpy as np
from scipy.interpolate import BSpline, make_smoothing_spline
from scipy.linalg import eigh
from scipy.optimize import minimize_scalar

from ..arrays import Array
from ..errors import TraceError
from ..phases import DENSER, MotionPhase, find_boundaries, find_phases, find_way_in, spread
from .displacement import fit_broken_line
from .numerics import average_in_bins, build_cubic_interpolation, compute_rms
from .record import Trace
from .touchdown import TouchDown

_MIN_SAMPLES = 5  # of a part: a spline's
_MIN_CROWDED = 8  # of a hold: fewer, averaged over ever longer runs, are fewer averages than a spline needs
_MAX_BINS = 200  # per part: a smoothing spline of so many averages equals that of all samples
_TIME_TOLERANCE = 1e-9  # of a corner and a point there
_END_WEIGHT = 1e3  # weight of a shared end point, in weights of its whole part
END_SHARE = 0.05  # of the largest force: an indenter that hardly pushes may be anywhere


@dataclass(frozen=True)
class RegularisedCurve:
    """Curves from touch-down: (n,) arrays that start at time 0, displacement 0, force 0.

    ``knots_s`` and ``knots_mm`` are the corners of the displacement; ``phases`` what it does, from touch-down
    on. ``noise_N`` is the standard deviation of what was smoothed away. ``curve`` is the force as the splines
    that it is made of.
    """

    time_s: Array
    displacement_mm: Array
    force_N: Array
    knots_s: Array
    knots_mm: Array
    phases: tuple[MotionPhase, ...]
    noise_N: float
    curve: SmoothCurve = field(repr=False)

    @property
    def peak_index(self) -> int:
        """Index of the largest force."""
        return int(np.argmax(self.force_N))

    @property
    def peak_force_N(self) -> float:
        return float(self.force_N.max())

    @property
    def peak_s(self) -> float:
        """When the first way in ends."""
        last = find_way_in(self.phases)
        assert last is not None  # touch-down lies on it
        return last.end_s

    @property
    def depth_mm(self) -> float:
        return float(self.knots_mm.max())

    @property
    def speed_load_mm_s(self) -> float:
        """Speed of the first loading."""
        return self._speed("load")

    @property
    def speed_unload_mm_s(self) -> float:
        """Speed of the first unloading; nan if nothing was unloaded."""
        return self._speed("unload")

    def _speed(self, kind: str) -> float:
        return next((abs(phase.rate_mm_s) for phase in self.phases if phase.kind == kind), float("nan"))

    def resample(self, points: int) -> Self:
        """The same curves at about ``points`` times (`spread`), every corner among them."""
        time = spread(self.phases, points, self.knots_s)
        displacement, force = self._evaluate(time)
        return replace(self, time_s=time, displacement_mm=displacement, force_N=force)

    def _evaluate(self, time: Array) -> tuple[Array, Array]:
        """Displacement and force at times (n,); a dry indenter cannot pull."""
        return np.interp(time, self.knots_s, self.knots_mm), np.maximum(self.curve(time), 0.0)


def regularise(
    trace: Trace, touch_down: TouchDown, smoothing: float | None = None, peak_s: float | None = None
) -> RegularisedCurve:
    """The record as smooth curves counted from touch-down.

    ``smoothing`` is the penalty on the squared second derivative of force, s^3 (``lam`` of
    ``scipy.interpolate.make_smoothing_spline`` on the samples as recorded); by default generalised
    cross-validation chooses it for each phase. ``peak_s``: when the (first) way in ends, as someone states
    it; found where it is not given. Raises `TraceError` where fewer than 8 samples lie between touch-down and
    the peak, or no smoothing can be chosen, or the way in cannot end where it is stated to.
    """
    line = fit_broken_line(trace.time_s, trace.displacement_mm, peak_s)
    start, end = touch_down.time_s, line.find_return_s(touch_down.displacement_mm)
    knots = np.r_[start, line.times[(line.times > start) & (line.times < end)], end]
    knots_mm = line(knots) - touch_down.displacement_mm
    phases = find_phases(knots - start, knots_mm)
    force = trace.force_N - touch_down.baseline_N
    if ((trace.time_s >= start) & (trace.time_s <= line.peak_s)).sum() < 8:
        raise TraceError("fewer than 8 samples between touch-down and peak", remedy="check the record")
    curve = SmoothCurve(trace.time_s - start, force, phases, smoothing)
    inside = (trace.time_s >= start) & (trace.time_s <= end)
    time = spread(phases, 1000, knots - start)
    return RegularisedCurve(
        time_s=time,
        displacement_mm=np.interp(time, knots - start, knots_mm),
        force_N=np.maximum(curve(time), 0.0),  # a dry indenter cannot pull
        knots_s=knots - start,
        knots_mm=knots_mm,
        phases=phases,
        noise_N=compute_rms(force[inside] - curve(trace.time_s[inside] - start)),
        curve=curve,
    )


def select_sampled_corners(corners: Array, time: Array) -> Array:
    """The corners between which there are samples enough for a spline: a shorter part belongs to its
    neighbour."""
    kept = list(corners)
    k = 0
    while len(kept) > 2 and k < len(kept) - 1:
        if ((time >= kept[k]) & (time <= kept[k + 1])).sum() >= _MIN_SAMPLES:
            k += 1
        else:
            del kept[k + 1 if k + 2 < len(kept) else k]
            k = max(k - 1, 0)
    return np.array(kept)


@dataclass(frozen=True)
class _PhaseClock:
    """Time since a part's start as the part counts it: in a hold slower and slower, as relaxation goes."""

    start_s: float
    end_s: float
    power: float

    def __call__(self, time_s: Array | float) -> Array:
        whole = self.end_s - self.start_s
        share = np.clip((np.asarray(time_s) - self.start_s) / whole, 0.0, 1.0)
        return np.asarray(whole * share ** (1.0 / self.power))


class SmoothCurve:
    """Force over time: smoothing splines per part that meet at the corners; the first starts from zero.

    In holds they are splines of a power of the time since the start of the hold, in which a relaxation is as
    smooth there as later on. Called with times (n,) s from touch-down on, the curve gives forces (n,) N. Once
    the penalties are chosen it is linear in the record: `compute_response` applies the same smoothing to
    another force.
    """

    def __init__(
        self, time: Array, force: Array, phases: Sequence[MotionPhase], smoothing: float | None
    ) -> None:
        self._corners = select_sampled_corners(find_boundaries(phases), time)
        holds = [(phase.start_s, phase.end_s) for phase in phases if phase.kind == "hold"]
        self._clocks: list[_PhaseClock] = []
        self._bins: list[tuple[Array, Array, Array]] = []
        for start, end in pairwise(self._corners):
            is_hold = any(begin < (start + end) / 2 < stop for begin, stop in holds)
            clock = _PhaseClock(start, end, DENSER if is_hold else 1.0)
            part = (time >= start) & (time <= end)
            power = clock.power if part.sum() >= _MIN_CROWDED else 1.0
            self._clocks.append(clock)
            self._bins.append(average_in_bins(clock(time[part]), force[part], _MAX_BINS, power))
        given = [(smoothing, smoothing)] * len(self._bins)
        self._splines, self._penalties = self._fit_splines([averages for _, averages, _ in self._bins], given)

    def __call__(self, at: Array) -> Array:
        return self._evaluate(self._splines, at)

    def compute_response(self, at: Array) -> Array:
        """Compute the matrix (n, n) that smooths a force given at times (n,) s, a cubic in each part.

        That force is averaged over the same times as the samples of the record, and smoothed by as much.
        Straight between, a convex force would be too large everywhere.
        """
        given = []
        for (x, _, _), clock in zip(self._bins, self._clocks):
            near = np.flatnonzero(
                (at >= clock.start_s - _TIME_TOLERANCE) & (at <= clock.end_s + _TIME_TOLERANCE)
            )
            matrix = np.zeros((len(x), len(at)))
            matrix[:, near] = build_cubic_interpolation(x, clock(at[near]))
            given.append(matrix)
        splines, _ = self._fit_splines(given, self._penalties)
        return self._evaluate(splines, at)

    def _evaluate(self, splines: Sequence[BSpline], at: Array) -> Array:
        """At each of the times (n,) the spline of its part (n, ...)."""
        part = np.clip(np.searchsorted(self._corners, at, side="left") - 1, 0, len(splines) - 1)
        values: Array = np.stack([spline(clock(at)) for spline, clock in zip(splines, self._clocks)])
        return values[part, np.arange(len(at))]

    def _fit_splines(
        self, values: list[Array], penalties: Sequence[tuple[float | None, float | None]]
    ) -> tuple[list[BSpline], list[tuple[float, float]]]:
        """Splines of averages (bins of a part, ...) per part; their penalties, free and with ends given."""
        data = [(x, y, w) for (x, _, w), y in zip(self._bins, values)]
        free = [_fit_spline(*d, penalty, {}) for d, (penalty, _) in zip(data, penalties)]
        # The way up to a corner is smooth; the way from it starts with the fastest relaxation, which a spline
        # blunts.
        ends = [np.zeros(values[0].shape[1:])]
        ends += [before(clock(clock.end_s)) for clock, (before, _) in zip(self._clocks, free)]
        pinned = []
        for k, (d, clock, (_, penalty)) in enumerate(zip(data, self._clocks, penalties)):
            own = {0.0: ends[k], clock.end_s - clock.start_s: ends[k + 1]}
            pinned.append(_fit_spline(*d, penalty, own))
        return [spline for spline, _ in pinned], [(f, p) for (_, f), (_, p) in zip(free, pinned)]


def _fit_spline(
    time: Array, values: Array, weight: Array, penalty: float | None, pinned: dict[float, Array]
) -> tuple[BSpline, float]:
    """A smoothing spline of values (n, ...) and its penalty; cross-validation chooses it where it is None."""
    keep = ~np.isin(time, list(pinned))
    x = np.r_[time[keep], list(pinned)]
    y = np.concatenate([values[keep], *(np.asarray(v)[None] for v in pinned.values())])
    w = np.r_[weight[keep], np.full(len(pinned), _END_WEIGHT * weight.sum())]
    order = np.argsort(x)
    x, y, w = x[order], y[order], w[order]
    try:
        chosen = _choose_penalty(x, y, w) if penalty is None else penalty
        return make_smoothing_spline(x, y, w=w, lam=chosen), chosen
    except ValueError:
        what = "cross-validation finds no smoothing for so short or so rough a record"
        raise TraceError(what, remedy="give traces.smoothing in the study") from None


def _choose_penalty(x: Array, y: Array, w: Array) -> float:
    """The penalty by generalised cross-validation, as `make_smoothing_spline` seeks it (to 1e-5), without its
    loops: in the modes of the spline (Green and Silverman 1994, sections 2.3 and 3.3). Raises `ValueError`.
    """
    n, h = len(x), np.diff(x)
    Q = np.diff(np.diff(np.eye(n), axis=0) / h[:, None], axis=0)  # second differences: Q y
    R = np.diag(h[:-1] + h[1:]) / 3 + (np.diag(h[1:-1], 1) + np.diag(h[1:-1], -1)) / 6
    rough, modes = eigh(Q / w @ Q.T, R)
    back, size = (Q / w).T @ modes, modes.T @ (Q @ y)

    def score(penalty: float) -> float:
        share = penalty / (1.0 + penalty * rough)
        return float(np.sum((back @ (share * size)) ** 2) / np.sum(share * rough) ** 2)

    found = minimize_scalar(score, bounds=(0.0, n), method="bounded")
    if not found.success:
        raise ValueError(found.message)
    return float(found.x)


@dataclass(frozen=True)
class Creep(RegularisedCurve):
    """Curves from touch-down under a stated force; they end where it falls below 5 % of its largest.

    ``knots_s`` and ``knots_N`` are the corners of the force, ``knots_mm`` the displacement there; ``phases``
    are those of the force, with the displacements at their ends. ``curve`` is the displacement.
    """

    knots_N: Array

    @property
    def depth_mm(self) -> float:
        return float(self.displacement_mm.max())

    def _evaluate(self, time: Array) -> tuple[Array, Array]:
        return self.curve(time), np.interp(time, self.knots_s, self.knots_N)


def regularise_creep(
    trace: Trace, touch_down: TouchDown, smoothing: float | None = None, peak_s: float | None = None
) -> Creep:
    """A record under a stated force as curves counted from touch-down, as `regularise` with both exchanged.

    ``peak_s``: when the force has first risen, as someone states it; found where it is not given. Raises
    `TraceError` where the force never rises or is no ramps and holds, or no smoothing can be chosen.
    """
    since = trace.time_s - touch_down.time_s
    force = trace.force_N - touch_down.baseline_N
    line = fit_broken_line(trace.time_s, force, peak_s, quantity="force", unit="N")
    end = line.find_return_s(END_SHARE * float(line.values.max())) - touch_down.time_s
    corners = line.times - touch_down.time_s
    knots = np.r_[0.0, corners[(corners > 0.0) & (corners < end)], end]
    knots_N = np.maximum(line(knots + touch_down.time_s), 0.0)
    knots_N[0] = 0.0
    of_force = find_phases(knots, knots_N)
    moved = trace.displacement_mm - touch_down.displacement_mm
    curve = SmoothCurve(since, moved, of_force, smoothing)
    inside = (since >= 0.0) & (since <= end)
    ends = [curve(np.array([phase.start_s, phase.end_s])).tolist() for phase in of_force]
    phases = tuple(replace(phase, start_mm=start, end_mm=end) for phase, (start, end) in zip(of_force, ends))
    time = spread(phases, 1000, knots)
    return Creep(
        time_s=time,
        displacement_mm=curve(time),
        force_N=np.interp(time, knots, knots_N),
        knots_s=knots,
        knots_mm=curve(knots),
        phases=phases,
        noise_N=compute_rms(force[inside] - np.interp(since[inside], knots, knots_N)),
        curve=curve,
        knots_N=knots_N,
    )
