"""The implicit limb: anatomy where a textbook has it, surfaces that lie on the fields."""

from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
from scipy.spatial import cKDTree

from limbfit.anatomy.grid import BONES
from limbfit.anatomy.surfaces.surfaces import check_closed
from limbfit.phantom.geometry import Limb, build_rotation, build_true_anatomy, make_limb
from limbfit.phantom.robot import (
    DETAIL_SITES,
    FITTED,
    SAFE_SHARE,
    TrueSite,
    build_true_sites,
    select_sites,
)

SEEDS = (0, 1, 2, 3)
SPACING_MM = 3.0  # of the points at which fields are asked


@pytest.fixture(scope="module", params=SEEDS)
def fields(request) -> tuple[Limb, np.ndarray, np.ndarray, dict[str, np.ndarray]]:
    """A limb, heights of points of its box, the skin's field there, and those of its bones."""
    limb = make_limb(request.param)
    axes = [np.arange(-70, 71, SPACING_MM), np.arange(-75, 76, SPACING_MM), np.arange(-2, 249, SPACING_MM)]
    local = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    points = limb.to_patient(local)
    return limb, local[..., 2], limb.skin(points), {name: limb.bone(name, points) for name in BONES}


@pytest.fixture(scope="module")
def anatomy():
    return build_true_anatomy(make_limb(0), 4.0)


@pytest.mark.parametrize("seed", SEEDS)
def test_the_crest_lies_3_to_5_mm_under_the_skin(seed: int) -> None:
    limb = make_limb(seed)
    heights = np.arange(70.0, limb.shape.joint - 60, 8.0)
    depths = []
    for height in heights:
        angles = np.linspace(-0.3, 0.6, 46)
        skin = np.array([limb.skin_point(a, height) for a in angles])
        normal = limb.inward(skin)
        depths.append(min(limb.tissue_thickness(p, n, 12.0) for p, n in zip(skin, normal, strict=True)))
    assert min(depths) >= 3.0
    assert max(depths) <= 5.0


def test_bones_are_inside_the_skin_and_do_not_overlap(fields) -> None:
    _, _, skin, bones = fields
    assert all((skin[field < 0] < -2.5).all() for field in bones.values())
    assert sum((field < 0).astype(int) for field in bones.values()).max() == 1


def test_sizes_of_a_transtibial_residuum(fields) -> None:
    _, z, skin, bones = fields
    area = [(skin < 0)[np.abs(z - height) < 0.5 * SPACING_MM].sum() * SPACING_MM**2 for height in (40, 231)]
    assert 38 < np.sqrt(area[0] / np.pi) < 50
    assert 57 < np.sqrt(area[1] / np.pi) < 66
    tibia, fibula = (z[bones[name] < 0].min() for name in ("tibia", "fibula"))
    assert 19 < tibia < 27
    assert tibia < fibula < tibia + 20
    assert 1.8 < (skin < 0).sum() * SPACING_MM**3 / 1e6 < 3.0  # litres


def test_the_joint_gap_separates_femur_and_tibia() -> None:
    limb = make_limb(0)
    along = np.arange(-15, 15, 0.05)
    line = limb.to_patient(np.stack([0 * along + 21, 0 * along + 5, limb.shape.joint + along], axis=-1))
    free = (limb.bone("tibia", line) > 0) & (limb.bone("femur", line) > 0)
    assert free.sum() * 0.05 == pytest.approx(limb.shape.joint_gap, abs=1.0)


def test_seeds_differ_and_repeat() -> None:
    assert make_limb(3).shape == make_limb(3).shape
    assert make_limb(3).shape != make_limb(4).shape
    a, b = make_limb(3), make_limb(3)
    np.testing.assert_array_equal(a.rotation, b.rotation)
    np.testing.assert_array_equal(a.origin, b.origin)
    assert np.abs(make_limb(4).origin - a.origin).max() > 1


