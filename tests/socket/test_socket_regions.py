"""Named regions lie where their names say, and together cover the limb."""

import numpy as np
import pytest
from socket_limbs import FILES, real_limb, round_limb

from limbfit.anatomy.surfaces.surfaces import Anatomy
from limbfit.errors import SurfaceError
from limbfit.socket.landmarks import (
    SkinRegion,
    build_default_regions,
    build_stated_region,
    find_bone,
    find_directions,
    find_knee_centre,
)

SIDES = ("anterior", "posterior", "medial", "lateral")
LEVELS = ("proximal", "middle", "distal")


def regions(limb: Anatomy) -> dict[str, SkinRegion]:
    return build_default_regions(limb, find_directions(limb))


def check_sides(limb: Anatomy) -> None:
    found, known = regions(limb), find_directions(limb)
    towards = {
        "anterior": known.anterior,
        "posterior": -known.anterior,
        "medial": known.medial_axis,
        "lateral": -known.medial_axis,
    }
    sides = [found[f"{side} {level}"] for side in SIDES for level in LEVELS]
    assert np.sum([region.faces for region in sides], axis=0).max() == 1  # none overlap
    knee = find_knee_centre(limb)
    assert knee is not None
    below = limb.height(limb.skin.triangles.mean(axis=1)) < limb.height(knee) - 1.0
    covered = np.any([region.faces for region in sides], axis=0)
    assert covered[below].all()
    middle = limb.skin.triangles.mean(axis=1)
    for level in LEVELS:
        all_round = np.any([found[f"{side} {level}"].faces for side in SIDES], axis=0)
        for side in SIDES:
            apart = middle[found[f"{side} {level}"].faces].mean(axis=0) - middle[all_round].mean(axis=0)
            assert apart @ towards[side] == max(apart @ way for way in towards.values())
    heights = [limb.height(found[f"anterior {level}"].position) for level in LEVELS]
    assert heights == sorted(heights, reverse=True)


def test_sides_and_levels_of_a_round_limb() -> None:
    check_sides(round_limb())


@pytest.mark.parametrize("name", ["mean", pytest.param("limb-1", marks=pytest.mark.slow)])
@pytest.mark.skipif(not FILES["mean"].is_file(), reason="shared/data is not here")
def test_regions_of_real_limbs(name: str) -> None:
    limb = real_limb(name)
    check_sides(limb)
    found, known = regions(limb), find_directions(limb)
    assert set(found) >= {"tibial crest", "distal tibia", "distal fibula", "fibular head", "patellar tendon"}
    tibia, fibula, patella = (find_bone(limb, n) for n in ("tibia", "fibula", "patella"))
    assert tibia is not None
    assert fibula is not None
    assert patella is not None
    centre = tibia.points.mean(axis=0)
    assert (found["tibial crest"].position - centre) @ known.anterior > 5.0
    assert (found["fibular head"].position - centre) @ known.medial_axis < -10.0
    near_end = np.linalg.norm(fibula.points - found["fibular head"].position, axis=1).min()
    assert near_end < 25.0
    assert abs(limb.height(found["fibular head"].position) - limb.height(fibula.points).max()) < 30.0
    low = limb.height(tibia.points).min()
    assert abs(limb.height(found["distal tibia"].position) - low) < 35.0
    tendon = limb.height(found["patellar tendon"].position)
    assert limb.height(tibia.points).min() < tendon < limb.height(patella.points).min()
    areas = {name: limb.skin.face_areas[region.faces].sum() for name, region in found.items()}
    assert 300.0 < areas["fibular head"] < np.pi * 20.0**2 * 1.4
    assert min(areas.values()) > 200.0


def test_a_side_that_the_fibula_contradicts_is_refused() -> None:
    limb = round_limb()
    found = find_directions(limb)
    assert np.array_equal(find_directions(limb, "right").medial_axis, found.medial_axis)
    with pytest.raises(SurfaceError, match=r'a right leg does, but socket.side is "left".*mirrored'):
        find_directions(limb, "left")


def test_without_bones_sides_are_left_and_right() -> None:
    limb = round_limb()
    bare = Anatomy(limb.skin, {}, limb.cut_point, limb.cut_normal)
    found = regions(bare)
    assert set(found) == {f"{s} {l}" for s in ("anterior", "left", "posterior", "right") for l in LEVELS}
    assert found["left middle"].position[0] > 30.0  # LPS: x grows to the patient's left


def test_a_stated_region_is_a_disc_on_one_side() -> None:
    limb = round_limb()
    region = build_stated_region(limb, "shin", np.array([0.0, -46.0, 70.0]), 15.0)
    middle = limb.skin.triangles.mean(axis=1)
    assert np.linalg.norm(middle[region.faces] - region.position, axis=1).max() <= 15.0
    assert limb.skin.face_areas[region.faces].sum() == pytest.approx(np.pi * 15.0**2, rel=0.1)
    with pytest.raises(SurfaceError, match="off the skin"):
        build_stated_region(limb, "shin", np.array([0.0, -96.0, 70.0]), 15.0)
    small = build_stated_region(limb, "dot", np.array([0.0, -46.0, 70.0]), 0.1)
    assert small.faces.sum() == 1
