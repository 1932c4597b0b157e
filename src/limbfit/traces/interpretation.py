"""A record is mended where that is safe, and refused where it cannot be used, before it is regularised.

Rows that are there twice are left out, rounded times are spread, single samples that stick out are replaced
by their neighbours' line, a force that drifts is set straight by what the sensor says clear of the skin, and
a record that begins in contact is refused, because nobody knows where its skin was met. Warnings say what was
done, and what the user should know (`faults`); the touch-down's deviation counts it.
"""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.ndimage import median_filter

from ..arrays import Array, Mask
from ..errors import TraceError
from . import faults
from .displacement import BrokenLine, fit_broken_line
from .numerics import average_in_bins, estimate_noise, estimate_noise_level, find_resolution, find_runs
from .record import Trace, TraceWarning, measure_start_force
from .touchdown import TouchDown, compute_deviation_before, find_depth_at, find_touch_down, touch_down_at

_SPIKE_WIDTH = 2  # samples; what lasts longer may have happened
_SPIKE_NOISE = 8.0  # standard deviations
_SPIKE_STEPS = 6.0  # times the usual step between the samples around it: a corner is no spike
_SPIKE_RESOLUTION = 2.5  # steps in which the values come
_SPIKE_SHARE = 0.02  # of the range: less does no harm
_MAX_SPIKES = 0.01  # of the samples; one spike is allowed in a short record, too
_NEIGHBOURS = 4  # samples on either side
_CLEAR_MM = 0.1  # and two standard deviations of touch-down: off the skin
_MIN_CLEAR = 20  # samples
_DRIFT_SHARE = 0.01  # of the peak force, over the record: less does no harm
_DRIFT_SD = 5.0
_FADING_TIMES = (0.05, 0.1, 0.2, 0.4, 0.8)  # of the record: times with which a warming may fade
_MAX_EXCESS = 16.0  # of squared misfit in variances, by which a straight drift is worse
_ONSET_S = 0.5
_STEP_SPAN_S = 0.1
_MAX_DRIFT = 0.3  # of the peak force: more is no sensor to correct
_PRELOAD_SHARE = 0.05  # of the peak force
_START_FORCE_SHARE = 0.25  # of the peak force, where there are too few samples for a slope
_START_SHARES = (0.03, 0.06, 0.12, 0.25)  # of the travel
_CHANCE_SD = 4.0  # standard deviations that the first and the least of all bins may be apart
_SLOPE_SD = 2.0  # standard deviations
_START_SLOPE = 0.25  # of the mean slope of the way in
_MIN_START = 8  # samples
_RISE_SHARE = 0.5  # of its rise: the part in which a stated force meets the skin
_MAX_BINS = 200


@dataclass(frozen=True)
class InterpretedRecord:
    """A record as it is used, where its skin is met, and what to know about it."""

    trace: Trace
    touch_down: TouchDown
    warnings: tuple[TraceWarning, ...]


def interpret_record(
    trace: Trace, touch_down_s: float | None = None, *, forced: bool = False
) -> InterpretedRecord:
    """Mend a record and find its touch-down, unless ``touch_down_s`` states it.

    ``forced``: a force was stated to the machine, not a displacement. Raises `TraceError` where it begins in
    contact, where more than 1 % of its samples stick out, where its force drifts by more than 30 % of the
    peak, or as `find_touch_down` and `touch_down_at` do.
    """
    trace, doubled = faults.mend_times(trace)
    trace, spikes = _remove_spikes(trace)
    line = fit_broken_line(trace.time_s, trace.displacement_mm)
    _check_start(trace, line)
    rise, gaps = _compute_rise(trace), faults.find_gaps(trace, line)
    frozen = [] if forced else faults.find_frozen(trace, line, rise)
    lost = gaps + [(float(trace.time_s[run.start]), float(trace.time_s[run.stop - 1])) for run in frozen]
    steps = [] if forced else faults.find_steps(trace, line, rise, lost)
    level = _remove_steps(trace, steps) if steps else _level_ends(trace, line)
    touch = _find_touch_down(level, line, touch_down_s, forced)
    straight, drift = (trace, []) if steps else _remove_drift(trace, level, line, touch)
    if straight is not level and not steps:
        touch = _find_touch_down(straight, line, touch_down_s, forced)
    warnings = [
        *doubled,
        *spikes,
        *faults.find_coarse_steps(trace, line, touch, rise),
        *faults.report_gaps(gaps, line, touch.time_s),
        *faults.report_frozen_force(trace, frozen, line, touch.time_s),
        *faults.report_steps(steps),
        *drift,
        *([] if forced else _find_impassive_force(straight, line, touch, rise, lost, steps)),
        *([] if touch_down_s is not None else _report_start(straight, line, touch, forced)),
    ]
    added = [warning.evidence.get("adds_sd_mm", 0.0) for warning in warnings]
    wide = float(np.linalg.norm([touch.uncertainty_mm, *added]))
    return InterpretedRecord(straight, replace(touch, uncertainty_mm=wide), tuple(warnings))


