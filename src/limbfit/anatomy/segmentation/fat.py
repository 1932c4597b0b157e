"""Subcutaneous fat: what is bright and joined to the skin over more than a thin septum.

The skin itself belongs to it, as in the skin–adipose layer of the model. Marrow, fat between muscles and
the septa of fat that reach in from the skin do not.
"""

import numpy as np
from scipy.ndimage import binary_propagation, distance_transform_edt, gaussian_filter
from scipy.ndimage import label as connected

from ...arrays import Array, Mask
from ..morphology import Field, find_largest_piece, open_mask

SKIN_MM = 1.5  # skin is darker than fat; so deep everything counts as skin
SEPTUM_MM = 1.5  # sheets of fat thinner than twice this are septa
_VESSEL_MM2 = 60.0  # cross-section of the largest vessel in the fat
FAT_HU = (-200.0, -25.0)
_MIN_FAT_LEVEL = 1.5  # of muscle: fat is at least this bright
_USUAL_FAT_LEVEL = 2.0  # where nothing tells how bright fat is
_RIND_MM = 20.0  # tissue so near to the skin shows both fat and muscle
_NEAR_MM, _STEP_MM = 14.0, 8.0  # half the edge of a neighbourhood, and how far apart they are
_LOW, _HIGH = 25, 93  # percentiles between which the level is looked for
_ROUNDS = 10
_MIN_SAMPLES = 50  # samples in a neighbourhood
_SAMPLE_MM = 2.5
_NOISE_MM = 0.9


def find_bright_fat(levels: Field, limb: Mask, bones: Mask, depth: Field, spacing: Array) -> Mask:
    """Voxels nearer to fat than to muscle in MRI, as bright as these are in their neighbourhood.

    ``levels`` are relative to muscle, ``depth`` is that below the skin (:func:`compute_depth`). What a coil
    sees less of is darker, fat and muscle alike, and N4 leaves some of that.
    """
    rind = limb & ~bones & (depth < _RIND_MM)
    sigma = _NOISE_MM / spacing[::-1]
    weight = gaussian_filter(limb.astype(np.float32), sigma, mode="nearest")
    total = gaussian_filter(np.where(limb, levels, 0).astype(np.float32), sigma, mode="nearest")
    mean = total / np.maximum(weight, 1e-3)  # of the neighbourhood inside the limb
    return np.asarray(limb & (mean > _compute_half_way_level(levels, rind, spacing)))


def _compute_half_way_level(levels: Field, rind: Mask, spacing: Array) -> Field:
    """Half-way between muscle and fat around each voxel."""
    every = np.maximum((_SAMPLE_MM / spacing[::-1]).astype(int), 1)
    thinned = tuple(slice(None, None, n) for n in every)
    values, inside = levels[thinned], rind[thinned]
    sampling = spacing[::-1] * every
    half = np.maximum(np.round(_NEAR_MM / sampling).astype(int), 1)
    centres = [
        np.linspace(0, n - 1, max(2, round(n / max(step, 1.0)) + 1))
        for n, step in zip(values.shape, _STEP_MM / sampling)
    ]
    found = np.full([len(c) for c in centres], np.nan)
    for place in np.ndindex(*found.shape):
        middle = [int(c[n]) for c, n in zip(centres, place)]
        box = tuple(slice(max(m - h, 0), m + h + 1) for m, h in zip(middle, half))
        near = values[box][inside[box]]
        if len(near) >= _MIN_SAMPLES:
            found[place] = _compute_isodata_level(near)
    if np.isfinite(found).any():
        nearest = distance_transform_edt(np.isnan(found), return_distances=False, return_indices=True)
        found = found[tuple(nearest)]
    else:
        found[:] = (1 + _USUAL_FAT_LEVEL) / 2
    k, j, i = (
        _interpolate_places(np.interp(np.arange(n) / e, c, np.arange(len(c))), len(c))
        for n, e, c in zip(levels.shape, every, centres)
    )
    return np.asarray(j @ np.tensordot(k, found.astype(np.float32), 1) @ i.T, dtype=np.float32)


def _compute_isodata_level(values: Field) -> float:
    """The level half-way between two kinds of tissue (isodata); not a number where there is one kind."""
    level = float(np.mean(np.percentile(values, (_LOW, _HIGH))))
    for _ in range(_ROUNDS):
        above = values > level
        if above.all() or not above.any():
            return np.nan
        low, high = float(values[~above].mean()), float(values[above].mean())
        level, before = (low + high) / 2, level
        if level == before:  # more rounds would change nothing
            break
    return level if high > _MIN_FAT_LEVEL * low else np.nan


def _interpolate_places(places: Array, count: int) -> Field:
    """The matrix (n, count) that interpolates ``count`` values linearly at fractional indices (n,)."""
    low = np.minimum(places.astype(int), count - 2)
    rows, part = np.arange(len(places)), (places - low).astype(np.float32)
    weights = np.zeros((len(places), count), dtype=np.float32)
    weights[rows, low], weights[rows, low + 1] = 1 - part, part
    return weights


def select_subcutaneous(bright: Mask, limb: Mask, bones: Mask, depth: Field, spacing: Array) -> Mask:
    """The part of ``bright`` that belongs to the skin's layer, skin included; all masks ``[k, j, i]``.

    The image's ends (first and last k) do not count as skin.
    """
    outer = ~limb | (depth < SKIN_MM)
    layer = _fill_small_holes(bright | outer, spacing) & ~bones
    opened = open_mask(layer, SEPTUM_MM, spacing)
    joined = binary_propagation(outer & opened, mask=opened) | outer
    # What the layer parts from the inner limb belongs to it too.
    rest = limb & ~joined
    joined |= rest & ~find_largest_piece(rest)
    return np.asarray(joined & limb & ~bones)


def _fill_small_holes(mask: Mask, spacing: Array) -> Mask:
    """Vessels and nerves in the fat filled, slice by slice."""
    in_slice = np.zeros((3, 3, 3), dtype=int)
    in_slice[1] = [[0, 1, 0], [1, 1, 1], [0, 1, 0]]
    parts, _ = connected(~mask, in_slice)
    small = np.bincount(parts.ravel()) * float(spacing[0] * spacing[1]) < _VESSEL_MM2
    small[0] = False
    return np.asarray(mask | small[parts])
