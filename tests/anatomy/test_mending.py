"""Surfaces as scans and atlases give them: open ends are capped, small holes filled, and both are told."""

import re
from dataclasses import replace

import numpy as np
import pytest

from bodies import limb
from limbfit.anatomy.surfaces.mending import build_closed_anatomy, find_flat_ends, open_loops, repair_surface
from limbfit.anatomy.surfaces.surfaces import Surface, check_anatomy, check_closed
from limbfit.anatomy.surfaces.triangles import from_pyvista, remove_unused_points
from limbfit.errors import SurfaceError
from limbs import rotation


@pytest.fixture(scope="module")
def whole():
    return limb(rotation(3))


def without(surface: Surface, faces: np.ndarray) -> Surface:
    return remove_unused_points(replace(surface, faces=surface.faces[~faces]))


def opened(surface: Surface, point: np.ndarray, normal: np.ndarray) -> Surface:
    """Without every face that reaches beyond a plane: a ragged open end."""
    return without(surface, (((surface.points - point) @ normal)[surface.faces] > 0).any(axis=1))


def test_a_closed_surface_is_left_alone(whole):
    found = repair_surface(whole.skin, "skin")
    assert found.surface is whole.skin
    assert found.cap is None
    assert found.notes == ()


def turned(surface: Surface, which: slice) -> Surface:
    faces = surface.faces.copy()
    faces[which] = faces[which, ::-1]
    return replace(surface, faces=faces)


@pytest.mark.parametrize("which", [slice(0, None, 2), slice(1, None, 2), slice(0, 1), slice(0, 3000)])
def test_turned_triangles_are_turned_back_and_counted(whole, which):
    found = repair_surface(turned(whole.skin, which), "skin")
    assert found.surface.volume == pytest.approx(whole.skin.volume, rel=1e-12)
    check_closed(found.surface)
    count = len(whole.skin.faces[which])
    assert found.notes == (
        f"skin: {count} of {len(whole.skin.faces)} triangles looked inward and were turned",
    )


def test_an_open_surface_with_turned_triangles_is_capped_as_one_without(whole):
    skin = opened(whole.skin, whole.cut_point - 3 * whole.cut_normal, whole.cut_normal)
    plain, found = repair_surface(skin, "skin"), repair_surface(turned(skin, slice(0, None, 2)), "skin")
    assert found.surface.volume == pytest.approx(plain.surface.volume, rel=1e-9)
    assert found.cap.normal == pytest.approx(plain.cap.normal, abs=1e-9)


def test_a_surface_that_looks_inward_as_a_mirrored_one_does_is_refused(whole):
    for surface in (whole.skin.flipped_surface, turned(whole.skin.flipped_surface, slice(0, None, 5))):
        with pytest.raises(SurfaceError, match=r"inverted|oriented against each other"):
            build_closed_anatomy(surface, whole.bones)


def test_the_cut_of_a_closed_skin_is_the_flat_end_that_bones_reach_out_of(whole):
    anatomy, notes = build_closed_anatomy(whole.skin, whole.bones)
    assert anatomy.cut_normal == pytest.approx(whole.cut_normal, abs=1e-9)
    assert abs(whole.height(anatomy.cut_point)) < 1e-9
    assert len(notes) == 1
    assert notes[0].startswith("skin: the proximal cut is its flat end at (12.0, -80.0, 300.0) mm")


def test_a_cut_that_the_skin_does_not_reach_is_refused_before_it_is_meshed(whole):
    cut = (whole.cut_point + 20.0 * whole.cut_normal, whole.cut_normal)
    with pytest.raises(SurfaceError, match=r"geometry\.proximal_cut: the skin ends 20\.0 mm below"):
        build_closed_anatomy(whole.skin, whole.bones, cut)


def segment_along_x(length: float) -> tuple[Surface, Surface]:
    """The proximal part of a limb along x, flat at both ends, and its bone, whose tip is 70 mm below."""
    upright = limb()
    skin, bone = (Surface(s.points[:, [2, 0, 1]], s.faces) for s in (upright.skin, upright.bones["tibia"]))
    cut = skin.to_pyvista().clip_closed_surface("x", origin=(300.0 - length, 0, 0)).triangulate().clean()
    return from_pyvista(cut), bone


