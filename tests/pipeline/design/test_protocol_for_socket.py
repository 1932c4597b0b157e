"""Records that are chosen for the pressures of a socket, on a small limb with an identified tissue."""

from pathlib import Path

import numpy as np
import pytest

import limbfit
from conftest import COARSE, write_trace
from limbfit.errors import InputError
from limbfit.pipeline.design.design import OWN, WITH_SENSORS
from limbfit.pipeline.design.protocol import DESIGNED
from small_limb import LIMB, small_limb

LOAD = """hold_s = 1.0
[[socket.loads]]
name = "stance"
force_N = [0.0, 0.0, 150.0]
duration_s = 1.0
hold_s = 1.0
"""
SESSION = {"minutes": 6, "depths_mm": (1.5,), "holds_s": (0, 10), "draws": 1}


@pytest.fixture(scope="module")
def study(tmp_path_factory) -> limbfit.Study:
    folder = small_limb(tmp_path_factory.mktemp("for-socket"), "")
    write_trace(folder / "1.csv", depth=2.0, peak=6.0)
    site = LIMB.replace("depth_mm = 3.0", 'trace = "1.csv"\nfitted = true')
    site = site.replace("[46.0, -80.0, 290.0]", "[-20.0, -80.0, 275.0]")
    free = '[calibration]\nfixed = ["skin.m", "skin.gamma", "skin.tau_s", "muscle.m", "muscle.gamma"]\n'
    (folder / "study.toml").write_text(site + LOAD + COARSE.replace("[calibration]\n", free))
    found = limbfit.load_study(folder)
    limbfit.run_study(found, until="calibrate")
    return found


@pytest.mark.slow
def test_a_design_says_what_sensors_in_the_socket_would_add(study) -> None:
    with pytest.raises(InputError, match="no current socket"):
        limbfit.plan_protocol(study, determine=("socket",), **SESSION)
    assert WITH_SENSORS not in [row["design"] for row in limbfit.design_study(study)["designs"]]
    limbfit.fit_socket(study)
    found = limbfit.design_study(study)
    own, more = (
        next(row["factor_95"] for row in found["designs"] if row["design"] == name)
        for name in (OWN, WITH_SENSORS)
    )
    assert all(more[name] <= own[name] * (1 + 1e-12) for name in own)
    assert more["muscle.c_kPa"] < own["muscle.c_kPa"]
    assert "pressures in the socket, measured in every region, " in found["verdict"]
    assert WITH_SENSORS in Path(limbfit.report_study(study)["report"]).read_text().replace("&#39;", "'")


@pytest.mark.slow
def test_the_records_for_a_socket_tell_its_pressures_best(study) -> None:
    """By the sum of the variances of their logarithms, which no simpler session of that time makes less."""
    socket = limbfit.fit_socket(study)
    found = limbfit.plan_protocol(study, determine=("socket",), **SESSION)
    regions = [one["region"] for one in socket["loads"][0]["regions"] if one["mean_kPa"] > 0]
    assert found["pressures"] == [f"stance, {name}" for name in regions]
    assert found["criterion"] == "A"
    own = next(row for row in found["protocols"] if row["design"] == DESIGNED)
    spread = np.log(list(own["pressures_95"].values())) / 1.959964
    assert own["cost"] == pytest.approx(float(np.sum(spread**2)), rel=1e-6)
    for row in found["protocols"]:
        assert own["cost"] <= row["cost"] + 1e-12 or row["minutes"] > own["minutes"]
    assert "as far as tissue decides" in found["verdict"]
    # Ramps of 0.3 s are quicker than the socket's, and a record of 10 s and more lasts as long as its loads.
    assert not any("does not determine all" in text for text in found["left_out"])
    assert {row["speed_mm_s"] for row in found["candidates"]} == {0.96, 4.8}
    text = Path(limbfit.report_study(study)["report"]).read_text()
    assert "stance, " in text
    with pytest.raises(InputError, match="are not determined with other parameters"):
        limbfit.plan_protocol(study, determine=("socket", "muscle.c_kPa"), **SESSION)
