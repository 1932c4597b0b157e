"""Site meshes of an analytic limb and of a real mean limb: volumes, layer, quality, sets, failures."""

import json
import sys
from dataclasses import replace
from importlib.util import find_spec

import igl
import numpy as np
import pytest

from bodies import limb
from limbfit.anatomy.meshing import engines
from limbfit.anatomy.meshing.extrusion import build_columns
from limbfit.anatomy.meshing.improving import curve_diagonals
from limbfit.anatomy.meshing.layers import LayerSpec, evaluate_distance
from limbfit.anatomy.meshing.meshing import BaseMesh, MeshSettings, build_base_mesh, mesh_site
from limbfit.anatomy.meshing.meshreport import check_quality
from limbfit.anatomy.surfaces.surfaces import Anatomy, Surface, read_surface
from limbfit.errors import MeshingError, SurfaceError
from limbfit.mesh import Mesh, boundary_faces, measure_quality, to_tet10
from limbfit.mesh.cells import quadratic_simplex
from limbs import OPENLIMB, rotation

COARSE = MeshSettings(edge_near_mm=6.0, edge_far_mm=17.0, near_radius_mm=10.0, growth=0.7)


def site_of(anatomy: Anatomy, direction: np.ndarray, height: float) -> tuple[np.ndarray, np.ndarray]:
    """The skin point and inward axis seen from the limb's axis in a direction of the limb frame."""
    z = anatomy.cut_normal
    side = direction - (direction @ z) * z
    side /= np.linalg.norm(side)
    start = anatomy.cut_point + height * z + 60 * side
    _, _, nearest = igl.point_mesh_squared_distance(start[None], anatomy.skin.points, anatomy.skin.faces)
    return nearest[0], -side


@pytest.fixture(scope="module")
def oblique() -> Anatomy:
    return limb(rotation(3))


@pytest.fixture(scope="module")
def base(oblique: Anatomy) -> BaseMesh:
    return build_base_mesh(oblique, COARSE)


@pytest.fixture(scope="module")
def meshed(oblique: Anatomy, base: BaseMesh) -> tuple:
    position, axis = site_of(oblique, np.array([1.0, 0.2, 0.1]), -35.0)
    return *mesh_site(oblique, position, axis, COARSE, base), position


