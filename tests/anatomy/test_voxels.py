"""Closed surfaces as label maps, and amputated there: bones end at the plane, a pad of tissue beyond."""

import numpy as np
import pytest

from bodies import limb
from limbfit.anatomy.segmentation.amputation import amputate_anatomy, voxelise_anatomy
from limbfit.anatomy.surfaces.surfaces import check_anatomy
from limbfit.errors import LabelError
from limbs import rotation

PAD, EDGE = 10.0, 5.0


@pytest.fixture(scope="module")
def whole():
    """A tapered limb of 98 mm in an oblique frame; its bone ends 70 mm below the cut."""
    return limb(rotation(3))


def test_voxels_keep_the_volumes(whole):
    labels = voxelise_anatomy(whole)
    assert labels.bone_names == ("tibia",)
    assert labels.limb.sum() * labels.voxel_mm3 == pytest.approx(whole.skin.volume, rel=0.005)
    below = labels.index_to_point((np.array(np.nonzero(labels.limb))[::-1]).T)
    assert -1.0 < whole.height(below).max() <= 0.0


def test_bones_end_at_the_plane_and_the_limb_within_the_pad(whole):
    tilt = whole.cut_normal + 0.1 * np.linalg.svd(whole.cut_normal[None])[2][1]
    normal = tilt / np.linalg.norm(tilt)
    point = whole.cut_point - 40.0 * whole.cut_normal
    stump = amputate_anatomy(whole, point, normal, PAD, EDGE)
    check_anatomy(stump)
    bone = (stump.bones["tibia"].points - point) @ normal
    skin = (stump.skin.points - point) @ normal
    assert bone.min() == pytest.approx(0.0, abs=1.0)
    assert skin.min() == pytest.approx(-PAD, abs=1.0)
    assert np.abs(stump.height(stump.skin.points)).min() < 1e-6
    assert np.allclose(stump.cut_normal, whole.cut_normal)


def test_a_plane_beyond_the_bones_is_refused(whole):
    with pytest.raises(LabelError, match="cuts nothing off"):
        amputate_anatomy(whole, whole.cut_point - 85.0 * whole.cut_normal, whole.cut_normal, PAD, EDGE)