def _find_impassive_force(
    trace: Trace,
    line: BrokenLine,
    touch: TouchDown,
    rise_N: float,
    lost: list[tuple[float, float]],
    steps: list[tuple[float, float]],
) -> list[TraceWarning]:
    """Warn of forces that no passive tissue gives, each sought where no other warning explains it."""
    at_top = faults.find_saturation(trace, line, rise_N, lost)
    if at_top:
        return at_top
    way_in = (trace.time_s <= line.peak_s) & (trace.time_s >= touch.time_s)
    sample_noise = estimate_noise(trace.force_N[trace.time_s < touch.time_s], trace.force_N[way_in])
    stepped = [at for at, _ in steps]
    swing = [] if lost else faults.find_swings(trace, line, touch, sample_noise, rise_N, stepped)
    odd = [*lost, *((at, at) for at in stepped)]
    return [*swing, *faults.find_lag(trace, line, touch, sample_noise, odd)]


def _find_touch_down(trace: Trace, line: BrokenLine, touch_down_s: float | None, forced: bool) -> TouchDown:
    """Find the touch-down; under a stated force from the rise alone, as depths creep far beyond the skin."""
    if touch_down_s is not None:
        return touch_down_at(trace, touch_down_s)
    if not forced:
        return find_touch_down(trace, line)
    risen = trace.force_N - measure_start_force(trace)
    most = max(int(np.argmax(risen >= _RISE_SHARE * risen.max())), 2)
    return find_touch_down(trace.select(slice(most)))


def _remove_spikes(trace: Trace) -> tuple[Trace, list[TraceWarning]]:
    warnings = []
    for column, quantity, unit in (("force_N", "force", "N"), ("displacement_mm", "displacement", "mm")):
        values: Array = getattr(trace, column)
        spikes = _find_spikes(values)
        count = int(spikes.sum())
        if not count:
            continue
        if count > max(_SPIKE_WIDTH, _MAX_SPIKES * len(values)):
            what = f"{count} of {len(values)} samples stick out from their neighbours"
            raise TraceError(what, place=column, remedy="check the sensor and its cable, and record again")
        mended = values.copy()
        mended[spikes] = np.interp(trace.time_s[spikes], trace.time_s[~spikes], values[~spikes])
        largest = float(np.abs(values - mended).max())
        change: dict[str, Any] = {column: mended}
        trace = replace(trace, **change)
        what = (
            f"{count} of {len(values)} samples of the {quantity} stick out by up to {largest:.2g} {unit} and "
            "were replaced"
        )
        numbers = {"spikes": float(count), f"largest_{unit}": largest}
        cause = "a loose contact or a disturbance"
        warnings.append(TraceWarning("spikes", what, cause, "check the cable", numbers))
    return trace, warnings


def _find_spikes(values: Array) -> Mask:
    """Find the samples (n,) that stick out from the median of their neighbours, one or two in a row."""
    off = values - median_filter(values, 2 * _SPIKE_WIDTH + 1, mode="mirror")
    noise = max(1.4826 * float(np.median(np.abs(off))), estimate_noise_level(values))
    share = _SPIKE_SHARE * float(np.ptp(np.percentile(values, [1, 99])))
    out = np.abs(off) > max(_SPIKE_NOISE * noise, share, _SPIKE_RESOLUTION * find_resolution(values))
    steps = np.abs(np.diff(values))
    for i in np.flatnonzero(out):
        before, after = steps[max(i - 1 - _NEIGHBOURS, 0) : max(i - 1, 0)], steps[i + 2 : i + 2 + _NEIGHBOURS]
        out[i] = abs(off[i]) > _SPIKE_STEPS * np.median(np.r_[before, after])
    for start, end in find_runs(out):
        if end - start > _SPIKE_WIDTH:
            out[start:end] = False
    return np.asarray(out, dtype=bool)


def _remove_steps(trace: Trace, steps: list[tuple[float, float]]) -> Trace:
    """Remove the jumps of the force, so that the onset is seen whichever side of a jump is right."""
    force = trace.force_N.copy()
    for at, size in steps:
        change = np.diff(np.interp([at - _STEP_SPAN_S, at + _STEP_SPAN_S], trace.time_s, trace.force_N))[0]
        if change / size > 0.5:  # one that lasts, not a dropout
            force -= size * (trace.time_s >= at)
    return replace(trace, force_N=force)


def _find_ends(trace: Trace, line: BrokenLine) -> tuple[Mask, Mask]:
    """Find samples (n,) before the way in and after the last way out, with the indenter where it began."""
    back = line(trace.time_s) < line.values[0] + _CLEAR_MM
    return back & (trace.time_s < line.peak_s), back & (trace.time_s > _find_release_s(line))


