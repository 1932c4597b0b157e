"""Where the indenter met the skin."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ..errors import TraceError
from .displacement import BrokenLine, broken_line
from .numerics import Array, bins, noise_level
from .record import MIN_SAMPLES, Trace


@dataclass(frozen=True)
class TouchDown:
    """Where the indenter met the skin.

    ``uncertainty_mm`` is a standard deviation: the spread allowed by the noise, and by how much of the onset
    is looked at. ``exponent`` is p of the onset F = baseline + a (d - d0)^p. ``in_contact_at_start`` says
    that the record has no slack before the skin, so that the baseline rests on the assumption of a zeroed
    sensor.
    """

    time_s: float
    displacement_mm: float
    uncertainty_mm: float
    exponent: float
    baseline_N: float
    in_contact_at_start: bool


_ONSET_LEVELS = (0.05, 0.10)  # of the peak force: how much of the onset is fitted
_MIN_LEVEL_NOISE = 4.0  # and never less than this many standard deviations of the noise
_EXPONENTS = np.linspace(1.0, 2.5, 31)  # flat punch full on: 1; sphere: 1.5; cone, or an edge coming in: 2


def find_touch_down(trace: Trace) -> TouchDown:
    """Where the skin is met, from the shape of the onset of force.

    A flat punch meets a curved limb at a corner first, so the force starts like a power of the depth and any
    threshold is late. Here ``F = baseline + a (d - d0)^p`` is fitted to the low-force part of loading for all
    d0 and p on a grid (a and the baseline follow by linear least squares), and d0 is the mean over its
    likelihood; two lengths of the onset are weighed against each other.

    Raises
    ------
    TraceError
        Where the force does not rise on the way in.
    """
    return _from_onset(trace, broken_line(trace.time_s, trace.displacement_mm))


def _from_onset(trace: Trace, line: BrokenLine) -> TouchDown:
    load = trace.time_s <= line.peak_s
    # Counting travel along the fitted line keeps the noise of the displacement sensor out of the abscissa.
    travel, force = line(trace.time_s[load]), trace.force_N[load]
    noise = noise_level(trace.force_N)
    moving = int(np.searchsorted(trace.time_s[load], line.start_s))
    estimates = [_onset(travel, force, level, noise, moving) for level in _ONSET_LEVELS]
    weight = np.array([1 / max(e.sd, 1e-9) ** 2 for e in estimates])
    weight /= weight.sum()
    where = np.array([e.d0 for e in estimates])
    best = float(weight @ where)
    spread = float(weight @ (where - best) ** 2)
    sd = float(np.sqrt(1 / sum(1 / max(e.sd, 1e-9) ** 2 for e in estimates) + spread))
    return TouchDown(
        time_s=float(line.time_at(best)),
        displacement_mm=best,
        uncertainty_mm=sd,
        exponent=float(weight @ [e.exponent for e in estimates]),
        baseline_N=float(weight @ [e.baseline for e in estimates]),
        in_contact_at_start=bool(best - travel[0] < 2 * sd and moving < MIN_SAMPLES),
    )


def touch_down_at(trace: Trace, time_s: float) -> TouchDown:
    """The touch-down at a time that someone states; baseline and uncertainty are those of the onset.

    Raises
    ------
    TraceError
        Where the time does not lie on the way in, or the force does not rise on it.
    """
    line = broken_line(trace.time_s, trace.displacement_mm)
    first, last = float(trace.time_s[0]), line.peak_s
    if not first <= time_s < last:
        raise TraceError(
            f"{time_s:g} s is not on the way in",
            place="touch_down_s",
            remedy=f"give a time from {first:.3f} s to before {last:.3f} s",
        )
    return replace(_from_onset(trace, line), time_s=time_s, displacement_mm=float(line(np.array(time_s))))


@dataclass(frozen=True)
class _Onset:
    d0: float
    sd: float
    exponent: float
    baseline: float


def _onset(travel: Array, force: Array, level: float, noise: float, moving: int) -> _Onset:
    """Likelihood-weighted onset of force over the part of loading below ``level`` of the peak."""
    at, smooth, _ = bins(np.arange(len(force), dtype=float), force, 200)
    base = float(np.median(force[: max(moving, len(force) // 50, 1)]))
    rise = float(smooth.max()) - base
    if rise <= 0.1 * float(np.ptp(smooth)):
        raise TraceError("the force does not rise while the indenter goes in", remedy="check the record")
    threshold = max(level * rise, _MIN_LEVEL_NOISE * noise)
    below = np.flatnonzero(smooth - base < threshold)
    end = min(int(at[below[-1]]) + 1, len(force)) if below.size else MIN_SAMPLES
    x, y, n = bins(travel[: max(end, 8)], force[: max(end, 8)], 300)
    d0 = np.linspace(x[0], x[-1] - 0.05 * (x[-1] - x[0]), 300)
    shape = np.maximum(x - d0[:, None, None], 0.0) ** _EXPONENTS[:, None]
    mean_shape, mean_y = shape @ n / n.sum(), float(y @ n / n.sum())
    centred, dy = shape - mean_shape[..., None], y - mean_y
    slope = np.maximum((centred * dy) @ n / np.maximum((centred**2) @ n, 1e-300), 0.0)
    baseline = mean_y - slope * mean_shape
    misfit = ((dy - slope[..., None] * centred) ** 2) @ n
    # A record without slack leaves the baseline free to take up the onset: hold it to a zeroed sensor,
    # loosely.
    misfit = misfit + (noise * baseline / (0.02 * rise)) ** 2
    variance = max(noise**2, float(misfit.min()) / max(len(x) - 4, 1), (1e-4 * rise) ** 2)
    likelihood = np.exp(-(misfit - misfit.min()) / (2 * variance))
    likelihood /= likelihood.sum()
    mean = float(likelihood.sum(axis=1) @ d0)
    grid = d0[1] - d0[0]
    sd = float(np.sqrt(likelihood.sum(axis=1) @ (d0 - mean) ** 2 + grid**2 / 12))
    return _Onset(mean, sd, float(likelihood.sum(axis=0) @ _EXPONENTS), float((likelihood * baseline).sum()))
