"""A socket from a file is the one that was written, or refused in one line with the remedy."""

from collections.abc import Callable
from functools import cache
from pathlib import Path

import igl
import numpy as np
import pytest
from socket_limbs import CUT_NORMAL, round_limb

from limbfit.anatomy.surfaces.files import write_surface
from limbfit.anatomy.surfaces.triangles import Surface, close_by_fans, find_half_edges, stack_surfaces
from limbfit.errors import SurfaceError
from limbfit.socket import Recipe, Socket, read_socket, rectify_limb
from limbfit.socket.rectify import Trim
from limbfit.socket.wall import build_wall

TRIM = Trim([(np.array([0.0, 0.0, 112.0]), CUT_NORMAL)])


def read(file: Path, unit: str = "mm", space: str | None = None) -> Socket:
    limb = round_limb()
    return read_socket(file, unit, space, outer=limb.skin, frame=limb.frame, bones=limb.bones)  # type: ignore[arg-type]


@cache
def drawn() -> Socket:
    limb = round_limb()
    return rectify_limb(limb.skin, limb.frame, Recipe(TRIM, flare_mm=0.0, edge_mm=6.0))


def face() -> Surface:
    return drawn().surface


def offset_by(surface: Surface, outwards: float) -> Surface:
    """The face moved away from the tissue."""
    return Surface(surface.points - outwards * surface.vertex_normals, surface.faces)


def walled(thickness: float = 4.0) -> Surface:
    """The face with an outer side and a strip between their brims, as a closed body, outward."""
    inner, outer = face(), offset_by(face(), thickness)
    brim, n = drawn().brim, len(inner.points)
    after = np.roll(brim, -1)
    lower, upper = np.column_stack([brim, after + n, after]), np.column_stack([brim, brim + n, after + n])
    strip = np.vstack([lower, upper])
    flipped = outer.faces[:, ::-1] + n
    body = Surface(np.vstack([inner.points, outer.points]), np.vstack([inner.faces, flipped, strip]))
    edges = np.unique(find_half_edges(body.faces), axis=0)
    if len(edges) != 3 * len(body.faces):  # the brim runs the other way
        strip = strip[:, ::-1]
        body = Surface(body.points, np.vstack([inner.faces, flipped, strip]))
    return body


def test_round_trip(tmp_path: Path) -> None:
    write_surface(tmp_path / "socket.stl", face())
    socket = read(tmp_path / "socket.stl")
    assert socket.notes == ()
    assert not socket.open_distal
    assert socket.volume_mm3 == pytest.approx(drawn().volume_mm3, rel=1e-5)
    assert len(socket.points) == len(drawn().points)
    assert len(socket.brim) == len(drawn().brim)
    limb = round_limb()
    assert -Socket(socket.clear, socket.faces, socket.clear, socket.brim).offset(limb.skin).max() > 0.49


def test_unit_and_space(tmp_path: Path) -> None:
    flipped = Surface(face().points * [-1e-3, -1e-3, 1e-3], face().faces)
    flipped.to_pyvista().save(tmp_path / "ras.stl")  # limbfit would state mm and LPS
    socket = read(tmp_path / "ras.stl", "m", "RAS")
    assert socket.volume_mm3 == pytest.approx(drawn().volume_mm3, rel=1e-4)


def test_inside_out_is_turned_and_said(tmp_path: Path) -> None:
    write_surface(tmp_path / "socket.stl", face().flipped_surface)
    socket = read(tmp_path / "socket.stl")
    assert socket.volume_mm3 == pytest.approx(drawn().volume_mm3, rel=1e-5)
    assert "turned" in socket.notes[0]
    after = np.roll(socket.brim, -1)
    edges = {tuple(edge) for edge in find_half_edges(socket.faces)}
    assert all(edge in edges for edge in zip(socket.brim, after))


@pytest.mark.parametrize("first", [0, 1])
def test_every_third_triangle_is_turned_back_and_said(tmp_path: Path, first: int) -> None:
    faces = face().faces.copy()
    faces[first::3] = faces[first::3, ::-1]
    write_surface(tmp_path / "socket.stl", Surface(face().points, faces))
    socket = read(tmp_path / "socket.stl")
    assert socket.volume_mm3 == pytest.approx(drawn().volume_mm3, rel=1e-5)
    count = len(faces[first::3])
    assert f"{count} of its triangles were oriented against their neighbours" in socket.notes[0]