def _level_ends(trace: Trace, line: BrokenLine) -> Trace:
    """Remove the straight line from start to end of a record whose indenter is back where it began.

    Only there a drift shows before the touch-down is known: near the skin it looks like an onset.
    """
    before, after = _find_ends(trace, line)
    if min(before.sum(), after.sum()) < _MIN_CLEAR:
        return trace
    change = float(np.median(trace.force_N[after]) - np.median(trace.force_N[before]))
    if abs(change) < _DRIFT_SHARE * _compute_rise(trace):
        return trace
    slope = change / float(trace.time_s[after].mean() - trace.time_s[before].mean())
    return replace(trace, force_N=trace.force_N - slope * (trace.time_s - trace.time_s[0]))


def _find_release_s(line: BrokenLine) -> float:
    """Find when the last way out begins, s; infinite if there is none."""
    return max((phase.start_s for phase in line.phases if phase.kind == "unload"), default=float("inf"))


def _remove_drift(
    trace: Trace, level: Trace, line: BrokenLine, touch: TouchDown
) -> tuple[Trace, list[TraceWarning]]:
    """Remove the drift of the force: a straight line, or a warming that fades where no straight line fits."""
    margin = max(_CLEAR_MM, 2 * touch.uncertainty_mm)
    # Surely off the skin: the approach, the end, and what is between cycles.
    clear = np.asarray(line(trace.time_s) < touch.displacement_mm - margin)
    fallen = level.force_N[-1] > trace.force_N[-1]
    # A record that starts in contact and has fallen shows what it was zeroed under.
    if level is not trace and not (touch.in_contact_at_start and fallen):
        clear |= np.logical_or(*_find_ends(trace, line))
    if clear.sum() < _MIN_CLEAR:
        return trace, []
    time, force = trace.time_s[clear], trace.force_N[clear]
    start_force, slope = map(float, np.polynomial.polynomial.polyfit(time - time[0], force, 1))
    residual = force - start_force - slope * (time - time[0])
    sample_noise = estimate_noise(*np.split(residual, np.flatnonzero(np.diff(np.flatnonzero(clear)) > 1) + 1))
    spread = float(np.sqrt(np.sum((time - time.mean()) ** 2)))
    noise = sample_noise.sd_N * float(np.sqrt((1 + sample_noise.lag) / (1 - sample_noise.lag)))
    sd = noise / spread
    peak = _compute_rise(trace)
    total = slope * float(np.ptp(trace.time_s))
    if abs(slope) < _DRIFT_SD * sd or abs(total) < _DRIFT_SHARE * peak:
        return trace, []
    what = f"the force drifts by {slope:+.2g} N/s clear of the skin, {total:+.2g} N over the record"
    if abs(total) > _MAX_DRIFT * peak:
        what = f"{what}, against a peak of {peak:.3g} N"
        raise TraceError(what, place="force_N", remedy="let the sensor warm up, zero it, and record again")
    numbers = {"drift_N_per_s": slope, "drift_sd_N_per_s": sd, "drift_N": total}
    shapes, misfits = _fit_drifts(time, force, trace.time_s)
    excess = (misfits - misfits.min()) / noise**2
    weights = np.exp(-0.5 * excess) / np.exp(-0.5 * excess).sum()
    drift = shapes[0]
    if excess[0] > _MAX_EXCESS:
        drift = shapes[int(np.argmin(misfits))]
        first, last = np.diff(drift)[[0, -1]] / np.diff(trace.time_s)[[0, -1]]
        what += f", and not along a straight line ({first:+.2g} N/s at its start, {last:+.2g} at its end)"
        numbers |= {"drift_start_N_per_s": float(first), "drift_end_N_per_s": float(last)}
    numbers["adds_sd_mm"] = _compute_drift_sd(trace, line, touch, shapes - drift, weights)
    straight = replace(trace, force_N=trace.force_N - (drift - drift[0]))
    remedy = "let the sensor warm up before recording"
    return straight, [TraceWarning("drift", what + "; taken off", "a sensor that warms up", remedy, numbers)]


def _fit_drifts(time: Array, force: Array, at: Array) -> tuple[Array, Array]:
    """Fit a straight drift, and drifts that fade with each of `_FADING_TIMES`, to what is clear of the skin.

    Returns their forces (k, n) at times (n,) s, and their squared misfits (k,).
    """
    shapes, misfits = [], []
    whole = float(np.ptp(at))
    for fading in (np.inf, *(share * whole for share in _FADING_TIMES)):

        def shape(t: Array, fading: float = fading) -> Array:
            return t - at[0] if np.isinf(fading) else -np.expm1(-(t - at[0]) / fading)

        basis = np.stack([np.ones_like(time), shape(time)], axis=1)
        (level, size), *_ = np.linalg.lstsq(basis, force, rcond=None)
        shapes.append(level + size * shape(at))
        misfits.append(float(np.sum((force - basis @ [level, size]) ** 2)))
    return np.array(shapes), np.array(misfits)


