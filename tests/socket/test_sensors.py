"""Files of sensors in a socket, cells that cannot be compared, and a sheet wrapped over a cone."""

from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from socket_limbs import round_limb

from limbfit.errors import InputError, SurfaceError
from limbfit.phantom.sensors import count_pressure, record_pressure, write_from_template
from limbfit.socket import Recipe, rectify_limb
from limbfit.socket.rays import compute_profile
from limbfit.socket.rectify import Trim
from limbfit.socket.sensors import SheetLayout, read_recording
from limbfit.socket.wrapping import wrap_sheet

HEAD = """DATA_TYPE MOVIE
ROWS 3
COLS 4
ROW_SPACING 1.27 centimeters
COL_SPACING 10 mm
SENSEL_AREA 1.27 cm2
NOISE_THRESHOLD 5
SECONDS_PER_FRAME 0.5
SATURATION_PRESSURE 102 KPa
COMMENTS:
by hand
UNITS KPa
ASCII_DATA @@
"""
FRAMES = """
Frame 1
B,10,20,30
10,0,20,30
0,10,102,30

Frame 2, 0.5,, 12/2/2019 6:21:52.44PM,,,Raw Sum=,,307
B,30,20,30
10,0,20,30
0,10,90,1
@@
"""
PLIANCE = """file name: 1.mat date/time 17.06.23 15.21
mat type s2160_001
total times [secs]: 1.0 time per frame [secs]: 0.5 scanning rate [Hz]: 2
pressure values in kPa

electrical:
time[secs]       2       3       5
    0.50000   1.000  10.000   5.000
    1.00000   3.000  10.000   7.000

    MPP   3.000  10.000   7.000
"""
CELLS = "cell,x_mm,y_mm,z_mm,area_mm2,pressure_kPa\n1,0,-50,10,100,25\n2,5,-50,10,100,\n"


def read(folder: Path, text: str, kind: str, layout: SheetLayout | None = None, **stated: float):
    (folder / "file").write_text(text)
    return read_recording(folder / "file", layout, kind, **stated)


def test_a_sheet_of_tekscan_has_its_units_and_marks_what_is_no_reading(tmp_path):
    found = read(tmp_path, HEAD + FRAMES, "tekscan")
    assert found.layout == SheetLayout((3, 4), (12.7, 10.0))
    assert found.noise_kPa == pytest.approx(5 * 102 / 255)
    assert found.area_mm2[0] == pytest.approx(127.0)
    named = dict(zip(found.names, zip(found.frames.mean(axis=0), found.states, strict=True), strict=True))
    assert "1-1" not in named  # B: there is no cell
    assert named["1-2"] == (20.0, "compared")
    assert named["2-2"] == (0.0, "dead")  # its seven neighbours read something, but for one
    assert named["3-1"] == (0.0, "below noise")  # at the edge of what is pressed
    assert named["3-3"] == (96.0, "saturated")
    later = read(tmp_path, HEAD + FRAMES, "tekscan", start_s=0.4, noise_kPa=0.0, saturation_kPa=200.0)
    assert later.frames[:, 0] == 30.0
    assert Counter(later.states) == {"compared": 10, "dead": 1}


def test_cells_of_pliance_are_numbered_along_the_rows_of_the_stated_layout(tmp_path):
    found = read(tmp_path, PLIANCE, "pliance", SheetLayout((2, 3), (10.0, 15.0)))
    assert found.names == ["1-2", "1-3", "2-2"]
    np.testing.assert_allclose(found.frames, [[1.0, 10.0, 5.0], [3.0, 10.0, 7.0]])
    assert found.area_mm2.tolist() == [150.0] * 3


def test_a_cell_without_pressure_is_dead(tmp_path):
    found = read(tmp_path, CELLS, "cells")
    assert found.states == ["compared", "dead"]
    assert found.position[1].tolist() == [5.0, -50.0, 10.0]


