"""A rectified socket has the circumferences, depths and clearances that were asked for."""

from dataclasses import replace
from functools import cache

import igl
import numpy as np
import pytest
from socket_limbs import CUT_NORMAL, FILES, TOP, measure_circumference, real_limb, revolved, round_limb

from limbfit.anatomy.grid import build_limb_frame
from limbfit.anatomy.surfaces.surfaces import Anatomy
from limbfit.anatomy.surfaces.triangles import Surface, find_half_edges
from limbfit.errors import SurfaceError
from limbfit.socket import Area, Recipe, Socket, rectify_limb
from limbfit.socket.landmarks import find_knee_centre
from limbfit.socket.rectify import Trim

TRIM = Trim([(np.array([0.0, 0.0, 115.0]), CUT_NORMAL)])
PLAIN = Recipe(TRIM, flare_mm=0.0, distal="bearing")


def made(recipe: Recipe = PLAIN, anatomy: Anatomy | None = None) -> Socket:
    anatomy = anatomy or round_limb()
    return rectify_limb(anatomy.skin, anatomy.frame, recipe)


@cache
def made_plain() -> Socket:
    return made()


def ratio(socket: Socket, anatomy: Anatomy, height: float) -> float:
    """Socket's over limb's circumference at a height over the proximal cut."""
    point = anatomy.cut_point + height * anatomy.cut_normal
    return measure_circumference(socket.surface, point, anatomy.cut_normal) / measure_circumference(
        anatomy.skin, point, anatomy.cut_normal
    )


def check_face(socket: Socket, anatomy: Anatomy) -> None:
    """What holds of every socket: one brim, one side, no crossing, and clear where it is clear."""
    skin = anatomy.skin
    face, clear = socket.surface, Surface(socket.clear, socket.faces)
    assert len(face.self_intersections) == len(clear.self_intersections) == 0
    assert socket.closed_surface.volume > 0
    edges = np.sort(find_half_edges(socket.faces), axis=1)
    alone, counts = np.unique(edges, axis=0, return_counts=True)
    brim = np.sort(np.column_stack([socket.brim, np.roll(socket.brim, -1)]), axis=1)
    assert {tuple(e) for e in alone[counts == 1]} == {tuple(e) for e in brim}
    # Clear of the limb: from points on the face, and from the limb's points.
    weights = np.array([[1, 0, 0], [0.5, 0.5, 0], [1 / 3, 1 / 3, 1 / 3], [0.2, 0.2, 0.6], [0.6, 0.2, 0.2]])
    on = np.einsum("wc,mcd->mwd", weights, clear.triangles).reshape(-1, 3)
    assert skin.signed_distance(on).min() > 0.49
    apart = igl.point_mesh_squared_distance(skin.points, socket.clear, socket.faces)[0]
    assert np.sqrt(apart.min()) > 0.49
    assert closed_above(clear, anatomy).signed_distance(skin.points).max() < 0.0


def closed_above(clear: Surface, anatomy: Anatomy) -> Surface:
    """The clear face carried on straight along the limb to far above its cut, and closed there."""
    socket = Socket(clear.points, clear.faces, clear.points, np.empty(0, dtype=int))
    closed = socket.closed_surface
    points = closed.points.copy()
    points[len(clear.points) :] += 1000.0 * anatomy.cut_normal  # the fan's middle: a cone above the brim
    rim = np.unique(closed.faces[(closed.faces >= len(clear.points)).any(axis=1)])
    rim = rim[rim < len(clear.points)]
    middle = points[rim].mean(axis=0)
    points[rim] += 2.0 * (points[rim] - middle)
    return Surface(points, closed.faces)


@pytest.mark.parametrize("percent", [-2.0, 6.0])
def test_circumference_is_reduced_by_what_was_asked(percent: float) -> None:
    socket = made(replace(PLAIN, reduction_percent=percent))
    for height in (-100.0, -80.0, -60.0, -45.0):
        assert ratio(socket, round_limb(), height) == pytest.approx(1 - percent / 100, abs=0.002)


def test_volume_and_brim_of_a_round_limb() -> None:
    socket = made(replace(PLAIN, reduction_percent=0.0))
    radius = 40.0 + 12.0 * 75.0 / 110.0  # at the brim, z = 115
    cone = np.pi * 75.0 / 3 * (40.0**2 + 40.0 * radius + radius**2)
    assert socket.volume_mm3 == pytest.approx(cone + 2 / 3 * np.pi * 40.0**3, rel=0.004)
    brim = socket.points[socket.brim]
    np.testing.assert_allclose(brim[:, 2], 115.0, atol=0.02)
    np.testing.assert_allclose(np.hypot(*brim[:, :2].T), radius, atol=0.05)
    assert socket.offset(round_limb().skin)[socket.brim] == pytest.approx(0.0, abs=0.1)


