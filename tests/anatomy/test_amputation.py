"""Virtual amputation: bones end at the plane, a rounded pad covers them."""

import numpy as np
import pytest

from limbfit.anatomy.imaging import LabelMap
from limbfit.anatomy.segmentation.amputation import amputate_limb
from limbfit.errors import LabelError, SurfaceError
from limbs import DIRECTIONS, leg_image

PAD = 16.0


@pytest.fixture(scope="module")
def leg() -> LabelMap:
    return leg_image([2.0, 2.0, 4.0], (38, 60, 60), DIRECTIONS["oblique"])[1]


@pytest.fixture(scope="module")
def plane(leg) -> tuple[np.ndarray, np.ndarray]:
    """Across the shafts, 12 degrees off the slices."""
    normal = leg.direction @ np.array([0.15, -0.15, 1.0])
    return leg.index_to_point([30, 30, 17]), normal / np.linalg.norm(normal)


@pytest.fixture(scope="module")
def stump(leg, plane) -> LabelMap:
    return amputate_limb(leg, *plane, PAD)


def test_what_is_proximal_is_untouched(leg, plane, stump):
    kept = leg.index_to_point([[30, 30, 30], [30, 18, 30], [19, 31, 30], [3, 3, 30]])
    before = [leg.array[tuple(np.rint(leg.point_to_index(p)).astype(int)[::-1])] for p in kept]
    after = [stump.array[tuple(np.rint(stump.point_to_index(p)).astype(int)[::-1])] for p in kept]
    assert before == after == [1, 2, 3, 0]
    high = leg.compute_heights(*plane) > 0
    assert (stump.array[stump.compute_heights(*plane) > 0] > 0).sum() * stump.voxel_mm3 == pytest.approx(
        (leg.limb & high).sum() * leg.voxel_mm3, rel=0.01
    )


def test_bones_end_at_the_plane_and_the_pad_beyond(plane, stump):
    height = stump.compute_heights(*plane)
    for name in ("tibia", "fibula"):
        assert 0 <= height[stump.mask(name)].min() < 2.5
    assert -PAD <= height[stump.limb].min() < -PAD + 2.5


def test_the_pad_is_muscle_even_where_the_lowest_label_is_fat(leg, plane):
    """As in a file of 3D Slicer with the segments muscle and fat, which keep the values 7 and 6."""
    names = {2: "tibia", 3: "fibula", 6: "fat", 7: "muscle"}
    stump = amputate_limb(leg.with_array(np.where(leg.array == 1, 7, leg.array), names), *plane, PAD)
    pad = stump.limb & (stump.compute_heights(*plane) < 0)
    assert set(np.unique(stump.array[pad])) == {7}


def test_where_proximal_is_may_be_stated_for_a_leg_that_is_held_up(leg, plane):
    point, normal = plane
    stump = amputate_limb(leg, point, -normal, PAD, -normal)
    assert stump.compute_heights(point, normal)[stump.limb].max() == pytest.approx(PAD, abs=2.5)


def test_the_end_is_rounded(plane, stump):
    """Sections shrink distally, ever faster."""
    height = stump.compute_heights(*plane)
    areas = [(stump.limb & (np.abs(height + d) < 1.0)).sum() for d in (1.0, 5.0, 9.0, 13.0)]
    drops = -np.diff(areas)
    assert (drops > 0).all()
    assert (np.diff(drops) > 0).all()
    assert areas[0] > 0.9 * (stump.limb & (np.abs(height - 1.0) < 1.0)).sum()


def test_thick_slices_are_divided(leg, stump):
    assert np.allclose(stump.spacing, [1.0, 1.0, 4.0 / 3])
    low = leg.index_to_point([-0.5, -0.5, -0.5])
    assert np.allclose(stump.index_to_point([-0.5, -0.5, -0.5]), low)


@pytest.mark.parametrize(
    ("shift", "factor", "pad", "expected"),
    [
        (500, 1, PAD, "misses the limb"),
        (0, 0, PAD, "normal .* is zero"),
        (0, 1, -1, "thicker"),
        (-66, 1, PAD, "less than 16 mm distal|cuts nothing off"),
        (60, -1, PAD, "points distally; reverse it"),
        (0, -1, PAD, "points distally; reverse it"),
    ],
)
def test_impossible_planes_are_refused(leg, plane, shift, factor, pad, expected):
    point, normal = plane
    with pytest.raises(SurfaceError if factor == 0 else LabelError, match=expected):
        amputate_limb(leg, point + shift * normal, factor * normal, pad)


def test_a_plane_along_the_limb_is_refused(leg, plane):
    with pytest.raises(LabelError, match=r"does not cross the limb: its normal is 8[0-9] degrees"):
        amputate_limb(leg, plane[0], np.cross(plane[1], [0.3, 0.1, 0.5]), PAD)
