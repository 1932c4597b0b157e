"""Contours on slices: rasterised, written and read back."""

import numpy as np
import pytest

from limbfit.anatomy.labels.labelfiles import (
    fill_even_odd,
    find_outlines,
    read_contours,
    write_contours,
)
from limbfit.errors import LabelError
from limbs import DIRECTIONS, leg_image

SHAPE, SPACING = (12, 40, 44), [1.2, 1.3, 5.0]


def circle(radius: float, count: int = 200) -> np.ndarray:
    angle = 2 * np.pi * np.arange(count) / count
    return np.column_stack([20.3 + radius * np.cos(angle), 19.7 + radius * np.sin(angle)])


def test_area_of_a_circle_with_a_hole():
    mask = fill_even_odd([circle(15.0), circle(6.0)], 44, 40)
    assert mask.sum() == pytest.approx(np.pi * (15.0**2 - 6.0**2), rel=0.01)
    assert not mask[19, 20]


def test_a_polygon_beyond_the_image_is_cut_at_its_border():
    corners = np.array([[-50.0, -50.0], [500.0, -50.0], [500.0, 10.5], [-50.0, 10.5]])
    mask = fill_even_odd([corners], 44, 40)
    assert mask[:11].all()
    assert not mask[11:].any()


def test_outlines_of_any_mask_give_it_back():
    random = np.random.default_rng(1)
    for density in (0.1, 0.5, 0.9):
        mask = random.random((40, 44)) < density
        assert np.array_equal(fill_even_odd(find_outlines(mask), 44, 40), mask)


@pytest.mark.parametrize("direction", DIRECTIONS.values(), ids=DIRECTIONS.keys())
def test_a_label_map_survives_its_contour_file(tmp_path, direction):
    image, truth = leg_image([3.0, 3.0, 4.0], (40, 40, 40), direction)
    write_contours(tmp_path / "leg.csv", truth)
    back = read_contours(tmp_path / "leg.csv", image)
    assert np.array_equal(back.array, truth.array)
    assert back.bone_names == truth.bone_names


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("a,b\n1,2\n", "not a file of contours"),
        ("label,slice,contour,x_mm,y_mm,z_mm\ntibia,0,0,1,two,3\n", "line 2"),
        ("label,slice,contour,x_mm,y_mm,z_mm\ntibia,0,0,1,nan,3\n", "line 2"),
        ("label,slice,contour,x_mm,y_mm,z_mm\ntibia,0,0,1,2,3\n", "fewer than 3 points"),
        ("label,slice,contour,x_mm,y_mm,z_mm\n", "no segment"),
    ],
)
def test_malformed_files_name_the_place(tmp_path, text, expected):
    file = tmp_path / "contours.csv"
    file.write_text(text)
    image, _ = leg_image([6.0, 6.0, 8.0], (20, 20, 20), DIRECTIONS["straight"])
    with pytest.raises(LabelError, match=expected):
        read_contours(file, image)