@pytest.mark.parametrize(
    ("text", "kind", "said"),
    [
        (
            HEAD.replace("UNITS KPa", "UNITS raw") + FRAMES,
            "tekscan",
            "UNITS: unknown unit 'raw'; export it in",
        ),
        (HEAD.replace("ROWS 3\n", "") + FRAMES, "tekscan", "header: no line ROWS; export the file again"),
        (
            HEAD + FRAMES.replace("10,0,20,30\n", "", 1),
            "tekscan",
            "Frame: frames that are not of 3 rows of 4",
        ),
        (HEAD.replace("ROWS 3", "ROWS x") + FRAMES, "tekscan", "not readable: invalid literal"),
        (PLIANCE.replace("time[secs]", "time"), "pliance", "no line time"),
        (PLIANCE.replace("in kPa", "in bananas"), "pliance", "unknown unit 'bananas'"),
        (
            PLIANCE.replace("       5\n", "       9\n"),
            "pliance",
            "cells up to number 9 on a sheet of 2 rows of 3",
        ),
        (PLIANCE.replace("   7.000\n\n", "\n\n"), "pliance", "not readable: the number of columns changed"),
        (CELLS.replace("area_mm2", "area"), "cells", "header: no column area_mm2; name the columns"),
        (CELLS.replace("-50,10", ",10"), "cells", "cells without position or area"),
    ],
)
def test_a_broken_file_is_named_with_the_place_and_the_remedy(tmp_path, text, kind, said):
    layout = SheetLayout((2, 3), (10.0, 15.0)) if kind == "pliance" else None
    with pytest.raises(InputError, match=said.replace("[", r"\[")) as caught:
        read(tmp_path, text, kind, layout)
    assert str(caught.value).startswith(str(tmp_path / "file"))


def test_synthetic_files_hold_the_truth_within_the_stated_error(tmp_path):
    layout, true = SheetLayout((8, 6), (12.7, 12.7)), np.linspace(5.0, 60.0, 48)
    frames = record_pressure(true, 2.0, 10.0, seed=3)
    facts = {"layout": layout, "saturation_kPa": 100.0, "positions": np.zeros((48, 3)), "area_mm2": 100.0}
    counted = count_pressure(frames, 100.0)
    for kind, template, values in (
        ("tekscan", "tekscan.asf.j2", counted),
        ("pliance", "pliance.asc.j2", frames),
        ("cells", "cells.csv.j2", frames),
    ):
        means = values.mean(axis=0)
        write_from_template(tmp_path / kind, template, frames=values, means=means, **facts)
        found = read_recording(tmp_path / kind, layout if kind == "pliance" else None, kind)
        read_kPa = found.frames.mean(axis=0)
        np.testing.assert_allclose(read_kPa, means, atol=0.006)
        assert np.mean(np.abs(read_kPa - true) <= np.hypot(2.0, 0.1 * true)) > 0.95
    assert np.std((frames.mean(axis=0) - true) / np.hypot(2.0, 0.1 * true)) * 1.96 > 0.3


@pytest.fixture(scope="module")
def cone():
    """The limb's socket without reduction, and where a sheet lies that is rolled onto it."""
    limb, slope = round_limb(), 12.0 / 110.0  # radius 40 at z = 40
    brim = Trim([(np.array([0.0, 0.0, 115.0]), limb.cut_normal)])
    socket = rectify_limb(limb.skin, limb.frame, Recipe(brim, 0.0, []))

    def roll(across: np.ndarray, down: np.ndarray) -> np.ndarray:
        """A cone is developed by polar coordinates about its apex."""
        half, apex = np.arctan(slope), 40.0 - 40.0 / slope
        along = (100.0 - apex) / np.cos(half) - down
        turn = 0.9 * np.pi + np.arctan2(across, along) / np.sin(half)
        z = apex + np.hypot(across, along) * np.cos(half)
        radius = (z - apex) * slope
        return np.column_stack([radius * np.cos(turn), radius * np.sin(turn), z])

    return limb, socket, roll


@pytest.mark.parametrize("held", [[0, 11, 60], [5, 30, 66], [0, 11, 60, 71]])
def test_a_sheet_bends_around_a_cone_and_is_not_stretched(cone, held):
    """From three or four cells, over more than half of its circumference and across where angles start."""
    limb, socket, roll = cone
    layout, cells = SheetLayout((6, 12), (10.0, 15.0)), np.indices((6, 12)).reshape(2, -1).T
    true = roll(15.0 * cells[:, 1] - 82.5, 10.0 * cells[:, 0])
    rays = compute_profile(limb.skin, limb.frame).rays
    found, stretch = wrap_sheet(layout, cells[held], true[held], socket, rays, limb.frame)
    assert np.linalg.norm(found.reshape(-1, 3) - true, axis=1).max() < 1.0
    assert stretch < 0.5
    wrong = SheetLayout((6, 12), (25.4, 38.1))  # inches for centimetres
    with pytest.raises(SurfaceError, match=r"stretched by [0-9]+ % over the socket's face; check rows"):
        wrap_sheet(wrong, cells[held], true[held], socket, rays, limb.frame)
