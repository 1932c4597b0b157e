"""Files of sensors in a socket, cells that cannot be compared, and a sheet wrapped over a cone."""

from pathlib import Path

import numpy as np
import pytest
from socket_limbs import round_limb

from limbfit.errors import InputError, SurfaceError
from limbfit.phantom.build import make_phantom, render_template
from limbfit.pipeline.socket.sensors import record_pressure
from limbfit.socket import Recipe, rectify_limb
from limbfit.socket.rays import compute_profile
from limbfit.socket.rectify import Trim
from limbfit.socket.sensors import SheetLayout, read_recording
from limbfit.socket.wrapping import wrap_sheet

HEAD = (
    "DATA_TYPE MOVIE\nROWS 3\nCOLS 4\nROW_SPACING 1.27 centimeters\nCOL_SPACING 10 mm\nSENSEL_AREA 1.27 cm2\n"
    "NOISE_THRESHOLD 5\nSECONDS_PER_FRAME 0.5\nSATURATION_PRESSURE 102 KPa\nUNITS KPa\nASCII_DATA @@\n"
)
ONE = "\nFrame 1\nB,10,20,30\n10,0,20,30\n0,10,102,30\n"
TWO = "\nFrame 2, 0.5,, 12/2/2019 6:21:52.44PM,,,Raw Sum=,,307\nB,30,20,30\n10,0,20,30\n0,10,90,1\n@@\n"
PLIANCE = (
    "file name: 1.mat\nmat type s2160\npressure values in kPa\n\nelectrical:\ntime[secs]     2     3     5\n"
    "   0.500   1.000  10.000   5.000\n   1.000   3.000  10.000   7.000\n\n   MPP   3.000  10.000   7.000\n"
)
CELLS = "cell,x_mm,y_mm,z_mm,area_mm2,pressure_kPa\n1,0,-50,10,100,25\n2,5,-50,10,100,\n"


def read(folder: Path, text: str, kind: str, **stated: float):
    (folder / "file").write_text(text)
    layout = SheetLayout((2, 3), (10.0, 15.0)) if kind == "pliance" else None
    return read_recording(folder / "file", layout, kind, **stated)


def test_a_sheet_of_tekscan_has_its_units_and_marks_what_is_no_reading(tmp_path):
    found = read(tmp_path, HEAD + ONE + TWO, "tekscan")
    assert found.layout == SheetLayout((3, 4), (12.7, 10.0))
    assert (found.noise_kPa, found.area_mm2[0]) == (pytest.approx(5 * 102 / 255), pytest.approx(127.0))
    named = dict(zip(found.names, zip(found.frames.mean(axis=0), found.states, strict=True), strict=True))
    assert "1-1" not in named  # B: there is no cell
    assert named["1-2"] == (20.0, "compared")
    assert named["2-2"] == (0.0, "dead")  # its seven neighbours read something, but for one
    assert named["3-1"] == (0.0, "below noise")  # at the edge of what is pressed
    assert named["3-3"] == (96.0, "saturated")
    later = read(tmp_path, HEAD + ONE + TWO, "tekscan", start_s=0.4, noise_kPa=0.0, saturation_kPa=200.0)
    assert later.frames[:, 0] == 30.0
    assert sorted(later.states) == ["compared"] * 10 + ["dead"]


def test_cells_of_pliance_are_numbered_along_rows_and_one_without_pressure_is_dead(tmp_path):
    found = read(tmp_path, PLIANCE, "pliance")
    assert (found.names, found.area_mm2.tolist()) == (["1-2", "1-3", "2-2"], [150.0] * 3)
    np.testing.assert_allclose(found.frames, [[1.0, 10.0, 5.0], [3.0, 10.0, 7.0]])
    found = read(tmp_path, CELLS, "cells")
    assert (found.states, found.position[1].tolist()) == (["compared", "dead"], [5.0, -50.0, 10.0])


