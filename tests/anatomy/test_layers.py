"""Layers of tissue: conforming columns, thickness from the fat, several layers, layers thinned over bone."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from test_meshing import COARSE, conforms, limb, site_of

from limbfit.anatomy.grid import LabelMap
from limbfit.anatomy.meshing.background import compute_volumes
from limbfit.anatomy.meshing.extrusion import build_columns, choose_even_steps
from limbfit.anatomy.meshing.layers import LayerSpec, build_limb_fields
from limbfit.anatomy.meshing.meshing import build_base_mesh, mesh_site
from limbfit.anatomy.surfaces.surfaces import Anatomy, build_anatomy
from limbfit.anatomy.surfaces.thickness import measure_fat_depth, read_thickness, write_thickness
from limbfit.errors import LabelError, SurfaceError
from limbfit.mesh import Mesh

THREE = (LayerSpec("skin", 1.5), LayerSpec("fat", 6.0))


def sheet(count: int) -> tuple[np.ndarray, np.ndarray]:
    """A flat grid of triangles, outward is +z."""
    x, y = (part.ravel() for part in np.meshgrid(np.arange(count), np.arange(count), indexing="ij"))
    node = np.arange(count * count).reshape(count, count)
    a, b, c, d = node[:-1, :-1], node[1:, :-1], node[1:, 1:], node[:-1, 1:]
    faces = np.concatenate([np.stack(t, axis=-1).reshape(-1, 3) for t in ((a, b, c), (a, c, d))])
    return np.column_stack([x, y, np.zeros(len(x))]).astype(float), faces


def test_columns_of_any_steps_fill_the_layers_and_conform() -> None:
    points, faces = sheet(6)
    random = np.random.default_rng(0)
    steps = random.integers(1, 4, size=(2, len(points)))
    shuffled = random.permutation(faces)
    stack = build_columns(np.arange(len(points)), steps, len(points))
    shares = np.tile([[0.0], [0.7], [1.0]], len(points))
    mesh_points = np.vstack([points, stack.place_nodes(points, points + np.array([0, 0, 2.0]), shares)])
    tets, layer = stack.build_tets(shuffled)
    size = compute_volumes(mesh_points, tets)
    assert size.min() > 0
    assert size[layer == 0].sum() == pytest.approx(25 * 1.4)
    assert size[layer == 1].sum() == pytest.approx(25 * 0.6)
    conforms(Mesh(mesh_points, tets, "tet4", layer, ("fat", "skin")))
    conforms(Mesh(mesh_points, tets[layer == 0], "tet4", layer[layer == 0], ("fat",)))


def test_steps_follow_the_thickness_and_change_by_one_at_most() -> None:
    thickness = np.array([1.0, 1.0, 12.0, 12.0])
    edges = np.array([[0, 1], [1, 2], [2, 3]])
    assert choose_even_steps(thickness, np.full(4, 3.0), edges, 8).tolist() == [1, 1, 2, 3]
    assert choose_even_steps(thickness, np.full(4, 100.0), edges, 8).tolist() == [1, 1, 1, 1]


@pytest.mark.slow
def test_three_layers_are_as_thick_as_asked() -> None:
    anatomy = limb()
    position, axis = site_of(anatomy, np.array([0, 1.0, 0]), -35.0)
    settings = replace(COARSE, edge_near_mm=3.5, edge_far_mm=15.0, growth=0.6, layers=THREE)
    mesh, report = mesh_site(anatomy, position, axis, settings)
    assert mesh.region_names == ("skin", "fat", "muscle")
    assert np.unique(mesh.regions).tolist() == [0, 1, 2]
    conforms(mesh)
    assert report.layer_thickness_mm["skin"].mean == pytest.approx(1.5, abs=0.05)
    assert report.layer_thickness_mm["fat"].mean == pytest.approx(6.0, abs=0.1)
    assert report.min_dihedral_deg >= 7.0
    assert report.min_scaled_jacobian > 0.1
    assert report.region_cells["fat"] > report.region_cells["skin"]


@pytest.mark.slow
def test_layers_are_thinned_over_bone_instead_of_trimming_it() -> None:
    anatomy = limb(bone_offset=19.0)
    thin = replace(COARSE, bone_policy="thin-skin")
    base = build_base_mesh(anatomy, thin)
    trimmed = build_base_mesh(anatomy, COARSE).trimmed["tibia"]
    position, axis = site_of(anatomy, np.array([1.0, 0, 0]), -40.0)
    mesh, report = mesh_site(anatomy, position, axis, thin, base)
    conforms(mesh)
    assert trimmed.volume_mm3 > 0
    assert base.trimmed["tibia"].volume_mm3 < 0.2 * trimmed.volume_mm3
    thickness = report.layer_thickness_mm["skin"]
    assert 1.0 - 0.1 <= thickness.min < 2.8
    assert thickness.max == pytest.approx(3.0, abs=0.1)
    assert report.thinned_skin.thinnest_mm == pytest.approx(thickness.min, abs=0.3)
    assert report.thinned_skin.volume_mm3 > 0
    assert report.min_dihedral_deg >= 7.0
    assert abs(report.volume_error) < 0.005
    deep = mesh_site(limb(), *site_of(limb(), np.array([1.0, 0, 0]), -40.0), thin)[1]
    assert deep.thinned_skin.volume_mm3 == 0.0


def fat_thickness(angle: np.ndarray) -> np.ndarray:
    return 7.0 + 3.0 * np.cos(angle)


@pytest.fixture(scope="module")
def fatty() -> tuple[LabelMap, Anatomy]:
    """A cylinder of 40 mm radius, rounded below, in 1.5 mm of skin and a fat that varies around it."""
    spacing = 1.5
    axis = np.arange(-48.0, 48.0, spacing)
    z, y, x = np.meshgrid(np.arange(0.0, 90.0, spacing), axis, axis, indexing="ij")
    low = np.minimum(z - 45.0, 0.0)
    depth = 40.0 - np.sqrt(x**2 + y**2 + low**2)
    array = np.where(depth > 0, 1, 0)
    array[(depth > 1.5) & (depth < fat_thickness(np.arctan2(y, x)))] = 2
    array[(np.hypot(x, y) < 6.0) & (z > 40)] = 2  # an island of fat
    labels = LabelMap(array, [spacing] * 3, [-48.0, -48.0, 0.0], np.eye(3), {1: "soft tissue", 2: "fat"})
    return labels, build_anatomy(labels, 6.0)


@pytest.fixture(scope="module")
def depth(fatty: tuple) -> np.ndarray:
    """Of the fat's inner face at the vertices of the skin, mm."""
    return measure_fat_depth(*fatty)


