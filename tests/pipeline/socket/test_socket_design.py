"""``limbfit socket design``: a small limb from target pressure to printable socket, table and report."""

import json
import re
import shutil
from pathlib import Path

import numpy as np
import psutil
import pytest
import trimesh

from limbfit import design_socket, load_study, report_study
from limbfit.errors import InputError
from limbfit.execution import Placement, SerialExecutor, place_jobs
from limbfit.pipeline.engine.context import Context
from limbfit.pipeline.engine.store import Store
from limbfit.pipeline.socket.design import _Design, _optimise_depths
from limbfit.pipeline.socket.simulation import SocketRun
from limbfit.results.socket import LoadedRegion, RegionGain, SocketSimulation, SocketState
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
def said() -> list[str]:
    return []


@pytest.fixture(scope="module")
def designed(folder, said) -> dict:
    """On two workers; ``said`` is its progress."""
    with place_jobs(Placement(workers=2)):
        return design_socket(load_study(folder), listener=lambda progress: said.append(str(progress)))


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
def test_side_by_side_they_are_what_they_are_one_after_the_other(designed, said, folder, tmp_path):
    names = [
        name for line in said for name in ("control", "design") if f": {name}: " in line and " s: " in line
    ]
    assert {name: names.count(name) > 8 for name in ("control", "design")} == dict.fromkeys(names, True)
    assert names.index("design") < len(names) - 1 - names[::-1].index("control")  # at the same time
    shares = [float(line.split()[1]) for line in said if "kPa at most" in line]
    assert shares == sorted(shares)
    assert shares[-1] == 3.0
    for file in ("study.toml", "skin.stl", "tibia.stl"):
        shutil.copy(folder / file, tmp_path)
    with place_jobs(Placement(workers=1)):
        alone = design_socket(load_study(tmp_path))
    for one, other in zip(designed["designs"], alone["designs"], strict=True):
        assert one["volume_cm3"] == pytest.approx(other["volume_cm3"], rel=1e-12)  # sums in another order
        assert one["peaks_kPa"] == pytest.approx(other["peaks_kPa"], rel=1e-3)
        assert one["simulation"]["steps"][-1]["move_mm"] == pytest.approx(
            other["simulation"]["steps"][-1]["move_mm"], abs=1e-3
        )


@pytest.mark.slow
def test_an_interrupt_ends_both_and_both_go_on_after_donning(designed, folder, tmp_path):
    """Interrupted when both are loaded, after 2 of 3 s."""
    for file in ("study.toml", "skin.stl", "tibia.stl"):
        shutil.copy(folder / file, tmp_path)
    times: dict[str, list[float]] = {"control": [], "design": []}

    def listen(progress) -> None:
        found = re.search(r": (control|design): ([0-9.]+) of 3 s", str(progress))
        if found:
            times[found[1]].append(float(found[2]))

    def stop(progress) -> None:
        listen(progress)
        if all(max(told, default=0.0) > 2.05 for told in times.values()):
            raise KeyboardInterrupt

    with place_jobs(Placement(workers=2)):
        with pytest.raises(KeyboardInterrupt):
            design_socket(load_study(tmp_path), listener=stop)
        assert not [one for one in psutil.Process().children() if "spawn_main" in " ".join(one.cmdline())]
        for told in times.values():
            told.clear()
        again = design_socket(load_study(tmp_path), listener=listen)
    assert all(min(told) > 2.0 for told in times.values())
    for one, other in zip(designed["designs"], again["designs"], strict=True):
        assert one["peaks_kPa"] == pytest.approx(other["peaks_kPa"], rel=1e-3)
    assert not list(tmp_path.glob("results/socket_design/runs/begun-*"))


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
    shop = folder / "results" / "socket_design" / "shop"
    assert {file.name for file in shop.iterdir()} == set(designed["shop"]["files"])
    assert designed["shop"]["aop_deviation_mm"] < 0.1


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


def test_a_region_that_the_control_does_not_touch_has_no_percent_of_change(folder):
    """A control that leaves the end of the limb free presses nothing there, and the search still ends."""
    study = load_study(folder)
    context = Context(study, Store(study.results), SerialExecutor(), lambda progress: None)

    def press(name: str, distal_kPa: float, crest_kPa: float) -> _Design:
        peaks = {"distal tibia": distal_kPa, NAMED: crest_kPa}
        rows = [LoadedRegion.model_construct(region=region, peak_kPa=peak) for region, peak in peaks.items()]
        state = SocketState.model_construct(regions=rows)
        run = SocketRun(name, None, {})
        return _Design(run, {}, SocketSimulation.model_construct(donning=state, loads=[]))

    designs = [press("control", 0.0, 90.0), press("design", 12.0, 60.0)]
    names = ["distal tibia", NAMED]
    _, found = _optimise_depths(context, None, None, designs, names, 0, lambda done, words: None)
    changes = [RegionGain(**gain).change_percent for gain in found["gains"]]
    assert changes == [None, pytest.approx(-100.0 / 3.0)]
