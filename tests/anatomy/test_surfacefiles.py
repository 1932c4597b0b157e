"""Surface files say their space or are told it, and are in millimetres or a stated unit."""

import numpy as np
import pytest
import pyvista as pv

from limbfit.anatomy.surfaces.files import UNITS_MM, read_surface
from limbfit.anatomy.surfaces.triangles import check_closed
from limbfit.errors import SurfaceError


def write(path, space: str | None):
    """A ball at (10, 20, 30) whose file states its space as 3D Slicer does."""
    ball = pv.Sphere(radius=50, center=(10, 20, 30), theta_resolution=12, phi_resolution=12).triangulate()
    if space and path.suffix == ".vtp":
        ball.field_data["SPACE"] = [space]
    if path.suffix == ".obj":
        points = "\n".join("v {} {} {}".format(*p) for p in ball.points)
        faces = "\n".join("f {} {} {}".format(*(f + 1)) for f in ball.regular_faces)
        path.write_text(f"# 3D Slicer output. SPACE={space}\n{points}\n{faces}\n")
        return path
    ball.save(path)
    raw = path.read_bytes()
    if space and path.suffix == ".stl":
        path.write_bytes(f"3D Slicer output. SPACE={space}".encode().ljust(80) + raw[80:])
    if space and path.suffix == ".ply":
        path.write_bytes(raw.replace(b"comment VTK", f"comment SPACE={space} VTK".encode(), 1))
    return path


def centre(surface) -> np.ndarray:
    return (surface.points.max(axis=0) + surface.points.min(axis=0)) / 2


@pytest.mark.parametrize("suffix", [".stl", ".ply", ".obj", ".vtp"])
@pytest.mark.parametrize(("space", "sign"), [("LPS", 1), ("RAS", -1)])
def test_what_the_file_says_is_followed(tmp_path, suffix, space, sign):
    file = write(tmp_path / f"ball{suffix}", space)
    for said in (None, space):
        surface = read_surface(file, said)
        assert np.allclose(centre(surface), [sign * 10, sign * 20, 30], atol=0.5)
        assert surface.volume > 0  # a turn about z, no mirror
    other = "RAS" if space == "LPS" else "LPS"
    with pytest.raises(SurfaceError, match=f"the file says that it is in {space}, the study says {other}"):
        read_surface(file, other)


def test_a_file_that_does_not_say_is_lps_or_what_the_study_says(tmp_path):
    file = write(tmp_path / "ball.stl", None)
    assert np.allclose(centre(read_surface(file)), [10, 20, 30], atol=0.5)
    assert np.allclose(centre(read_surface(file, "RAS")), [-10, -20, 30], atol=0.5)


@pytest.mark.parametrize("unit", ["cm", "m", "inch"])
def test_other_units_are_refused_until_they_are_stated(tmp_path, unit):
    ball = pv.Sphere(radius=50, center=(10, 20, 30)).triangulate()
    pv.PolyData(ball.points / UNITS_MM[unit], ball.faces).save(tmp_path / "ball.stl")
    for name in ("skin", "tibia"):
        with pytest.raises(SurfaceError, match=r"surfaces\.unit"):
            check_closed(read_surface(tmp_path / "ball.stl"), name, tmp_path / "ball.stl")
    surface = read_surface(tmp_path / "ball.stl", unit=unit)
    check_closed(surface, "skin")
    assert np.allclose(np.ptp(surface.points, axis=0), 100, atol=1)


@pytest.mark.parametrize("share", [0.2, 0.5, 0.9])
@pytest.mark.parametrize("suffix", [".stl", ".ply", ".vtp"])
def test_a_file_cut_short_is_refused_and_takes_nothing_down(tmp_path, suffix, share):
    file = write(tmp_path / f"skin{suffix}", None)
    content = file.read_bytes()
    file.write_bytes(content[: int(len(content) * share)])
    with pytest.raises(SurfaceError) as refused:
        check_closed(read_surface(file), "skin", file)
    assert str(file) in str(refused.value)


@pytest.mark.parametrize("suffix", [".vtp", ".obj", ".ply"])
def test_a_file_without_triangles_is_refused(tmp_path, suffix):
    file, points = tmp_path / f"cloud{suffix}", np.eye(3)
    if suffix == ".obj":
        file.write_text("\n".join("v {} {} {}".format(*point) for point in points))
    else:
        pv.PolyData(points).save(file)
    with pytest.raises(SurfaceError, match=f"cloud{suffix}: .*export the surface again"):
        read_surface(file)


def test_a_ply_file_with_more_than_points_and_faces_is_refused_and_ends_nothing(tmp_path, capfd):
    lines = (
        write(tmp_path / "ball.ply", None).read_bytes().replace(b"end_header", b"element edge 0\nend_header")
    )
    (tmp_path / "ball.ply").write_bytes(lines)
    with pytest.raises(SurfaceError, match=r"ball\.ply: the surface cannot be read"):
        read_surface(tmp_path / "ball.ply")
    assert capfd.readouterr() == ("", "")