def _compute_drift_sd(
    trace: Trace, line: BrokenLine, touch: TouchDown, others: Array, weights: Array
) -> float:
    """Compute the deviation of the touch-down, mm, if the drift has one of the other shapes (k, n).

    ``weights`` (k,) are their probabilities. The deviation is the depth at which the force reaches what these
    shapes leave between the onset and the level before it.
    """
    met = int(np.searchsorted(trace.time_s, touch.time_s))
    deep = min(int(np.searchsorted(trace.time_s, touch.time_s + _ONSET_S)), len(trace.time_s) - 1)
    change = others[:, deep] - others[:, : met + 1].mean(axis=1)
    rms = float(np.sqrt(weights @ change**2))
    return max(find_depth_at(trace, line, touch, rms) - touch.uncertainty_mm, 0.0)


def _compute_rise(trace: Trace) -> float:
    _, force, _ = average_in_bins(trace.time_s, trace.force_N, _MAX_BINS)
    return float(np.ptp(force))


def _check_start(trace: Trace, line: BrokenLine) -> None:
    """Refuse a record whose force is there from the first sample on, and rises at once."""
    _, force, count = average_in_bins(trace.time_s, trace.force_N, _MAX_BINS)
    peak, first, least = float(force.max()), float(force[0]), float(force.min())
    # Once released, the sensor says what its zero is; else it is taken to be zeroed.
    released = np.isfinite(_find_release_s(line))
    noise = estimate_noise_level(trace.force_N)
    by_chance = _CHANCE_SD * noise / float(np.sqrt(count.min()))
    preload = max(first, first - least if released else 0.0) - by_chance
    if preload < _PRELOAD_SHARE * peak or not _is_rising_at_once(trace, line, noise):
        return
    zeroed = f", and {least:.3g} N when it is released" if released else ""
    what = f"the record begins in contact: {first:.3g} N of {peak:.3g} N in its first samples{zeroed}"
    raise TraceError(what, place="force_N", remedy="zero the sensor clear of the skin, and start there")


def _is_rising_at_once(trace: Trace, line: BrokenLine, noise: float) -> bool:
    """True if the force rises over the first bit of travel about as it does on the whole way in.

    The bit is longer where ``noise`` (N, of a sample) would hide that.
    """
    load = (trace.time_s >= line.start_s) & (trace.time_s <= line.peak_s)
    travel, force = line(trace.time_s[load]), trace.force_N[load]
    way = travel[-1] - travel[0]
    least = _START_SLOPE * (force[-1] - force[0]) / way
    if (travel < travel[0] + _START_SHARES[0] * way).sum() < _MIN_START:
        return bool(force[0] > _START_FORCE_SHARE * force.max())
    for share in _START_SHARES:
        bit = travel < travel[0] + share * way
        slope = float(np.polynomial.polynomial.polyfit(travel[bit], force[bit], 1)[1])
        doubt = _SLOPE_SD * noise / float(np.linalg.norm(travel[bit] - travel[bit].mean()))
        if doubt < least:
            break
    return slope - doubt > least


def _report_start(trace: Trace, line: BrokenLine, touch: TouchDown, forced: bool) -> list[TraceWarning]:
    """Warn of a record without an approach: its skin may have been met before, and the sensor zeroed."""
    if not touch.in_contact_at_start:
        return []
    what = (
        f"no approach is seen before the skin is met after {touch.displacement_mm:.2f} +- "
        f"{touch.uncertainty_mm:.2f} mm: the touch-down rests on a sensor that was zero at the start"
    )
    numbers = {"touch_down_mm": touch.displacement_mm, "touch_down_sd_mm": touch.uncertainty_mm}
    _, force, count = average_in_bins(trace.time_s, trace.force_N, _MAX_BINS)
    preload = touch.baseline_N - float(force.min())
    by_chance = _CHANCE_SD * estimate_noise_level(trace.force_N) / float(np.sqrt(count.min()))
    pressed = preload > max(by_chance, _DRIFT_SHARE * _compute_rise(trace))
    if pressed:
        what += f"; drawn back it shows {preload:.2g} N less, as if it had been zeroed in contact"
        numbers["preload_N"] = preload
    if not forced and (pressed or line.values[-1] > line.values[0] - _CLEAR_MM):
        numbers["adds_sd_mm"] = compute_deviation_before(trace, line, touch)
    cause = "a record that starts on the skin"
    return [TraceWarning("start", what, cause, "start some tenths of a millimetre clear of it", numbers)]
