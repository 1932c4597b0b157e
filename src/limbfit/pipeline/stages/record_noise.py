"""The noise of a study's records, from what regularising took away from them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ...identify.uncertainty.noise import SiteNoise, record_noise
from ...study import Study
from .layers import layer_noise
from .traces import SiteRecord, read_record

Array = NDArray[np.float64]


def site_noise(study: Study, record: SiteRecord, force_N: Array) -> SiteNoise:
    """Noise of a record at the times of comparison, its touch-down included.

    ``force_N`` (n,) is the simulated one: what a wrong touch-down does is told by its slope, which is smooth.
    Under a stated force it is the depth, mm, and so is the noise; and so it is with what ultrasound saw.
    """
    trace, smooth, facts = read_record(study, record.record)
    if record.seen is not None:
        moved = np.interp(record.seen.time_s, record.times_s, record.displacement_mm)
        stated = None if record.record.forced else moved
        doubt = facts["touch_down_uncertainty_mm"]
        return layer_noise(record.name, record.seen, force_N, stated, doubt)
    since = trace.time_s - facts["touch_down_s"]
    inside = (since >= 0) & (since <= smooth.time_s[-1])
    residual = trace.force_N[inside] - np.interp(since[inside], smooth.time_s, smooth.force_N)
    if record.record.forced:
        moved = trace.displacement_mm[inside] - facts["touch_down_mm"]
        residual = moved - np.interp(since[inside], smooth.time_s, smooth.displacement_mm)
    return record_noise(
        record.name,
        record.times_s,
        residual,
        force_N,
        None if record.record.forced else record.displacement_mm,
        facts["touch_down_uncertainty_mm"],
        record.smoothing,
    )
