"""Morphology by distance maps is that by balls, voxel by voxel."""

import numpy as np
import pytest
from scipy import ndimage

from limbfit.anatomy.morphology import (
    close_mask,
    compute_depth,
    compute_distance,
    dilate_mask,
    erode_mask,
    fill_slices,
    find_box,
    find_largest_piece,
    open_mask,
)

SPACINGS = [(1.0, 1.0, 1.0), (1.18, 1.15, 1.0), (0.5, 0.5, 0.5), (0.7, 0.7, 3.0)]
RADIUS_MM = 2.0


def make_ball(radius_mm: float, spacing: np.ndarray) -> np.ndarray:
    """Every voxel whose centre lies within the radius of the middle one's."""
    steps = spacing[::-1]
    axes = [np.arange(-n, n + 1) * step for n, step in zip((radius_mm / steps).astype(int), steps)]
    return sum(x * x for x in np.meshgrid(*axes, indexing="ij")) <= radius_mm**2 + 1e-9


def make_blobs(shape: tuple[int, ...], seed: int = 0) -> np.ndarray:
    """Random bodies of some voxels, of which many touch the border."""
    return ndimage.gaussian_filter(np.random.default_rng(seed).normal(size=shape), 2.5) > 0.02


@pytest.mark.parametrize("spacing", SPACINGS)
@pytest.mark.parametrize("shape", [(24, 30, 28), (40, 44)])
def test_closed_opened_dilated_and_eroded_as_by_a_ball(spacing, shape):
    mask, spacing = make_blobs(shape), np.array(spacing)
    ball = make_ball(RADIUS_MM, spacing[: len(shape)])
    reach = [n + 1 for n in ball.shape]
    padded = np.pad(mask, [(n, n) for n in reach], mode="edge")
    inner = tuple(slice(n, -n) for n in reach)
    closed = ndimage.binary_closing(padded, ball)[inner]
    opened = ndimage.binary_opening(padded, ball)[inner]
    assert mask.sum() < closed.sum() < mask.size
    assert 0 < opened.sum() < mask.sum()
    assert np.array_equal(close_mask(mask, RADIUS_MM, spacing), closed)
    assert np.array_equal(open_mask(mask, RADIUS_MM, spacing), opened)
    assert np.array_equal(dilate_mask(mask, RADIUS_MM, spacing), ndimage.binary_dilation(mask, ball))
    eroded = ndimage.binary_erosion(mask, ball, border_value=1)
    assert np.array_equal(erode_mask(mask, RADIUS_MM, spacing), eroded)


def test_distances_are_exact_and_infinite_from_nothing():
    mask, spacing = make_blobs((20, 22, 24)), np.array([1.18, 1.15, 1.0])
    exact = ndimage.distance_transform_edt(~mask, sampling=spacing[::-1])
    assert np.abs(compute_distance(mask, spacing) - exact).max() < 1e-5
    nothing = np.zeros((4, 5, 6), bool)
    assert np.isinf(compute_distance(nothing, spacing)).all()
    assert not close_mask(nothing, 3.0, spacing).any()
    assert open_mask(~nothing, 3.0, spacing).all()


def test_a_limb_goes_on_beyond_its_slices_and_not_beside_them():
    limb = np.ones((5, 9, 11), bool)
    depth = compute_depth(limb, np.array([2.0, 1.0, 4.0]))
    assert np.ptp(depth, axis=0).max() == 0
    assert depth[2, 4, 5] == pytest.approx(5.0)
    assert depth[0, 4, 0] == pytest.approx(2.0)


def test_boxes_pieces_and_holes():
    mask = np.zeros((6, 10, 10), bool)
    mask[:, 2:8, 2:8] = True
    mask[:, 4:6, 4:6] = False
    mask[0, 0, 0] = True
    assert find_box(mask[1:], 1) == (slice(0, 5), slice(1, 9), slice(1, 9))
    body = find_largest_piece(mask)
    assert body.sum() == mask.sum() - 1
    assert fill_slices(body).sum() == 6 * 36