def test_triangles_are_even() -> None:
    corners = made_plain().surface.triangles
    lengths = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2)
    assert 2.5 < np.percentile(lengths, 1) < 4.0 < np.percentile(lengths, 99) < 6.5
    ratio = lengths.max(axis=1) / lengths.min(axis=1)
    assert np.percentile(ratio, 99) < 2.2


def test_areas_are_as_deep_as_asked_inwards_and_outwards() -> None:
    limb, plain = round_limb(), made_plain()
    areas = [
        Area(f"{depth} mm", np.array([0.0, y, 80.0]), 25.0, depth)
        for y, depth in ((-44.0, -4.0), (44.0, 6.0))
    ]
    socket = made(replace(PLAIN, areas=areas))
    change = socket.offset(limb.skin) - plain.offset(limb.skin)
    moved = np.linalg.norm(socket.points - plain.points, axis=1)
    away = np.linalg.norm(plain.points[:, None] - [area.position for area in areas], axis=2)
    assert moved[away.min(axis=1) > 26.5].max() == 0.0
    for area, apart in zip(areas, away.T, strict=True):
        shape = (1 - (apart / 25.0) ** 2) ** 3
        middle, half = apart.argmin(), np.abs(apart - 12.5).argmin()
        assert change[middle] == pytest.approx(area.depth_mm * shape[middle], rel=0.03)
        assert np.abs(change[apart < 25.0]).max() == pytest.approx(abs(area.depth_mm), rel=0.05)
        assert change[half] / area.depth_mm == pytest.approx(shape[half], abs=0.05)


def test_a_position_on_the_skin_means_the_liner_outside_it() -> None:
    limb = round_limb()
    liner = Surface(limb.skin.points * [1.15, 1.15, 1.0], limb.skin.faces)  # some 6 mm off the skin
    at = np.array([0.0, -44.4, 80.0])
    recipe = replace(PLAIN, reduction_percent=0.0, areas=[Area("front", at, 25.0, 5.0)])
    depth = rectify_limb(liner, limb.frame, recipe).offset(liner)
    assert depth.max() == pytest.approx(5.0, rel=0.04)


def test_distal_clearance_and_bearing() -> None:
    limb = round_limb()
    bearing, clear = made_plain(), made(replace(PLAIN, distal="clearance", distal_clearance_mm=8.0))
    assert bearing.points[:, 2].min() == pytest.approx(0.0, abs=0.1)
    assert clear.points[:, 2].min() == pytest.approx(-8.0, abs=0.1)
    assert -clear.offset(limb.skin).min() == pytest.approx(8.0, abs=0.15)
    above = bearing.points[:, 2] > 41.0
    np.testing.assert_allclose(clear.points[above], bearing.points[above])


def test_the_brim_is_flared_along_an_arc() -> None:
    plain, flared = made_plain(), made(replace(PLAIN, flare_mm=10.0))
    out = np.hypot(*flared.points[flared.brim][:, :2].T) - np.hypot(*plain.points[plain.brim][:, :2].T)
    np.testing.assert_allclose(out, 10.0 * (1 - np.cos(np.pi / 3)), atol=0.9)
    low = flared.points[:, 2] < 100.0
    assert ratio(flared, round_limb(), -60.0) == pytest.approx(0.97, abs=0.002)
    assert flared.offset(round_limb().skin)[low].min() > -0.1


def test_every_part_of_a_recipe_together() -> None:
    areas = [
        Area("tendon", np.array([0.0, -47.0, 100.0]), 20.0, 5.0),
        Area("crest", np.array([5.0, -42.0, 60.0]), 18.0, -3.0),
        Area("back", np.array([0.0, 46.0, 95.0]), 30.0, 6.0),
    ]
    check_face(made(Recipe(TRIM, 4.0, areas)), round_limb())


def test_a_plane_and_a_line_trim_together() -> None:
    angle = np.linspace(0, 2 * np.pi, 12, endpoint=False)
    height = 95.0 + 12.0 * np.cos(2 * angle)
    radius = 40.0 + 12.0 * (height - 40.0) / 110.0
    line = np.column_stack([radius * np.cos(angle), radius * np.sin(angle), height])
    socket = made(replace(PLAIN, trim=Trim(line=line), reduction_percent=0.0))
    brim = socket.points[socket.brim]
    around = np.arctan2(brim[:, 1], brim[:, 0])
    np.testing.assert_allclose(brim[:, 2], 95.0 + 12.0 * np.cos(2 * around), atol=1.5)
    plane = (np.array([0.0, 0.0, 95.0]), CUT_NORMAL)
    both = made(replace(PLAIN, trim=Trim([plane], line), reduction_percent=0.0))
    low = both.points[both.brim][:, 2]
    assert low.max() == pytest.approx(95.0, abs=0.1)
    assert low.min() == pytest.approx(83.0, abs=1.0)
    check_face(both, round_limb())


