"""What the grey values of an image mean: MRI, in which air is dark and bones are dark rings, or CT.

T1 and UTE images are segmented alike, by grey levels relative to muscle. CT has Hounsfield units.
"""

from __future__ import annotations

from typing import Literal

import numpy as np

from ...errors import ImageError
from ..grid import Volume

Contrast = Literal["auto", "T1", "UTE", "CT"]

AIR_HU, MUSCLE_HU = -1000.0, 50.0
_LIGHTEST_HU = -200.0  # every CT of a limb shows something lighter than fat
_DENSEST_AIR_HU = -400.0  # no air is denser, where a grey-value window cut it off
_AIR_WIDTH_HU = 100.0  # half the width of its peak in the histogram
_AIR_SHARE = 0.03  # of the voxels: fewer are an artefact of resampling
_TOP_HU = 100.0  # the outline does not tell bone from soft tissue


def is_ct(volume: Volume, stated: Contrast = "auto") -> bool:
    """Whether an image has Hounsfield units: by its DICOM modality, else by the peak of air in its histogram.

    Without a modality a stated ``CT`` needs no such peak, only grey values below those of fat.

    Raises
    ------
    ImageError
        For a constant image, a CT without Hounsfield units, or a stated contrast that the image contradicts.
    """
    low, high = float(volume.array.min()), float(volume.array.max())
    if high <= low:
        raise ImageError("the image is constant", remedy="check the series")
    if volume.modality in ("CT", "MR"):
        found, evidence = volume.modality == "CT", f"the DICOM modality {volume.modality} does"
    else:
        found = _has_air_peak(volume, low) or (stated == "CT" and low < _LIGHTEST_HU)
        evidence = f"the grey values, {low:.0f} to {high:.0f}, do"
    if stated != "auto" and found != (stated == "CT"):
        raise ImageError(
            f"{evidence} not fit {stated}",
            remedy='check the series, or give segmentation.contrast = "auto"',
        )
    if found and low > _LIGHTEST_HU:
        raise ImageError(
            f"the grey values of this CT, {low:.0f} to {high:.0f}, are not Hounsfield units",
            remedy="export the original series again",
        )
    return found


def _has_air_peak(volume: Volume, low: float) -> bool:
    """Whether the histogram has a peak at -1000, or at the end of a grey-value window.

    Resampling of MRI by B-splines overshoots to negative values too, but in few voxels, the fewer the lower.
    """
    air = max(low, AIR_HU)
    span = (air - _AIR_WIDTH_HU, air + _AIR_WIDTH_HU)
    count = int(np.histogram(volume.array, bins=1, range=span)[0][0])
    return air < _DENSEST_AIR_HU and count > _AIR_SHARE * volume.array.size


def rescale_above_air(volume: Volume) -> Volume:
    """A CT image as an MRI-like one for the outline: air 0, soft tissue about 1000, bone no brighter."""
    return volume.with_array(np.clip(volume.array, AIR_HU, _TOP_HU) - AIR_HU)
