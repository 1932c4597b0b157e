"""What ultrasound saw beside a record: read in the stage ``traces``, compared beside the force."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...errors import TraceError
from ...identify.uncertainty.noise import SiteNoise, depth_slope
from ...study import Record, Study
from ...traces import Regularised, Thinning, read_layers, thinnings
from ..shared.tabular import read_curves, write_curves

Array = NDArray[np.float64]

CURVES = "{}-layers"  # of a record
END_SHARE = 0.05  # of the largest force: an indenter that hardly pushes does not hold the layers


def read_thinnings(
    study: Study, record: Record, touch_down_s: float, smooth: Regularised
) -> tuple[Thinning, ...]:
    """How each tissue gives way while the record's force is 5 % of its largest or more.

    Raises
    ------
    TraceError
        For a file that cannot be that, with the file, the place and the remedy.
    """
    assert record.ultrasound is not None
    file = study.path(record.ultrasound)
    pressed = smooth.time_s[smooth.force_N >= END_SHARE * smooth.force_N.max()]
    end_s = touch_down_s + float(pressed[-1])
    try:
        found = thinnings(
            read_layers(file, study.traces.time_s), touch_down_s, end_s, record.ultrasound_sd_mm
        )
    except TraceError as error:
        raise TraceError(error.what, file=file, place=error.place, remedy=error.remedy) from None
    for one in found:
        if one.tissue not in study.tissues:
            known = ", ".join(f"{tissue}_mm" for tissue in study.tissues)
            raise TraceError(
                f"the model has no tissue {one.tissue!r}",
                file=file,
                place="header",
                remedy=f"name columns among {known}",
            )
    return found


def store_thinnings(folder: Path, record: Record, found: Sequence[Thinning]) -> dict[str, Any]:
    """Write the curves of a record's tissues; what ``traces.json`` says of them."""
    columns = {f"{one.tissue}_mm": one.compression_mm for one in found}
    name = CURVES.format(record.name)
    write_curves(folder / f"{name}.csv", time_s=found[0].time_s, samples=found[0].samples, **columns)
    return {
        one.tissue: {
            "thickness_mm": one.thickness_mm,
            "compression_mm": float(one.compression_mm.max()),
            "before": one.before,
            "sd_mm": one.sd_mm,
            "compared": one.is_seen,
        }
        for one in found
    }


def load_thinnings(folder: Path, record: Record, facts: dict[str, Any]) -> tuple[Thinning, ...]:
    """The tissues of a record that are compared, as `store_thinnings` left them."""
    stated = facts.get("layers", {})
    tissues = [tissue for tissue, one in stated.items() if one["compared"]]
    if not tissues:
        return ()
    curves = read_curves(folder / f"{CURVES.format(record.name)}.csv")
    return tuple(
        Thinning(
            tissue,
            stated[tissue]["thickness_mm"],
            curves["time_s"],
            curves[f"{tissue}_mm"],
            curves["samples"],
            stated[tissue]["before"],
            stated[tissue]["sd_mm"],
        )
        for tissue in tissues
    )


def weight_of(seen: Thinning, force_error_percent: float) -> float:
    """How much its residuals count beside those of a force, 1 at most.

    A force counts as one whose error is ``force_error_percent`` of its largest. Where ultrasound is off by
    more than that share of the compression, it counts by as much less.
    """
    error = float(np.sqrt(np.diag(seen.covariance).mean())) / float(seen.compression_mm.max())
    return min(1.0, (force_error_percent / 100.0 / error) ** 2)


def layer_noise(
    name: str, seen: Thinning, compression_mm: Array, displacement_mm: Array | None, touch_down_sd_mm: float
) -> SiteNoise:
    """Noise of a tissue's compression: of the readings, of the thickness at rest, of the touch-down.

    ``compression_mm`` (n,) is the simulated one, along whose slope a wrong touch-down moves it; no
    ``displacement_mm`` (n,) under a stated force, where the time of touch-down alone is off.
    """
    covariance = seen.covariance
    if displacement_mm is not None:
        slope = touch_down_sd_mm * depth_slope(seen.time_s, displacement_mm, compression_mm)
        covariance = covariance + np.outer(slope, slope)
    return SiteNoise(name, seen.time_s, covariance, seen.sd_mm, 0.0, touch_down_sd_mm, "mm")
