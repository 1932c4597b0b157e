"""Markers: found on rendered images to 2 mm, one to one with names, misses and doubles told."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import pyvista as pv
from scipy.ndimage import gaussian_filter

from limbfit.anatomy.markers import Marker, find_markers, match_markers
from limbfit.anatomy.triangles import Surface, bodies, from_pyvista
from limbfit.errors import SiteError
from limbfit.phantom.geometry import make_limb, rotation_about
from limbfit.phantom.mri import make_grid, slabs
from limbfit.phantom.sites import markers_of, true_sites


def outline(limb, grid, markers, seed) -> Surface:
    """The limb's outline in an image: a contour below the muscle signal, closed where the image ends."""
    image = np.concatenate([signal for _, signal in slabs(limb, grid, markers, seed)])
    padded = np.pad(gaussian_filter(image, 0.4), 1)
    data = pv.ImageData(dimensions=padded.shape[::-1])
    data.point_data["signal"] = padded.ravel()
    surface = bodies(from_pyvista(data.contour([0.3], scalars="signal", method="flying_edges")))[0]
    index = (surface.points - 1) * np.array(grid.spacing)
    surface = Surface(grid.origin + index @ grid.direction.T, surface.faces)
    return surface if surface.volume > 0 else surface.flipped


@cache
def scans(seed: int, motion: bool):
    """True sites, and outlines with and without markers; between the scans the limb may move."""
    limb = moved = make_limb(seed)
    grid = make_grid(limb, "coarse", seed)
    if motion:
        random = np.random.default_rng(seed)
        turn = rotation_about(random.normal(size=3), np.deg2rad(1.5))
        moved = limb.moved(turn, random.uniform(-2, 2, 3))
    marked = outline(moved, grid, markers_of(true_sites(moved, seed)), seed)
    return true_sites(limb, seed), marked, outline(limb, grid, (), seed)


@pytest.mark.parametrize(("seed", "motion"), [(0, False), (1, True), (2, False)])
def test_all_markers_are_found_within_2_mm(seed: int, motion: bool) -> None:
    sites, marked, plain = scans(seed, motion)
    markers = find_markers(marked, plain)
    assert len(markers) == len(sites)
    matched = match_markers(markers, {site.name: site.hint for site in sites})
    errors = [np.linalg.norm(matched[site.name].position - site.position) for site in sites]
    assert max(errors) < 2.0
    assert np.mean(errors) < 1.0
    assert all(matched[site.name].direction @ site.axis < -0.97 for site in sites)
    assert all(2.0 < marker.height < 8.0 for marker in markers)


def test_no_marker_where_there_is_none() -> None:
    _, _, plain = scans(0, False)
    assert find_markers(plain, plain) == ()


def test_without_registration_a_moved_limb_misleads() -> None:
    sites, marked, plain = scans(1, True)
    found = find_markers(marked, plain, register=False)
    hints = {site.name: site.hint for site in sites}
    try:
        matched = match_markers(found, hints)
    except SiteError:
        return
    assert max(np.linalg.norm(matched[s.name].position - s.position) for s in sites) > 2.0


def marker_at(x: float, y: float = 0.0) -> Marker:
    return Marker(np.array([x, y, 0.0]), 4.0, 60.0, np.array([0.0, 0.0, 1.0]))


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


def test_a_missing_marker_is_named_with_the_nearest_distance() -> None:
    hints = {"near": np.zeros(3), "far-1": np.array([40.0, 0, 0]), "far-2": np.array([0.0, 80, 0])}
    with pytest.raises(SiteError, match=r"far-1 \(nearest at 40.0 mm\), far-2 .*; correct 'near'"):
        match_markers([marker_at(0)], hints)


def test_two_names_for_one_marker_are_told() -> None:
    hints = {"a": np.zeros(3), "b": np.array([2.0, 0, 0])}
    with pytest.raises(SiteError, match="no marker of its own within 15 mm for"):
        match_markers([marker_at(0)], hints)


def test_two_markers_for_one_name_are_told() -> None:
    with pytest.raises(SiteError, match="more than one marker within 15 mm of a;"):
        match_markers([marker_at(-6), marker_at(7)], {"a": np.zeros(3)})


def test_no_marker_at_all_names_the_sites() -> None:
    with pytest.raises(SiteError, match="for a, b"):
        match_markers([], {"a": np.zeros(3), "b": np.ones(3)})


def test_matching_does_not_depend_on_the_order_of_markers() -> None:
    markers = [replace(marker_at(20.0 * i), height=float(i)) for i in range(6)]
    hints = {f"s{i}": np.array([20.0 * i + 3, 2.0, 0]) for i in range(6)}
    forward, backward = match_markers(markers, hints), match_markers(markers[::-1], hints)
    assert {k: v.height for k, v in forward.items()} == {k: v.height for k, v in backward.items()}
