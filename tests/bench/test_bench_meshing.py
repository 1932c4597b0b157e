"""The benchmark of meshes counts what failed and measures what was made."""

import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks"))
from site_meshes import bench_meshing, draw_random_sites, make_phantom_limb

from limbfit.anatomy.meshing.layers import LayerSpec
from limbfit.anatomy.meshing.meshing import MeshSettings
from limbfit.anatomy.surfaces.surfaces import Anatomy
from limbfit.errors import InputError
from small_limb import limb

COARSE = MeshSettings(edge_near_mm=6.0, edge_far_mm=24.0, near_radius_mm=8.0, growth=0.9, flatness=1.6)


def silent(done: int, total: int, text: str) -> None:
    assert 0 <= done <= total


@pytest.fixture(scope="module")
def anatomy() -> Anatomy:
    return limb()


def test_sites_lie_on_the_skin_and_look_in(anatomy: Anatomy) -> None:
    for position, axis in draw_random_sites(anatomy, 5):
        assert anatomy.height(position) < -20
        assert np.linalg.norm(axis) == pytest.approx(1.0)
        nearest = np.linalg.norm(anatomy.skin.points - position, axis=1).argmin()
        assert anatomy.skin.vertex_normals[nearest] @ axis < -0.5


@pytest.mark.slow
def test_meshes_are_measured() -> None:
    makers = {"one": lambda: make_phantom_limb(0)}
    found = bench_meshing(sites=1, settings=COARSE, tell=silent, makers=makers)
    assert (found["sites"], found["failures"], found["failed"]) == (1, 0, [])
    assert found["thickness_mean_mm"] == pytest.approx(3.0, abs=0.1)
    assert 0 < found["min_dihedral_deg"] < 60
    assert found["seconds_median"] > 0
    assert found["limbs"]["one"]["sites"] == 1


def test_failures_are_counted(anatomy: Anatomy) -> None:
    hurried = MeshSettings(time_limit_s=0.01, edge_far_mm=24.0, layers=(LayerSpec("skin", 3.0),))
    found = bench_meshing(sites=1, settings=hurried, tell=silent, makers={"one": lambda: anatomy})
    assert (found["sites"], found["failures"]) == (1, 1)
    assert "did not end in 0.01 s" in found["failed"][0]


def test_an_unknown_mesher_is_refused() -> None:
    with pytest.raises(InputError, match="no mesher is named 'gmsh'; use one of mmg"):
        bench_meshing(engine="gmsh", tell=silent)
