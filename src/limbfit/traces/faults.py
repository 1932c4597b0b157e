"""Faults of the instrument, and forces that no passive tissue gives.

Times are rounded, samples lost; a force is frozen, at the end of its range, jumps, or comes in coarse steps.
What is certain is mended (times); for the rest a warning says what happened, where and how much.

A tissue with fading memory pushes back the less, the longer ago it was moved, so where the indenter turns or
stops the force turns at once, or seems to have done so before. Pushed in at one speed it gives a force that
is a sum of powers of the depth and of what memory leaves of them, all with positive weights; such sums cannot
swing, but a person who breathes does.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
from scipy.linalg import block_diag
from scipy.optimize import nnls

from ..arrays import Array, Mask
from ..phases import MotionPhase
from .displacement import BrokenLine
from .numerics import SampleNoise, average_in_bins, estimate_noise_level, find_resolution, find_runs
from .record import Trace, TraceWarning
from .touchdown import TouchDown, compute_memory, find_depth_at

_MAX_REPEATED = 0.2  # of the samples: more of them share a time because times are rounded
_CLOCK_SHARE = 0.75  # of the resolution that an even clock may be off the times that are stated
_GAP_STEPS = 3.0  # times nearly all steps between samples
_MIN_MOTION = 0.01  # of the travel: where the indenter moves less, nothing is missed
_FROZEN_SAMPLES = 15
_JUMP_NOISE = 6.0  # standard deviations
_CONTACT_SHARE = 0.05  # of the rise
_FORCE_STEP, _TRAVEL_STEP = 0.01, 0.005  # of the rise, of the travel
_MAX_DITHER = 0.6  # of a step: where neighbours scatter by more, means of them know better than a step
_MAX_BINS = 400
_TOP_SD = 4.0  # standard deviations
_FLAT_RATIO = 4.0  # times the way that noise would keep a turning force near its top
_FLAT_SHARE = 0.02  # of the travel
_FLAT_BINS = 4
_STEP_S = 0.08  # on either side of a step
_STEP_SAMPLES = (6, 40)
_STEP_SD, _STEP_SHARE = 8.0, 0.02  # standard deviations; of the rise
_STEP_RESOLUTIONS = 2.5  # times the resolution
_ADHESION_SHARE = 0.1  # of the rise: what lets go of the skin may jump
_KINK_SHARE = 0.25  # of a step that shorter windows may find more or less: a kink halves with them
_CORNER_SHARE = 0.5  # of the largest speed: a corner at which the speed changes by more
_WINDOW_S = 1.0  # on either side of a corner
_MIN_KINK_SAMPLES = 8  # on either side
_MAX_DELAY = 0.4  # of the window
_DELAYS = 25
_MAX_KINK_BINS = 200
_MIN_LAG_SD = 5.0  # standard deviations
_MIN_LAG_STEPS = 1.5  # times the time between samples: nobody synchronises better
_MIN_HARM = 0.3  # standard deviations of touch-down
_MIN_SWING_FORCE = 0.03  # of the rise
_CYCLES = np.geomspace(0.15, 0.6, 21)  # per second: how people breathe, at rest and not
_POWERS = (1.0, 1.25, 1.5, 2.0, 2.5, 3.0, 4.0, 6.0)
_POWERS_OUT = (1.0, 1.5, 2.0, 3.0, 5.0, 8.0, 15.0, 30.0, 60.0)
_TAUS_S = (0.05, 0.15, 0.5, 1.5, 5.0, 15.0)
_MIN_BINS = 8  # of a phase
_MAX_SWING_BINS = 400
_MIN_GAIN = 25.0  # squared misfit that a swing explains, in what is left
_MIN_EXPLAINED = 0.6  # of what noise does not explain
_MIN_FREE = 0.1  # of a swing that passive forces must leave
_MIN_SWING = 0.015  # of the rise: less does no harm


def mend_times(trace: Trace) -> tuple[Trace, list[TraceWarning]]:
    """Leave out rows that are there twice; spread samples that share a rounded time evenly."""
    time = trace.time_s
    same = np.r_[False, np.diff(time) == 0.0]
    count, n = int(same.sum()), len(time)
    if not count:
        return trace, []
    twice = same & np.r_[False, (np.diff(trace.displacement_mm) == 0.0) & (np.diff(trace.force_N) == 0.0)]
    if np.array_equal(twice, same) and count < _MAX_REPEATED * n:
        what = f"{count} of {n} rows are there twice and were left out once"
        cause = "an export that repeats rows"
        numbers = {"doubled_rows": float(count)}
        return trace.select(~same), [TraceWarning("rows", what, cause, "check the export", numbers)]
    size = float(np.median(np.diff(time[~same])))
    spread = replace(trace, time_s=_spread_times(time, same, size))
    what = (
        f"{count} of {n} samples have the time of the sample before; they were spread over {size:.3g} s each"
    )
    numbers = {"doubled_times": float(count), "time_step_s": size}
    cause = "times that are rounded in the export"
    return spread, [TraceWarning("times", what, cause, "export more digits", numbers)]


def _spread_times(time: Array, same: Mask, size: float) -> Array:
    """Even times (n,) where an even clock fits the stated ones; else those of each time over its step."""
    index = np.arange(len(time), dtype=float)
    start, step = np.polynomial.polynomial.polyfit(index, time, 1)
    even = start + step * index
    if np.abs(even - time).max() <= _CLOCK_SHARE * size:
        return np.asarray(even)
    first = np.flatnonzero(~same)
    count = np.diff(np.r_[first, len(time)])
    within = (index - np.repeat(first, count) + 0.5) / np.repeat(count, count) - 0.5
    return np.asarray(time + size * within)


def find_gaps(trace: Trace, line: BrokenLine) -> list[tuple[float, float]]:
    """Find the spans of time, s, in which samples are lost while the indenter moves."""
    steps = np.diff(trace.time_s)
    long = np.flatnonzero(steps > _GAP_STEPS * np.percentile(steps, 99))
    travel = float(np.ptp(line.values))
    spans = [(float(trace.time_s[i]), float(trace.time_s[i + 1])) for i in long]
    return [(a, b) for a, b in spans if line.measure_path_mm(a, b) > _MIN_MOTION * travel]


def report_gaps(gaps: list[tuple[float, float]], line: BrokenLine, met_s: float) -> Iterator[TraceWarning]:
    """Warn of each gap; a skin that is met in one may be met anywhere in it."""
    for start, end in gaps:
        moved = line.measure_path_mm(start, end)
        what = f"no samples from {start:.2f} s to {end:.2f} s, while the indenter moves by {moved:.2g} mm"
        numbers = {"start_s": start, "end_s": end, "moved_mm": moved}
        numbers |= _compute_added_deviation(start, end, line, met_s)
        cause = "samples that the logger lost"
        yield TraceWarning("gap", what, cause, "record again: the force there is a guess", numbers)


def _compute_added_deviation(start: float, end: float, line: BrokenLine, met_s: float) -> dict[str, float]:
    """Compute what a span without a force adds to the deviation of a touch-down in it or next to it."""
    if not start - (end - start) <= met_s <= end + (end - start):
        return {}
    return {"adds_sd_mm": float(np.ptp(line(np.array([start, end])))) / float(np.sqrt(12.0))}


def find_frozen(trace: Trace, line: BrokenLine, rise_N: float) -> list[slice]:
    """Find runs of samples of one and the same force while the indenter moves.

    The force jumps at their end, or is at no level at which a force that scatters could stay.
    """
    force, path = trace.force_N, line.compute_path_mm(trace.time_s)
    noise, size = estimate_noise_level(force), find_resolution(force)
    jump = max(2.5 * size, _JUMP_NOISE * noise, _MIN_MOTION * rise_N)
    in_contact = force > np.percentile(force, 2) + _CONTACT_SHARE * rise_N
    found, least_mm = [], _MIN_MOTION * float(np.ptp(line.values))
    for start, last in find_runs(np.diff(force) == 0.0):  # of the equal samples start..last
        if last - start + 1 < _FROZEN_SAMPLES or path[last] - path[start] < least_mm:
            continue
        away = last + 1 < len(force) and abs(force[last + 1] - force[last]) > jump
        odd = size < noise and in_contact[start] and force[start] < force.max()
        if away or odd:
            found.append(slice(start, last + 1))
    return found


def report_frozen_force(
    trace: Trace, frozen: list[slice], line: BrokenLine, met_s: float
) -> Iterator[TraceWarning]:
    for run in frozen:
        start, end = float(trace.time_s[run.start]), float(trace.time_s[run.stop - 1])
        moved, force = line.measure_path_mm(start, end), float(trace.force_N[run.start])
        what = (
            f"the force stays at exactly {force:.3g} N from {start:.2f} s to {end:.2f} s, while the indenter "
            f"moves by {moved:.2g} mm"
        )
        numbers = {"start_s": start, "end_s": end, "force_N": force, "moved_mm": moved}
        numbers |= _compute_added_deviation(start, end, line, met_s)
        yield TraceWarning("frozen", what, "a sensor that froze", "check it, and record again", numbers)


def find_saturation(
    trace: Trace, line: BrokenLine, rise_N: float, spans: list[tuple[float, float]]
) -> list[TraceWarning]:
    """Find a force that stays at its top while the indenter moves, longer than noise at a turn explains.

    Not where ``spans`` of time lack a force.
    """
    near = trace.time_s < 2 * line.peak_s - line.start_s  # a slow way out would have few bins for the turn
    time, force, _ = average_in_bins(trace.time_s[near], trace.force_N[near], _MAX_BINS)
    noise = max(estimate_noise_level(force), 1e-3 * rise_N, find_resolution(trace.force_N) / 4)
    top = float(np.median(force[force > force.max() - _TOP_SD * noise]))
    low = np.flatnonzero(force < top - _TOP_SD * noise)
    peak = int(np.argmax(force))
    before, after = low[low < peak], low[low > peak]
    if not before.size:
        return []
    a, b = int(before[-1]), int(after[0]) if after.size else len(force)
    path = line.compute_path_mm(time)
    if any(start < time[b - 1] and end > time[a] for start, end in spans):
        return []
    flat, by_noise, wide = float(path[b - 1] - path[a + 1]), 0.0, max((b - a) // 4, 2)
    ends = [(a, max(a - wide, 0)), (b, min(b + wide, len(force) - 1))]
    for edge, beyond in ends if after.size else ends[:1]:
        steep = (force[edge] - force[beyond]) / max(abs(path[edge] - path[beyond]), 1e-12)
        by_noise += _TOP_SD * noise / steep if steep > 0.0 else np.inf
    if b - a <= _FLAT_BINS or flat < max(_FLAT_RATIO * by_noise, _FLAT_SHARE * float(np.ptp(line.values))):
        return []
    what = f"the force stays at {top:.3g} N while the indenter moves by {flat:.2g} mm"
    numbers = {"limit_N": top, "start_s": float(time[a + 1]), "end_s": float(time[b - 1]), "moved_mm": flat}
    cause = "a sensor or an amplifier at the end of its range"
    return [TraceWarning("saturation", what, cause, "choose a larger range and record again", numbers)]


def find_steps(
    trace: Trace, line: BrokenLine, rise_N: float, spans: list[tuple[float, float]]
) -> list[tuple[float, float]]:
    """Find when (s) the force jumps from one sample to the next and stays there, and by how much (N).

    Not looked at: corners of the displacement, ``spans`` of time, and what lets go of the skin.
    """
    time, force = trace.time_s, trace.force_N
    rate = 1.0 / float(np.median(np.diff(time)))
    m = int(np.clip(round(_STEP_S * rate), *_STEP_SAMPLES))
    if len(force) < 4 * m:
        return []
    whole, half = _compute_jumps(force, m), _compute_jumps(force, m // 2)
    sd = 1.4826 * float(np.median(np.abs(whole)))
    least = max(_STEP_SD * sd, _STEP_SHARE * rise_N, _STEP_RESOLUTIONS * find_resolution(force))
    sharp = np.abs(half - whole) < _KINK_SHARE * np.abs(whole) + sd
    steps = (np.abs(whole) > least) & sharp
    near = (m + 1) / rate
    for start, end in [(t, t) for t in line.times] + spans:
        steps[(time > start - near) & (time < end + near)] = False
    base = float(np.percentile(force, 2))
    steps[(time > line.peak_s) & (force < base + _ADHESION_SHARE * rise_N)] = False
    found = []
    while steps.any():
        k = int(np.argmax(np.where(steps, np.abs(whole), 0.0)))
        found.append((float(time[k]), float(whole[k])))
        steps[max(k - 2 * m, 0) : k + 2 * m] = False
    return sorted(found)


def _compute_jumps(force: Array, m: int) -> Array:
    """Compute the jump at each sample, (n,) N; 0 at the ends.

    It is how far the straight line through the ``m`` samples from there on starts above the end of the line
    through the ``m`` samples before.
    """
    x = np.arange(m) + 0.5
    weights = np.linalg.pinv(np.stack([np.ones(m), x], axis=1))[0]  # of the line's value at 0
    inside = np.convolve(force, np.r_[weights[::-1], -weights], mode="valid")
    jumps = np.zeros(len(force))
    jumps[m : m + len(inside)] = inside
    return jumps


def report_steps(steps: list[tuple[float, float]]) -> Iterator[TraceWarning]:
    for at, size in steps:
        what = f"the force jumps by {size:+.2g} N from one sample to the next, at {at:.2f} s"
        cause = "a slip of the limb, a knock at the sensor or its amplifier's range"
        numbers = {"time_s": at, "step_N": size}
        yield TraceWarning("step", what, cause, "record again: nobody knows which part is right", numbers)


def find_coarse_steps(
    trace: Trace, line: BrokenLine, touch: TouchDown, rise_N: float
) -> Iterator[TraceWarning]:
    """Warn of a force or a displacement whose steps are larger than its neighbours scatter.

    A touch-down is then known to where the force reaches the standard deviation of what is rounded.
    """
    for kind, values, unit, least in (
        ("force", trace.force_N, "N", _FORCE_STEP * rise_N),
        ("displacement", trace.displacement_mm, "mm", _TRAVEL_STEP * float(np.ptp(line.values))),
    ):
        size = find_resolution(values)
        sample_noise = float(np.sqrt(np.mean(np.diff(values, 2) ** 2) / 6.0))
        if size < least or sample_noise > _MAX_DITHER * size:
            continue
        what = f"the {kind} comes in steps of {size:.3g} {unit}"
        cause = f"a sensor or an export that rounds the {kind}"
        numbers = {f"step_{unit}": size}
        if unit == "N":
            numbers["adds_sd_mm"] = find_depth_at(trace, line, touch, size / float(np.sqrt(12.0)))
        yield TraceWarning("resolution", what, cause, "record with a finer range or more digits", numbers)


def find_lag(
    trace: Trace,
    line: BrokenLine,
    touch: TouchDown,
    sample_noise: SampleNoise,
    spans: list[tuple[float, float]],
) -> list[TraceWarning]:
    """Find a force that turns later than the displacement, from its kinks where that turns or stops.

    Corners in ``spans`` of time are left out.
    """
    speed = np.diff(line.values) / np.diff(line.times)
    sharp = np.flatnonzero(np.abs(np.diff(speed)) > _CORNER_SHARE * np.abs(speed).max()) + 1
    base, top = np.percentile(trace.force_N, [2, 99])
    found = []
    for corner in sharp:
        at, before, after = line.times[[corner, corner - 1, corner + 1]]
        low, high = max(at - _WINDOW_S, before, touch.time_s), min(at + _WINDOW_S, after)
        inside = (trace.time_s > low) & (trace.time_s < high)
        time, force = trace.time_s[inside] - at, trace.force_N[inside]
        if any(start < high and end > low for start, end in spans):
            continue
        if min((time < 0).sum(), (time > 0).sum()) < _MIN_KINK_SAMPLES:
            continue
        if np.median(force[np.abs(time) <= np.sort(np.abs(time))[4]]) < base + 0.2 * (top - base):
            continue
        found.append(_estimate_delay(time, force, sample_noise))
    if not found:
        return []
    # No kink may be late, and at some of them memory hides a delay.
    delay, sd = max(found, key=lambda estimate: estimate[0] / estimate[1])
    met = float(np.interp(touch.time_s, (line.times[1:] + line.times[:-1]) / 2, speed))
    late_mm = delay * abs(met)
    step = float(np.median(np.diff(trace.time_s)))
    unseen = find_resolution(trace.displacement_mm) / float(np.abs(speed).max())  # of when a corner was
    least = max(_MIN_LAG_SD * sd, _MIN_LAG_STEPS * step, unseen)
    if delay < least or late_mm < _MIN_HARM * touch.uncertainty_mm:
        return []
    what = (
        f"the force turns {delay:.2g} +- {sd:.1g} s after the displacement, which no passive tissue does: "
        f"the touch-down comes out about {late_mm:.2g} mm late"
    )
    numbers = {"lag_s": delay, "lag_sd_s": sd, "adds_sd_mm": late_mm}
    cause = "a low-pass filter of the force, or a column that is shifted"
    remedy = "filter both alike, or shift the force back, and import again"
    return [TraceWarning("lag", what, cause, remedy, numbers)]


def _estimate_delay(time: Array, force: Array, sample_noise: SampleNoise) -> tuple[float, float]:
    """Estimate by how much the kink of a force is late, s, with its standard deviation, by two parabolas."""
    x, y, n = average_in_bins(time, force, _MAX_KINK_BINS)
    correlation = (1.0 + sample_noise.lag) / (1.0 - sample_noise.lag)
    noise = sample_noise.sd_N**2 * min(correlation, float(n.mean())) + 1e-18
    widest = _MAX_DELAY * min(-time[0], time[-1])
    delays = np.linspace(-widest, widest, _DELAYS)
    for _ in range(2):
        left = np.array([_compute_kink_misfit(x, y, n, delay) for delay in delays])
        variance = max(left.min() / max(len(x) - 6, 1), noise)
        weights = np.exp(-0.5 * (left - left.min()) / variance)
        weights /= weights.sum()
        mean, step = float(weights @ delays), delays[1] - delays[0]
        sd = float(np.sqrt(weights @ (delays - mean) ** 2 + step**2 / 12))
        delays = np.linspace(mean - 5 * sd, mean + 5 * sd, _DELAYS)
    return mean, sd


def _compute_kink_misfit(x: Array, y: Array, n: Array, delay: float) -> float:
    """Compute the misfit of two parabolas that meet at ``delay`` to means ``y`` (k,) of ``n`` samples."""
    beyond = np.maximum(x - delay, 0.0)
    basis = np.stack([np.ones_like(x), x, x**2, beyond, beyond**2], axis=1)
    q, _ = np.linalg.qr(basis * np.sqrt(n)[:, None])
    weighted = np.sqrt(n) * y
    return max(float(weighted @ weighted - np.sum((q.T @ weighted) ** 2)), 0.0)


def find_swings(
    trace: Trace,
    line: BrokenLine,
    touch: TouchDown,
    sample_noise: SampleNoise,
    rise_N: float,
    steps_s: Sequence[float],
) -> list[TraceWarning]:
    """Find a force that swings as a person breathes, beyond what tissue and ``steps_s`` explain."""
    parts = _remove_passive_forces(trace, line, touch, rise_N, steps_s)
    if not parts:
        return []
    time, left = (np.concatenate([part[i] for part in parts]) for i in (0, 1))
    per_bin = len(trace.time_s) / _MAX_SWING_BINS if len(trace.time_s) > _MAX_SWING_BINS else 1.0
    noise = sample_noise.compute_mean_sd(max(int(per_bin), 1))
    noise = max(noise, estimate_noise_level(left), 2e-4 * rise_N)
    misfit = float(left @ left) / noise**2
    if misfit < len(left) + _MIN_GAIN:
        return []
    used, _ = np.linalg.qr(block_diag(*[forces for _, _, forces in parts]))
    left = left - used @ (used.T @ left)
    misfit = float(left @ left) / noise**2
    best = (0.0, 0.0, 0.0)
    for cycles in _CYCLES:
        angle = 2 * np.pi * cycles * time
        waves = np.stack([np.sin(angle), np.cos(angle)], axis=1)
        free = waves - used @ (used.T @ waves)
        if np.sum(free**2) < _MIN_FREE * np.sum(waves**2):
            continue
        size, *_ = np.linalg.lstsq(free, left, rcond=None)
        gain = misfit - float(np.sum((left - free @ size) ** 2)) / noise**2
        best = max(best, (gain, float(np.hypot(*size)), float(cycles)))
    gain, size, cycles = best
    free_values = max(len(left) - used.shape[1] - 2, 1)
    remaining = max((misfit - gain) / free_values, 1.0)
    share = gain / max(misfit - free_values, 1e-12)
    if gain < _MIN_GAIN * remaining or share < _MIN_EXPLAINED or size < _MIN_SWING * rise_N:
        return []
    moved = find_depth_at(trace, line, touch, size)
    what = f"the force in contact swings by {size:.2g} N, {60 * cycles:.0f} times a minute"
    numbers = {"swing_N": size, "cycles_per_s": cycles, "explained": share, "adds_sd_mm": moved}
    cause = "a limb that moves as the person breathes"
    remedy = "support the limb, or record again while the breath is held"
    return [TraceWarning("swing", what, cause, remedy, numbers)]


def _remove_passive_forces(
    trace: Trace, line: BrokenLine, touch: TouchDown, rise_N: float, steps_s: Sequence[float]
) -> list[tuple[Array, Array, Array]]:
    """Fit passive forces to each phase in contact.

    Returns of each the times of its bins (n,) s, what the forces leave (n,) N, and those in use (n, k).
    """
    time, force, _ = average_in_bins(trace.time_s, trace.force_N - touch.baseline_N, _MAX_SWING_BINS)
    contact = (force > _MIN_SWING_FORCE * rise_N) & (time > touch.time_s)
    found = []
    for phase in line.phases:
        inside = contact & (time > phase.start_s) & (time < phase.end_s)
        if inside.sum() < _MIN_BINS:
            continue
        basis = _build_passive_forces(phase, time[inside], line, touch)
        basis /= np.linalg.norm(basis, axis=0)
        within = [at for at in steps_s if time[inside][0] < at < time[inside][-1]]
        free = np.stack([np.ones(len(basis)), *(1.0 * (time[inside] > at) for at in within)], axis=1)
        columns = np.hstack([free, -free, basis])
        weights, _ = nnls(columns, force[inside])
        used = np.hstack([free, basis[:, weights[2 * free.shape[1] :] > 0.0]])
        found.append((time[inside], force[inside] - columns @ weights, used))
    return found


def _build_passive_forces(phase: MotionPhase, time: Array, line: BrokenLine, touch: TouchDown) -> Array:
    """Build the forces (n, k) that a passive tissue may have in a phase, but for a constant."""
    since = time - phase.start_s
    fading = np.stack([np.exp(-since / tau) for tau in _TAUS_S], axis=1)
    if phase.kind == "hold":
        return np.hstack([fading, line(time)[:, None] - phase.start_mm])
    depth = np.maximum(line(time) - touch.displacement_mm, 0.0)
    if phase.kind == "unload":
        share = depth - depth.min()
        return np.stack([(share / share.max()) ** p for p in _POWERS_OUT], axis=1)
    grid = np.linspace(max(phase.start_s, touch.time_s), phase.end_s, 301)
    deep = np.maximum(line(grid) - touch.displacement_mm, 0.0) / max(float(depth.max()), 1e-12)
    elastic = deep ** np.array(_POWERS)[:, None]
    forces = [elastic, *(compute_memory(grid, elastic[::2], tau) for tau in _TAUS_S)]
    loads = np.concatenate(forces).T
    at = np.stack([np.interp(time, grid, column) for column in loads.T], axis=1)
    return at if phase.start_s <= touch.time_s else np.hstack([at, fading, -fading])
