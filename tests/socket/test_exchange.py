"""Shapes in the formats of shops: round trips, slices against their definition, comparison, bad input."""

import re
import zipfile
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import pyvista
from scipy.spatial.transform import Rotation
from socket_limbs import CUT_NORMAL, revolved, round_limb

from limbfit import InputError, compare_shapes, convert_shape
from limbfit.anatomy.grid import build_limb_frame
from limbfit.anatomy.surfaces.exchange import find_axis, list_circumferences, read_body, register_surface
from limbfit.anatomy.surfaces.files import read_surface, write_surface
from limbfit.anatomy.surfaces.slices import format_slices, read_slices
from limbfit.anatomy.surfaces.triangles import Surface, stack_surfaces
from limbfit.socket import Area, Recipe, Socket, rectify_limb
from limbfit.socket.rectify import Trim
from limbfit.socket.wall import build_wall

LINE = np.array([[0.0, -50.0, 118.0], [45.0, 0.0, 100.0], [0.0, 50.0, 90.0], [-45.0, 0.0, 100.0]])
# A cylinder with four spokes and three slices that rise by 10 mm, and a landmark.
SLICES = [
    "AAOP1",
    "AAOP1",
    "made by hand",
    "END COMMENTS",
    "CYLINDRICAL",
    "RIGHT",
    "1",
    "TIB",
    "1",
    "5",
    "-90",
]
SLICES += ["20", "4", "90", "3", "10", *["50"] * 4, *["60", "50", "50", "50"], *["50"] * 4]


@cache
def face() -> Socket:
    """With a trim line that rises by 28 mm, a flared brim and an area."""
    limb = round_limb()
    areas = [Area("press", np.array([0.0, -44.0, 60.0]), 22.0, 4.0)]
    recipe = Recipe(Trim([], LINE), flare_mm=6.0, areas=areas)
    return rectify_limb(limb.skin, limb.frame, recipe)


@pytest.fixture
def stl(tmp_path: Path) -> Path:
    write_surface(tmp_path / "socket.stl", face().surface)
    return tmp_path / "socket.stl"


def test_a_socket_as_stl_3mf_and_aop_is_one_shape(stl: Path) -> None:
    files = {kind: stl.with_suffix(kind) for kind in (".stl", ".3mf", ".aop")}
    assert convert_shape(stl, files[".3mf"])["deviation_mm"] < 1e-4
    assert convert_shape(files[".3mf"], files[".aop"])["deviation_mm"] < 0.1
    for first, second in ((".stl", ".3mf"), (".stl", ".aop"), (".3mf", ".aop")):
        found = compare_shapes(files[first], files[second])
        assert found.max_mm < 0.1
        assert found.rms_mm < 0.02
        for row in found.circumferences[:4]:
            assert row.first_mm == pytest.approx(row.second_mm, abs=0.2)
    assert len(found.circumferences) == 5


@pytest.mark.parametrize("kind", [".stl", ".ply", ".obj", ".vtp", ".3mf"])
def test_what_was_written_says_its_unit_and_comes_back(tmp_path: Path, kind: str) -> None:
    file = tmp_path / f"ball{kind}"
    write_surface(file, round_limb().skin)
    again = read_body(file)
    assert np.sqrt(round_limb().skin.find_nearest(again.points)[0]).max() < 1e-3
    assert again.volume == pytest.approx(round_limb().skin.volume, rel=1e-6)
    with pytest.raises(InputError, match="says that its unit is mm"):
        read_surface(file, unit="inch")
    if kind != ".3mf":
        with pytest.raises(InputError, match="says that it is in LPS"):
            read_body(file, space="RAS")


def test_a_3mf_file_in_inches_is_read_in_millimetres(tmp_path: Path) -> None:
    write_surface(tmp_path / "mm.3mf", round_limb().skin)
    for unit, factor in (("inch", 25.4), ("centimeter", 10.0)):
        with zipfile.ZipFile(tmp_path / "mm.3mf") as old, zipfile.ZipFile(tmp_path / "new.3mf", "w") as new:
            for name in old.namelist():
                new.writestr(name, old.read(name).replace(b'unit="millimeter"', f'unit="{unit}"'.encode()))
        size = np.ptp(read_body(tmp_path / "new.3mf").points, axis=0)
        np.testing.assert_allclose(size, factor * np.ptp(round_limb().skin.points, axis=0), rtol=1e-9)


def read_as_ampscan(file: Path) -> np.ndarray:
    """Points of a file with regular spokes and stated slices, by the rules of the reader of ampscan."""
    lines = file.read_text().splitlines()
    values = [float(line) for line in lines[lines.index("CYLINDRICAL") + 3 :]]
    spokes, step, slices = int(values[0]), values[1], int(values[2])
    heights, radii = values[4 : 4 + slices], np.reshape(values[4 + slices :], (slices, spokes))
    angles = np.radians(np.arange(-90.0, 270.0, step)[::-1])
    up = np.repeat(heights, spokes).reshape(radii.shape)
    return np.stack([radii * np.cos(angles), radii * np.sin(angles), up], axis=-1).reshape(-1, 3)


