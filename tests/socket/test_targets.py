"""The pressure that a socket is designed for, over a limb whose regions and bones are known."""

from dataclasses import replace

import numpy as np
import pytest
from socket_limbs import CUT_NORMAL, round_limb

from limbfit.errors import SurfaceError
from limbfit.socket import Recipe, rectify_limb
from limbfit.socket.landmarks import build_default_regions, find_directions
from limbfit.socket.pressing import PRESETS, TISSUE_DEPTH, Target, build_zone
from limbfit.socket.rectify import Trim

LIMB = round_limb()
REGIONS = build_default_regions(LIMB, find_directions(LIMB))
FACE = rectify_limb(
    LIMB.skin,
    LIMB.frame,
    Recipe(Trim([(np.array([0.0, 0.0, 112.0]), CUT_NORMAL)]), 0.0, distal="bearing", edge_mm=5.0),
)
POINTS = LIMB.skin.triangles.mean(axis=1)
UNDER = POINTS[:, 2] < 85.0  # of the brim at 112 mm, where pressure has come on


def at(target: Target) -> np.ndarray:
    return target.at(POINTS, LIMB, REGIONS, FACE)


def test_hydrostatic_is_even_below_the_brim_and_nothing_above() -> None:
    found = at(Target("hydrostatic", 12.0))
    np.testing.assert_allclose(found[UNDER], 12.0)
    assert (found[POINTS[:, 2] > 113.0] == 0.0).all()
    ring = (POINTS[:, 2] > 98.0) & (POINTS[:, 2] < 106.0)
    assert (found[ring] > 0.0).all()
    assert (found[ring] < 12.0).all()


@pytest.mark.parametrize("kind", ["total surface bearing", "patellar tendon bearing"])
def test_presets_relieve_the_prominences(kind: str) -> None:
    found, (limb, others) = at(Target(kind, 10.0)), PRESETS[kind]
    inside = REGIONS["tibial crest"].faces & UNDER
    np.testing.assert_allclose(found[inside], 10.0 * others["tibial crest"], rtol=1e-6)
    calf = REGIONS["posterior distal"].faces & (POINTS[:, 2] > 20.0)
    np.testing.assert_allclose(np.median(found[calf]), 10.0 * limb, rtol=1e-6)


def test_pressure_goes_with_the_tissue_over_the_bones() -> None:
    found = at(Target(TISSUE_DEPTH, 10.0))
    depth = np.min([bone.signed_distance(POINTS) for bone in LIMB.bones.values()], axis=0)
    np.testing.assert_allclose(found[UNDER], 10.0 * np.clip(depth[UNDER] / 20.0, 0.0, 1.0), atol=0.03)
    with pytest.raises(SurfaceError, match="the limb has no bones"):
        Target(TISSUE_DEPTH, 10.0).at(POINTS, replace(LIMB, bones={}), REGIONS, FACE)


def test_a_stated_region_wins_also_under_a_liner() -> None:
    target = Target("total surface bearing", 10.0, {"tibial crest": 25.0})
    inside = REGIONS["tibial crest"].faces & UNDER
    np.testing.assert_allclose(at(target)[inside], 25.0, rtol=1e-6)
    outside = POINTS + 6.0 * LIMB.skin.face_normals
    lined = target.at(outside, LIMB, REGIONS, FACE)
    np.testing.assert_allclose(lined[inside], 25.0, rtol=0.02)


def test_an_unknown_region_names_the_others() -> None:
    with pytest.raises(SurfaceError, match="no region is named 'heel'") as caught:
        build_zone("heel", LIMB, REGIONS, 1.0)
    assert "tibial crest" in str(caught.value.remedy)
