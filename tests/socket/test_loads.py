"""Standard loads: their size, their line past the knee, and the names that a study knows."""

from typing import get_args

import numpy as np
import pytest
from socket_limbs import round_limb

from limbfit.errors import SurfaceError
from limbfit.socket.landmarks import STANDARD_LOADS, find_directions, find_knee_centre
from limbfit.study.socket import Preset


def test_a_study_names_the_loads_that_there_are() -> None:
    assert set(get_args(Preset)) == set(STANDARD_LOADS)


@pytest.mark.parametrize("name", STANDARD_LOADS)
def test_the_moment_is_that_of_the_force_on_its_line(name: str) -> None:
    load, known = STANDARD_LOADS[name], find_directions(round_limb())
    force, moment = load.force(800.0, known), load.moment(800.0, known)
    assert force @ known.proximal == pytest.approx(800.0 * load.proximal)
    on_line = load.ahead_mm * known.anterior + load.inside_mm * known.medial_axis
    np.testing.assert_allclose(moment, np.cross(on_line + 0.7 * force, force), atol=1e-6)
    # A line ahead of the knee extends it: the moment on the shank turns its end forward, about medio-lateral.
    to_the_left = np.cross(known.proximal, known.anterior)
    assert (moment @ to_the_left < 0) == (load.ahead_mm > 0)


def test_directions_of_a_limb_with_its_fibula_on_the_right() -> None:
    known = find_directions(round_limb())
    np.testing.assert_allclose(known.anterior, [0.0, -1.0, 0.0], atol=1e-12)
    assert known.lateral is not None
    np.testing.assert_allclose(known.lateral, [-1.0, 0.0, 0.0], atol=1e-12)
    knee = find_knee_centre(round_limb())
    assert knee is not None
    np.testing.assert_allclose(knee, [0.0, -10.0, 119.0], atol=1.5)


def test_without_bones_medial_must_be_stated() -> None:
    limb = round_limb()
    bare = type(limb)(limb.skin, {}, limb.cut_point, limb.cut_normal)
    assert find_knee_centre(bare) is None
    with pytest.raises(SurfaceError, match=r"socket\.side"):
        STANDARD_LOADS["heel strike"].force(800.0, find_directions(bare))
    assert STANDARD_LOADS["single stance"].force(800.0, find_directions(bare))[2] == 800.0