def test_another_reader_sees_the_same_shape(stl: Path) -> None:
    convert_shape(stl, stl.with_suffix(".aop"))
    points = read_as_ampscan(stl.with_suffix(".aop"))
    axis = find_axis(face().surface.flipped_surface, CUT_NORMAL)
    height = face().points @ axis
    middle = face().points[height < height.min() + 0.02].mean(axis=0)
    frame = build_limb_frame(middle + (height.min() - middle @ axis) * axis, axis)
    below = frame.to_patient(points[points[:, 2] < 80.0])
    assert np.sqrt(face().surface.find_nearest(below)[0]).max() < 0.1


def test_the_sense_of_the_spokes_must_be_stated_and_mirrors(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="does not say in which sense"):
        read_slices("\n".join(SLICES))
    for ends in ("\n", "\r", "\r\n"):
        clockwise, placed = read_slices(ends.join(SLICES), "clockwise")
        assert not placed
    other = read_slices("\n".join(SLICES), "counter-clockwise")[0]
    bump, mirrored = (one.points[np.hypot(*one.points[:, :2].T) > 55.0][0] for one in (clockwise, other))
    np.testing.assert_allclose(bump, [-60.0, 0.0, 10.0], atol=1e-9)  # the last of four looks along -y
    np.testing.assert_allclose(mirrored, [60.0, 0.0, 10.0], atol=1e-9)  # the first one looks along x
    assert (clockwise.face_normals[:, :2] * clockwise.triangles.mean(axis=1)[:, :2]).sum(axis=1).min() > 0.0


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({0: "solid x"}, "no AOP file"),
        ({3: "more"}, "no AOP file"),
        ({4: "CARTESIAN"}, "no AOP file"),
        ({6: "one"}, "line 7: 'one' instead of the number of landmarks"),
        ({12: "-4"}, "line 13: '-4' instead of the number of spokes"),
        ({13: "120"}, "do not go around once"),
        ({14: "9"}, "the end of the file instead of a radius in mm, 9 slices of 4 in all"),
        ({20: "wide"}, "line 21: 'wide' instead of a radius"),
        ({20: "nan"}, "line 21: 'nan' instead of a radius"),
        (
            {2: "LIMBFIT FRAME LPS mm, clockwise: 1 2 3"},
            "comment 'LIMBFIT FRAME LPS mm, clockwise:' is broken",
        ),
        ({27: "50\n50"}, "or more lines follow"),
    ],
)
def test_a_broken_file_of_slices_is_refused_with_its_line(tmp_path: Path, change: dict, words: str) -> None:
    file = tmp_path / "broken.aop"
    file.write_text("\n".join(change.get(k, line) for k, line in enumerate(SLICES)))
    with pytest.raises(InputError, match=words) as refused:
        read_body(file, spokes="clockwise")
    assert str(file) in str(refused.value)
    assert "\n" not in str(refused.value)


def test_a_wall_does_not_fit_in_slices() -> None:
    with pytest.raises(InputError, match=r"slices deviate by \d+\.\d\d mm .* give a wall's inner face"):
        format_slices(build_wall(face(), CUT_NORMAL, 4.0), CUT_NORMAL)


def test_bodies_are_taken_by_name_and_number(tmp_path: Path) -> None:
    limb = round_limb()
    write_surface(
        tmp_path / "limb.vtp", stack_surfaces([limb.bones["fibula"], limb.skin, limb.bones["tibia"]])
    )
    for body, volume in (("skin", limb.skin.volume), ("1", limb.skin.volume), ("fibula", None), ("3", None)):
        found = read_body(tmp_path / "limb.vtp", body)
        assert found.volume == pytest.approx(volume or limb.bones["fibula"].volume, rel=1e-5)
    with pytest.raises(InputError, match="no body is called 'patella'; there are 1, 2, 3, skin, tibia"):
        convert_shape(tmp_path / "limb.vtp", tmp_path / "x.stl", body="patella")
    with pytest.raises(InputError, match="3 bodies in one file; choose one by --body"):
        convert_shape(tmp_path / "limb.vtp", tmp_path / "x.aop")
    convert_shape(tmp_path / "limb.vtp", tmp_path / "skin.3mf", body="skin")
    assert read_body(tmp_path / "skin.3mf", "skin").volume == pytest.approx(limb.skin.volume, rel=1e-6)


def test_a_scan_without_bones_is_converted_closed_and_compared(tmp_path: Path) -> None:
    skin = round_limb().skin
    scan = replace(skin, faces=skin.faces[skin.triangles[..., 2].max(axis=1) < 149.0])
    write_surface(tmp_path / "scan.ply", scan)
    assert convert_shape(tmp_path / "scan.ply", tmp_path / "scan.aop")["deviation_mm"] < 0.1
    made = convert_shape(tmp_path / "scan.aop", tmp_path / "scan.stl", close=True)
    assert "open at one end" in made["notes"][-1]
    assert read_surface(tmp_path / "scan.stl").volume > 0.0
    write_surface(tmp_path / "skin.stl", skin)
    found = compare_shapes(tmp_path / "skin.stl", tmp_path / "scan.stl", map_file=tmp_path / "map.vtp")
    assert found.circumferences[2].first_mm == pytest.approx(found.circumferences[2].second_mm, abs=0.2)
    assert (tmp_path / "map.vtp").is_file()


