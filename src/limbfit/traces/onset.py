"""The onset of force: what it may look like, and where the skin is met given what it looks like.

``F = baseline + k [s^p + gamma (s^p relaxed with tau)]``, with ``s`` the depth since touch-down: a power of
the depth, as a body that is met at a point or at an edge gives, in a material with memory (quasi-linear
viscoelasticity, one term). Memory bends the onset down as another exponent does: without it the touch-down
comes out too late, and too well known.  A small ball first bends the skin and then finds the bone below, so
that its force starts straight and stiffens: ``s + a L (s / L)^q`` over a part of length L.  Without these its
touch-down comes out a quarter of a millimetre early.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..autoregressive import compute_block_covariance
from .numerics import Array
from .scatter import Scatter

EXPONENTS = np.linspace(1.0, 2.5, 13)  # flat punch full on: 1; sphere: 1.5; cone, or an edge coming in: 2
STIFFENING = ((1.0, 2.5), (4.0, 2.5), (2.0, 2.0), (8.0, 2.0))  # a and q
STARTS = np.r_[EXPONENTS, np.ones(len(STIFFENING))]  # exponents at the very start
TAU_S = (0.1, 0.3, 1.0, 3.0)
GAMMA = (0.5, 1.5, 4.0)
_PLACES = 60  # of touch-down
_AROUND = 5.0  # standard deviations
_ZEROED = 0.02  # of the rise: how well a sensor is zeroed, loosely
_LEAST_NOISE = 1e-4  # of the rise


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
    """Where the skin is met: means over all onsets that the part allows, and ``sd`` (mm) of the place.

    ``misfit`` is what the best onset leaves, in variances of the noise.
    """

    place_mm: float
    sd: float
    exponent: float
    baseline_N: float
    misfit: float


def find_onset(
    part: OnsetPart, scatter: Scatter, around: Onset | None = None, before_mm: float = 0.0
) -> Onset:
    """The mean place over its likelihood, the noise's correlation known and the shape of the onset not.

    Stiffness and baseline are integrated out (both flat, the stiffness by the force at the end of the part),
    exponent and memory summed over a grid; the place over one that spans the part, or a finer one ``around``
    what was found so.  With ``before_mm`` it may lie by so much before the part, and the sensor was zeroed
    wherever the part begins.
    """
    covariance = compute_block_covariance(scatter.sd_N, scatter.lag, np.full(len(part.time_s), part.samples))
    covariance += (_LEAST_NOISE * part.rise_N) ** 2 * np.eye(len(part.time_s))
    whiten = np.linalg.inv(np.linalg.cholesky(covariance))
    low, high = part.travel_mm[0], part.travel_mm[-1]
    high -= 0.05 * (high - low)
    if around is not None:
        reach = _AROUND * around.sd
        low, high = max(around.place_mm - reach, low), min(around.place_mm + reach, high)
    return _weigh_onsets(part, whiten, np.linspace(low - before_mm, high, _PLACES), zeroed=before_mm == 0.0)


def _weigh_onsets(part: OnsetPart, whiten: Array, places: Array, zeroed: bool) -> Onset:
    """Every onset that starts at one of the places (m,), weighed by its likelihood."""
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
        weight -= np.log1p((baseline / (_ZEROED * part.rise_N)) ** 2)
    least, free = float(misfit.min()), max(len(force) - 5, 1)
    weight -= 0.5 * misfit / max(1.0, least / free)
    share = np.exp(weight - weight.max())
    share /= share.sum()
    along = share.sum(axis=(0, 2))
    mean, step = float(along @ places), places[1] - places[0]
    sd = float(np.sqrt(along @ (places - mean) ** 2 + step**2 / 12))
    exponent = float(share.sum(axis=(0, 1)) @ STARTS)
    return Onset(mean, sd, exponent, float((share * baseline).sum()), least / free)


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
    """What relaxes with ``tau`` of an elastic force (..., n) that is straight between the times (n,)."""
    step = np.diff(time)
    decay = np.exp(-step / tau)
    gain = (1.0 - decay) * tau / step
    change = np.diff(elastic, axis=-1)
    memory = np.zeros_like(elastic)
    for k in range(len(step)):
        memory[..., k + 1] = decay[k] * memory[..., k] + gain[k] * change[..., k]
    return memory
