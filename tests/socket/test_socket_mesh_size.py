"""How fine a limb is meshed under its socket, where the study does not say so."""

from dataclasses import replace

import numpy as np
import pytest
from socket_limbs import CUT_NORMAL, round_limb

from editing import edit
from limbfit.pipeline.socket.shape import mesh_edge_mm
from limbfit.socket import Recipe, Socket, rectify_limb
from limbfit.socket.rectify import Trim
from limbfit.study import Study, load_study
from small_limb import small_limb


@pytest.fixture(scope="module")
def shank() -> Socket:
    limb = round_limb()
    recipe = Recipe(Trim([(np.array([0.0, 0.0, 112.0]), CUT_NORMAL)]), 3.0, edge_mm=5.0)
    return rectify_limb(limb.skin, limb.frame, recipe)


def of_size(socket: Socket, factor: float) -> Socket:
    return replace(socket, points=factor * socket.points, clear=factor * socket.clear)


def study_of(folder, edge: str) -> Study:
    edit(small_limb(folder, ""), "edge_mm = 14.0\n", edge)
    return load_study(folder)


def test_edges_are_of_10_mm_on_a_shank_and_grow_with_a_thigh(tmp_path, shank):
    """A thigh twice as long and as wide has four times the skin, and no more faces than a shank may have."""
    study = study_of(tmp_path, "")
    assert mesh_edge_mm(study, shank) == 10.0
    most = 8e4 / 10.0**2
    for factor in (1.8, 2.4):
        thigh = of_size(shank, factor)
        edge = mesh_edge_mm(study, thigh)
        assert thigh.surface.area > 8e4
        assert edge > 10.0
        assert thigh.surface.area / edge**2 == pytest.approx(most)
    twice, thrice = (mesh_edge_mm(study, of_size(shank, factor)) for factor in (2.0, 3.0))
    assert thrice / twice == pytest.approx(1.5)


def test_a_stated_edge_is_taken_as_it_is(tmp_path, shank):
    assert mesh_edge_mm(study_of(tmp_path, "edge_mm = 12.0\n"), of_size(shank, 2.0)) == 12.0