def test_distances_circumferences_and_volumes_of_balls(tmp_path: Path) -> None:
    fall, radii = np.linspace(0.0, np.pi, 91), (40.0, 42.0)
    for radius in radii:
        profile = radius * np.column_stack([np.sin(fall), -np.cos(fall)])
        write_surface(tmp_path / f"{radius:.0f}.vtp", revolved(profile, 180))
    found = compare_shapes(tmp_path / "40.vtp", tmp_path / "42.vtp")
    assert (found.max_mm, found.rms_mm, found.mean_mm) == pytest.approx((2.0, 2.0, 2.0), abs=0.02)
    assert found.volumes_cm3 == pytest.approx([4 / 3e3 * np.pi * radius**3 for radius in radii], rel=2e-3)
    for row in found.circumferences[:3]:
        around = [2 * np.pi * np.sqrt(radius**2 - (row.height_mm - 40.0) ** 2) for radius in radii]
        assert (row.first_mm, row.second_mm) == pytest.approx(around, rel=2e-3)
    assert compare_shapes(tmp_path / "42.vtp", tmp_path / "40.vtp").mean_mm == pytest.approx(-2.0, abs=0.02)


def test_a_closed_limb_is_compared_with_an_open_socket_where_it_is_inside(tmp_path: Path, stl: Path) -> None:
    write_surface(tmp_path / "limb.vtp", round_limb().skin)
    found = compare_shapes(tmp_path / "limb.vtp", stl, map_file=tmp_path / "map.vtp")
    back = compare_shapes(stl, tmp_path / "limb.vtp")
    # The deepest area presses 4 mm inward; the end is 5 mm off, and so is the brim, measured from the limb.
    assert 4.0 < found.max_mm < 6.0
    assert 4.0 < back.max_mm < 6.0
    assert found.rms_mm < 2.5
    mapped = pyvista.read(tmp_path / "map.vtp")
    left_out = np.isnan(mapped["distance_mm"])
    assert left_out[mapped.points[:, 2] > 125.0].all()  # over the brim
    assert not left_out[mapped.points[:, 2] < 80.0].any()


def test_a_tape_spans_hollows() -> None:
    skin = round_limb().skin
    middle, angle = skin.points * [1.0, 1.0, 0.0], np.arctan2(skin.points[:, 1], skin.points[:, 0])
    dented = Surface(skin.points - 0.2 * middle * (np.abs(angle) < 0.3)[:, None], skin.faces)
    row = list_circumferences(skin, dented, CUT_NORMAL)[3]  # 80 mm over the end
    chord = 2.0 * (40.0 + 12.0 * 40.0 / 110.0) * (0.35 - np.sin(0.35))  # the straight tape over the dent
    assert row.first_mm - row.second_mm == pytest.approx(chord, rel=0.1)


def test_registration_finds_a_known_motion() -> None:
    socket = face().surface
    turn = Rotation.from_rotvec([1.6, -1.2, 0.9])
    moved = Surface(turn.apply(socket.points) + np.array([30.0, -50.0, 80.0]), socket.faces)
    found = register_surface(moved, socket)
    assert np.linalg.norm(found.points - socket.points, axis=1).max() < 0.05


def test_other_bad_input_is_one_line(tmp_path: Path) -> None:
    write_surface(tmp_path / "skin.vtp", round_limb().skin)
    (tmp_path / "text.3mf").write_text("no zip")
    (tmp_path / "bare.obj").write_text("v 0 0 0\nv 9 0 0\nv 0 9 0\nv 0 0 9\nf 1 2 3\nf 1 2 4\n")
    refusals = {
        ("bare.obj", "out.stl"): "does not say its unit; state the unit, one of mm, cm, m, inch",
        ("none.stl", "out.stl"): "no such surface",
        ("text.3mf", "out.stl"): "holds no mesh that can be read",
        ("skin.vtp", "out.step"): "unknown kind of surface '.step'",
        ("skin.vtp", "skin.vtp"): "is the file that is read",
    }
    for (source, target), words in refusals.items():
        with pytest.raises(InputError, match=re.escape(words)) as refused:
            convert_shape(tmp_path / source, tmp_path / target)
        assert "\n" not in str(refused.value)
    round_limb().skin.to_pyvista().save(tmp_path / "skin.stl")  # in mm, and does not say so
    with pytest.raises(InputError, match=r"1\.5e\+05 mm long; state its unit"):
        convert_shape(tmp_path / "skin.stl", tmp_path / "skin.aop", unit="m")
    with pytest.raises(InputError, match=r"map\.png: is no \.vtp file"):
        compare_shapes(tmp_path / "skin.vtp", tmp_path / "skin.vtp", map_file="map.png")
