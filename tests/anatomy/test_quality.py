"""The quality measures find what is wrong with a label map, in the slice where it is, and nothing else."""

import json

import matplotlib.image
import numpy as np
import pytest

from limbfit.anatomy.labels.labelcheck import LIMB, assess_labels
from limbfit.report.drawing.sheet import draw_sheet
from limbs import DIRECTIONS, leg_image

SHAPE, SPACING = (62, 60, 60), [2.0, 2.0, 2.5]


@pytest.fixture(scope="module")
def leg():
    return leg_image(SPACING, SHAPE, DIRECTIONS["oblique"])


def test_a_good_map_has_measures_and_no_suspects(leg):
    quality = assess_labels(leg[1])
    assert not quality.suspects
    tibia = quality.labels["tibia"]
    assert tibia.volume_cm3 == pytest.approx(np.pi * 1.3**2 * 12, rel=0.07)
    assert (tibia.pieces, tibia.holes, tibia.slices_without) == (1, 0, 0)
    json.dumps(quality.to_plain())


def _grown(array, labels, k):
    inside = np.argwhere(labels.mask("fibula")[k])
    low, high = inside.min(axis=0) - 2, inside.max(axis=0) + 3
    array[k, low[0] : high[0], low[1] : high[1]] = labels.value("fibula")


def _shifted(array, labels, k):
    mask = labels.mask("tibia")[k]
    array[k][mask] = labels.soft_value
    array[k][np.roll(mask, 3, axis=1)] = labels.value("tibia")


def _emptied(array, labels, k):
    array[k][labels.mask("fibula")[k]] = labels.soft_value


def _bitten(array, labels, k):
    array[k, :, :22] = 0


@pytest.mark.parametrize(
    ("damage", "label", "words"),
    [
        (_grown, "fibula", "area"),
        (_shifted, "tibia", "beside"),
        (_emptied, "fibula", "missing"),
        (_bitten, LIMB, "area"),
    ],
)
def test_one_bad_slice_is_named(leg, damage, label, words):
    labels, array = leg[1], leg[1].array.copy()
    damage(array, labels, 31)
    found = [s for s in assess_labels(labels.with_array(array)).suspects if s.label == label]
    assert [s.slice for s in found if words in s.what] == [31]


def test_pieces_and_holes_are_counted(leg):
    labels, array = leg[1], leg[1].array.copy()
    k, j, i = np.argwhere(labels.mask("tibia")).mean(axis=0).astype(int)
    array[k, j, i] = labels.soft_value
    array[30, 30, 30:32] = labels.value("tibia")
    facts = assess_labels(labels.with_array(array)).labels["tibia"]
    assert (facts.pieces, facts.holes) == (2, 1)
    assert facts.holes_cm3 == pytest.approx(0.01)


def test_slices_are_counted_along_the_limb_whatever_the_axis(leg):
    labels, array = leg[1], leg[1].array.copy()
    _emptied(array, labels, 31)
    turned = labels.with_array(array).permute_axes([2, 0, 1])
    quality = assess_labels(turned)
    assert quality.axis == "i"
    assert [s.slice for s in quality.suspects if "missing" in s.what] == [31]


def test_the_picture_grows_by_the_slices_to_look_at(leg, tmp_path):
    image, labels = leg
    array = labels.array.copy()
    _shifted(array, labels, 31)
    bad = labels.with_array(array)
    for name, drawn in (("good", labels), ("bad", bad)):
        draw_sheet(tmp_path / f"{name}.png", image, drawn, assess_labels(drawn))
    good, worse = (matplotlib.image.imread(tmp_path / f"{name}.png") for name in ("good", "bad"))
    assert good.shape[1] == worse.shape[1] == 1200
    assert worse.shape[0] > good.shape[0] + 200
    coloured = np.ptp(good[..., :3], axis=-1) > 0.2
    assert coloured.mean() > 0.005
