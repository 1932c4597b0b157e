"""Regions inside the core: conforming meshes of them, where they touch bone, layer and each other, errors."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from bodies import ellipsoid, limb
from limbfit.anatomy.imaging import read_labels, write_labels
from limbfit.anatomy.meshing.engines import VolumeTask, run_netgen
from limbfit.anatomy.meshing.layers import LayerSpec, build_limb_fields, evaluate_distance
from limbfit.anatomy.meshing.meshing import MeshSettings, build_base_mesh, mesh_limb, mesh_site
from limbfit.anatomy.meshing.regions import build_region_level, find_interfaces
from limbfit.anatomy.segmentation.amputation import amputate_limb, voxelise_anatomy
from limbfit.anatomy.surfaces.mending import build_closed_anatomy
from limbfit.anatomy.surfaces.surfaces import (
    Anatomy,
    build_anatomy,
    check_anatomy,
    load_anatomy,
    save_anatomy,
)
from limbfit.errors import LabelError, MeshingError, SurfaceError
from limbfit.mesh import Mesh, boundary_faces

COARSE = MeshSettings(edge_near_mm=6.0, edge_far_mm=24.0, near_radius_mm=10.0, growth=0.9)
FINE = replace(COARSE, edge_far_mm=15.0, growth=0.6)  # volumes of regions within some percent
CUT = np.array([12.0, -80.0, 300.0])  # the middle of the limb's proximal cut, LPS mm


def at(x: float, y: float, z: float) -> np.ndarray:
    """A point from the middle of the cut."""
    return CUT + np.array([x, y, z])


SITE = at(-32.0, 0.0, -40.0), np.array([1.0, 0.0, 0.0])


def with_regions(**places: tuple[list[float], list[float]]) -> Anatomy:
    """The limb with ellipsoids, each by its centre from the middle of the cut and its half axes, mm."""
    regions = {name: ellipsoid(at(*centre), np.array(axes)) for name, (centre, axes) in places.items()}
    return replace(limb_without(), regions=regions)


@cache
def limb_without() -> Anatomy:
    bare = limb()
    return build_closed_anatomy(bare.skin, bare.bones, (bare.cut_point, bare.cut_normal))[0]


INSIDE = ([-14.0, 0.0, -40.0], [5.0, 8.0, 11.0])
LONG = ([-14.0, 0.0, -40.0], [5.0, 9.0, 16.0])
THROUGH = ([23.0, 0.0, -40.0], [8.0, 8.0, 11.0])  # the sheet of muscle between bone and layer


@pytest.fixture(scope="module")
def meshed() -> tuple:
    anatomy = with_regions(scar=INSIDE, tendon=THROUGH)
    return anatomy, *mesh_site(anatomy, *SITE, COARSE)


def find_nodes_between(mesh: Mesh) -> np.ndarray:
    """The corners of the faces between the region and the muscle."""
    return np.unique(find_interfaces(mesh, 1)[0][:, :3])


def test_the_mesh_conforms_to_a_region(meshed: tuple) -> None:
    anatomy, mesh, report = meshed
    assert mesh.region_names == ("skin", "scar", "tendon", "muscle")
    assert len(boundary_faces(mesh)) < 4 * len(mesh.cells)  # raises where a face has three cells
    depth = -evaluate_distance(anatomy.regions["scar"], mesh.points)[0]
    between, scar = find_nodes_between(mesh), mesh.regions == 1
    assert np.percentile(np.abs(depth[between]), 95) < 0.01
    assert np.abs(depth[between]).max() < 0.3
    # Not the middles of cells: faces between the regions are chords of a curved surface.
    assert depth[np.setdiff1d(mesh.corners[scar], between)].min() > 0.0
    assert depth[np.setdiff1d(mesh.corners[~scar], between)].max() < 0.0
    assert report.min_dihedral_deg > 8.0
    assert report.warnings == ()


def test_its_volume_is_that_of_its_surface(meshed: tuple) -> None:
    anatomy, _, report = meshed
    assert report.region_volumes_mm3["scar"] == pytest.approx(anatomy.regions["scar"].volume, rel=0.03)
    assert report.regions["scar"].enclosed_mm3 == pytest.approx(anatomy.regions["scar"].volume, rel=0.01)
    assert report.regions["scar"].mean_mm < 0.5
    assert report.volume_mm3 == pytest.approx(sum(report.region_volumes_mm3.values()))


def test_it_joins_bone_and_layer_at_right_angles(meshed: tuple) -> None:
    """An ellipsoid through the sheet of muscle between bone and layer leaves no wedge at either."""
    _, mesh, report = meshed
    own = np.unique(mesh.cells[mesh.regions == 2])
    assert np.isin(own, mesh.node_sets["fixed_bone"]).sum() > 10
    assert np.isin(own, mesh.cells[mesh.regions == 0]).sum() > 10
    assert report.min_dihedral_deg > 8.0
    assert report.region_volumes_mm3["tendon"] == pytest.approx(
        report.regions["tendon"].enclosed_mm3, rel=0.05
    )


def test_a_gap_thinner_than_the_clearance_is_closed() -> None:
    fields = build_limb_fields(
        with_regions(scar=([-23.5, 0.0, -40.0], [4.5, 9.0, 14.0])), (LayerSpec("skin", 3.0),), 1.5
    )
    level = build_region_level(fields, 0)
    towards = fields.frame.to_limb(at(-28.0, 0.0, -40.0)[None])  # in the gap, 0.6 mm wide
    surface = fields.regions["scar"]
    outside = towards + np.linspace(0.0, 0.6, 4)[:, None] * fields.depth(towards)[1]
    between = outside[evaluate_distance(surface, outside)[0] > 0.0]
    assert len(between)
    assert (level(between)[0] < 0.0).all()


@pytest.mark.slow
def test_two_that_overlap_share_one_face() -> None:
    anatomy = with_regions(first=LONG, second=([-14.0, 14.0, -40.0], [6.0, 9.0, 16.0]))
    mesh, report = mesh_site(anatomy, *SITE, FINE)
    assert mesh.region_names == ("skin", "first", "second", "muscle")
    assert report.region_volumes_mm3["first"] == pytest.approx(anatomy.regions["first"].volume, rel=0.04)
    assert report.region_volumes_mm3["second"] < 0.98 * anatomy.regions["second"].volume
    shared = np.intersect1d(mesh.cells[mesh.regions == 1], mesh.cells[mesh.regions == 2])
    assert len(shared) > 6
    assert report.min_dihedral_deg > 7.0


@pytest.mark.slow
def test_the_mesh_of_a_whole_limb_has_it_too() -> None:
    mesh, report = mesh_limb(with_regions(scar=INSIDE), replace(FINE, edge_near_mm=8.0), 30.0)
    assert mesh.region_names == ("skin", "scar", "muscle")
    assert report.region_volumes_mm3["scar"] == pytest.approx(report.regions["scar"].enclosed_mm3, rel=0.05)


@pytest.mark.parametrize(
    ("centre", "axes", "words"),
    [
        ([-40.0, 0.0, -40.0], [5.0, 9.0, 16.0], "lies outside the limb by up to"),
        ([8.0, 12.0, -40.0], [6.0, 9.0, 12.0], "the region and the bone tibia overlap by up to"),
        ([0.0, 0.0, -40.0], [25.0, 25.0, 25.0], "the region and the bone tibia overlap by up to"),
        ([0.0, 0.0, 20.0], [5.0, 5.0, 5.0], "wholly beyond the proximal cut"),
    ],
)
def test_regions_in_the_wrong_place_are_refused(centre: list, axes: list, words: str) -> None:
    with pytest.raises(SurfaceError, match=f"geometry.regions.scar: .*{words}"):
        check_anatomy(with_regions(scar=(centre, axes)))


def test_regions_that_cannot_be_meshed_are_refused() -> None:
    thin = with_regions(scar=([-14.0, 0.0, -40.0], [1.0, 9.0, 16.0]))
    with pytest.raises(SurfaceError, match=r"geometry.regions.scar: .* 2\.0 mm thick at most, too thin"):
        build_base_mesh(thin, COARSE)
    shallow = with_regions(scar=([-30.0, 0.0, -40.0], [2.0, 9.0, 16.0]))
    with pytest.raises(SurfaceError, match="scar: nothing of the region lies under the layers"):
        build_base_mesh(shallow, replace(COARSE, layers=(LayerSpec("skin", 9.0),)))


def test_netgen_knows_no_regions() -> None:
    none = np.zeros((0, 3), dtype=np.int64)
    task = VolumeTask(np.zeros((4, 3)), np.arange(4)[None], np.array([1]), none, none, np.ones(4), 1.0)
    with pytest.raises(MeshingError, match=r"not installed|knows no regions"):
        run_netgen(task, 1.0)


def test_a_label_becomes_a_region_and_no_bone(tmp_path) -> None:
    anatomy = with_regions(scar=INSIDE)
    drawn = voxelise_anatomy(anatomy)
    write_labels(tmp_path / "labels.seg.nrrd", drawn)
    labels = read_labels(tmp_path / "labels.seg.nrrd")
    assert set(labels.bone_names) == {"scar", "tibia"}  # of a label that the study does not name
    labels = labels.with_regions({"mark": "scar"})
    assert labels.bone_names == ("tibia",)
    built = build_anatomy(labels, 4.0, (anatomy.cut_point, anatomy.cut_normal))
    check_anatomy(built)
    assert set(built.bones) == {"tibia"}
    assert built.regions["mark"].volume == pytest.approx(anatomy.regions["scar"].volume, rel=0.02)
    assert np.abs(evaluate_distance(anatomy.regions["scar"], built.regions["mark"].points)[0]).max() < 1.0
    save_anatomy(tmp_path, built)
    assert load_anatomy(tmp_path).regions["mark"].volume == pytest.approx(built.regions["mark"].volume)
    with pytest.raises(
        LabelError, match=r"geometry.regions.mark: no voxel is labelled 'tendon'; .*scar, tibia"
    ):
        labels.with_regions({"mark": "tendon"})


def test_a_virtual_amputation_keeps_what_is_proximal_of_it() -> None:
    anatomy = with_regions(scar=([-14.0, 0.0, -30.0], [5.0, 9.0, 16.0]))
    labels = amputate_limb(voxelise_anatomy(anatomy), at(0.0, 0.0, -30.0), [0.0, 0.0, 1.0], pad_mm=10.0)
    built = build_anatomy(labels, 5.0, (anatomy.cut_point, anatomy.cut_normal))
    assert built.regions["scar"].volume == pytest.approx(anatomy.regions["scar"].volume / 2, rel=0.05)