def test_where_the_limb_lies_does_not_matter() -> None:
    limb = round_limb()
    turn = np.linalg.qr(np.random.default_rng(3).normal(size=(3, 3)))[0]
    turn *= np.sign(np.linalg.det(turn))
    shift = np.array([120.0, -340.0, 55.0])
    skin = Surface(limb.skin.points @ turn.T + shift, limb.skin.faces)
    recipe = replace(PLAIN, trim=Trim([(turn @ [0.0, 0.0, 115.0] + shift, turn @ CUT_NORMAL)]))
    moved = rectify_limb(skin, build_limb_frame(turn @ limb.cut_point + shift, turn @ CUT_NORMAL), recipe)
    assert moved.volume_mm3 == pytest.approx(made_plain().volume_mm3, rel=1e-4)
    assert moved.closed_surface.volume > 0


BAD = {
    "beyond the limb's proximal cut": replace(PLAIN, trim=Trim([(np.array([0.0, 0.0, 170.0]), CUT_NORMAL)])),
    "of the distal end": replace(PLAIN, trim=Trim([(np.array([0.0, 0.0, 8.0]), CUT_NORMAL)])),
    "points distally": replace(PLAIN, trim=Trim([(np.array([0.0, 0.0, 115.0]), -CUT_NORMAL)])),
    "mm off the socket's face": replace(PLAIN, areas=[Area("far", np.array([0.0, -100.0, 80.0]), 20.0, 3.0)]),
    "does not go once around": replace(
        PLAIN, trim=Trim(line=np.array([[44.0, 0, 90], [0, 44, 90], [44, 1, 90], [0, -44, 90]]))
    ),
    "too much": replace(PLAIN, distal="clearance", distal_clearance_mm=30.0),
    "cross itself": replace(
        PLAIN,
        areas=[Area(str(k), np.array([0.0, -47.0 * (-1) ** k, 100.0 - 4 * k]), 60.0, 30.0) for k in range(8)],
    ),
}


@pytest.mark.parametrize("words", BAD)
def test_what_cannot_be_made_is_refused_in_one_line(words: str) -> None:
    with pytest.raises(SurfaceError) as caught:
        made(BAD[words])
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)
    assert caught.value.remedy


def test_an_area_of_steep_sides_is_refused() -> None:
    with pytest.raises(SurfaceError, match="sides of area 'deep' would be steeper than 45 degrees") as caught:
        Area("deep", np.array([0.0, -44.0, 80.0]), 10.0, 6.0)
    assert "10.3 mm" in str(caught.value.remedy)


def test_a_folded_limb_is_refused() -> None:
    z = np.linspace(0.0, TOP, 60)
    fall = np.linspace(0.0, np.pi / 2, 20)
    profile = np.vstack(
        [
            np.column_stack([30.0 * np.sin(fall), 30.0 - 30.0 * np.cos(fall)]),
            np.column_stack([np.full(60, 45.0), z])[(z > 32.0) & (z < 95.0)],
            [[60.0, 85.0], [62.0, 90.0]],
            np.column_stack([np.full(60, 45.0), z])[z > 105.0],
        ]
    )
    folded = revolved(profile, 90)
    with pytest.raises(SurfaceError, match="folded by"):
        rectify_limb(folded, build_limb_frame(np.array([0.0, 0.0, TOP]), CUT_NORMAL), PLAIN)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["mean", "limb-1", "limb-4", "limb-5", "limb-8"])
@pytest.mark.skipif(not FILES["mean"].is_file(), reason="shared/data is not here")
def test_real_limbs(name: str) -> None:
    limb = real_limb(name)
    knee = find_knee_centre(limb)
    assert knee is not None
    top, tip = float(limb.height(knee)), float(limb.height(limb.skin.points).min())
    trim = Trim([(limb.cut_point + (top - 10.0) * limb.cut_normal, limb.cut_normal)])
    areas = [
        Area("side", _skin_at(limb, 0, top + 0.4 * (tip - top)), 25.0, 5.0),
        Area("back", _skin_at(limb, 1, top + 0.4 * (tip - top)), 30.0, -4.0),
    ]
    socket = made(Recipe(trim, 3.0, areas), limb)
    check_face(socket, limb)
    plain = made(Recipe(trim, 3.0, flare_mm=0.0, distal="bearing"), limb)
    for share in (0.15, 0.3, 0.45, 0.5):
        assert ratio(plain, limb, top + share * (tip - top)) == pytest.approx(0.97, abs=0.002)


def _skin_at(limb: Anatomy, axis: int, height: float) -> np.ndarray:
    """The point of the skin that is farthest along an axis at a height over the cut."""
    points = limb.skin.points
    near = np.abs(limb.height(points) - height) < 3.0
    return points[near][points[near][:, axis].argmax()]
