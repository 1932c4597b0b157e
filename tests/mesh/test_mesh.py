"""Volume meshes: quality against closed forms, promotion, checks, and files."""

from pathlib import Path

import numpy as np
import pytest
import pyvista as pv
from vtkmodules.util.numpy_support import vtk_to_numpy
from vtkmodules.vtkIOXML import vtkXMLUnstructuredGridReader

from limbfit.errors import ProblemError
from limbfit.mesh import (
    Mesh,
    boundary_faces,
    cell_volumes,
    check,
    compute_dihedral_angles,
    measure_quality,
    read_vtu,
    to_tet10,
    write_pvd,
    write_vtu,
)

KUHN = np.array([[0, 1, 3, 7], [0, 3, 2, 7], [0, 2, 6, 7], [0, 6, 4, 7], [0, 4, 5, 7], [0, 5, 1, 7]])


def cube(cell_type: str = "tet4") -> Mesh:
    """A cube of side 2 in two regions with a node set and a face set."""
    points = 2.0 * np.array([[i & 1, i >> 1 & 1, i >> 2] for i in range(8)])
    if cell_type == "hex8":
        cells = np.array([[0, 1, 3, 2, 4, 5, 7, 6]])
        return Mesh(points, cells, "hex8", np.zeros(1, np.int64), ("all",))
    mesh = Mesh(points, KUHN, "tet4", np.array([0, 0, 0, 1, 1, 1]), ("skin", "muscle"))
    faces = boundary_faces(mesh)
    top = faces[(points[faces, 2] == 2.0).all(axis=1)]
    mesh = Mesh(points, KUHN, "tet4", mesh.regions, mesh.region_names, {"bottom": np.arange(4)}, {"top": top})
    return to_tet10(mesh) if cell_type == "tet10" else mesh


@pytest.mark.parametrize("cell_type", ["tet4", "tet10", "hex8"])
def test_volume_and_jacobian_of_a_cube(cell_type: str) -> None:
    found = measure_quality(cube(cell_type))
    assert found.volume_mm3 == pytest.approx(8.0, rel=1e-12)
    assert found.min_scaled_jacobian == pytest.approx(1.0, rel=1e-12)
    assert found.inverted == 0


def test_dihedral_angles_of_the_kuhn_tetrahedron() -> None:
    mesh = cube()
    found = measure_quality(mesh)
    assert found.min_dihedral_deg == pytest.approx(45.0)
    assert compute_dihedral_angles(mesh.points, mesh.cells).max() == pytest.approx(90.0)
    assert found.region_volumes_mm3 == pytest.approx({"skin": 4.0, "muscle": 4.0})


def test_curved_volume_is_exact_for_a_quadratic_map() -> None:
    mesh = cube("tet10")
    x, y, z = mesh.points.T
    bent = mesh.with_points(np.column_stack([x + 0.1 * y * y, y, z + 0.05 * x * y]))  # its determinant is 1
    assert cell_volumes(bent).sum() == pytest.approx(8.0, rel=1e-12)
    stretched = mesh.with_points(np.column_stack([x + 0.1 * x * x, y, z]))
    assert cell_volumes(stretched).sum() == pytest.approx(8.0 + 0.1 * 4 * 4, rel=1e-12)


@pytest.mark.parametrize(("cell_type", "count"), [("tet4", 12), ("tet10", 12), ("hex8", 6)])
def test_boundary_is_closed_and_outward(cell_type: str, count: int) -> None:
    mesh = cube(cell_type)
    faces = boundary_faces(mesh)
    assert len(faces) == count
    corners = mesh.points[faces[:, :3]]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert (np.einsum("ij,ij->i", normals, corners.mean(axis=1) - 1.0) > 0).all()


def test_promotion_keeps_corners_and_extends_sets_over_faces_only() -> None:
    linear, mesh = cube(), cube("tet10")
    assert len(mesh.points) == 8 + 19  # 12 edges, 6 face diagonals, 1 space diagonal
    np.testing.assert_array_equal(mesh.points[:8], linear.points)
    for column, (a, b) in enumerate([(0, 1), (1, 2), (2, 0), (0, 3), (1, 3), (2, 3)]):
        middle = mesh.points[mesh.cells[:, [a, b]]].mean(axis=1)
        np.testing.assert_array_equal(mesh.points[mesh.cells[:, 4 + column]], middle)
    np.testing.assert_array_equal(mesh.node_sets["bottom"], np.flatnonzero(mesh.points[:, 2] == 0.0))
    np.testing.assert_array_equal(np.unique(mesh.face_sets["top"]), np.flatnonzero(mesh.points[:, 2] == 2.0))
    with pytest.raises(ProblemError, match="only tet4"):
        to_tet10(mesh)


