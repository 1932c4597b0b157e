"""What no passive tissue does: its force turns after the displacement, or comes and goes by itself.

A tissue with fading memory pushes back the less, the longer ago it was moved, so where the indenter turns or
stops the force turns at once, or seems to have done so before.  Pushed in at one speed it gives a force that
is a sum of powers of the depth and of what memory leaves of them, all with positive weights; such sums cannot
swing, but a person who breathes does.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import block_diag
from scipy.optimize import nnls

from ..phases import MotionPhase
from .displacement import BrokenLine
from .numerics import Array, Scatter, average_in_bins, estimate_noise_level, find_resolution
from .record import Remark, Trace
from .touchdown import TouchDown, compute_memory, find_depth_at

_SHARPLY = 0.5  # of the largest speed: a corner at which the speed changes by more
_WINDOW_S = 1.0  # on either side of a corner
_LEAST_SAMPLES = 8  # on either side
_LATEST = 0.4  # of the window
_DELAYS = 25
_BINS = 200
_LAG_SD = 5.0  # standard deviations
_LAG_STEPS = 1.5  # times the time between samples: nobody synchronises better
_LAG_HARM = 0.3  # standard deviations of touch-down
_IN_CONTACT = 0.03  # of the rise
_CYCLES = np.geomspace(0.15, 0.6, 21)  # per second: how people breathe, at rest and not
_POWERS = (1.0, 1.25, 1.5, 2.0, 2.5, 3.0, 4.0, 6.0)
_POWERS_OUT = (1.0, 1.5, 2.0, 3.0, 5.0, 8.0, 15.0, 30.0, 60.0)
_TAUS_S = (0.05, 0.15, 0.5, 1.5, 5.0, 15.0)
_LEAST_BINS = 8  # of a phase
_SWING_BINS = 400
_SWING_F = 25.0  # squared misfit that a swing explains, in what is left
_SWING_SHARE = 0.6  # of what noise does not explain
_SWING_FREE = 0.1  # of a swing that passive forces must leave
_SWING_RISE = 0.015  # of the rise: less does no harm


def find_lag(
    trace: Trace, line: BrokenLine, touch: TouchDown, scatter: Scatter, spans: list[tuple[float, float]]
) -> list[Remark]:
    """A force that turns later than the displacement, told from its kinks where that turns or stops; corners
    in ``spans`` of time are not looked at."""
    speed = np.diff(line.values) / np.diff(line.times)
    sharp = np.flatnonzero(np.abs(np.diff(speed)) > _SHARPLY * np.abs(speed).max()) + 1
    base, top = np.percentile(trace.force_N, [2, 99])
    found = []
    for corner in sharp:
        at, before, after = line.times[[corner, corner - 1, corner + 1]]
        low, high = max(at - _WINDOW_S, before, touch.time_s), min(at + _WINDOW_S, after)
        inside = (trace.time_s > low) & (trace.time_s < high)
        time, force = trace.time_s[inside] - at, trace.force_N[inside]
        if any(start < high and end > low for start, end in spans):
            continue
        if min((time < 0).sum(), (time > 0).sum()) < _LEAST_SAMPLES:
            continue
        if np.median(force[np.abs(time) <= np.sort(np.abs(time))[4]]) < base + 0.2 * (top - base):
            continue
        found.append(_estimate_delay(time, force, scatter))
    if not found:
        return []
    # At none of them may it be late, and at some memory hides a delay.
    delay, sd = max(found, key=lambda one: one[0] / one[1])
    met = float(np.interp(touch.time_s, (line.times[1:] + line.times[:-1]) / 2, speed))
    late_mm = delay * abs(met)
    step = float(np.median(np.diff(trace.time_s)))
    unseen = find_resolution(trace.displacement_mm) / float(np.abs(speed).max())  # of when a corner was
    if delay < max(_LAG_SD * sd, _LAG_STEPS * step, unseen) or late_mm < _LAG_HARM * touch.uncertainty_mm:
        return []
    what = (
        f"the force turns {delay:.2g} +- {sd:.1g} s after the displacement, which no passive tissue does: "
        f"the touch-down comes out about {late_mm:.2g} mm late"
    )
    numbers = {"lag_s": delay, "lag_sd_s": sd, "adds_sd_mm": late_mm}
    cause = "a low-pass filter of the force, or a column that is shifted"
    return [
        Remark("lag", what, cause, "filter both alike, or shift the force back, and import again", numbers)
    ]


def _estimate_delay(time: Array, force: Array, scatter: Scatter) -> tuple[float, float]:
    """By how much the kink of a force is late, s, and its standard deviation: parabolas that meet there."""
    x, y, n = average_in_bins(time, force, _BINS)
    alike = (1.0 + scatter.lag) / (1.0 - scatter.lag)
    noise = scatter.sd_N**2 * min(alike, float(n.mean())) + 1e-18
    widest = _LATEST * min(-time[0], time[-1])
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
    """What two parabolas that meet at ``delay`` leave of means ``y`` (k,) of ``n`` samples each."""
    beyond = np.maximum(x - delay, 0.0)
    basis = np.stack([np.ones_like(x), x, x**2, beyond, beyond**2], axis=1)
    return _compute_misfit(basis * np.sqrt(n)[:, None], np.sqrt(n) * y)


def _compute_misfit(basis: Array, y: Array) -> float:
    q, _ = np.linalg.qr(basis)
    return max(float(y @ y - np.sum((q.T @ y) ** 2)), 0.0)


@dataclass(frozen=True)
class _Part:
    """A phase in contact: bins, and the passive forces that the fit made use of (n, k)."""

    time_s: Array
    residual_N: Array
    used: Array


def find_swings(
    trace: Trace,
    line: BrokenLine,
    touch: TouchDown,
    scatter: Scatter,
    rise_N: float,
    steps_s: Sequence[float],
) -> list[Remark]:
    """A force that swings as a person breathes, beyond all that passive tissue can do, and beyond its
    ``steps_s``."""
    parts = _remove_passive_forces(trace, line, touch, rise_N, steps_s)
    if not parts:
        return []
    time = np.concatenate([part.time_s for part in parts])
    left = np.concatenate([part.residual_N for part in parts])
    per_bin = len(trace.time_s) / _SWING_BINS if len(trace.time_s) > _SWING_BINS else 1.0
    noise = scatter.of_means(max(int(per_bin), 1))
    noise = max(noise, estimate_noise_level(left), 2e-4 * rise_N)
    misfit = float(left @ left) / noise**2
    if misfit < len(left) + _SWING_F:
        return []
    used, _ = np.linalg.qr(block_diag(*[part.used for part in parts]))
    left = left - used @ (used.T @ left)
    misfit = float(left @ left) / noise**2
    best = (0.0, 0.0, 0.0)
    for cycles in _CYCLES:
        angle = 2 * np.pi * cycles * time
        waves = np.stack([np.sin(angle), np.cos(angle)], axis=1)
        free = waves - used @ (used.T @ waves)
        if np.sum(free**2) < _SWING_FREE * np.sum(waves**2):
            continue
        size, *_ = np.linalg.lstsq(free, left, rcond=None)
        gain = misfit - float(np.sum((left - free @ size) ** 2)) / noise**2
        best = max(best, (gain, float(np.hypot(*size)), float(cycles)))
    gain, size, cycles = best
    free_values = max(len(left) - used.shape[1] - 2, 1)
    remaining = max((misfit - gain) / free_values, 1.0)
    share = gain / max(misfit - free_values, 1e-12)
    if gain < _SWING_F * remaining or share < _SWING_SHARE or size < _SWING_RISE * rise_N:
        return []
    moved = find_depth_at(trace, line, touch, size)
    what = f"the force in contact swings by {size:.2g} N, {60 * cycles:.0f} times a minute"
    numbers = {"swing_N": size, "cycles_per_s": cycles, "explained": share, "adds_sd_mm": moved}
    cause = "a limb that moves as the person breathes"
    remedy = "support the limb, or record again while the breath is held"
    return [Remark("swing", what, cause, remedy, numbers)]


def _remove_passive_forces(
    trace: Trace, line: BrokenLine, touch: TouchDown, rise_N: float, steps_s: Sequence[float]
) -> list[_Part]:
    """What passive forces leave of each phase in contact."""
    time, force, _ = average_in_bins(trace.time_s, trace.force_N - touch.baseline_N, _SWING_BINS)
    contact = (force > _IN_CONTACT * rise_N) & (time > touch.time_s)
    found = []
    for phase in line.phases:
        inside = contact & (time > phase.start_s) & (time < phase.end_s)
        if inside.sum() < _LEAST_BINS:
            continue
        basis = _build_passive_forces(phase, time[inside], line, touch)
        basis /= np.linalg.norm(basis, axis=0)
        within = [at for at in steps_s if time[inside][0] < at < time[inside][-1]]
        free = np.stack([np.ones(len(basis)), *(1.0 * (time[inside] > at) for at in within)], axis=1)
        columns = np.hstack([free, -free, basis])
        weights, _ = nnls(columns, force[inside])
        used = np.hstack([free, basis[:, weights[2 * free.shape[1] :] > 0.0]])
        found.append(_Part(time[inside], force[inside] - columns @ weights, used))
    return found


def _build_passive_forces(phase: MotionPhase, time: Array, line: BrokenLine, touch: TouchDown) -> Array:
    """Forces (n, k) that a passive tissue may have in a phase, but for a constant."""
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