def test_fat_depth_is_that_of_its_inner_face(fatty: tuple, depth: np.ndarray) -> None:
    _, anatomy = fatty
    x, y, z = anatomy.skin.points.T
    side = (z > 50) & (z < 84)
    error = depth[side] - fat_thickness(np.arctan2(y, x)[side])
    assert abs(error.mean()) < 0.15
    assert np.abs(error).max() < 0.8


def test_a_map_makes_a_layer_of_that_thickness(fatty: tuple, depth: np.ndarray, tmp_path: Path) -> None:
    _, anatomy = fatty
    write_thickness(tmp_path / "map.vtp", anatomy.skin, depth)
    again = read_thickness(tmp_path / "map.vtp", anatomy.skin)
    np.testing.assert_allclose(again, depth, atol=1e-4)
    layers = (LayerSpec("skin", 1.5), LayerSpec("fat", None))
    settings = replace(COARSE, layers=layers)
    with pytest.raises(SurfaceError, match="fat_depth_mm is not given"):
        build_base_mesh(anatomy, settings)
    base = build_base_mesh(anatomy, settings, again)
    position, axis = np.array([40.0, 0.0, 60.0]), np.array([-1.0, 0.0, 0.0])
    mesh, report = mesh_site(anatomy, position, axis, settings, base)
    conforms(mesh)
    assert report.min_dihedral_deg >= 7.0
    assert report.interface_error_mm.mean < 0.1
    assert abs(report.volume_error) < 0.005
    fat = report.layer_thickness_mm["fat"]
    assert fat.min == pytest.approx(2.5, abs=0.5)
    # Of the map itself, whose own error (see the test above) depends on how the skin was remeshed.
    assert fat.max == pytest.approx(again.max() - 1.5, abs=0.6)


def test_a_map_needs_fat(fatty: tuple) -> None:
    labels, anatomy = fatty
    with pytest.raises(LabelError, match="no voxel is labelled 'fat'"):
        measure_fat_depth(replace(labels, names={1: "soft tissue", 2: "tibia"}), anatomy)
    with pytest.raises(LabelError, match="nothing but fat"):
        measure_fat_depth(labels.with_array(np.where(labels.array > 0, 2, 0)), anatomy)


def test_fat_is_at_least_as_thick_as_the_least() -> None:
    anatomy = limb()
    layers = LayerSpec("skin", 1.5), LayerSpec("fat", None, 2.0)
    none = np.zeros(len(anatomy.skin.points))
    fields = build_limb_fields(anatomy, layers, COARSE.bone_clearance_mm, fat_depth_mm=none)
    np.testing.assert_allclose(fields.depths[:, 0], [1.5, 3.5])