def test_check_finds_what_cannot_be_computed_with() -> None:
    mesh = cube()
    check(mesh)
    turned = mesh.cells.copy()
    turned[2] = turned[2][[1, 0, 2, 3]]
    cases = {
        "inverted": Mesh(mesh.points, turned, "tet4", mesh.regions, mesh.region_names),
        "twice": Mesh(
            mesh.points, mesh.cells[[0, 1, 2, 3, 4, 5, 5]], "tet4", np.zeros(7, np.int64), ("all",)
        ),
        "no cell": Mesh(np.vstack([mesh.points, [9, 9, 9]]), mesh.cells, "tet4", mesh.regions, ("a", "b")),
        "finite": mesh.with_points(np.where(mesh.points > 1, np.nan, mesh.points)),
        "do not exist": Mesh(mesh.points[:7], mesh.cells, "tet4", mesh.regions, ("a", "b")),
    }
    for words, bad in cases.items():
        with pytest.raises(ProblemError, match=words):
            check(bad)


def test_numbers_of_one_name_are_one_tissue() -> None:
    """As two they had the parameters of one name, and a fit took the derivatives of the first alone."""
    names = {1: "muscle", 2: "fat", 4: "muscle"}
    mesh = Mesh.from_arrays(cube().points, KUHN, [4, 2, 1, 1, 3, 2], names)
    assert mesh.region_names == ("muscle", "fat", "region 3")
    assert mesh.regions.tolist() == [0, 1, 0, 0, 2, 1]
    assert measure_quality(mesh).region_volumes_mm3["muscle"] == pytest.approx(4.0)


def test_a_face_of_three_cells_is_refused() -> None:
    points = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [0, 0, 2], [0, 0, 3]])
    cells = np.array([[0, 1, 2, 3], [0, 1, 2, 4], [0, 1, 2, 5]])
    with pytest.raises(ProblemError, match="more than two"):
        boundary_faces(Mesh(points, cells, "tet4", np.zeros(3, np.int64), ("all",)))


@pytest.mark.parametrize("cell_type", ["tet4", "tet10", "hex8"])
def test_vtu_round_trip_is_exact(cell_type: str, tmp_path: Path) -> None:
    mesh = cube(cell_type)
    mesh = mesh.with_points(mesh.points + np.random.default_rng(1).normal(scale=1e-3, size=mesh.points.shape))
    write_vtu(mesh, tmp_path / "site.vtu", {"u": mesh.points}, {"p": np.arange(len(mesh.cells)) / 3})
    back = read_vtu(tmp_path / "site.vtu")
    for name in ("points", "cells", "regions"):
        np.testing.assert_array_equal(getattr(back, name), getattr(mesh, name))
    assert (back.cell_type, back.region_names) == (mesh.cell_type, mesh.region_names)
    for sets, expected in ((back.node_sets, mesh.node_sets), (back.face_sets, mesh.face_sets)):
        assert set(sets) == set(expected)
        for name, values in expected.items():
            np.testing.assert_array_equal(sets[name], values)


def test_vtu_shows_fields_regions_and_sets(tmp_path: Path) -> None:
    mesh = cube()
    write_vtu(mesh, tmp_path / "site.vtu", {"u": 2.0 * mesh.points})
    reader = vtkXMLUnstructuredGridReader()
    reader.SetFileName(str(tmp_path / "site.vtu"))
    reader.Update()
    data = reader.GetOutput()
    np.testing.assert_array_equal(vtk_to_numpy(data.GetPointData().GetArray("u")), 2.0 * mesh.points)
    np.testing.assert_array_equal(vtk_to_numpy(data.GetCellData().GetArray("region")), mesh.regions)
    shown = vtk_to_numpy(data.GetPointData().GetArray("in bottom"))
    np.testing.assert_array_equal(np.flatnonzero(shown), mesh.node_sets["bottom"])


@pytest.mark.parametrize(
    ("given", "names"),
    [([7, 3], ("region 3", "region 7")), (["skin", "muscle"], ("muscle", "skin"))],
)
def test_regions_of_a_foreign_file_are_read(given: list, names: tuple[str, str], tmp_path: Path) -> None:
    mesh = cube()
    grid = pv.UnstructuredGrid({10: mesh.cells}, mesh.points)
    grid["region"] = np.array(given)[np.arange(grid.n_cells) % 2]
    grid.save(tmp_path / "foreign.vtu")
    found = read_vtu(tmp_path / "foreign.vtu")
    assert found.region_names == names
    assert (found.regions == 1 - np.arange(grid.n_cells) % 2).all()


def test_a_file_that_is_no_mesh_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ProblemError, match="no such mesh"):
        read_vtu(tmp_path / "absent.vtu")
    (tmp_path / "text.vtu").write_text("no XML", encoding="utf-8")
    with pytest.raises(ProblemError, match="not a VTU file"):
        read_vtu(tmp_path / "text.vtu")


def test_pvd_names_files_relative_to_itself(tmp_path: Path) -> None:
    (tmp_path / "steps").mkdir()
    write_pvd(
        tmp_path / "run.pvd", [(0.0, tmp_path / "steps" / "a.vtu"), (0.5, tmp_path / "steps" / "b.vtu")]
    )
    text = (tmp_path / "run.pvd").read_text(encoding="utf-8")
    assert 'timestep="0.5"' in text
    assert 'file="steps/b.vtu"' in text
