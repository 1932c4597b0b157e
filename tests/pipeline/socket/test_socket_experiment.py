"""``limbfit socket``: a small limb in its socket, from the study to table and report."""

import json
import os
import re
import shutil
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import pyvista as pv

from limbfit import fit_socket, load_results, load_study, report_study
from limbfit.anatomy.meshing.layers import LayerSpec
from limbfit.anatomy.meshing.meshing import MeshSettings, mesh_limb
from limbfit.cli.socket import show_socket
from limbfit.donning import Load, SocketFit, build_socket_problem, build_socket_steps, simulate_donning
from limbfit.errors import InputError, RunError
from limbfit.fe import OgdenQLV
from limbfit.fe.kernel.laws import Laws
from limbfit.identify.fit.prediction import NORMAL_95
from limbfit.indentation import to_parameters
from limbfit.pipeline.commands.run import run_experiment
from limbfit.pipeline.socket.shape import build_socket
from small_limb import limb, small_limb

SOCKET = """hold_s = 1.0
[[socket.loads]]
name = "stance"
force_N = [0.0, 0.0, 150.0]
duration_s = 1.0
hold_s = 1.0
"""

TISSUES = np.array([9.0, 6.0, 2.0, 0.5, 4.0, 4.0, 3.0, 0.3])  # kPa, 1, 1, s of skin and muscle


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    return small_limb(tmp_path_factory.mktemp("socket"), SOCKET)


@pytest.fixture(scope="module")
def coarse(tmp_path_factory) -> Path:
    """The same with a coarser mesh, its load not held."""
    short = SOCKET.removesuffix("hold_s = 1.0\n") + "hold_s = 0.0\n"
    return small_limb(tmp_path_factory.mktemp("coarse"), short, edge_mm=22.0)


@pytest.fixture(scope="module")
def found(coarse) -> dict:
    return fit_socket(load_study(coarse))


def test_what_is_told_is_what_others_read(found, coarse):
    assert {"seconds", "balance_percent", "loads", "donning", "parameters_from", "steps"} <= found.keys()
    (load,) = found["loads"]
    assert {"name", "settling_mm", "contact_area_mm2", "peak_kPa", "regions"} <= load.keys()
    row = load["regions"][0]
    assert {"region", "peak_kPa", "mean_kPa", "interval_kPa", "shear_kPa"} <= row.keys()
    assert found["parameters_from"] == "literature"  # nothing was identified
    assert str(coarse) not in (coarse / "results" / "socket" / "socket.json").read_text()


def test_the_load_is_carried_and_the_limb_settles(found):
    """By contact alone, at every step; pressure and area grow under the load, and most under its brim."""
    assert found["balance_percent"] < 0.1
    last, (load,) = found["steps"][-1], found["loads"]
    np.testing.assert_allclose(last["force_N"], [0.0, 0.0, 150.0], atol=0.15)
    assert 0.5 < load["settling_mm"] < 10.0
    assert load["contact_area_mm2"] > found["donning"]["contact_area_mm2"]
    for held in (found["donning"], load):
        for row in held["regions"]:
            assert 0.0 <= row["mean_kPa"] <= row["peak_kPa"] <= held["peak_kPa"]
    before = {row["region"]: row["mean_kPa"] for row in found["donning"]["regions"]}
    assert all(row["mean_kPa"] > before[row["region"]] for row in load["regions"])


def test_what_holds_the_donned_socket_goes_over_into_the_load(found):
    """No jump where displacement hands over to force."""
    steps = found["steps"]
    ends = [i for i, row in enumerate(steps) if np.isclose(row["time_s"], 3.0)]
    here, after = (steps[i]["force_N"][2] for i in (ends[0], ends[0] + 1))
    assert here < after < here + 0.3 * (150.0 - here)


def test_the_strain_inside_is_told_and_stored(found, coarse):
    """Of every tissue under the liner, with its place; more under the load; cells in the file."""
    (load,) = found["loads"]
    for one in (found["donning"], load):
        assert [row["tissue"] for row in one["inside"]] == ["skin", "muscle"]
        for row in one["inside"]:
            assert 0.0 < row["shear_rare"] <= row["shear"]
            assert 0.0 < row["compression_rare"] <= row["compression"] < 0.5
            volumes = [row["volume_mm3"], *row["sheared_mm3"].values()]
            assert volumes == sorted(volumes, reverse=True)
            assert row["near"] in {region["region"] for region in one["regions"]}
    before, after = (max(row["shear"] for row in one["inside"]) for one in (found["donning"], load))
    assert after > before
    stored = pv.read(coarse / "results" / "socket" / "held-1.vtu")
    names = list(stored.field_data["region_names"])
    skin = np.asarray(stored.cell_data["region"]) == names.index("skin")
    assert stored.cell_data["shear_strain"][skin].max() == pytest.approx(load["inside"][0]["shear"])


