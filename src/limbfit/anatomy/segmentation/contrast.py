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
_LOWEST_MR = -200.0  # MRI has no negative values but for small ones of filters
_TOP_HU = 100.0  # the outline does not tell bone from soft tissue


def is_ct(volume: Volume, stated: Contrast = "auto") -> bool:
    """Whether an image has Hounsfield units, by its grey values; what was stated must not contradict them.

    Raises
    ------
    ImageError
        For a constant image, or a stated contrast that the grey values contradict.
    """
    low, high = float(volume.array.min()), float(volume.array.max())
    if high <= low:
        raise ImageError("the image is constant", remedy="check the series")
    found = low < _LOWEST_MR
    if stated != "auto" and found != (stated == "CT"):
        raise ImageError(
            f"the grey values, {low:.0f} to {high:.0f}, are not those of {stated}",
            remedy='check the series, or give segmentation.contrast = "auto"',
        )
    return found


def above_air(volume: Volume) -> Volume:
    """A CT image as an MRI-like one for the outline: air 0, soft tissue about 1000, bone no brighter."""
    return volume.with_array(np.clip(volume.array, AIR_HU, _TOP_HU) - AIR_HU)
