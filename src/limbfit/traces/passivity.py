"""Forces that no passive tissue gives: they turn after the displacement, or come and go by themselves.

A tissue with fading memory pushes back the less, the longer ago it was moved, so where the indenter turns or
stops the force turns at once, or seems to have done so before.  Pushed in at one speed it gives a force that
is a sum of powers of the depth and of what memory leaves of them, all with positive weights; such sums cannot
swing, but a person who breathes does.
"""

from collections.abc import Sequence

import numpy as np
from scipy.linalg import block_diag
from scipy.optimize import nnls

from ..phases import MotionPhase
from .displacement import BrokenLine
from .numerics import Array, SampleNoise, average_in_bins, estimate_noise_level, find_resolution
from .record import Trace, TraceWarning
from .touchdown import TouchDown, compute_memory, find_depth_at

_CORNER_SHARE = 0.5  # of the largest speed: a corner at which the speed changes by more
_WINDOW_S = 1.0  # on either side of a corner
_MIN_SAMPLES = 8  # on either side
_MAX_DELAY = 0.4  # of the window
_DELAYS = 25
_MAX_BINS = 200
_MIN_LAG_SD = 5.0  # standard deviations
_MIN_LAG_STEPS = 1.5  # times the time between samples: nobody synchronises better
_MIN_HARM = 0.3  # standard deviations of touch-down
_CONTACT_SHARE = 0.03  # of the rise
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
        if min((time < 0).sum(), (time > 0).sum()) < _MIN_SAMPLES:
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
    if (
        delay < max(_MIN_LAG_SD * sd, _MIN_LAG_STEPS * step, unseen)
        or late_mm < _MIN_HARM * touch.uncertainty_mm
    ):
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
    x, y, n = average_in_bins(time, force, _MAX_BINS)
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
    contact = (force > _CONTACT_SHARE * rise_N) & (time > touch.time_s)
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