def test_tissue_relaxes_while_the_socket_is_held(found):
    held = [row for row in found["steps"] if 2.0 - 1e-9 <= row["time_s"] <= 3.0 + 1e-9]
    assert (np.diff([row["mean_kPa"] for row in held]) < 0.0).all()


@pytest.mark.slow
def test_it_is_not_done_twice_and_the_report_shows_it(found, coarse, limbfit):
    file = coarse / "results" / "socket" / "socket.json"
    before = file.stat().st_mtime_ns
    assert fit_socket(load_study(coarse))["steps"] == json.loads(file.read_text())["steps"]
    code, out, _ = limbfit("socket", coarse, "--json")
    told = json.loads(out)
    assert (code, told["steps"]) == (0, found["steps"])
    assert file.stat().st_mtime_ns == before
    page = Path(told["report"]).read_text()
    assert "The limb in its socket" in page
    assert "not a medical device" in page
    assert page.count("stance, anterior view") == 2  # pressure and shear
    assert "cuts along and across it through the largest shear" in page


def begin(folder: Path) -> subprocess.Popen:
    """The command on one core: what several threads add up comes in any order."""
    return subprocess.Popen(
        [sys.executable, "-m", "limbfit", "socket", str(folder)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        preexec_fn=lambda: os.sched_setaffinity(0, {max(os.sched_getaffinity(0))}),
    )


def seconds_told(lines: list[str]) -> list[float]:
    """The simulated times that a run says it is at."""
    found = (re.search(r"([0-9.]+) of 5 s: ", line) for line in lines)
    return [float(one[1]) for one in found if one]


def stored_parts(folder: Path) -> tuple[dict, list[np.ndarray]]:
    """What a run stored, but for how long it took: facts, and fields of every part."""
    results = folder / "results" / "socket"
    facts = json.loads((results / "socket.json").read_text())
    meshes = [pv.read(results / f"held-{i}.vtu") for i in (0, 1)]
    fields = [data[name] for mesh in meshes for data in (mesh.point_data, mesh.cell_data) for name in data]
    return {key: value for key, value in facts.items() if key not in ("seconds", "mesh")}, fields


@pytest.mark.slow
def test_one_that_was_killed_in_its_load_goes_on_after_donning_to_the_same_end(folder, tmp_path):
    """SIGKILL of the command when the load is on its way: donning and hold, 3 s of 5, are not done again."""
    straight, killed = tmp_path / "straight", tmp_path / "killed"
    for place in (straight, killed):
        place.mkdir()
        for file in ("study.toml", "skin.stl", "tibia.stl"):
            shutil.copy(folder / file, place)
    run = begin(killed)
    while not any(time > 3.1 for time in seconds_told([run.stderr.readline()])):
        assert run.poll() is None, "the run ended before"
    run.send_signal(signal.SIGKILL)
    run.communicate()
    assert not (killed / "results" / "socket").exists()
    assert len(list(killed.glob("results/.work-socket-*/runs/begun-*.npz"))) == 1
    said = {}
    for place in (straight, killed):
        run = begin(place)
        _, lines = run.communicate(timeout=600)
        assert run.returncode == 0, lines
        said[place] = seconds_told(lines.splitlines())
    assert min(said[straight]) < 1.0
    assert min(said[killed]) > 3.0
    assert said[killed] == said[straight][-len(said[killed]) :]
    (one, fields), (other, again) = map(stored_parts, (straight, killed))
    assert other == one
    for before, after in zip(fields, again, strict=True):
        np.testing.assert_array_equal(after, before)
    assert not list((killed / "results" / "socket" / "runs").iterdir())


PULL = """friction = 0.0
hold_s = 0.0
[[socket.loads]]
name = "pull"
force_N = [0.0, 0.0, -60.0]
duration_s = 1.0
hold_s = 0.0
"""


@pytest.mark.slow
def test_a_load_that_nothing_carries_is_named(tmp_path):
    """A socket without friction, pulled off the limb."""
    with pytest.raises(RunError, match=r"the load 'pull' could not be carried .*socket\.friction"):
        fit_socket(load_study(small_limb(tmp_path, PULL)))


@pytest.mark.slow
def test_simulated_draws_widen_the_intervals_and_are_kept(folder, tmp_path, capsys):
    """With a covariance of the muscle's c and m; more draws later simulate only those."""
    for file in ("study.toml", "skin.stl", "tibia.stl"):
        shutil.copy(folder / file, tmp_path)
    study, covariance, said = load_study(tmp_path), np.zeros((8, 8)), []
    covariance[4:6, 4:6] = [[0.04, -0.02], [-0.02, 0.04]]
    known = {"parameters": to_parameters(TISSUES, study.tissues), "parameters_from": "identified"}

    def run(samples: int) -> dict:
        said.clear()
        return run_experiment(
            study,
            "socket",
            listener=said.append,
            covariance_log=covariance.tolist(),
            samples=samples,
            **known,
        )

    plain, two, three = run(0), run(2), run(3)
    assert plain["samples"] is None
    assert two["samples"] == {"simulated": 2, "failed": []}
    assert not [line for line in said if "draw 1: " in str(line) or "draw 2: " in str(line)]
    assert [line for line in said if "draw 3: " in str(line)]
    for one, other in zip(plain["loads"][0]["regions"], three["loads"][0]["regions"], strict=True):
        assert one["mean_kPa"] == pytest.approx(other["mean_kPa"], rel=1e-3)
        narrow, wide = np.diff(one["interval_kPa"])[0], np.diff(other["interval_kPa"])[0]
        missed = 2 * NORMAL_95 * other["missed_kPa"][1]
        assert wide == pytest.approx(np.hypot(narrow, missed), rel=1e-2)
        assert missed > 0.0
        assert "friction" not in one["change_kPa"]
        assert 0.0 < abs(other["change_kPa"]["friction"]) < 0.1 * other["mean_kPa"]
    assert three["loads"][0]["settling_change_mm"]["friction"] < 0.0  # more friction holds the limb
    show_socket(load_results(study).socket)
    assert "95 %: by derivatives and 3 simulated draws" in capsys.readouterr().out
    assert "by derivatives and 3 simulated draws" in Path(report_study(study)["report"]).read_text()


def test_samples_of_tissues_that_were_not_identified_are_refused(folder):
    with pytest.raises(InputError, match=r"--samples: there is nothing to draw 2 samples from"):
        fit_socket(load_study(folder), samples=2)


@pytest.mark.slow
def test_slopes_of_pressure_and_settling_are_central_differences(folder):
    """With respect to the muscle's and the skin's stiffness: what the intervals are made of.

    Within 2 %, or what 1 % of the value itself is.  What the load takes over from the donned socket depends
    on them too.
    """
    study, anatomy = load_study(folder), limb()
    socket = build_socket(study, anatomy, anatomy.skin)
    settings = MeshSettings(edge_near_mm=14.0, edge_far_mm=24.0, growth=0.6, layers=(LayerSpec("skin", 3.0),))
    mesh, _ = mesh_limb(anatomy, settings, 10.0)
    up = np.array([0.0, 0.0, 1.0])
    load = Load("stance", 60.0 * up, np.zeros(3), anatomy.cut_point, 1.0, 0.0)
    fit = SocketFit(anatomy.cut_point, up, np.array([0.0, -1.0, 0.0]), 0.3, 1.0, 0.0, loads=(load,))
    tissues = {"skin": OgdenQLV(0.009, 6.0, 2.0, 0.5), "muscle": OgdenQLV(0.004, 4.0, 3.0, 0.3)}
    problem = build_socket_problem(mesh, tissues, socket, fit)
    middles = mesh.points[mesh.face_sets["skin"][:, :3]].mean(axis=1)
    regions = {"front": middles[:, 1] < anatomy.cut_point[1] - 20.0}
    names = [f"{region}.{name}" for region, name in problem.parameter_names]
    laws = Laws.build([tissues[name] for name in mesh.region_names])
    steps = build_socket_steps(fit, laws.modulus)
    whole = simulate_donning(problem, fit, regions, sensitivities=True, steps=steps)
    centre = whole.held
    for tissue in ("muscle", "skin"):
        ways = []
        for sign in (1.0, -1.0):
            other = replace(tissues[tissue], c=tissues[tissue].c * np.exp(sign * 0.01))
            moved = problem.with_materials({**tissues, tissue: other})
            ways.append(simulate_donning(moved, fit, regions, steps=steps).held)
        for name in ("donning", "stance"):
            ahead, back = (way[name].row for way in ways)
            slope = centre[name].slopes["front"][names.index(f"{tissue}.c")]
            difference = (ahead.regions["front"].mean_kPa - back.regions["front"].mean_kPa) / 0.02
            one_percent = 0.01 * centre[name].row.regions["front"].mean_kPa
            assert slope == pytest.approx(difference, rel=0.02, abs=one_percent)
        slope = centre["stance"].slopes["settling"][names.index(f"{tissue}.c")]
        difference = (ways[0]["stance"].row.move[2] - ways[1]["stance"].row.move[2]) / 0.02
        assert slope == pytest.approx(difference, rel=0.02, abs=0.01 * centre["stance"].row.move[2])
