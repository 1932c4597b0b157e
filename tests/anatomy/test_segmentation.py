"""Limb and bones found in synthetic, phantom and real images."""

import numpy as np
import pytest
from scipy.ndimage import label

from limbfit.anatomy.grid import BONES
from limbfit.anatomy.imaging import LabelMap, Volume, read_volume
from limbfit.anatomy.segmentation.body import estimate_bias_field, find_limb_mask, smooth_image
from limbfit.anatomy.segmentation.bones import find_bones, name_bones
from limbfit.anatomy.segmentation.segmentation import segment
from limbfit.errors import ImageError
from limbfit.phantom.geometry import make_limb
from limbfit.phantom.mri import generate_slabs, make_grid
from limbs import CALF, DIRECTIONS, dice, leg_image

SHAPE, SPACING = (62, 60, 60), [2.0, 2.0, 2.5]


@pytest.mark.slow
@pytest.mark.parametrize("direction", DIRECTIONS.values(), ids=DIRECTIONS.keys())
def test_synthetic_leg(direction):
    image, truth = leg_image(SPACING, SHAPE, direction)
    labels = segment(image)
    assert labels.has_same_grid(image)
    assert dice(labels.limb, truth.limb) > 0.99
    for name in ("tibia", "fibula"):
        assert dice(labels.mask(name), truth.mask(name)) > 0.92


def test_limb_along_another_grid_axis():
    image, truth = leg_image(SPACING, SHAPE, DIRECTIONS["oblique"])
    turned = Volume(
        image.array.transpose(2, 0, 1)[:, ::-1],
        image.spacing[[1, 2, 0]],
        image.index_to_point([0, 0, SHAPE[0] - 1]),
        image.direction[:, [1, 2, 0]] * [1, -1, 1],
    )
    labels = segment(turned)
    assert labels.has_same_grid(turned)
    back = labels.array[:, ::-1].transpose(1, 2, 0)
    assert dice(back > 0, truth.limb) > 0.99
    assert dice(back == labels.value("tibia"), truth.mask("tibia")) > 0.92
    assert dice(back == labels.value("fibula"), truth.mask("fibula")) > 0.92


@pytest.mark.slow
def test_phantom_with_all_four_bones():
    """The demo's image: limb above 0.98, every bone above 0.93 (Dice)."""
    limb = make_limb(1)
    where = make_grid(limb, "coarse", 1)
    array = np.concatenate([slab for _, slab in generate_slabs(limb, where, (), 1)])
    image = Volume(array, where.spacing, where.origin, where.direction)
    labels = segment(image)
    points = where.points(*(slice(0, n) for n in array.shape))
    assert dice(labels.limb, limb.skin(points) < 0) > 0.98
    for name in BONES:
        assert dice(labels.mask(name), limb.bone(name, points) < 0) > 0.93, name


@pytest.mark.slow
def test_more_noise_and_no_bias_correction():
    image, truth = leg_image(SPACING, SHAPE, DIRECTIONS["oblique"], noise=0.05)
    labels = segment(image, bias_correction=False)
    assert dice(labels.limb, truth.limb) > 0.98
    assert dice(labels.mask("tibia"), truth.mask("tibia")) > 0.9


@pytest.mark.slow
def test_small_bones_are_left_out_one_alone_is_not_named_and_no_bone_is_an_error():
    image, _ = leg_image(SPACING, SHAPE, DIRECTIONS["straight"])
    assert segment(image, min_bone_volume_mm3=3e4).bone_names == ("bone-1",)
    with pytest.raises(ImageError, match="no bone was found"):
        segment(image, min_bone_volume_mm3=1e6)


@pytest.mark.parametrize(
    ("array", "expected"),
    [
        (np.full(SHAPE, 7.0), "constant"),
        (np.random.default_rng(0).normal(0, 300, SHAPE) - 500, "no bone"),
        (np.pad(np.full((6, 6, 6), 100.0), 20), "no limb"),
    ],
)
def test_what_is_no_mri_of_a_limb_is_refused(array, expected):
    with pytest.raises(ImageError, match=expected):
        segment(Volume(array, SPACING, [0, 0, 0], np.eye(3)))


@pytest.fixture(scope="module")
def quiet() -> tuple[Volume, LabelMap]:
    """An image with half of the noise, and its truth."""
    return leg_image(SPACING, SHAPE, DIRECTIONS["straight"], noise=0.01)