def test_true_surfaces_are_closed_and_on_the_fields(anatomy) -> None:
    limb = make_limb(0)
    check_closed(anatomy.skin, "skin")
    below = anatomy.height(anatomy.skin.points) < -0.01
    assert np.abs(limb.skin(anatomy.skin.points[below])).max() < 1e-6
    middle = anatomy.skin.triangles.mean(axis=1)
    middle = middle[anatomy.height(middle) < -1]
    assert np.abs(limb.skin(middle)).max() < 0.1 * (4.0 / 2.4) ** 2  # 0.1 mm at the default spacing
    for name, bone in anatomy.bones.items():
        check_closed(bone, name)
        distal = bone.points[anatomy.height(bone.points) < 5]
        assert np.abs(limb.bone(name, distal)).max() < 1e-6
    assert set(anatomy.bones) == set(BONES)


def test_bones_keep_a_gap_that_an_image_can_show(anatomy) -> None:
    for one, other in combinations(anatomy.bones.values(), 2):
        assert cKDTree(one.points).query(other.points)[0].min() > 5.0


def test_the_femur_sticks_out_of_the_flat_cut_and_nothing_else_does(anatomy) -> None:
    assert anatomy.height(anatomy.skin.points).max() == pytest.approx(0, abs=1e-9)
    tops = {name: anatomy.height(bone.points).max() for name, bone in anatomy.bones.items()}
    assert tops["femur"] == pytest.approx(6.0, abs=1e-9)
    assert max(top for name, top in tops.items() if name != "femur") < -20


def test_a_moved_limb_is_the_same_limb_elsewhere() -> None:
    limb = make_limb(0)
    turn, shift = build_rotation(np.array([1.0, 2.0, 3.0]), 0.05), np.array([1.0, -2.0, 0.5])
    moved = limb.move(turn, shift)
    middle = limb.to_patient(np.array([0.0, 0.0, 125.0]))
    point = limb.skin_point(1.0, 100.0)
    there = turn @ (point - middle) + middle + shift
    assert moved.skin(there[None])[0] == pytest.approx(0, abs=1e-9)
    np.testing.assert_allclose(moved.skin_point(1.0, 100.0), there, atol=1e-9)


@pytest.mark.parametrize("seed", SEEDS[:2])
def test_sites_lie_on_the_skin_in_four_regions_at_safe_depths(seed: int) -> None:
    limb = make_limb(seed)
    sites = build_true_sites(limb, seed)
    assert len(sites) == 18
    positions = np.array([site.position for site in sites])
    assert np.abs(limb.skin(positions)).max() < 1e-9
    apart = np.linalg.norm(positions[:, None] - positions, axis=-1) + 1e3 * np.eye(18)
    assert apart.min() > 20  # so that hints 5 mm off stay unambiguous
    inward = limb.inward(positions)
    assert all(site.axis @ n > 0.97 for site, n in zip(sites, inward, strict=True))
    assert all(1.5 < site.depth <= SAFE_SHARE * site.thickness + 0.01 for site in sites)
    errors = [np.linalg.norm(site.hint - site.position) for site in sites]
    assert 3.0 <= min(errors) <= max(errors) <= 5.0
    assert {site.region for site in sites if site.fitted} == {site.region for site in sites}


def test_the_coarse_phantom_has_all_fitted_sites_and_two_more() -> None:
    coarse = DETAIL_SITES["coarse"]
    assert set(FITTED) < set(coarse)
    assert len(coarse) == len(set(coarse)) == 6


def test_sites_that_are_all_held_out_elsewhere_are_fitted_where_they_are_alone() -> None:
    first = TrueSite("02", "tibia", False, np.zeros(3), np.zeros(3), 3.0, 1.0, 10.0, np.zeros(3))
    sites = [first, replace(first, name="03"), replace(first, name="05", fitted=True)]
    assert [site.fitted for site in select_sites(sites, ["02", "05"])] == [False, True]
    assert [site.fitted for site in select_sites(sites, ["02", "03"])] == [True, True]
