"""One body, stored with other axes and in the other space, gives the same surfaces in patient space."""

from pathlib import Path

import nrrd
import numpy as np
import pytest
import pyvista as pv

from limbfit.anatomy.imaging import LabelMap, Volume, read_labels, read_volume
from limbfit.anatomy.meshing.meshing import MeshSettings, mesh_site
from limbfit.anatomy.sites.sites import compute_indenter_axis
from limbfit.anatomy.surfaces.surfaces import (
    Anatomy,
    build_anatomy,
)
from limbfit.mesh import write_vtu
from limbs import leg_image, rotation

TOLERANCE_MM, EDGE_MM = 0.01, 8.0
OBLIQUE = rotation(2) @ np.diag([1.0, -1.0, 1.0])  # left-handed: rows run backward
RAS = np.array([-1.0, -1.0, 1.0])


def write_ras_nrrd(file: Path, image: Volume) -> None:
    header = {
        "space": "right-anterior-superior",
        "kinds": ["domain"] * 3,
        "space directions": (image.direction * image.spacing).T * RAS,
        "space origin": image.origin * RAS,
    }
    nrrd.write(str(file), np.transpose(image.array, (2, 1, 0)), header)


def write_ras_segmentation(file: Path, labels: LabelMap) -> None:
    """As 3D Slicer does it, cropped to the segments."""
    filled = np.argwhere(labels.array > 0)
    low, high = filled.min(axis=0), filled.max(axis=0) + 1
    header = {
        "space": "right-anterior-superior",
        "kinds": ["domain"] * 3,
        "space directions": (labels.direction * labels.spacing).T * RAS,
        "space origin": labels.index_to_point(low[::-1]) * RAS,
    }
    for n, (value, name) in enumerate(labels.names.items()):
        header |= {f"Segment{n}_ID": f"S{n}", f"Segment{n}_Name": name, f"Segment{n}_LabelValue": str(value)}
    crop = labels.array[tuple(slice(a, b) for a, b in zip(low, high))]
    nrrd.write(str(file), np.transpose(crop, (2, 1, 0)), header)


@pytest.fixture(scope="module")
def body() -> tuple[Volume, LabelMap]:
    image, labels = leg_image([3.013, 3.297, 4.1], (38, 39, 40), OBLIQUE)
    return image.with_array(np.round(image.array)), labels


@pytest.fixture(scope="module")
def reference(body) -> Anatomy:
    return build_anatomy(body[1], EDGE_MM)


def assert_same(found: Anatomy, wanted: Anatomy) -> None:
    pairs = [(found.skin, wanted.skin), *((found.bones[name], wanted.bones[name]) for name in wanted.bones)]
    for one, other in pairs:
        assert np.array_equal(one.faces, other.faces)
        assert np.abs(one.points - other.points).max() < TOLERANCE_MM
    assert np.abs(found.cut_point - wanted.cut_point).max() < TOLERANCE_MM
    assert np.abs(found.cut_normal - wanted.cut_normal).max() < 1e-5


def test_a_turned_image_in_ras_with_cropped_labels_gives_the_same_surfaces(tmp_path, body, reference):
    image, labels = body
    write_ras_nrrd(tmp_path / "image.nrrd", image.permute_axes((1, 2, 0)).reverse_axes([0, 2]))
    write_ras_segmentation(tmp_path / "labels.seg.nrrd", labels)
    seen = read_volume(tmp_path / "image.nrrd")
    places = np.argwhere(labels.array > 1)[::97]
    points = image.index_to_point(places[:, ::-1])
    there = np.rint(seen.point_to_index(points)).astype(int)
    assert np.abs(seen.index_to_point(there) - points).max() < TOLERANCE_MM
    assert np.allclose(seen.array[tuple(there[:, ::-1].T)], image.array[tuple(places.T)])
    assert_same(build_anatomy(read_labels(tmp_path / "labels.seg.nrrd", seen), EDGE_MM), reference)


@pytest.mark.slow
def test_the_mesh_on_disk_lies_where_the_body_lies(tmp_path):
    """Read by another program (VTK): nodes of the skin on the skin, none of them in a bone."""
    reference = build_anatomy(leg_image([2.013, 2.297, 3.1], (50, 56, 60), OBLIQUE)[1], 6.0)
    site = reference.skin.points[np.argmin(np.abs(reference.height(reference.skin.points) + 60))]
    settings = MeshSettings(element="tet4", edge_near_mm=8.0, edge_far_mm=20.0, flatness=1.6)
    mesh, _ = mesh_site(reference, site, compute_indenter_axis(reference.skin, site, 20.0), settings)
    write_vtu(mesh, tmp_path / "mesh.vtu")
    seen = pv.read(tmp_path / "mesh.vtu")
    assert np.abs(seen.points - mesh.points).max() < TOLERANCE_MM
    outer = seen.points[np.unique(mesh.face_sets["skin"])]
    assert np.abs(reference.skin.signed_distance(outer)).max() < 1.0
    for bone in reference.bones.values():
        assert bone.signed_distance(seen.points).min() > -1.0
