"""The noise of a record: sensor noise, estimated from its own scatter, and the uncertain touch-down.

The forces compared are a smoothed record at a few points. Slow noise passes the smoothing unchanged, fast
noise does not. Therefore the compared points have the covariance that means of their share of the samples
have.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ...arrays import Array, Indices
from ...autoregressive import compute_block_covariance, estimate_lag_one
from ...phases import find_phases
from ..fit.objective import MeasuredCurve, SiteResponse

SKIN_CORRELATION_MM = 10.0  # over which a misfit of the skin's moves goes from one point to the next
_MIN_NOISE_SHARE = 1e-4  # of the largest force: a smaller sd than this no simulation has


@dataclass(frozen=True)
class SiteNoise:
    """Noise of a site's record at the n times of comparison.

    ``covariance`` (n, n) N^2; ``sd_N`` and ``autocorrelation`` of neighbours are those of the samples as
    recorded; ``touch_down_sd_mm`` is the standard deviation of the touch-down, which is part of the
    covariance. If depths are compared, ``unit`` is mm and so are all numbers. ``site`` is where the record is
    from; by default a record is a site of its own. ``similarity`` (n, n) is the correlation of the model's
    misfit between values of one time, such as points that are near each other; None: all are the same.
    """

    name: str
    times_s: Array
    covariance: Array
    sd_N: float
    autocorrelation: float
    touch_down_sd_mm: float = 0.0
    unit: str = "N"
    site: str = ""
    similarity: Array | None = None

    @property
    def site_name(self) -> str:
        """The name that all records of one site share."""
        return self.site or self.name


def compute_skin_similarity(points_mm: Array, components: Indices) -> Array:
    """Return `SiteNoise.similarity` of moves of ``points_mm`` (n, 3) along ``components`` (n,).

    It falls over `SKIN_CORRELATION_MM`; each component has a misfit of its own.
    """
    apart = np.linalg.norm(points_mm[:, None] - points_mm[None], axis=2)
    return np.asarray(np.exp(-apart / SKIN_CORRELATION_MM) * (components[:, None] == components[None]))


def estimate_record_noise(
    name: str,
    times_s: Array,
    residual_N: Array,
    force_N: Array,
    displacement_mm: Array | None,
    touch_down_sd_mm: float = 0.0,
    smoothing: Array | None = None,
    sd_and_lag: tuple[float, float] | None = None,
) -> SiteNoise:
    """Estimate the noise of a record from ``residual_N`` (samples,), raw minus smoothed force.

    Parameters
    ----------
    times_s, force_N, displacement_mm : the compared curve (n,). The displacement is None if it is compared
        itself, in place of the force: a wrong touch-down then shifts it everywhere by the same.
    touch_down_sd_mm : an error of the touch-down moves the whole curve along its own slope.
    smoothing : (n, n) of the curve, which that slope passes too; by default none.
    sd_and_lag : standard deviation of the samples and correlation of neighbours, where they are known better
        than by the residual, from which smoothing has taken slow noise; by default those of the residual.
    """
    residual = residual_N - residual_N.mean()
    sd, lag = sd_and_lag or (float(residual.std()), estimate_lag_one(residual))
    # A point has its share of the samples, by time, and at least one.
    widths = np.gradient(times_s)
    samples = np.maximum(np.round(residual.size * widths / widths.sum()).astype(np.int64), 1)
    slope = np.full(len(times_s), touch_down_sd_mm)
    if displacement_mm is not None:
        slope *= compute_depth_slope(times_s, displacement_mm, force_N)
    slope = slope if smoothing is None else smoothing @ slope
    floor = (_MIN_NOISE_SHARE * force_N.max()) ** 2
    covariance = compute_block_covariance(sd, lag, samples) + np.outer(slope, slope)
    covariance += floor * np.eye(len(times_s))
    unit = "mm" if displacement_mm is None else "N"
    return SiteNoise(name, times_s, covariance, sd, lag, touch_down_sd_mm, unit)


def estimate_curve_noise(
    responses: Sequence[SiteResponse], measured: Sequence[MeasuredCurve]
) -> tuple[SiteNoise, ...]:
    """Estimate white noise of curves that were never smoothed from the scatter of neighbouring residuals.

    Second differences remove what is smooth.
    """
    found = []
    for response, curve in zip(responses, measured, strict=True):
        differences = np.diff(response.force_N - curve.force_N, 2)
        sd = float(np.sqrt(np.mean(differences**2) / 6.0)) if differences.size else 0.0
        sd = float(np.hypot(sd, _MIN_NOISE_SHARE * curve.force_N.max()))
        n = curve.force_N.size
        found.append(SiteNoise(curve.name, np.arange(float(n)), sd**2 * np.eye(n), sd, 0.0, site=curve.site))
    return tuple(found)


def compute_depth_slope(times_s: Array, displacement_mm: Array, force_N: Array) -> Array:
    """Return dF/dd (n,) in N/mm at every point.

    Where the indenter goes deeper than before, it is the slope of the curve itself. In a hold, on the way out
    and in later cycles it is the slope at the same depth when that was new, scaled by the force over the
    force then. It is zero where the tissue has lost contact.
    """
    slope, new = np.zeros_like(force_N), np.zeros(len(force_N), dtype=bool)
    deepest = -np.inf
    for phase in find_phases(times_s, displacement_mm):
        inside = np.flatnonzero((times_s >= phase.start_s) & (times_s <= phase.end_s))
        so_far = np.maximum.accumulate(displacement_mm[inside])
        inside = inside[displacement_mm[inside] > np.r_[-np.inf, so_far[:-1]]]
        if phase.kind != "load" or len(inside) < 2:
            continue
        rising = np.gradient(force_N[inside], displacement_mm[inside])
        deeper = displacement_mm[inside] > deepest
        slope[inside[deeper]], new[inside[deeper]] = rising[deeper], True
        deepest = max(deepest, float(displacement_mm[inside[-1]]))
    depth = displacement_mm[new]
    entering = np.interp(displacement_mm, depth, force_N[new])
    share = np.clip(force_N / np.maximum(entering, 1e-6 * force_N.max()), 0.0, 1.0)
    return np.where(new, slope, share * np.interp(displacement_mm, depth, slope[new]))
