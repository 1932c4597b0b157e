"""People are simulated: rows of a trial, in processes and on Dask, and after kills."""

import os
import signal
import subprocess
import sys
import time

import pandas as pd
import psutil
import pytest

import limbfit
from limbfit.execution import Placement, place_jobs
from limbfit.population.running import COLUMNS

QUIET = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
# As coarse as sockets go: what is tested is the bookkeeping.
TRIAL = """
[population]
people = 2
[shapes]
phantom = "transfemoral"
[liner]
thickness_mm = 0.0
[[rules]]
name = "tight"
[[limits]]
kPa = 5.0
[person.socket]
edge_mm = 30.0
face_edge_mm = 8.0
hold_s = 0.0
friction = "frictionless"
distal = "bearing"
[[person.socket.loads]]
name = "stance"
force_N = [0.0, 0.0, 60.0]
hold_s = 0.0
"""


def make(folder, text=TRIAL):
    folder.mkdir()
    (folder / "population.toml").write_text(text)
    return folder


def read(folder):
    table = pd.read_parquet(folder / "results" / "people.parquet")
    table = table[table["quantity"] != "seconds"]
    return table.sort_values(list(COLUMNS[:-1]), ignore_index=True)


@pytest.mark.slow
def test_a_person_wears_a_socket_and_can_be_opened(tmp_path):
    folder = make(tmp_path / "trial")
    with place_jobs(Placement(workers=1)):
        found = limbfit.run_population(folder, people=1)
    assert found["people"] == 1
    table = read(folder)
    assert set(table["load"]) == {"", "donning", "stance"}
    peak = table[(table["load"] == "stance") & (table["quantity"] == "peak_kPa")]
    assert (peak["value"] >= 0.0).all()
    # What is stored is what the ordinary command found, and it is not done again.
    opened = limbfit.open_person(folder, 1)
    stored = limbfit.load_results(opened["studies"]["tight"]).socket
    whole = peak[peak["place"] == "the limb"]["value"].item()
    assert whole == stored.loads[0].peak_kPa
    assert stored.parameters["muscle"]["c_kPa"] == opened["inputs"]["muscle.c_kPa"]
    before = {file: file.stat().st_mtime_ns for file in (folder / "results" / "people.parquet").iterdir()}
    limbfit.run_population(folder, people=1)
    assert {file: file.stat().st_mtime_ns for file in before} == before


@pytest.mark.slow
def test_a_run_that_is_killed_twice_ends_with_the_same_table(tmp_path):
    plain, killed = make(tmp_path / "plain"), make(tmp_path / "killed")
    limbfit.run_population(plain, people=3)
    command = [sys.executable, "-m", "limbfit", "population", "run", str(killed), "--people", "3"]
    for whom in ("parent", "workers"):
        run = subprocess.Popen(
            [*command, "--workers", "2"], stderr=subprocess.DEVNULL, stdout=subprocess.DEVNULL
        )
        time.sleep(25.0)
        children = psutil.Process(run.pid).children(recursive=True)
        if whom == "parent":
            os.kill(run.pid, signal.SIGKILL)
        for child in children if whom == "workers" else ():
            if "spawn_main" in " ".join(child.cmdline()):
                child.kill()
        run.wait()
    subprocess.run(command, check=True, **QUIET)
    pd.testing.assert_frame_equal(read(plain), read(killed))


@pytest.mark.slow
def test_dask_gives_the_same_table(tmp_path):
    plain, other = make(tmp_path / "plain"), make(tmp_path / "dask")
    limbfit.run_population(plain, people=2)
    with place_jobs(Placement(workers=2, dask="local")):
        limbfit.run_population(other, people=2)
    pd.testing.assert_frame_equal(read(plain), read(other))


@pytest.mark.slow
def test_a_rule_is_made_robust_and_checked_on_fresh_people(tmp_path):
    tight = TRIAL.replace('name = "tight"', 'name = "tight"\nsocket = { reduction_percent = 5.0 }')
    folder = make(tmp_path / "trial", tight + "[robust]\nranges = { reduction_percent = [0.0, 5.0] }\n")
    found = limbfit.make_robust(folder, people=12, fresh=2)["robust"]
    # A looser socket presses less, and the limb's end bears.
    assert found["keys"]["reduction_percent"] < 2.0
    assert found["interval_kPa"][1] < 0.0
    assert found["checked_p90_kPa"] < found["beside_p90_kPa"]
    assert found["checked_people"] == 2


@pytest.mark.slow
def test_a_rule_that_fits_no_limb_is_refused_in_one_line(tmp_path):
    area = '[rules.socket]\nareas = [{ name = "a", region = "shin", radius_mm = 20.0, depth_mm = 3.0 }]\n'
    folder = make(tmp_path / "trial", TRIAL.replace("[[limits]]\n", area + "[[limits]]\n"))
    with pytest.raises(limbfit.InputError, match="no region is named 'shin'"):
        limbfit.check_trial(folder)


@pytest.mark.slow  # it waits for the scheduler for 20 s
def test_a_scheduler_that_is_not_there_costs_nothing(tmp_path):
    folder = make(tmp_path / "trial")
    nowhere = Placement(scheduler="tcp://127.0.0.1:9")
    with place_jobs(nowhere), pytest.raises(limbfit.InputError, match=r"127\.0\.0\.1:9"):
        limbfit.run_population(folder)
    assert limbfit.count_people(folder)["people"] == 0