def test_outline_lies_at_half_the_signal_of_the_tissue_beside_it(quiet):
    """Bright fat at the skin does not push the outline outward: the volume is right to 0.5 %."""
    image, truth = quiet
    limb = find_limb_mask(image, smooth_image(image))
    assert limb.sum() == pytest.approx(truth.limb.sum(), rel=0.005)


def test_bias_field_is_the_coils(quiet):
    """In the middle 60 mm."""
    image, truth = (part.with_array(part.array[20:44]) for part in quiet)
    found = estimate_bias_field(image, truth.limb)
    before = image.array[truth.mask("soft tissue")]
    after = before / found[truth.mask("soft tissue")]
    muscle = after < 1.5 * np.median(after)
    assert found[truth.limb].std() > 0.02
    assert after[muscle].std() / after[muscle].mean() < 0.8 * before[muscle].std() / before[muscle].mean()


def shaft(low: int, high: int, centre: int, radius: float) -> np.ndarray:
    mask = np.zeros((100, 60, 60), bool)
    j, i = np.mgrid[:60, :60]
    mask[low:high] = np.hypot(j - 30, i - centre) < radius
    return mask


@pytest.mark.parametrize(
    ("bones", "expected"),
    [
        ([shaft(5, 100, 30, 14)], ["bone-1"]),  # a thigh
        ([shaft(5, 100, 40, 9), shaft(3, 100, 15, 8)], ["bone-1", "bone-2"]),  # a forearm
        ([shaft(5, 100, 30, 9), shaft(8, 96, 10, 4)], ["tibia", "fibula"]),
        (
            [shaft(60, 100, 30, 14), shaft(5, 58, 30, 11), shaft(8, 52, 10, 4), shaft(64, 76, 50, 6)],
            ["femur", "tibia", "fibula", "patella"],
        ),
        ([shaft(5, 100, 30, 9), shaft(40, 46, 10, 4)], ["bone-1", "bone-2"]),
        ([], []),
    ],
)
def test_names_by_size_and_place(bones, expected):
    assert name_bones(bones, np.array([1.0, 1.0, 2.0])) == expected


def marrow() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Levels of a limb with a bright rod along it, the limb, and the distance from the rod's middle."""
    levels = np.ones((20, 40, 40), np.float32)
    limb = np.zeros(levels.shape, bool)
    limb[:, 4:-4, 4:-4] = True
    j, i = np.mgrid[:40, :40]
    radius = np.hypot(j - 20, i - 20)
    levels[:, radius < 6] = 2.0
    return levels, limb, radius


def test_fat_enclosed_by_muscle_is_no_bone():
    levels, limb, radius = marrow()
    assert find_bones(levels, limb, np.ones(3), 100.0) == []
    levels[:, (radius >= 6) & (radius < 8)] = 0.2
    (bone,) = find_bones(levels, limb, np.ones(3), 100.0)
    assert bone.sum() == pytest.approx(20 * (radius < 8).sum(), rel=0.05)


def test_a_leak_in_the_cortex_does_not_part_a_bone():
    levels, limb, radius = marrow()
    levels[:, (radius >= 6) & (radius < 8)] = 0.2
    levels[9:11, 20, 24:30] = 2.0
    (bone,) = find_bones(levels, limb, np.ones(3), 100.0)
    assert (bone & (radius < 6)).any(axis=(1, 2)).all()


@pytest.mark.slow
@pytest.mark.skipif(not CALF.is_dir(), reason="the calf MRI of shared/ is missing")
def test_calf_in_every_slice():
    """The real calf: outline and tibia in at least 50 of 56 slices, the fibula too; shapes plausible."""
    labels = segment(read_volume(CALF))
    slices = labels.array.shape[0]
    limb_areas, tibia_areas, fibula_areas = (
        mask.sum(axis=(1, 2)) * np.prod(labels.spacing[:2])
        for mask in (labels.limb, labels.mask("tibia"), labels.mask("fibula"))
    )
    assert labels.bone_names == ("tibia", "fibula")
    assert ((limb_areas > 6000) & (limb_areas < 13000)).sum() == slices
    assert ((tibia_areas > 500) & (tibia_areas < 2200)).sum() >= 50
    assert ((fibula_areas > 50) & (fibula_areas < 700)).sum() >= 50
    for areas in (limb_areas, tibia_areas):
        assert np.abs(np.diff(areas) / areas[:-1]).max() < 0.15
    _one_piece(labels)


def _one_piece(labels: LabelMap) -> None:
    for name in labels.bone_names:
        parts, _ = label(labels.mask(name))
        assert np.bincount(parts.ravel())[1:].max() > 0.99 * labels.mask(name).sum()
