"""The image of a synthetic limb in memory, without a detour by files."""

from collections.abc import Sequence

import numpy as np

from limbfit.anatomy.grid import Volume
from limbfit.phantom.geometry import Limb
from limbfit.phantom.mri import UTE, Contrast, ScanGrid, SkinMarker, generate_slabs


def build_image(
    limb: Limb,
    grid: ScanGrid,
    markers: Sequence[SkinMarker] = (),
    *,
    seed: int = 0,
    levels: Contrast = UTE,
) -> Volume:
    """The whole image; ``levels`` is one of ``CONTRASTS``."""
    array = np.concatenate([signal for _, signal in generate_slabs(limb, grid, markers, seed, levels=levels)])
    return Volume(array, np.array(grid.spacing), grid.origin, grid.direction)
