"""Where the indenter met the skin."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ..errors import TraceError
from .displacement import BrokenLine, fit_broken_line
from .numerics import Array, average_in_bins, split_at_gaps
from .onset import OnsetPart, find_onset
from .record import MIN_SAMPLES, Trace
from .scatter import Scatter, estimate_scatter


@dataclass(frozen=True)
class TouchDown:
    """Where the indenter met the skin.

    ``uncertainty_mm`` is a standard deviation: the spread that the noise allows, with an exponent and a
    relaxation of the onset that are not known. ``exponent`` is p of its power law.
    ``in_contact_at_start`` says that the record has no slack before the skin, so that the baseline rests on
    the assumption of a zeroed sensor.
    """

    time_s: float
    displacement_mm: float
    uncertainty_mm: float
    exponent: float
    baseline_N: float
    in_contact_at_start: bool


_ONSET_LEVEL = 0.05  # of the peak force: more of the onset is no power law, where a punch comes full on
_LEAST_LEVEL_NOISE = 45.0  # and never less than this many standard deviations of what means of it scatter
_LEAST_TRAVEL = 0.03  # of the way in: a force that jumps before the indenter moves is no onset
_MEANS = 120  # that part as so many means
_BEFORE_SHARE, _BEFORE_MM = 0.2, 1.0  # of the way in; how far before the record the skin may have been met
_BINS = 200
_APPROACH_MM = 0.1  # less of it before the skin is none
_APPROACH = 3.0  # times the onset: more of what came before it says nothing more about it


def find_touch_down(trace: Trace, line: BrokenLine | None = None) -> TouchDown:
    """Where the skin is met, from the shape of the onset of force.

    A flat punch meets a curved limb at a corner first, so the force starts like a power of the depth and any
    threshold is late. Every onset of a power law with memory is compared with the low-force part of loading,
    under noise as correlated as the record shows it to be, and the touch-down is the mean over their
    likelihood (see `onset`).  ``line`` is the displacement's broken line, where it is known already.

    Raises
    ------
    TraceError
        Where the force does not rise on the way in.
    """
    return _from_onset(trace, line or fit_broken_line(trace.time_s, trace.displacement_mm))


def _from_onset(trace: Trace, line: BrokenLine) -> TouchDown:
    time, travel, force = _select_way_in(trace, line)
    moving = int(np.searchsorted(time, line.start_s))
    scatter = estimate_scatter(*split_at_gaps(time, force))
    part = _select_low_force_part(time, travel, force, moving, scatter)
    rough = find_onset(part, scatter)
    scatter, part = _estimate_near(rough.place_mm, time, travel, force, moving)
    onset = find_onset(part, scatter, rough)
    return TouchDown(
        time_s=float(np.interp(onset.place_mm, np.maximum.accumulate(travel), time)),
        displacement_mm=onset.place_mm,
        uncertainty_mm=onset.sd,
        exponent=onset.exponent,
        baseline_N=onset.baseline_N,
        in_contact_at_start=bool(
            onset.place_mm - travel[0] < max(2 * onset.sd, _APPROACH_MM) and moving < MIN_SAMPLES
        ),
    )


def compute_deviation_before(trace: Trace, line: BrokenLine, touch: TouchDown) -> float:
    """How far off (mm, root mean square) a touch-down is that may lie before the start of the record, with a
    sensor that was zeroed in contact."""
    time, travel, force = _select_way_in(trace, line)
    moving = int(np.searchsorted(time, line.start_s))
    scatter, part = _estimate_near(touch.displacement_mm, time, travel, force, moving)
    before = min(_BEFORE_SHARE * float(travel[-1] - travel[0]), _BEFORE_MM)
    onset = find_onset(part, scatter, before_mm=before)
    return float(np.hypot(onset.sd, onset.place_mm - touch.displacement_mm))


def _estimate_near(
    place_mm: float, time: Array, travel: Array, force: Array, moving: int
) -> tuple[Scatter, OnsetPart]:
    """The noise on either side of a touch-down, as the kink in between is none, and the part to look at."""
    met = int(np.searchsorted(travel, place_mm))
    parts = (split_at_gaps(time[side], force[side]) for side in (slice(met), slice(met, None)))
    scatter = estimate_scatter(*(part for side in parts for part in side))
    return scatter, _select_low_force_part(time, travel, force, moving, scatter)


def _select_way_in(trace: Trace, line: BrokenLine) -> tuple[Array, Array, Array]:
    """Time, travel and force of the first way in.

    Counting travel along the fitted line keeps the noise of the displacement sensor out of the abscissa.
    """
    load = trace.time_s <= line.peak_s
    return trace.time_s[load], line(trace.time_s[load]), trace.force_N[load]


def _select_low_force_part(
    time: Array, travel: Array, force: Array, moving: int, scatter: Scatter
) -> OnsetPart:
    """The low-force part of a way in, as means."""
    at, smooth, _ = average_in_bins(np.arange(len(force), dtype=float), force, _BINS)
    base = float(np.median(force[: max(moving, len(force) // 50, 1)]))
    rise = float(smooth.max()) - base
    if rise <= 0.1 * float(np.ptp(smooth)):
        raise TraceError("the force does not rise while the indenter goes in", remedy="check the record")
    noise = scatter.of_means(max(len(force) // len(smooth), 1))
    below = np.flatnonzero(smooth - base < max(_ONSET_LEVEL * rise, _LEAST_LEVEL_NOISE * noise))
    end = min(int(at[below[-1]]) + 1, len(force)) if below.size else MIN_SAMPLES
    goes = int(np.searchsorted(travel, travel[0] + _LEAST_TRAVEL * (travel[-1] - travel[0]), side="right"))
    end = min(max(end, goes, 8), len(force))
    samples = max(end // _MEANS, 1)
    start = end % samples
    t, u, f = (column[start:end].reshape(-1, samples).mean(axis=1) for column in (time, travel, force))
    return OnsetPart(t, u, f, samples, rise)


def touch_down_at(trace: Trace, time_s: float) -> TouchDown:
    """The touch-down at a time that someone states; baseline and uncertainty are those of the onset.

    Raises
    ------
    TraceError
        Where the time does not lie on the way in, or the force does not rise on it.
    """
    line = fit_broken_line(trace.time_s, trace.displacement_mm)
    first, last = float(trace.time_s[0]), line.peak_s
    if not first <= time_s < last:
        raise TraceError(
            f"{time_s:g} s is not on the way in",
            place="touch_down_s",
            remedy=f"give a time from {first:.3f} s to before {last:.3f} s",
        )
    return replace(_from_onset(trace, line), time_s=time_s, displacement_mm=float(line(np.array(time_s))))


def find_depth_at(trace: Trace, line: BrokenLine, touch: TouchDown, force_N: float) -> float:
    """How deep the indenter is when the force first reaches so much, mm."""
    way = (trace.time_s >= touch.time_s) & (trace.time_s <= line.peak_s)
    time, force, _ = average_in_bins(trace.time_s[way], trace.force_N[way] - touch.baseline_N, _BINS)
    first = int(np.argmax(force >= min(force_N, float(force.max()))))
    return max(float(line(time[first])) - touch.displacement_mm, touch.uncertainty_mm)
