"""Strays in a label map are dropped and said, what is ambiguous is refused; one limb in an image."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from limbfit.anatomy.imaging import LabelMap, Volume, check_image, read_volume
from limbfit.anatomy.labels.labelcheck import clean_labels
from limbfit.anatomy.segmentation.body import check_one_limb
from limbfit.errors import ImageError, LabelError
from limbs import CALF, leg_image

PATH = Path("labels.nrrd")


@pytest.fixture(scope="module")
def leg() -> tuple[Volume, LabelMap]:
    return leg_image([2.0, 2.0, 2.5], (62, 64, 60), np.eye(3))


def test_a_whole_map_is_left_as_it_is(leg):
    same, notes = clean_labels(leg[1], PATH)
    assert notes == []
    assert np.array_equal(same.array, leg[1].array)


def test_strays_and_holes_are_repaired_and_said(leg):
    labels = leg[1]
    array = labels.array.copy()
    array[30, 2:4, 2:4] = 1
    array[5, 60, 3] = 2
    array[40:42, 40, 40] = 0
    array[40, 44:46, 30] = 3
    back, notes = clean_labels(labels.with_array(array), PATH)
    assert np.array_equal(back.array, labels.array)
    assert notes == [
        "dropped 2 pieces (0.05 cm3) apart from the limb",
        "filled 1 hole (0.02 cm3) inside the limb",
        "1 piece (0.02 cm3) of 'fibula' apart from the bone became soft tissue",
    ]


def spoil(labels: LabelMap, how: str) -> LabelMap:
    array = labels.array.copy()
    if how == "nameless":
        array[array == 3] = 77
    if how == "bones only":
        array[array == 1] = 0
    if how == "two limbs":
        array = np.concatenate([array, np.zeros_like(array[..., :3]), array], axis=2)
    if how == "two pieces":
        array[30][array[30] == 2] = 1
    if how == "mostly bone":
        array[array > 0] = 2
        array[20, 30, 30] = 1
    return labels.with_array(array)


@pytest.mark.parametrize(
    ("how", "expected"),
    [
        ("nameless", "values without a name: 77"),
        ("bones only", "no label is soft tissue: the map has fibula, tibia"),
        ("two limbs", "two limbs"),
        ("two pieces", "'tibia' lies in 2 large pieces"),
        ("mostly bone", "more than 80%"),
    ],
)
def test_ambiguous_maps_are_refused(leg, how, expected):
    with pytest.raises(LabelError, match=expected) as caught:
        clean_labels(spoil(leg[1], how), PATH)
    assert str(PATH) in str(caught.value)
    assert caught.value.remedy


def beside_itself(image: Volume, gap: int) -> Volume:
    """The limb and its mirror image; a negative gap makes them touch."""
    mirrored = image.array[:, :, ::-1][:, :, max(-gap, 0) :]
    between = np.zeros((*image.array.shape[:2], max(gap, 0)))
    return replace(image, array=np.concatenate([image.array, between, mirrored], axis=2))


@pytest.mark.parametrize("gap", [12, 0, -8])
@pytest.mark.parametrize("order", [(0, 1, 2), (2, 0, 1)])
def test_two_limbs_in_one_image_are_refused(leg, gap, order):
    check_one_limb(leg[0].permute_axes(order))
    with pytest.raises(ImageError, match="crop the image to one limb"):
        check_one_limb(beside_itself(leg[0], gap).permute_axes(order))


@pytest.mark.skipif(not CALF.is_dir(), reason="the calf MRI of shared/ is missing")
def test_a_real_calf_is_one_limb_and_two_of_it_are_two():
    calf = read_volume(CALF)
    check_one_limb(calf)
    with pytest.raises(ImageError, match="two limbs"):
        check_one_limb(beside_itself(calf, 0))


def test_constant_images_and_other_units_are_refused(leg):
    image = leg[0]
    check_image(image, "x.nrrd")
    with pytest.raises(ImageError, match=r"x\.nrrd: the image is constant"):
        check_image(image.with_array(np.full_like(image.array, 3)), "x.nrrd")
    for factor in (0.1, 0.001, 100.0):
        with pytest.raises(ImageError, match=r"no limb's size.*millimetres"):
            check_image(replace(image, spacing=image.spacing * factor), "x.nrrd")