def conforms(mesh: Mesh) -> None:
    """Every face has one or two cells (else this raises) and the boundary is a closed surface."""
    faces = boundary_faces(mesh)[:, :3]
    edges = np.sort(np.vstack([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
    counts = np.unique(edges, axis=0, return_counts=True)[1]
    assert (counts % 2 == 0).all()


def test_it_conforms_and_has_volume_layer_and_quality(meshed: tuple) -> None:
    mesh, report, _ = meshed
    assert abs(report.volume_error) < 0.005
    assert report.layer_mean_mm == pytest.approx(3.0, abs=0.05)
    assert report.layer_std_mm < 0.05
    assert report.min_dihedral_deg >= 8.0
    assert report.min_scaled_jacobian > 0.1
    assert measure_quality(mesh).inverted == 0
    assert report.interface_error_mm.mean < 0.1
    assert report.warnings == ()
    assert sum(report.region_cells.values()) == report.cells == len(mesh.cells)
    conforms(mesh)


def test_a_flat_element_is_told_where_it_matters(meshed: tuple) -> None:
    """Below 8 degrees near the site, below 3 degrees anywhere."""
    mesh, _, position = meshed
    distance = np.linalg.norm(mesh.points[mesh.corners].mean(axis=1) - position, axis=1)

    def flatten(cell: int, angle_deg: float) -> Mesh:
        a, b, c, top = mesh.corners[cell]
        foot = mesh.points[[a, b, c]].mean(axis=0)
        for height in np.geomspace(0.5, 1e-4, 60):
            points = mesh.points.copy()
            points[top] = foot + height * (points[top] - foot)
            flat = mesh.with_points(points)
            if measure_quality(flat).min_dihedral_deg < angle_deg:
                return flat
        raise AssertionError(cell)

    def told(flat: Mesh) -> tuple[str, ...]:
        return check_quality(flat, measure_quality(flat), 0.0, (position, 20.0))

    near, far = int(distance.argmin()), int(distance.argmax())
    assert check_quality(mesh, measure_quality(mesh), 0.01, (position, 20.0)) == ()
    low = flatten(near, 7.0)
    assert 3.0 < measure_quality(low).min_dihedral_deg < 7.0
    assert [text.startswith("smallest dihedral angle within 20 mm") for text in told(low)] == [True]
    assert told(flatten(far, 7.0)) == ()
    assert told(flatten(far, 1.0))[0].startswith("smallest dihedral angle 0.")
    assert "volume differs by 3.0 %" in check_quality(mesh, measure_quality(mesh), 0.03)[0]


def test_nodes_of_the_skin_stay_on_a_rough_one(oblique: Anatomy) -> None:
    """Long flat elements are improved along the skin: along a plane their nodes went 6 mm out of this one."""
    noise = np.random.default_rng(7).normal(0.0, 0.3, oblique.skin.points.shape)
    rough = replace(oblique, skin=Surface(oblique.skin.points + noise, oblique.skin.faces))
    position, axis = site_of(rough, np.array([1.0, 0.2, 0.1]), -35.0)
    settings = replace(COARSE, edge_far_mm=30.0, growth=0.9, flatness=1.6, element="tet4")
    mesh, report = mesh_site(rough, position, axis, settings)
    heads = mesh.points[np.unique(mesh.face_sets["skin"])]
    below = heads[(heads - rough.cut_point) @ rough.cut_normal < -10.0]
    assert np.abs(evaluate_distance(rough.skin, below)[0]).max() < 1e-3
    assert report.min_dihedral_deg > 6.0


def test_sets_lie_on_their_surfaces(meshed: tuple, oblique: Anatomy) -> None:
    mesh, _, _ = meshed
    assert set(mesh.node_sets) == {"fixed_bone", "fixed_proximal"}
    boundary = boundary_faces(mesh)
    fixed = [np.isin(boundary, nodes).all(axis=1) for nodes in mesh.node_sets.values()]
    assert len(boundary) == (fixed[0] | fixed[1]).sum() + len(mesh.face_sets["skin"])
    on_cut = oblique.height(mesh.points[mesh.node_sets["fixed_proximal"]])
    assert np.abs(on_cut).max() < 1e-9
    missing = np.setdiff1d(
        np.flatnonzero(np.abs(oblique.height(mesh.points)) < 1e-9), mesh.node_sets["fixed_proximal"]
    )
    assert len(missing) == 0
    bone = mesh.points[mesh.node_sets["fixed_bone"]]
    off_bone = np.abs(evaluate_distance(oblique.bones["tibia"], bone)[0])
    assert np.median(off_bone) < 0.02
    assert np.percentile(off_bone, 95) < 0.25
    assert off_bone.max() < 1.0
    faces = mesh.face_sets["skin"]
    below = oblique.height(mesh.points[np.unique(faces)]) < -4
    off_skin = np.abs(evaluate_distance(oblique.skin, mesh.points[np.unique(faces)][below])[0])
    assert np.percentile(off_skin, 95) < 0.02
    assert off_skin.max() < 0.3
    corners = mesh.points[faces[:, :3]]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    outward = evaluate_distance(oblique.skin, corners.mean(axis=1))[1]
    assert (np.einsum("ij,ij->i", normals, outward) > 0).all()


def test_coarse_faces_lie_on_a_bone_in_the_mean(oblique: Anatomy, base: BaseMesh) -> None:
    """With its nodes on the bone they would cut 0.24 mm into it."""
    position, axis = site_of(oblique, np.array([1.0, 0.2, 0.1]), -35.0)
    settings = replace(COARSE, edge_far_mm=30.0, growth=0.9, flatness=1.6)
    mesh, report = mesh_site(oblique, position, axis, settings, base)
    faces, bone = boundary_faces(mesh), mesh.node_sets["fixed_bone"]
    faces = faces[np.isin(faces, bone).all(axis=1)]
    faces = faces[~np.isin(faces, mesh.node_sets["fixed_proximal"]).all(axis=1)]
    shares = np.array([[i / 8, j / 8] for i in range(9) for j in range(9 - i)])
    places = np.einsum("qk,fki->fqi", quadratic_simplex(shares)[0], mesh.points[faces]).reshape(-1, 3)
    level, _ = evaluate_distance(oblique.bones["tibia"], places)
    assert abs(level.mean()) < 0.08
    assert np.sqrt(np.mean(level**2)) < 0.32
    assert report.min_scaled_jacobian > 0.25


def test_elements_are_small_at_the_site_and_large_far_away(meshed: tuple) -> None:
    mesh, _, position = meshed
    ends = mesh.points[mesh.face_sets["skin"][:, :3]]
    edges = np.linalg.norm(ends - np.roll(ends, 1, axis=1), axis=2).mean(axis=1)
    distance = np.linalg.norm(ends.mean(axis=1) - position, axis=1)
    assert edges[distance < 10].mean() == pytest.approx(COARSE.edge_near_mm, rel=0.3)
    assert edges[distance > 40].mean() > 1.4 * edges[distance < 10].mean()


def test_curved_elements_follow_the_skin_better_than_straight_ones(
    meshed: tuple, oblique: Anatomy, base: BaseMesh
) -> None:
    _, report, position = meshed
    axis = site_of(oblique, np.array([1.0, 0.2, 0.1]), -35.0)[1]
    _, straight = mesh_site(oblique, position, axis, replace(COARSE, curved=False), base)
    assert abs(report.volume_error) < abs(straight.volume_error) / 2


def test_shallow_bone_is_trimmed_and_reported(base: BaseMesh) -> None:
    assert base.trimmed["tibia"].volume_mm3 == 0.0  # of a deep one
    shallow = limb(bone_offset=19.0)
    position, axis = site_of(shallow, np.array([1.0, 0, 0]), -40.0)
    made = build_base_mesh(shallow, COARSE)
    mesh, report = mesh_site(shallow, position, axis, COARSE, made)
    trimmed, fields = report.trimmed_bone["tibia"], made.fields
    bone = shallow.bones["tibia"].points
    nearest = fields.depth(fields.frame.to_limb(bone[shallow.height(bone) <= 0]))[0].min()
    assert trimmed.depth_mm == pytest.approx(4.5 - nearest, abs=1e-6)
    assert trimmed.volume_mm3 > 0
    depth = fields.depth(fields.frame.to_limb(mesh.points[mesh.node_sets["fixed_bone"]]))[0]
    assert depth.min() > 4.5 - 0.1
    assert abs(report.volume_error) < 0.005
    assert report.min_dihedral_deg >= 8.0


def test_a_mesher_that_crashes_is_an_error_not_a_crash() -> None:
    dying = [sys.executable, "-c", "import os, signal; os.kill(os.getpid(), signal.SIGSEGV)"]
    with pytest.raises(MeshingError, match="stopped with code -11"):
        engines.run_worker(dying, 20.0)


def test_nothing_under_the_layer_is_refused(oblique: Anatomy) -> None:
    with pytest.raises(MeshingError, match="no muscle is left"):
        build_base_mesh(oblique, replace(COARSE, layers=(LayerSpec("skin", 60.0),)))


def test_a_skin_that_does_not_reach_the_cut_is_refused(oblique: Anatomy) -> None:
    lifted = replace(oblique, cut_point=oblique.cut_point + 5 * oblique.cut_normal)
    with pytest.raises(SurfaceError, match=r"5\.0 mm below"):
        build_base_mesh(lifted, COARSE)


def test_diagonals_follow_the_curved_edges_above_and_below() -> None:
    stack = build_columns(np.array([0, 1, 2]), np.ones((1, 3), int), 3)
    points = np.array([[0.0, 0, 0], [6, 0, 0], [0, 6, 0], [0, 0, 1], [6, 0, 1], [0, 6, 1]])
    tets, _ = stack.build_tets(np.array([[0, 1, 2]]))
    mesh = to_tet10(Mesh(points, tets, "tet4", np.zeros(3, np.int64), ("skin",)))
    flat = np.isin(mesh.points[:, 2], [0.0, 1.0]) & (np.arange(len(mesh.points)) >= 6)
    target = mesh.points + np.where(flat, 2.0, 0.0)[:, None] * np.array([0, 0, 1.0])
    found = curve_diagonals(mesh, target, stack) - mesh.points
    upright = (mesh.points[:, 2] == 0.5) & np.isin(mesh.points[:, :2], points[:, :2]).all(axis=1)
    diagonal = (mesh.points[:, 2] == 0.5) & (mesh.points[:, :2] % 6 != 0).any(axis=1)
    assert diagonal.sum() == 3
    np.testing.assert_allclose(found[diagonal], np.tile([0, 0, 2.0], (3, 1)))
    np.testing.assert_array_equal(found[upright & ~diagonal], 0.0)


REAL = replace(COARSE, edge_far_mm=18.0)


@pytest.fixture(scope="module")
def mean_limb() -> tuple[Anatomy, BaseMesh]:
    bones = {bone: read_surface(OPENLIMB / f"{bone}.stl") for bone in ("tibia", "fibula")}
    anatomy = Anatomy(
        read_surface(OPENLIMB / "skin.stl"), bones, np.array([0, 0, 5.0]), np.array([0, 0, 1.0])
    )
    return anatomy, build_base_mesh(anatomy, REAL)


@pytest.mark.slow
@pytest.mark.skipif(not OPENLIMB.is_dir(), reason="the shared mean limb is not beside the repository")
@pytest.mark.parametrize("name", ["1", "4"])
def test_real_mean_limb(mean_limb: tuple[Anatomy, BaseMesh], name: str) -> None:
    site = json.loads((OPENLIMB / "sites.json").read_text(encoding="utf-8"))["sites"][name]
    place = np.array(site["position"]), np.array(site["axis"])
    mesh, report = mesh_site(mean_limb[0], *place, REAL, mean_limb[1])
    conforms(mesh)
    assert report.min_dihedral_deg >= 8.0
    assert abs(report.volume_error) < 0.005
    assert report.layer_mean_mm == pytest.approx(3.0, abs=0.1)
    assert report.nodes < 12_000


@pytest.mark.skipif(find_spec("netgen") is None, reason="netgen-mesher is not installed")
def test_netgen_makes_the_same_limb(oblique: Anatomy, base: BaseMesh, meshed: tuple) -> None:
    position, axis = site_of(oblique, np.array([1.0, 0.2, 0.1]), -35.0)
    mesh, report = mesh_site(oblique, position, axis, replace(COARSE, engine="netgen"), base)
    conforms(mesh)
    assert measure_quality(mesh).inverted == 0
    assert report.engine == "netgen"
    assert report.min_dihedral_deg >= 7.0
    assert report.layer_mean_mm == pytest.approx(3.0, abs=0.05)
    assert abs(report.volume_error) < 0.005
    assert report.volume_mm3 == pytest.approx(meshed[1].volume_mm3, rel=0.003)
    for name, nodes in meshed[0].node_sets.items():
        found = mesh.points[mesh.node_sets[name]]
        assert np.abs(found.mean(axis=0) - meshed[0].points[nodes].mean(axis=0)).max() < 3.0


def test_a_mesher_that_is_not_installed_is_named(
    oblique: Anatomy, base: BaseMesh, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(engines, "find_spec", lambda name: None)
    position, axis = site_of(oblique, np.array([1.0, 0, 0]), -35.0)
    with pytest.raises(MeshingError, match=r"Netgen is not installed; install it with  pip install"):
        mesh_site(oblique, position, axis, replace(COARSE, engine="netgen"), base)
