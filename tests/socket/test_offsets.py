"""From a deformed surface to a socket's face; areas and zones; the control of the same volume."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from socket_limbs import CUT_NORMAL, measure_circumference, round_limb

from limbfit.anatomy.surfaces.triangles import Surface
from limbfit.errors import SurfaceError
from limbfit.socket import Recipe, Zone, rectify_limb
from limbfit.socket.rays import LimbProfile, Offsets, compute_offsets, compute_profile
from limbfit.socket.rectify import Trim, reduce_to_volume

LIMB = round_limb()
PLAIN = Recipe(
    Trim([(np.array([0.0, 0.0, 112.0]), CUT_NORMAL)]), 0.0, flare_mm=0.0, distal="bearing", edge_mm=5.0
)


def moved(by: np.ndarray) -> Surface:
    """The skin with its points moved outwards from the axis, mm."""
    points = LIMB.skin.points.copy()
    radius = np.hypot(points[:, 0], points[:, 1])
    points[:, :2] *= (1.0 + np.divide(by, radius, out=np.zeros_like(by), where=radius > 1.0))[:, None]
    return Surface(points, LIMB.skin.faces)


@cache
def profile() -> LimbProfile:
    return compute_profile(LIMB.skin, LIMB.frame)


def pressed(by: np.ndarray) -> Offsets:
    return compute_offsets(profile(), LIMB.skin, moved(by), LIMB.frame)


def test_a_shaft_that_is_3_mm_thinner_gives_a_face_that_is() -> None:
    z = LIMB.skin.points[:, 2]
    thin = -3.0 * np.clip((z - 40.0) / 20.0, 0.0, 1.0)  # not on the rounded end
    face = rectify_limb(LIMB.skin, LIMB.frame, replace(PLAIN, offsets=pressed(thin)))
    for height in (75.0, 90.0, 105.0):
        radius = 40.0 + 12.0 * (height - 40.0) / 110.0 - 3.0
        around = measure_circumference(face.surface, [0.0, 0.0, height], CUT_NORMAL)
        assert around == pytest.approx(2 * np.pi * radius, rel=0.003)
    np.testing.assert_allclose(face.points[face.brim, 2], 112.0, atol=0.2)  # the brim stays where it is


def test_a_dent_is_where_it_was_pressed_and_nowhere_else() -> None:
    points = LIMB.skin.points
    apart = np.linalg.norm(points - [0.0, -45.0, 80.0], axis=1)
    face = rectify_limb(
        LIMB.skin, LIMB.frame, replace(PLAIN, offsets=pressed(-4.0 * np.exp(-((apart / 15.0) ** 2))))
    )
    depth = face.offset(LIMB.skin)
    deepest = face.points[depth.argmax()]
    assert depth.max() == pytest.approx(4.0 / (1.0 + 4 * 5.0**2 / 2 / 15.0**2), rel=0.15)  # less by smoothing
    np.testing.assert_allclose(deepest, [0.0, -45.0 + 4.0, 80.0], atol=5.0)
    far = np.linalg.norm(face.points - [0.0, -45.0, 80.0], axis=1) > 45.0
    still = rectify_limb(LIMB.skin, LIMB.frame, PLAIN)
    np.testing.assert_allclose(face.points[far], still.points[far], atol=2e-3)  # the dent's tail


def test_a_surface_beside_the_limb_is_refused() -> None:
    aside = Surface(LIMB.skin.points + np.array([120.0, 0.0, 0.0]), LIMB.skin.faces)
    with pytest.raises(SurfaceError, match="does not surround") as caught:
        compute_offsets(profile(), LIMB.skin, aside, LIMB.frame)
    assert caught.value.remedy


def test_a_zone_is_as_deep_all_over_and_fades() -> None:
    strip = np.column_stack([np.zeros(9), np.full(9, -42.0), np.linspace(60.0, 92.0, 9)])
    face = rectify_limb(LIMB.skin, LIMB.frame, replace(PLAIN, areas=[Zone("crest", strip, 18.0, -3.0)]))
    depth = face.offset(LIMB.skin)
    tree = np.linalg.norm(face.points[:, None] - strip[None], axis=2).min(axis=1)
    assert depth[tree < 5.5].max() < -2.0  # relief: outside the limb
    assert depth.min() == pytest.approx(-3.0, abs=0.2)
    assert np.abs(depth[tree > 24.0]).max() < 0.3


def test_zones_that_cannot_be_are_refused() -> None:
    with pytest.raises(SurfaceError, match="steeper than 45 degrees"):
        Zone("crest", np.zeros((1, 3)), 10.0, 8.0)
    above = Zone("knee", np.array([[0.0, -50.0, 140.0]]), 18.0, 2.0)
    with pytest.raises(SurfaceError, match=r"'knee' lies \d+ mm off the socket's face"):
        rectify_limb(LIMB.skin, LIMB.frame, replace(PLAIN, areas=[above]))


def test_the_control_has_the_volume_that_is_asked_for() -> None:
    recipe = replace(PLAIN, distal="clearance", flare_mm=6.0, reduction_percent=3.0)
    wanted = rectify_limb(LIMB.skin, LIMB.frame, replace(recipe, reduction_percent=5.0))
    found, reduction = reduce_to_volume(wanted.volume_mm3, LIMB.skin, LIMB.frame, recipe)
    assert found.volume_mm3 == pytest.approx(wanted.volume_mm3, rel=1e-3)
    assert reduction == pytest.approx(5.0, abs=0.1)
