"""Blocks of arrays, inlined scripts, and shapes that are drawn."""

import hashlib
import re

import numpy as np
import pytest
import pyvista as pv

from limbfit.mesh import Mesh, boundary_faces, to_tet10
from limbfit.web import (
    STATIC,
    build_inline_script,
    compute_cell_quality,
    extract_interface,
    pack,
    read_shell,
    to_volume_shape,
)
from unpacking import unpack


def _block(n: int = 3) -> Mesh:
    """A cube of n^3 cells, each of six tetrahedra; what lies below z = 1/3 is the second region."""
    grid = pv.ImageData(dimensions=(n + 1,) * 3, spacing=(1 / n,) * 3).to_tetrahedra(6)
    low = grid.cell_centers().points[:, 2] < 1 / 3
    return Mesh.from_arrays(grid.points, grid.cells_dict[10], low.astype(int), {0: "top", 1: "bottom"})


def test_arrays_come_back_and_stand_aligned():
    arrays = {
        "points": np.random.default_rng(0).random((7, 3)).astype("f4"),
        "faces": np.arange(9, dtype="u4").reshape(3, 3),
        "odd": np.arange(5, dtype="u1"),
        "none": np.zeros((0, 3), "f4"),
        "signed": np.array([-1, 2], "i4"),
    }
    block = pack(arrays, {"name": "ü <b>"})
    found, facts = unpack(block)
    assert facts == {"name": "ü <b>"}
    assert set(found) == set(arrays)
    for name, values in arrays.items():
        np.testing.assert_array_equal(found[name], values)
        assert found[name].dtype == values.dtype
    length = int.from_bytes(block[8:12], "little")
    assert (12 + length) % 8 == 0


def test_only_arrays_that_scripts_can_read_are_packed():
    with pytest.raises(ValueError, match="float64"):
        pack({"points": np.zeros(3)})
    with pytest.raises(ValueError, match="not a block"):
        unpack(b"<html></html>")


def test_inlined_modules_are_one_classic_script(tmp_path, monkeypatch):
    text = build_inline_script("colours.js", "overlay.js", "camera.js", "volume.js", "viewer.js", "chart.js")
    assert not re.search(r"^\s*(import|export)\b", text, re.MULTILINE)
    (tmp_path / "bad.js").write_text('const end = "</SCRIPT>";')
    monkeypatch.setattr("limbfit.web.STATIC", tmp_path)
    with pytest.raises(ValueError, match="ends a script"):
        build_inline_script("bad.js")


def test_vendored_files_are_those_that_are_listed():
    text = (STATIC / "vendor/VENDOR.md").read_text()
    listed = dict(re.findall(r"^\| `([^`]+)` .*`([0-9a-f]{64})` \|$", text, re.MULTILINE))
    assert set(listed) == {file.name for file in (STATIC / "vendor").glob("*.min.*")}
    for name, digest in listed.items():
        assert hashlib.sha256((STATIC / "vendor" / name).read_bytes()).hexdigest() == digest


@pytest.mark.parametrize("quadratic", [False, True])
def test_faces_of_a_volume_close_it(quadratic):
    mesh = _block()
    volume = to_volume_shape(to_tet10(mesh) if quadratic else mesh)
    outside = volume.neighbours < 0
    assert outside.sum() == len(boundary_faces(mesh)) == 6 * 9 * 2
    assert len(volume.cells) * 4 == outside.sum() + 2 * (~outside).sum()
    corners = volume.points[volume.faces[outside]].astype(float)
    enclosed = np.einsum("ki,ki->k", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])).sum() / 6
    assert enclosed == pytest.approx(1.0)  # outward faces: the divergence theorem gives the volume
    np.testing.assert_allclose(volume.points, mesh.points[volume.nodes] if not quadratic else volume.points)


def test_the_interface_lies_between_the_regions():
    shell = extract_interface(to_volume_shape(_block()), 0)
    np.testing.assert_allclose(shell.points[:, 2], 1 / 3, atol=1e-6)
    corners = shell.points[shell.faces]
    doubled = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert np.linalg.norm(doubled, axis=1).sum() / 2 == pytest.approx(1.0)


def test_quality_of_cells():
    found = compute_cell_quality(to_tet10(_block()))
    assert found["volume_mm3"].sum() == pytest.approx(1.0)
    np.testing.assert_allclose(found["scaled_jacobian"], 1.0, rtol=1e-5)
    np.testing.assert_allclose(found["min_dihedral_deg"], 45.0, rtol=1e-4)  # cubes cut along a diagonal


def test_a_large_surface_is_made_coarser_and_stays_where_it_is(tmp_path):
    pv.Icosphere(radius=50, nsub=5).save(tmp_path / "ball.stl")
    shell = read_shell(tmp_path / "ball.stl", 3000)
    assert 2000 < len(shell.faces) <= 3000
    np.testing.assert_allclose(np.linalg.norm(shell.points, axis=1), 50, atol=0.3)
