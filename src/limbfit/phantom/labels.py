"""The phantom's true label map: what someone who knew the limb would have drawn on its image."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ..anatomy.grid import DEFAULT_NAMES
from ..anatomy.imaging import LabelMap, write_labels
from .geometry import Limb
from .mri import SLAB, ScanGrid

FILE = Path("labels") / "labels.seg.nrrd"
TENDON_LABEL, TENDON_VALUE = "patellar tendon", 7


def build_true_labels(limb: Limb, grid: ScanGrid) -> LabelMap:
    """Soft tissue, bones and, where the limb has one, the patellar tendon, voxel by voxel."""
    values = {name: value for value, name in DEFAULT_NAMES.items()}
    array = np.zeros(grid.shape, dtype=np.uint8)
    for start in range(0, grid.shape[0], SLAB):
        k = slice(start, min(start + SLAB, grid.shape[0]))
        points = grid.points(k, slice(0, grid.shape[1]), slice(0, grid.shape[2]))
        part = (limb.skin(points) < 0).astype(np.uint8)
        if limb.has_tendon:
            part[limb.tendon(points) < 0] = TENDON_VALUE
        for name in limb.bone_names:
            part[limb.bone(name, points) < 0] = values[name]
        array[k] = part
    names = {value: name for value, name in DEFAULT_NAMES.items() if (array == value).any()}
    tendon = {TENDON_VALUE: TENDON_LABEL} if limb.has_tendon else {}
    return LabelMap(array, np.array(grid.spacing), grid.origin, grid.direction, names | tendon)


def write_true_labels(folder: Path, limb: Limb, grid: ScanGrid) -> None:
    """Write the label map to ``FILE`` below a folder."""
    (folder / FILE.parent).mkdir()
    write_labels(folder / FILE, build_true_labels(limb, grid))
