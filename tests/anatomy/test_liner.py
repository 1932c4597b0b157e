"""A liner outside the skin, and the mesh of a whole limb in it."""

import numpy as np
import pytest

from bodies import limb
from limbfit.anatomy.meshing.layers import (
    LayerSpec,
    build_limb_fields,
    build_liner_surface,
    evaluate_distance,
)
from limbfit.anatomy.meshing.meshing import MeshSettings, mesh_limb
from limbfit.anatomy.surfaces.surfaces import Anatomy
from limbfit.anatomy.surfaces.triangles import check_closed
from limbfit.mesh import measure_quality
from limbs import rotation

THICKNESS = 6.0
SETTINGS = MeshSettings(
    edge_near_mm=8.0,
    edge_far_mm=24.0,
    growth=0.9,
    layers=(LayerSpec("liner", THICKNESS), LayerSpec("skin", 3.0)),
)


@pytest.fixture(scope="module")
def oblique() -> Anatomy:
    return limb(rotation(3))


@pytest.fixture(scope="module")
def made(oblique: Anatomy) -> tuple[Anatomy, np.ndarray]:
    """The limb in its liner, and the depth of its fat, which is 4 mm in the skin."""
    return build_liner_surface(oblique, THICKNESS, np.full(len(oblique.skin.points), 4.0))


@pytest.fixture(scope="module")
def lined(made: tuple[Anatomy, np.ndarray]) -> Anatomy:
    return made[0]


def test_the_outer_face_is_a_thickness_outside_the_skin(oblique: Anatomy, lined: Anatomy) -> None:
    check_closed(lined.skin, "the liner")
    assert lined.skin.volume > oblique.skin.volume
    below = lined.skin.points[lined.height(lined.skin.points) < -5.0]
    fields = build_limb_fields(oblique, (), 0.0)
    away = evaluate_distance(fields.skin, fields.frame.to_limb(below))[0]
    assert away == pytest.approx(THICKNESS, abs=0.02)
    assert lined.height(lined.skin.points).max() == pytest.approx(0.0, abs=1e-6)


def test_depth_of_fat_is_counted_from_the_outer_face(made: tuple[Anatomy, np.ndarray]) -> None:
    lined, depth = made
    assert depth == pytest.approx(np.full(len(lined.skin.points), 4.0 + THICKNESS))


def test_a_whole_limb_is_fine_all_around(oblique: Anatomy, lined: Anatomy) -> None:
    mesh, report = mesh_limb(lined, SETTINGS, fine_to_mm=30.0)
    assert measure_quality(mesh).inverted == 0
    assert mesh.region_names == ("liner", "skin", "muscle")
    assert report.layer_thickness_mm["liner"].mean == pytest.approx(THICKNESS, rel=0.02)
    assert report.layer_thickness_mm["skin"].mean == pytest.approx(3.0, rel=0.03)
    assert report.volume_error < 0.02
    faces = mesh.face_sets["skin"][:, :3]
    corners = mesh.points[faces]
    height = lined.height(corners.mean(axis=1))
    edge = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).mean(axis=1)
    fine, coarse = edge[height < -35.0].mean(), edge[height > -8.0].mean()
    assert 6.5 < fine < 9.6  # edges of the core, seen through the layers
    assert coarse > 1.25 * fine
