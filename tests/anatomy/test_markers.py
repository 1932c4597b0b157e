"""Markers: found in two images or in one to 1 mm, one to one with names, misses and doubles told."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from limbfit.anatomy.grid import LabelMap, Volume
from limbfit.anatomy.segmentation.body import find_limb_mask, smooth_image
from limbfit.anatomy.sites.marked import extract_marked_skin, outline_height, register_limb, remove_markers
from limbfit.anatomy.sites.sites import Marker, find_bumps, find_markers, match_markers
from limbfit.anatomy.surfaces.surfaces import extract_surface
from limbfit.anatomy.surfaces.triangles import Surface
from limbfit.errors import ImageError, SiteError
from limbfit.phantom.geometry import build_rotation, make_limb
from limbfit.phantom.mri import make_grid
from limbfit.phantom.robot import build_markers, build_true_sites
from scanned import build_image

SHIFT_MM, TURN_DEG = np.array([3.0, -2.5, 2.5]), 2.8


def mask_of(volume: Volume) -> np.ndarray:
    return find_limb_mask(volume, smooth_image(volume))


def skin_of(volume: Volume) -> Surface:
    mask = mask_of(volume).astype(np.uint8)
    return extract_surface(LabelMap(mask, *volume.geometry), None, 4.0)


@cache
def scans(seed: int):
    """The limb, the limb after a motion, and images of the first without and the second with markers."""
    limb = make_limb(seed)
    turn = build_rotation(np.array([0.3, 0.2, 1.0]), np.deg2rad(TURN_DEG))
    moved = limb.move(turn, SHIFT_MM)
    grid = make_grid(limb, "coarse", seed)
    marked = build_image(moved, grid, build_markers(build_true_sites(moved, seed)), seed=seed)
    return limb, moved, build_image(limb, grid, seed=seed), marked


def check_found(found: tuple[Marker, ...], sites) -> None:
    assert len(found) == len(sites)
    matched = match_markers(found, {site.name: site.hint for site in sites})
    errors = [np.linalg.norm(matched[site.name].position - site.position) for site in sites]
    assert max(errors) < 1.0
    assert np.mean(errors) < 0.5
    assert all(matched[site.name].direction @ site.axis < -0.97 for site in sites)
    assert all(2.0 < marker.height < 8.0 for marker in found)


@pytest.mark.slow
def test_markers_of_a_second_image_of_a_moved_limb() -> None:
    """And they are misplaced by about the motion where it is not taken back."""
    limb, _, plain, marked = scans(1)
    outline, skin = extract_marked_skin(marked)[0], skin_of(plain)
    motion = register_limb(plain, marked, mask_of(plain))
    check_found(
        find_markers(replace(outline, points=motion.apply(outline.points)), skin), build_true_sites(limb, 1)
    )
    astray = [marker.position for marker in find_markers(outline, skin)]
    errors = [np.linalg.norm(astray - s.position, axis=1).min() for s in build_true_sites(limb, 1) if astray]
    assert not errors or max(errors) > 2.0


@pytest.mark.slow
def test_motion_of_a_limb() -> None:
    limb, moved, plain, marked = scans(1)
    motion = register_limb(plain, marked, mask_of(plain))
    before, after = (np.array([s.position for s in build_true_sites(place, 1)]) for place in (limb, moved))
    assert np.linalg.norm(motion.apply(after) - before, axis=1).max() < 0.15
    assert motion.turn_deg == pytest.approx(TURN_DEG, abs=0.2)
    assert motion.correlation > 0.95


def test_motion_between_fine_images_is_as_exact() -> None:
    """Voxels of 0.5 mm, of blobs that the shift moves analytically."""
    random = np.random.default_rng(0)
    centres, widths = random.uniform(10, 38, (14, 3)), random.uniform(4, 8, 14)
    k, j, i = np.mgrid[:96, :96, :96].astype(np.float32) * 0.5

    def blobs(shift: np.ndarray) -> Volume:
        total = np.zeros(k.shape, np.float32)
        for (x, y, z), width in zip(centres + shift, widths):
            total += np.exp(-((i - x) ** 2 + (j - y) ** 2 + (k - z) ** 2) / width**2)
        return Volume(total, np.full(3, 0.5), np.zeros(3), np.eye(3))

    shift = np.array([1.3, -0.8, 0.45])
    motion = register_limb(blobs(np.zeros(3)), blobs(shift), np.ones(k.shape, bool))
    assert np.abs(motion.apply(centres + shift) - centres).max() < 0.05


@pytest.mark.slow
def test_another_limb_is_no_motion() -> None:
    _, _, plain, _ = scans(1)
    noise = np.random.default_rng(0).uniform(0, 1, plain.array.shape).astype(np.float32)
    with pytest.raises(ImageError, match="do not match"):
        register_limb(plain, plain.with_array(noise), mask_of(plain))


@pytest.mark.slow
def test_markers_of_one_image_alone_are_found_and_taken_off() -> None:
    """The skin under them comes back within the thickness of a line, elsewhere it stays as it was."""
    _, moved, _, marked = scans(1)
    sites = build_true_sites(moved, 1)
    outline = extract_marked_skin(marked)[0]
    cleaned, count = remove_markers(marked, outline)
    assert count == len(sites)
    skin = skin_of(cleaned)
    check_found(find_markers(outline, skin), sites)
    under = np.linalg.norm(skin.points - [[s.position] for s in sites], axis=-1).min(axis=0) < 6.0
    assert np.abs(moved.skin(skin.points[under])).max() < 1.2
    changed = marked.index_to_point(np.argwhere(cleaned.array != marked.array)[:, ::-1])
    far = np.linalg.norm(changed - [[s.position] for s in sites], axis=-1).min(axis=0)
    assert far.max() < 20.0


@pytest.mark.slow
def test_no_marker_where_there_is_none() -> None:
    _, _, plain, _ = scans(1)
    outline = extract_marked_skin(plain)[0]
    assert find_bumps(outline, outline_height(outline)) == []
    assert remove_markers(plain, outline)[1] == 0
    assert find_markers(outline, outline) == ()


def marker_at(x: float, y: float = 0.0) -> Marker:
    return Marker(np.array([x, y, 0.0]), 4.0, np.array([0.0, 0.0, 1.0]))


def test_matching_is_one_to_one_where_the_nearest_is_not() -> None:
    """Both names are nearest to the first marker; only one pairing gives each its own."""
    markers = [marker_at(0), marker_at(9)]
    matched = match_markers(markers, {"a": np.array([-3.0, 0, 0]), "b": np.array([3.0, 0, 0])})
    assert matched["a"] is markers[0]
    assert matched["b"] is markers[1]


def test_reach_goes_before_nearness() -> None:
    """The least total distance would leave a name out of reach although both can be served."""
    markers = [marker_at(0), marker_at(14)]
    matched = match_markers(markers, {"a": np.array([1.0, 0, 0]), "b": np.array([-0.5, 0, 0])})
    assert matched["a"] is markers[1]
    assert matched["b"] is markers[0]


def test_markers_that_nobody_asks_for_are_left_over() -> None:
    matched = match_markers([marker_at(0), marker_at(60)], {"a": np.array([2.0, 0, 0])})
    assert list(matched) == ["a"]


@pytest.mark.parametrize(
    ("markers", "hints", "told"),
    [
        (
            [0],
            {"near": 0, "far-1": 40, "far-2": 80},
            r"far-1 \(nearest at 40.0 mm\), far-2 .*; correct 'near'",
        ),
        ([0], {"a": 0, "b": 2}, "no marker of its own within 15 mm for"),
        ([-6, 7], {"a": 0, "b": 90}, r"no marker .* b \(nearest.*; more than one marker .* of a;"),
        ([-6, 7], {"a": 0}, "more than one marker within 15 mm of a;"),
        ([], {"a": 0, "b": 1}, "for a, b"),
    ],
)
def test_missing_and_doubled_markers_are_told_by_the_names_of_their_sites(markers, hints, told) -> None:
    places = {name: np.array([float(x), 0.0, 0.0]) for name, x in hints.items()}
    with pytest.raises(SiteError, match=told):
        match_markers([marker_at(x) for x in markers], places)


def test_matching_does_not_depend_on_the_order_of_markers() -> None:
    markers = [replace(marker_at(20.0 * i), height=float(i)) for i in range(6)]
    hints = {f"s{i}": np.array([20.0 * i + 3, 2.0, 0]) for i in range(6)}
    forward, backward = match_markers(markers, hints), match_markers(markers[::-1], hints)
    assert {k: v.height for k, v in forward.items()} == {k: v.height for k, v in backward.items()}