@pytest.mark.parametrize(
    ("kind", "text", "old", "new", "said"),
    [
        ("tekscan", HEAD + ONE, "UNITS KPa", "UNITS raw", "UNITS: unknown unit 'raw'; export it in kpa, pa"),
        ("tekscan", HEAD + ONE, "ROWS 3\n", "", "header: no line ROWS; export the file again"),
        ("tekscan", HEAD + ONE, "10,0,20,30\n", "", "Frame: frames that are not of 3 rows of 4 cells"),
        ("tekscan", HEAD + ONE, "ROWS 3", "ROWS x", "not readable: invalid literal"),
        ("pliance", PLIANCE, "time[secs]", "time", r"no line time\[secs\]"),
        ("pliance", PLIANCE, "in kPa", "in bananas", "unknown unit 'bananas'"),
        ("pliance", PLIANCE, "5\n", "9\n", "cells up to number 9 on a sheet of 2 rows of 3"),
        ("pliance", PLIANCE, "   7.000\n\n", "\n\n", "not readable: the number of columns changed"),
        ("cells", CELLS, "area_mm2", "area", "header: no column area_mm2; name the columns"),
        ("cells", CELLS, "-50,10", ",10", "cells without position or area"),
    ],
)
def test_a_broken_file_is_named_with_the_place_and_the_remedy(tmp_path, kind, text, old, new, said):
    with pytest.raises(InputError, match=said) as caught:
        read(tmp_path, text.replace(old, new, 1), kind)
    assert str(caught.value).startswith(str(tmp_path / "file"))


def test_a_phantom_without_a_socket_has_no_sensors(tmp_path):
    with pytest.raises(InputError, match="no socket that sensors could be in; ask for a socket, too"):
        make_phantom(tmp_path / "limb", sensors=lambda *given: {})


def test_synthetic_files_hold_the_truth_within_the_stated_error(tmp_path):
    layout, true = SheetLayout((8, 6), (12.7, 12.7)), np.linspace(5.0, 60.0, 48)
    facts = {"layout": layout, "saturation_kPa": 100.0, "positions": np.zeros((48, 3)), "area_mm2": 100.0}
    for kind, end, full in (("tekscan", "asf", 100.0), ("pliance", "asc", np.inf), ("cells", "csv", np.inf)):
        frames, error = record_pressure(true, full, seed=3), np.hypot(2.0, 0.1 * true)
        facts |= {"frames": frames, "means": frames.mean(axis=0), "step_s": 0.1, "noise": 3}
        (tmp_path / kind).write_text(render_template(f"{kind}.{end}.j2", **facts))
        found = read_recording(tmp_path / kind, layout if kind == "pliance" else None, kind)
        np.testing.assert_allclose(found.frames.mean(axis=0), facts["means"], atol=0.006)
        assert np.mean(np.abs(facts["means"] - true) <= error) > 0.95
        assert 1.96 * np.std((facts["means"] - true) / error) > 0.3


@pytest.mark.parametrize("held", [[0, 11, 60], [5, 30, 66], [0, 11, 60, 71]])
def test_a_sheet_bends_around_a_cone_and_is_not_stretched(held):
    """From three or four cells, over more than half of its circumference and across where angles start."""
    limb, slope, brim = round_limb(), 12.0 / 110.0, np.array([0.0, 0.0, 115.0])  # radius 40 at z = 40
    socket = rectify_limb(limb.skin, limb.frame, Recipe(Trim([(brim, limb.cut_normal)]), 0.0, []))
    cells = np.indices((6, 12)).reshape(2, -1).T
    # A cone is developed by polar coordinates about its apex.
    half, apex = np.arctan(slope), 40.0 - 40.0 / slope
    across, along = 15.0 * cells[:, 1] - 82.5, (100.0 - apex) / np.cos(half) - 10.0 * cells[:, 0]
    turn, reach = 0.9 * np.pi + np.arctan2(across, along) / np.sin(half), np.hypot(across, along)
    radius = reach * np.cos(half) * slope
    true = np.column_stack([radius * np.cos(turn), radius * np.sin(turn), apex + reach * np.cos(half)])
    rays = compute_profile(limb.skin, limb.frame).rays
    rest = cells[held], true[held], socket, rays, limb.frame
    found, stretch = wrap_sheet(SheetLayout((6, 12), (10.0, 15.0)), *rest)
    assert np.linalg.norm(found.reshape(-1, 3) - true, axis=1).max() < 1.0
    assert stretch < 0.5
    with pytest.raises(SurfaceError, match=r"stretched by [0-9]+ % over the socket's face; check rows"):
        wrap_sheet(SheetLayout((6, 12), (25.4, 38.1)), *rest)  # inches for centimetres
