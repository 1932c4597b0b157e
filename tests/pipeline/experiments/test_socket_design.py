"""``limbfit socket design``: a small limb from target pressure to printable socket, table and report."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import trimesh

from limbfit import design_socket, load_study, report_study
from limbfit.errors import InputError
from small_limb import small_limb

SOCKET = """hold_s = 0.0
liner = { thickness_mm = 4.0 }
[[socket.loads]]
name = "stance"
force_N = [0.0, 0.0, 100.0]
duration_s = 1.0
hold_s = 0.0
[socket.design]
pressure_kPa = 6.0
wall_mm = 3.0
adapter_diameter_mm = 30.0
"""
NAMED = "tibial crest"


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    return small_limb(tmp_path_factory.mktemp("design"), SOCKET)


@pytest.fixture(scope="module")
def designed(folder) -> dict:
    return design_socket(load_study(folder))


@pytest.mark.slow
def test_the_control_has_the_volume_of_the_design_and_the_same_load(designed):
    control, design = designed["designs"]
    assert (control["name"], design["name"]) == ("control", "design")
    assert control["volume_cm3"] == pytest.approx(design["volume_cm3"], rel=1e-3)
    assert designed["balance_percent"] < 0.1
    for one in (control, design):
        (load,) = one["simulation"]["loads"]
        np.testing.assert_allclose(load["force_N"], [0.0, 0.0, 100.0])
        peaks = {row["region"]: row["peak_kPa"] for row in load["regions"]}
        assert one["peaks_kPa"] == peaks
    low, high = design["offset_mm"]
    assert low < -0.3  # pressed in where tissue is deep
    assert high > 0.3  # and out of the way elsewhere, tissue does not vanish
    assert control["offset_mm"] != design["offset_mm"]


@pytest.mark.slow
def test_the_printable_socket_is_watertight_and_as_thick_as_stated(designed, folder):
    body = trimesh.load(folder / "results" / "socket_design" / "socket.stl")
    assert body.is_watertight
    assert body.is_winding_consistent
    assert body.body_count == 1
    assert body.euler_number == 2
    told = designed["wall"]
    assert told["volume_cm3"] == pytest.approx(body.volume / 1000.0, rel=1e-3)
    assert told["median_mm"] == pytest.approx(3.0, rel=0.02)
    assert told["least_mm"] > 0.85 * 3.0


@pytest.mark.slow
def test_named_peaks_are_lowered_and_what_was_simulated_is_kept(designed, folder):
    kept = {file.name for file in (folder / "results" / "socket_design" / "runs").iterdir()}
    assert len(kept) == 3  # target pressure, control, design
    told: list[str] = []
    found = design_socket(
        load_study(folder), optimise=[NAMED], simulations=2, listener=lambda p: told.append(str(p))
    )
    assert not any("control: " in line and " of 3 s" in line for line in told)  # not simulated again
    assert kept < {file.name for file in (folder / "results" / "socket_design" / "runs").iterdir()}
    assert found["designs"][:2] == json.loads(json.dumps(designed["designs"]))
    optimisation = found["optimisation"]
    assert 2 <= len(optimisation["trials"]) <= 3
    (gain,) = optimisation["gains"]
    assert gain["optimised_kPa"] < gain["design_kPa"]
    assert not optimisation["beyond_limits"]
    last = found["designs"][2]
    assert last["depths_mm"][NAMED] < 0.0
    assert last["peaks_kPa"][NAMED] == gain["optimised_kPa"]
    page = Path(report_study(load_study(folder))["report"]).read_text()
    assert "The design of a socket" in page
    assert "not a medical device" in page
    for name in ("control", "design", "optimised"):
        assert page.count(f"{name}, anterior view") == 3  # offset, pressure, shear


def test_what_cannot_be_designed_is_one_line(folder):
    study = load_study(folder)
    with pytest.raises(InputError, match="0 simulations are too few"):
        design_socket(study, optimise=[NAMED], simulations=0)
    with pytest.raises(InputError, match="named twice"):
        design_socket(study, optimise=[NAMED, NAMED])
    with pytest.raises(InputError, match="--optimise: no region is named 'heel'") as caught:
        design_socket(study, optimise=["heel"])
    assert "tibial crest" in str(caught.value.remedy)
