"""A socket that cannot be this limb's, from the command line: one line with what is wrong and the remedy."""

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from editing import edit
from limbfit.anatomy.surfaces.surfaces import write_surface
from limbfit.anatomy.surfaces.triangles import Surface, remove_unused_points
from limbfit.socket import Recipe, rectify_limb
from limbfit.socket.rectify import Trim
from small_limb import limb, revolved, small_limb

NO_LINER = "[socket.liner]\nthickness_mm = 0.0\n"
FROM_FILE = 'file = "socket.stl"\n' + NO_LINER
OF_RECTIFICATION = ("trim_mm = 20.0\n", "distal_clearance_mm = 3.0\n")  # what a file stands in place of
DEEP = """reduction_percent = 2.0
[[socket.areas]]
name = "deep"
position = [46.0, -80.0, 262.0]
radius_mm = 40.0
depth_mm = 19.0
"""


def with_file(folder: Path, text: str) -> Path:
    """The small limb's study with a socket from a file."""
    small_limb(folder, text)
    for line in OF_RECTIFICATION:
        edit(folder, line, "")
    return folder


@cache
def drawn() -> Surface:
    anatomy = limb()
    trim = Trim([(anatomy.cut_point - [0.0, 0.0, 26.0], anatomy.cut_normal)])
    return rectify_limb(
        anatomy.skin, anatomy.frame, Recipe(trim, flare_mm=0.0, distal_clearance_mm=3.0, edge_mm=8.0)
    ).surface


def test_a_file_that_is_no_socket_of_this_limb_is_refused_by_check_and_socket(limbfit, tmp_path):
    study = with_file(tmp_path, FROM_FILE)
    write_surface(study / "socket.stl", Surface(drawn().points * 1e-3, drawn().faces))
    for verb in ("check", "socket"):
        told = limbfit(verb, study)
        check_refused(told, "study.toml", "socket.file", "socket.stl", "say so (socket.unit)")


def test_a_rectification_that_cuts_into_a_bone_is_refused(limbfit, tmp_path):
    told = limbfit("check", small_limb(tmp_path, DEEP + NO_LINER))
    check_refused(told, "study.toml", "into the bone tibia", "the depths of the areas")


def check_refused(told: tuple[int, str, str], *words: str) -> None:
    code, out, err = told
    errors = [line for line in err.splitlines() if not line.startswith("[")]
    assert (code, out, len(errors)) == (2, "", 1), err
    assert errors[0].startswith("error: ")
    assert all(word in errors[0] for word in words), errors[0]


def test_a_face_inside_out_is_turned_and_said(limbfit, tmp_path, commands_unasked):
    study = with_file(tmp_path, FROM_FILE)
    write_surface(study / "socket.stl", drawn().flipped_surface)
    code, out, _ = limbfit("check", study)
    assert code == 0
    assert "socket: its triangles looked away from the tissue and were turned" in out


CYLINDER = """friction = 0.0
hold_s = 0.0
file = "socket.stl"
[socket.liner]
thickness_mm = 0.0
[[socket.loads]]
name = "stance"
force_N = [0.0, 0.0, 60.0]
duration_s = 1.0
hold_s = 0.0
"""


@pytest.mark.slow
def test_a_load_that_a_frictionless_cylinder_cannot_carry_is_told_with_the_remedy(limbfit, tmp_path):
    """A straight tube, open at both ends, around a straight limb: nothing holds it along the limb."""
    study = with_file(tmp_path, CYLINDER)
    anatomy = limb()
    up = np.linspace(0.0, 1.0, 24)
    end = np.linspace(0.02, 1.0, 16)
    dome = 30.0 * np.sqrt(1.0 - (1.0 - end) ** 2)
    radii = np.concatenate([dome, np.full(23, 30.0)])
    straight = revolved(radii, np.concatenate([-98.0 + 30.0 * end, -68.0 + 68.0 * up[1:]]))
    straight = replace(straight, points=straight.points + anatomy.cut_point)
    write_surface(study / "skin.stl", straight)
    around = revolved(np.full(20, 29.0), np.linspace(200.0, 274.0, 20) - 300.0)
    side = np.abs(around.face_normals[:, 2]) < 0.5
    tube = Surface(around.points + anatomy.cut_point, around.faces[side])
    write_surface(study / "socket.stl", remove_unused_points(tube).flipped_surface)
    code, _, err = limbfit("socket", study)
    told = err.splitlines()[-1]
    assert code == 1, err
    assert told.startswith("error: the load 'stance' could not be carried beyond")
    assert "socket.friction" in told
