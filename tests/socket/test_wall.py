"""A wall for printing is watertight and as thick as asked, by a tool that did not make it."""

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import trimesh
from socket_limbs import CUT_NORMAL, FILES, real_limb, round_limb

from limbfit.anatomy.surfaces.files import write_surface
from limbfit.anatomy.surfaces.triangles import Surface
from limbfit.errors import SurfaceError
from limbfit.socket import Area, Recipe, Socket, rectify_limb
from limbfit.socket.landmarks import find_knee_centre
from limbfit.socket.rectify import Trim
from limbfit.socket.wall import build_wall, measure_thickness

RECIPE = Recipe(Trim([(np.array([0.0, 0.0, 112.0]), CUT_NORMAL)]), flare_mm=0.0)


@cache
def drawn_plain() -> Socket:
    return drawn(RECIPE)


def drawn(recipe: Recipe) -> Socket:
    limb = round_limb()
    return rectify_limb(limb.skin, limb.frame, recipe)


def read_back(body: Surface, folder: Path) -> trimesh.Trimesh:
    write_surface(folder / "wall.stl", body)
    return trimesh.load(folder / "wall.stl")


def thickness(body: trimesh.Trimesh, socket: Socket) -> np.ndarray:
    """From middles of the inner face's triangles through the wall, along their normals."""
    middles, outwards = socket.surface.triangles.mean(axis=1), -socket.surface.face_normals
    hits, rays, _ = body.ray.intersects_location(middles + 1e-3 * outwards, outwards, multiple_hits=True)
    apart = np.linalg.norm(hits - middles[rays], axis=1)
    least = np.full(len(middles), np.inf)
    np.minimum.at(least, rays, apart)
    return least


def check_wall(socket: Socket, axis: np.ndarray, folder: Path, thick: float) -> trimesh.Trimesh:
    body = read_back(build_wall(socket, axis, thick), folder)
    assert body.is_watertight
    assert body.is_winding_consistent
    assert body.volume > 0
    assert body.euler_number == 2  # one body without handles
    assert body.body_count == 1
    measured = thickness(body, socket)
    low = np.percentile(measured, 1)
    assert 0.95 * thick < low
    side = (socket.surface.triangles.mean(axis=1) - socket.points.mean(axis=0)) @ axis > 0
    assert np.median(measured[side]) == pytest.approx(thick, rel=0.02)
    return body


def test_a_wall_with_brim_and_adapter(tmp_path: Path) -> None:
    areas = [Area("press", np.array([0.0, -44.0, 80.0]), 22.0, 5.0)]
    socket = drawn(replace(RECIPE, areas=areas, flare_mm=6.0))
    body = check_wall(socket, CUT_NORMAL, tmp_path, 4.0)
    told = measure_thickness(build_wall(socket, CUT_NORMAL, 4.0), socket)
    np.testing.assert_allclose(told, thickness(body, socket), atol=2e-3)
    bottom = body.bounds[0, 2]
    assert bottom == pytest.approx(socket.points[:, 2].min() - 8.0, abs=1e-3)
    flat = (np.abs(body.triangles[:, :, 2] - bottom) < 1e-3).all(axis=1)
    assert body.area_faces[flat].sum() == pytest.approx(np.pi * 30.0**2, rel=0.01)
    assert body.face_normals[flat][:, 2].max() < -0.999
    brim_top = socket.points[socket.brim, 2].max()
    assert 0.0 < body.bounds[1, 2] - brim_top < 4.0
    _, apart, _ = trimesh.proximity.closest_point(body, socket.points)
    assert apart.max() < 0.01  # its inner side is the socket's face


def test_without_an_adapter(tmp_path: Path) -> None:
    socket = drawn_plain()
    body = read_back(build_wall(socket, CUT_NORMAL, 3.0, adapter_diameter_mm=0.0), tmp_path)
    assert body.is_watertight
    measured = thickness(body, socket)
    assert np.percentile(measured, [1, 99]) == pytest.approx(3.0, rel=0.02)


def test_walls_that_cannot_be_made_are_refused() -> None:
    narrow = drawn(replace(RECIPE, areas=[Area("narrow", np.array([0.0, -44.0, 80.0]), 11.0, 6.0)]))
    with pytest.raises(SurfaceError, match="would fold") as caught:
        build_wall(narrow, CUT_NORMAL, 15.0)
    assert caught.value.remedy
    with pytest.raises(SurfaceError, match="as wide as the socket"):
        build_wall(drawn_plain(), CUT_NORMAL, adapter_diameter_mm=200.0)
    with pytest.raises(SurfaceError, match="open distal end"):
        build_wall(replace(drawn_plain(), open_distal=True), CUT_NORMAL)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["mean", "limb-2", "limb-8"])
@pytest.mark.skipif(not FILES["mean"].is_file(), reason="shared/data is not here")
def test_real_limbs(tmp_path: Path, name: str) -> None:
    limb = real_limb(name)
    knee = find_knee_centre(limb)
    assert knee is not None
    trim = Trim([(knee - 15.0 * limb.cut_normal, limb.cut_normal)])
    socket = rectify_limb(limb.skin, limb.frame, Recipe(trim))
    check_wall(socket, limb.cut_normal, tmp_path, 4.0)
