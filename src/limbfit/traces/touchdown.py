"""Where the indenter met the skin, and what the onset of force there may look like.

``F = baseline + k [s^p + gamma (s^p relaxed with tau)]``, with ``s`` the depth since touch-down: a power of
the depth, as a body that is met at a point or at an edge gives, in a material with memory (quasi-linear
viscoelasticity, one term). Memory bends the onset down as another exponent does: without it the touch-down
comes out too late, and too well known. A small ball first bends the skin and then finds the bone below, so
that its force starts straight and stiffens: ``s + a L (s / L)^q`` over a part of length L. Without these its
touch-down comes out a quarter of a millimetre early.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ..arrays import Array
from ..autoregressive import compute_block_covariance
from ..errors import TraceError
from .displacement import BrokenLine, fit_broken_line
from .numerics import SampleNoise, average_in_bins, estimate_noise, split_at_gaps
from .record import MIN_SAMPLES, Trace

_ONSET_LEVEL = 0.05  # of the peak force: more of the onset is no power law, where a punch comes full on
_MIN_LEVEL_SD = 45.0  # and never less than this many standard deviations of what means of it scatter
_MIN_TRAVEL = 0.03  # of the way in: a force that jumps before the indenter moves is no onset
_MAX_MEANS = 120  # that part as so many means
_BEFORE_SHARE, _BEFORE_MM = 0.2, 1.0  # of the way in; how far before the record the skin may have been met
_BINS = 200
_MIN_APPROACH_MM = 0.1  # less of it before the skin is none
EXPONENTS = np.linspace(1.0, 2.5, 13)  # flat punch full on: 1; sphere: 1.5; cone, or an edge coming in: 2
STIFFENING = ((1.0, 2.5), (4.0, 2.5), (2.0, 2.0), (8.0, 2.0))  # a and q
TAU_S = (0.1, 0.3, 1.0, 3.0)
GAMMA = (0.5, 1.5, 4.0)
_PLACE_COUNT = 60  # of touch-down
_SEARCH_SD = 5.0  # standard deviations
_ZERO_SHARE = 0.02  # of the rise: how well a sensor is zeroed, loosely
_MIN_NOISE = 1e-4  # of the rise


@dataclass(frozen=True)
class TouchDown:
    """Where the indenter met the skin.

    ``uncertainty_mm`` is a standard deviation: the spread that the noise allows, with an exponent and a
    relaxation of the onset that are not known. ``in_contact_at_start`` says that the record has no slack
    before the skin, so that the baseline rests on the assumption of a zeroed sensor.
    """

    time_s: float
    displacement_mm: float
    uncertainty_mm: float
    baseline_N: float
    in_contact_at_start: bool


def find_touch_down(trace: Trace, line: BrokenLine | None = None) -> TouchDown:
    """Find where the skin is met, from the shape of the onset of force.

    A flat punch meets a curved limb at a corner first, so the force starts like a power of the depth and any
    threshold is late. Every onset of a power law with memory is compared with the low-force part of loading,
    under noise as correlated as the record shows it to be, and the touch-down is the mean over their
    likelihood (see `onset`).  ``line`` is the displacement's broken line, where it is known already. Raises
    `TraceError` where the force does not rise on the way in.
    """
    line = line or fit_broken_line(trace.time_s, trace.displacement_mm)
    time, travel, force = _select_way_in(trace, line)
    moving = int(np.searchsorted(time, line.start_s))
    sample_noise = estimate_noise(*split_at_gaps(time, force))
    part = _select_low_force_part(time, travel, force, moving, sample_noise)
    rough = find_onset(part, sample_noise)
    sample_noise, part = _estimate_noise_near(rough.place_mm, time, travel, force, moving)
    onset = find_onset(part, sample_noise, rough)
    is_near = onset.place_mm - travel[0] < max(2 * onset.sd, _MIN_APPROACH_MM)
    return TouchDown(
        time_s=float(np.interp(onset.place_mm, np.maximum.accumulate(travel), time)),
        displacement_mm=onset.place_mm,
        uncertainty_mm=onset.sd,
        baseline_N=onset.baseline_N,
        in_contact_at_start=bool(is_near and moving < MIN_SAMPLES),
    )


def compute_deviation_before(trace: Trace, line: BrokenLine, touch: TouchDown) -> float:
    """Compute the root-mean-square error, mm, of a touch-down that may lie before the start of the record.

    The sensor was then zeroed in contact.
    """
    time, travel, force = _select_way_in(trace, line)
    moving = int(np.searchsorted(time, line.start_s))
    sample_noise, part = _estimate_noise_near(touch.displacement_mm, time, travel, force, moving)
    before = min(_BEFORE_SHARE * float(travel[-1] - travel[0]), _BEFORE_MM)
    onset = find_onset(part, sample_noise, before_mm=before)
    return float(np.hypot(onset.sd, onset.place_mm - touch.displacement_mm))


def _estimate_noise_near(
    place_mm: float, time: Array, travel: Array, force: Array, moving: int
) -> tuple[SampleNoise, OnsetPart]:
    """The noise on either side of a touch-down, as the kink in between is none, and the part to look at."""
    met = int(np.searchsorted(travel, place_mm))
    parts = (split_at_gaps(time[side], force[side]) for side in (slice(met), slice(met, None)))
    sample_noise = estimate_noise(*(part for side in parts for part in side))
    return sample_noise, _select_low_force_part(time, travel, force, moving, sample_noise)


def _select_way_in(trace: Trace, line: BrokenLine) -> tuple[Array, Array, Array]:
    """Time, travel and force of the first way in.

    Counting travel along the fitted line keeps the noise of the displacement sensor out of the abscissa.
    """
    load = trace.time_s <= line.peak_s
    return trace.time_s[load], line(trace.time_s[load]), trace.force_N[load]


def _select_low_force_part(
    time: Array, travel: Array, force: Array, moving: int, sample_noise: SampleNoise
) -> OnsetPart:
    """The low-force part of a way in, as means."""
    at, smooth, _ = average_in_bins(np.arange(len(force), dtype=float), force, _BINS)
    base = float(np.median(force[: max(moving, len(force) // 50, 1)]))
    rise = float(smooth.max()) - base
    if rise <= 0.1 * float(np.ptp(smooth)):
        raise TraceError("the force does not rise while the indenter goes in", remedy="check the record")
    noise = sample_noise.compute_mean_sd(max(len(force) // len(smooth), 1))
    below = np.flatnonzero(smooth - base < max(_ONSET_LEVEL * rise, _MIN_LEVEL_SD * noise))
    end = min(int(at[below[-1]]) + 1, len(force)) if below.size else MIN_SAMPLES
    goes = int(np.searchsorted(travel, travel[0] + _MIN_TRAVEL * (travel[-1] - travel[0]), side="right"))
    end = min(max(end, goes, 8), len(force))
    samples = max(end // _MAX_MEANS, 1)
    start = end % samples
    t, u, f = (column[start:end].reshape(-1, samples).mean(axis=1) for column in (time, travel, force))
    return OnsetPart(t, u, f, samples, rise)


def touch_down_at(trace: Trace, time_s: float) -> TouchDown:
    """The touch-down at a time that someone states; baseline and uncertainty are those of the onset. Raises
    `TraceError` where the time does not lie on the way in, or the force does not rise on it.
    """
    line = fit_broken_line(trace.time_s, trace.displacement_mm)
    first, last = float(trace.time_s[0]), line.peak_s
    if not first <= time_s < last:
        remedy = f"give a time from {first:.3f} s to before {last:.3f} s"
        raise TraceError(f"{time_s:g} s is not on the way in", place="touch_down_s", remedy=remedy)
    return replace(find_touch_down(trace, line), time_s=time_s, displacement_mm=float(line(np.array(time_s))))


def find_depth_at(trace: Trace, line: BrokenLine, touch: TouchDown, force_N: float) -> float:
    """Find the depth at which the force first reaches ``force_N``, mm."""
    way = (trace.time_s >= touch.time_s) & (trace.time_s <= line.peak_s)
    time, force, _ = average_in_bins(trace.time_s[way], trace.force_N[way] - touch.baseline_N, _BINS)
    first = int(np.argmax(force >= min(force_N, float(force.max()))))
    return max(float(line(time[first])) - touch.displacement_mm, touch.uncertainty_mm)


@dataclass(frozen=True)
class OnsetPart:
    """The part of a way in that is looked at, as means of ``samples`` neighbours: (n,) s, mm, N.

    ``rise_N`` is how far the force rises on the whole way in.
    """

    time_s: Array
    travel_mm: Array
    force_N: Array
    samples: int
    rise_N: float


@dataclass(frozen=True)
class Onset:
    """Where the skin is met: means over all onsets that the part allows, and ``sd`` (mm) of the place."""

    place_mm: float
    sd: float
    baseline_N: float


def find_onset(
    part: OnsetPart, sample_noise: SampleNoise, around: Onset | None = None, before_mm: float = 0.0
) -> Onset:
    """The mean place over its likelihood, the noise's correlation known and the shape of the onset not.

    Stiffness and baseline are integrated out (both flat, the stiffness by the force at the end of the part),
    exponent and memory summed over a grid; the place over one that spans the part, or a finer one ``around``
    what was found so.  With ``before_mm`` it may lie by so much before the part, and the sensor was zeroed
    wherever the part begins.
    """
    covariance = compute_block_covariance(
        sample_noise.sd_N, sample_noise.lag, np.full(len(part.time_s), part.samples)
    )
    covariance += (_MIN_NOISE * part.rise_N) ** 2 * np.eye(len(part.time_s))
    whiten = np.linalg.inv(np.linalg.cholesky(covariance))
    low, high = part.travel_mm[0], part.travel_mm[-1]
    high -= 0.05 * (high - low)
    if around is not None:
        reach = _SEARCH_SD * around.sd
        low, high = max(around.place_mm - reach, low), min(around.place_mm + reach, high)
    places = np.linspace(low - before_mm, high, _PLACE_COUNT)
    return _weigh_onsets(part, whiten, places, zeroed=before_mm == 0.0)


def _weigh_onsets(part: OnsetPart, whiten: Array, places: Array, zeroed: bool) -> Onset:
    """Weigh every onset that starts at one of the places (m,) by its likelihood."""
    shapes = _build_shapes(part, places) @ whiten.T
    one, force = whiten.sum(axis=1), whiten @ part.force_N
    # Normal equations of baseline and stiffness, for all shapes (memories, m, forms) together.
    oo, oy, yy = one @ one, one @ force, force @ force
    oa, ay, aa = shapes @ one, shapes @ force, np.einsum("...n,...n", shapes, shapes)
    determinant = np.maximum(oo * aa - oa**2, 1e-300)
    stiffness = (oo * ay - oa * oy) / determinant
    baseline = (aa * oy - oa * ay) / determinant
    misfit = np.where(stiffness > 0, yy - baseline * oy - stiffness * ay, np.inf)
    # A record without slack leaves the baseline free to take up the onset: hold it to a zeroed sensor,
    # loosely, and not where it is far from zero.
    weight = -0.5 * np.log(determinant)
    if zeroed:
        weight -= np.log1p((baseline / (_ZERO_SHARE * part.rise_N)) ** 2)
    least, free = float(misfit.min()), max(len(force) - 5, 1)
    if not np.isfinite(least):
        what = "the force does not rise where the skin is met"
        raise TraceError(what, remedy="sample it faster, or check it")
    weight -= 0.5 * misfit / max(1.0, least / free)
    share = np.exp(weight - weight.max())
    share /= share.sum()
    along = share.sum(axis=(0, 2))
    mean, step = float(along @ places), places[1] - places[0]
    sd = float(np.sqrt(along @ (places - mean) ** 2 + step**2 / 12))
    return Onset(mean, sd, float((share * baseline).sum()))


def _build_shapes(part: OnsetPart, places: Array) -> Array:
    """Onsets (memories, places, forms, n) for all memories and elastic forms, one at the part's end."""
    depth = np.maximum(part.travel_mm - places[:, None, None], 0.0)
    whole = np.maximum(depth[..., -1:], 1e-300)
    stiffening = [depth + a * whole * (depth / whole) ** q for a, q in STIFFENING]
    elastic = np.concatenate([depth ** EXPONENTS[:, None], *stiffening], axis=1)
    shapes = [elastic]
    for tau in TAU_S:
        memory = compute_memory(part.time_s, elastic, tau)
        shapes += [elastic + gamma * memory for gamma in GAMMA]
    stacked = np.stack(shapes)
    return np.asarray(stacked / np.maximum(stacked[..., -1:], 1e-300))


def compute_memory(time: Array, elastic: Array, tau: float) -> Array:
    """Compute what relaxes with ``tau`` of an elastic force (..., n), straight between the times (n,)."""
    step = np.diff(time)
    decay = np.exp(-step / tau)
    gain = (1.0 - decay) * tau / step
    change = np.diff(elastic, axis=-1)
    memory = np.zeros_like(elastic)
    for k in range(len(step)):
        memory[..., k + 1] = decay[k] * memory[..., k] + gain[k] * change[..., k]
    return memory