def test_of_two_flat_ends_it_is_the_one_that_bones_reach_out_of():
    skin, bone = segment_along_x(80.0)
    assert len(find_flat_ends(skin)) == 2
    anatomy, notes = build_closed_anatomy(skin, {"tibia": bone})
    assert anatomy.cut_normal == pytest.approx([1.0, 0.0, 0.0], abs=1e-6)
    assert anatomy.cut_point[0] == pytest.approx(300.0, abs=1e-6)
    assert sum("the proximal cut is its flat end" in note for note in notes) == 1
    with pytest.raises(SurfaceError, match="lies outside the skin"):  # through both: no guess is made
        build_closed_anatomy(segment_along_x(60.0)[0], {"tibia": bone})


def test_open_skin_and_bone_are_capped_and_cut_below_both(whole):
    normal = whole.cut_normal + 0.15 * np.linalg.svd(whole.cut_normal[None])[2][1]
    normal /= np.linalg.norm(normal)
    skin = opened(whole.skin, whole.cut_point - 3 * whole.cut_normal, normal)
    bone = opened(whole.bones["tibia"], whole.cut_point - 6 * whole.cut_normal, whole.cut_normal)
    with pytest.raises(SurfaceError, match="open"):
        check_closed(skin)
    anatomy, notes = build_closed_anatomy(skin, {"tibia": bone})
    check_anatomy(anatomy)
    assert [note.split(":")[0] for note in notes] == ["skin", "tibia"]
    assert all("open at one end" in note and "mm2" in note for note in notes)
    # The cut fits the ragged rim: near the plane that opened the skin, and just below the bone's end.
    assert anatomy.cut_normal @ normal > 0.99
    top = anatomy.height(anatomy.bones["tibia"].points).max()
    assert 1.5 < top < 6.0
    assert anatomy.skin.volume == pytest.approx(whole.skin.volume, rel=0.12)
    assert anatomy.skin.volume < whole.skin.volume


def test_small_holes_are_filled_and_told_with_their_place(whole):
    middle = whole.skin.triangles.mean(axis=1)
    here = np.argmin(np.abs(whole.height(middle) + 50.0))
    gone = np.zeros(len(middle), dtype=bool)
    gone[here] = gone[np.linalg.norm(middle - middle[here], axis=1).argsort()[1]] = True
    found = repair_surface(without(whole.skin, gone), "skin")
    check_closed(found.surface)
    assert found.cap is None
    assert len(found.notes) == 1
    told = re.search(r"a hole of \d+ edges at \((.*)\) mm filled, [\d.]+ mm2", found.notes[0])
    assert told is not None
    assert np.linalg.norm(np.fromstring(told[1], sep=",") - middle[here]) < 5.0
    assert found.surface.volume == pytest.approx(whole.skin.volume, rel=1e-3)


def test_two_open_ends_are_refused_with_their_places(whole):
    both = opened(whole.skin, whole.cut_point - 3 * whole.cut_normal, whole.cut_normal)
    both = opened(both, whole.cut_point - 80 * whole.cut_normal, -whole.cut_normal)
    assert len(open_loops(both)) == 2
    with pytest.raises(SurfaceError, match=r"skin: 2 open ends .* at \(.*\) mm and \(.*\) mm; close all but"):
        repair_surface(both, "skin")


def test_loose_triangles_are_left_out(whole):
    far = whole.skin.points[whole.skin.faces[:1]].reshape(3, 3) + 0.5
    count = len(whole.skin.points)
    littered = Surface(
        np.vstack([whole.skin.points, far]), np.vstack([whole.skin.faces, [[count, count + 1, count + 2]]])
    )
    found = repair_surface(littered, "skin")
    check_closed(found.surface)
    assert "1 loose pieces of 1 triangles left out" in found.notes[0]


def test_loops_that_touch_in_a_point_are_taken_apart():
    # A flat square of 4 x 4 points without two squares that share a corner.
    index = np.arange(16).reshape(4, 4)
    a, b, c, d = index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]
    faces = np.vstack([np.stack([a, b, c], -1).reshape(-1, 3), np.stack([a, c, d], -1).reshape(-1, 3)])
    square = np.tile(np.arange(9), 2)
    points = np.column_stack([*np.divmod(np.arange(16), 4), np.zeros(16)]).astype(float)
    loops = open_loops(Surface(points, faces[~np.isin(square, [0, 4])]))
    assert all(len(set(loop.tolist())) == len(loop) for loop in loops)
    assert sum(len(loop) for loop in loops) == 16