def test_skin_and_bones_below_an_open_end_are_not_those_of_the_socket(tmp_path: Path) -> None:
    """The tibia reaches down to z = 25, out of a tube that ends at 50."""
    keep = face().triangles[:, :, 2].min(axis=1) > 50.0
    write_surface(tmp_path / "tube.stl", Surface(face().points, face().faces[keep]))
    socket, limb = read(tmp_path / "tube.stl"), round_limb()
    assert socket.open_distal
    assert socket.points[socket.brim, 2].min() > 100.0
    height = limb.skin.triangles.mean(axis=1)[:, 2]
    covered = socket.find_covered(limb.skin.triangles.mean(axis=1))
    assert not covered[height < 50.0].any()
    assert not covered[height > 112.0].any()
    assert covered[(height > 60.0) & (height < 105.0)].all()
    low = limb.bones["tibia"].points - np.array([38.0, 0.0, 0.0])
    aside = {"tibia": Surface(low, limb.bones["tibia"].faces)}
    with pytest.raises(SurfaceError, match="into the bone tibia"):  # through the tube's side
        read_socket(tmp_path / "tube.stl", outer=limb.skin, frame=limb.frame, bones=aside)


@pytest.mark.parametrize("turned", [False, True])
def test_of_a_wall_the_inner_side_is_taken(tmp_path: Path, turned: bool) -> None:
    body = walled()
    assert body.volume > 0
    write_surface(tmp_path / "wall.stl", body.flipped_surface if turned else body)
    socket = read(tmp_path / "wall.stl")
    assert socket.volume_mm3 == pytest.approx(drawn().volume_mm3, rel=2e-3)
    assert len(socket.faces) == pytest.approx(len(drawn().faces), rel=0.01)
    assert "4.0 mm" in socket.notes[-1]


def test_the_wall_that_limbfit_makes_for_printing_is_read_back(tmp_path: Path) -> None:
    """Its inner face, and of the rolled brim what looks inward: less than the wall is thick."""
    write_surface(tmp_path / "socket.stl", build_wall(drawn(), CUT_NORMAL, 4.0))
    socket = read(tmp_path / "socket.stl")
    own = igl.point_mesh_squared_distance(socket.points, face().points, face().faces)[0]
    back = igl.point_mesh_squared_distance(face().points, socket.points, socket.faces)[0]
    assert np.sqrt(back.max()) < 0.01
    above = socket.points[:, 2] > face().points[drawn().brim, 2].min()
    assert np.sqrt(own[~above].max()) < 0.01
    assert np.sqrt(own.max()) < 4.0


def moved(*by: float) -> Surface:
    return Surface(face().points + by, face().faces)


def with_hole() -> Surface:
    faces = face().faces
    middle = face().triangles.mean(axis=1)
    return Surface(face().points, faces[np.linalg.norm(middle - [0.0, -44.0, 70.0], axis=1) > 12.0])


def crossed() -> Surface:
    points = face().points.copy()
    near = np.linalg.norm(points - [0.0, -44.0, 70.0], axis=1) < 8.0
    points[near] += [0.0, 100.0, 0.0]
    return Surface(points, face().faces)


def upside_down() -> Surface:
    return Surface(face().points * [1.0, -1.0, -1.0] + [0.0, 0.0, 112.0], face().faces)


def narrow() -> Surface:
    return Surface((face().points - [0, 0, 60]) * [0.35, 0.35, 1] + [0, 0, 60], face().faces)


def twice() -> Surface:
    return stack_surfaces([face(), moved(0.0, 0.0, 200.0)])


BAD: dict[str, tuple[Callable[[], Surface], str]] = {  # what is said, of what, the remedy
    "mm from end to end": (lambda: Surface(face().points * 1e-3, face().faces), "say so (socket.unit)"),
    "from end to end, the limb": (
        lambda: Surface(face().points * 25.4, face().faces),
        "say so (socket.unit)",
    ),
    "no opening": (lambda: close_by_fans(face().flipped_surface), "open"),
    "a hole of": (with_hole, "close it; only brim and end may be open"),
    "does not surround the limb": (lambda: moved(150.0, 20.0, 0.0), "socket.space"),
    "is 310 mm off": (lambda: moved(0.0, 0.0, 400.0), "socket.space"),
    "into the bone": (narrow, "a socket is larger than the bones in it"),
    "opens towards the distal end": (upside_down, "open it at the brim"),
    "crosses itself": (crossed, ""),
    "separate pieces": (twice, ""),
}


@pytest.mark.parametrize("words", BAD)
def test_what_is_no_socket_of_this_limb_is_refused(tmp_path: Path, words: str) -> None:
    change, remedy = BAD[words]
    write_surface(tmp_path / "socket.stl", change())
    with pytest.raises(SurfaceError) as caught:
        read(tmp_path / "socket.stl")
    assert words in str(caught.value)
    assert str(caught.value).startswith(str(tmp_path / "socket.stl"))
    assert "\n" not in str(caught.value)
    assert caught.value.remedy
    assert remedy in caught.value.remedy
