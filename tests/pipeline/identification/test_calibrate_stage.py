"""The identification of a study of blocks by the real solver: two meshes, failures, interruptions."""

import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from layered import blocks_study, store_blocks
from limbfit.errors import StudyError
from limbfit.execution import Limits, SerialExecutor, make_executor
from limbfit.indentation import to_vector
from limbfit.pipeline.engine.context import Context, ignore_progress
from limbfit.pipeline.engine.store import Store
from limbfit.pipeline.identification.calibrate import run_calibrate
from limbfit.pipeline.identification.predict import run_predict
from limbfit.pipeline.identification.search import build_groupings, build_problem
from limbfit.priors import SOURCE
from limbfit.study import Study

TISSUES = ("skin", "muscle")
TRUTH = {
    "skin": {"c_kPa": 9.0, "m": 6.0, "gamma": 2.0, "tau_s": 0.6},
    "muscle": {"c_kPa": 4.5, "m": 4.5, "gamma": 3.0, "tau_s": 2.0},
}
# thickness of skin and muscle, depth, whether fitted
BLOCKS = {
    "a": ((3.0, 5.0), 2.2, True),
    "b": ((3.0, 21.0), 6.0, True),
    "c": ((3.0, 11.0), 4.0, False),
}
TEXT = """
[study]
name = "blocks"
[surfaces]
skin = "skin.stl"
[indenter]
edge_radius_mm = 2.0
[solver]
load_steps = 4
unload_steps = 3
penalty_per_mm = 100.0
"""
COARSE_MESHES = "[mesh.coarse]\nedge_near_mm = 6.0\n"


def write_study(folder: Path, more: str = COARSE_MESHES) -> Study:
    """Blocks as sites of a study."""
    return blocks_study(folder, TEXT + more, {name: fitted for name, (_, _, fitted) in BLOCKS.items()})


class Disturbed(SerialExecutor):
    """Fails simulations at random, or is interrupted after some."""

    def __init__(self, failing: float = 0.0, seed: int = 0, until: int = 10**6) -> None:
        self.failing, self.random, self.left, self.done = failing, np.random.default_rng(seed), until, 0

    def map(self, function, jobs, keys=None, on_lost=None) -> Iterator:
        for answer in super().map(function, jobs, keys):
            if self.left == 0:
                raise KeyboardInterrupt
            self.left -= 1
            self.done += 1
            failed = isinstance(answer, object) and self.random.random() < self.failing
            yield replace(answer, completed=False, reason="made to fail") if failed else answer


def calibrated(study: Study, store: Store, executor=None) -> dict:
    store["calibrate"].mkdir(exist_ok=True)
    run_calibrate(Context(study, store, executor or SerialExecutor(), ignore_progress), store["calibrate"])
    return store.results.calibration.to_plain()


def vector(found: dict) -> np.ndarray:
    return to_vector(found["stages"][-1]["parameters"], TISSUES)


@pytest.fixture(scope="module")
def blocks(tmp_path_factory):
    """A study of blocks, calibrated on two meshes."""
    study = write_study(tmp_path_factory.mktemp("blocks"))
    store = store_blocks(study, BLOCKS, TRUTH, 6, coarse=5)
    return study, store, calibrated(study, store)


def moved(study: Study, store: Store, folder: Path) -> Store:
    """The stored inputs of the calibration in another results folder, nothing simulated yet."""
    folder.mkdir()
    other = Store(folder)
    for stage in ("surfaces", "sites", "traces", "mesh"):
        other[stage].symlink_to(store[stage], target_is_directory=True)
    return other


@pytest.mark.slow
def test_two_meshes_give_the_fine_one_s_answer_with_the_coarse_one_s_derivatives(blocks):
    found = blocks[2]
    assert all(stage["converged"] for stage in found["stages"]), found["stages"]
    first, last = found["corrections"][0], found["corrections"][-1]
    assert max(first["difference_percent_by_site"].values()) > 2.0
    assert max(last["change_percent_by_site"].values()) <= 0.1
    assert found["stages"][-1]["parameters"]["muscle"]["c_kPa"] == pytest.approx(4.5, rel=0.15)
    plain = found["forward_runs"] - found["forward_runs_with_sensitivities"]
    corrected = {json.dumps(one["parameters"]) for one in found["corrections"]}
    assert plain == 2 * len(corrected) + 2  # two sites; once more on the other meshes, for their error
    assert found["forward_runs_with_sensitivities"] <= 40


@pytest.mark.slow
def test_held_out_sites_are_predicted_on_the_fine_mesh(blocks):
    study, store, _ = blocks
    store["predict"].mkdir(exist_ok=True)
    run_predict(Context(study, store, SerialExecutor(), ignore_progress), store["predict"])
    predicted = store.results.predict.to_plain()
    assert predicted["mean_error_fitted_percent"] < 1.0
    assert predicted["mean_error_heldout_percent"] < 1.5
    assert all(row["error_one_material_percent"] > row["error_percent"] for row in predicted["sites"])


@pytest.mark.slow
def test_one_simulation_in_ten_made_to_fail_ends_at_the_same_answer(blocks, tmp_path):
    study, store, found = blocks
    again = calibrated(study, moved(study, store, tmp_path / "r"), Disturbed(0.1, seed=1))
    assert all(stage["converged"] for stage in again["stages"]), again["stages"]
    for one, other in zip(found["stages"], again["stages"], strict=True):
        assert other["cost"] == pytest.approx(one["cost"], rel=0.02)
    assert vector(again)[[4, 6]] == pytest.approx(vector(found)[[4, 6]], rel=0.05)


@pytest.mark.slow
def test_an_interrupted_calibration_goes_on_where_it_was(blocks, tmp_path):
    study, store, found = blocks
    other = moved(study, store, tmp_path / "r")
    done = []
    for until in (3, 7, 10**6):
        executor = Disturbed(until=until)
        try:
            again = calibrated(study, other, executor)
        except KeyboardInterrupt:
            assert until < 10**6
        done.append(executor.done)
    assert sum(done) == found["forward_runs"]
    assert vector(again) == pytest.approx(vector(found), rel=1e-3)
    assert again["corrections"][0]["scale_by_site"] == pytest.approx(
        found["corrections"][0]["scale_by_site"], rel=1e-4
    )


@pytest.mark.slow
def test_several_starts_constraints_and_weights_of_a_study(blocks, tmp_path):
    _, store, _ = blocks
    more = (
        "[calibration]\nsearch_radius_mm = 0\nstarts = 3\nseed = 2\n"
        "fixed = ['skin.m']\ntied = [['skin.tau_s', 'muscle.tau_s']]\n"
        "[calibration.prior.'skin.c_kPa']\nmedian = 9.0\nfactor = 1.3\n"
    )
    study = write_study(tmp_path, more)
    for name in BLOCKS:
        (tmp_path / f"{name}.csv").write_bytes((store.folder.parent / f"{name}.csv").read_bytes())
    found = calibrated(study, moved(study, store, tmp_path / "r"))
    assert found["corrections"] == []
    told = found["multistart"]
    assert told["reached"] >= 2, told
    assert len(told["starts"]) == 3
    values = found["stages"][-1]["parameters"]
    assert values["skin"]["m"] == 3.0
    assert values["skin"]["tau_s"] == values["muscle"]["tau_s"]
    assert values["skin"]["c_kPa"] == pytest.approx(9.0, rel=0.4)


@pytest.mark.slow
def test_priors_of_people_count_and_are_stored_with_their_shares(blocks, tmp_path):
    """By processes as in this one: priors act where simulations are asked for, not where they are made."""
    _, store, plain = blocks
    study = write_study(tmp_path, COARSE_MESHES + '[calibration]\npriors = "population"\n')
    for name in BLOCKS:
        (tmp_path / f"{name}.csv").write_bytes((store.folder.parent / f"{name}.csv").read_bytes())
    with make_executor(2, Limits()) as executor:
        found = calibrated(study, moved(study, store, tmp_path / "r"), executor)
    assert plain["uncertainty"]["priors"] is None
    told = found["uncertainty"]["priors"]
    assert set(told["stated"]) == {"skin.c_kPa", "skin.m", "muscle.c_kPa", "muscle.m"}
    assert {one["source"] for one in told["stated"].values()} == {SOURCE}
    assert all(0 <= share < 1 for share in told["share"].values())
    assert all(wider >= 1 for wider in told["wider_without"].values())
    for name, verdict in plain["uncertainty"]["verdict"].items():
        if verdict == "determined":
            tissue, key = name.split(".")
            low, high = found["uncertainty"]["intervals_95"][tissue][key]
            assert low < plain["stages"][-1]["parameters"][tissue][key] < high
            assert told["share"][name] < 0.2


def test_groups_of_a_study(tmp_path):
    study = write_study(
        tmp_path, "[calibration]\nfixed = ['skin.m']\ntied = [['skin.c_kPa', 'muscle.c_kPa']]\n"
    )
    assert build_groupings(study) == ((0, -1, 2, 3, 0, 5, 2, 3), (0, -1, 2, 3, 0, 5, 6, 7))
    ties = ", ".join(f"['skin.{name}', 'muscle.{name}']" for name in ("c_kPa", "m", "gamma", "tau_s"))
    study = write_study(tmp_path, f"[calibration]\ntied = [{ties}]\n")
    assert build_groupings(study) == ((0, 1, 2, 3) * 2,)
    assert build_problem(study).titles == ("one material",)


@pytest.mark.parametrize("known", ["skin", "muscle"])
def test_a_study_that_fixes_a_whole_tissue_has_one_stage_which_is_not_called_one_material(tmp_path, known):
    fixed = [f"{known}.{name}" for name in ("c_kPa", "m", "gamma", "tau_s")]
    problem = build_problem(write_study(tmp_path, f"[calibration]\nfixed = {fixed}\n"))
    assert [sum(number >= 0 for number in stage) for stage in problem.stages] == [4]
    assert problem.titles == ("two materials",)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("fixed = ['fat.m']", "no parameter is named 'fat.m'"),
        ("tied = [['skin.m', 'muscle.gamma']]", "two or more parameters of one kind"),
        ("tied = [['skin.m', 'muscle.m']]\nfixed = ['skin.m']", "skin.m is tied twice, or fixed too"),
        ("objective = 'paper'\nprior = { 'skin.m' = { median = 3.0, factor = 2.0 } }", "no place for priors"),
        ("prior = { 'skin.m' = { median = 3.0, factor = 1.0 } }", "factor"),
        ("starts = 0", "starts"),
        ("use_socket_pressures = true", "no pressure was measured in the socket; give .*socket.measured"),
        ("use_socket_pressures = true\nobjective = 'paper'", "leave objective and stopping out"),
        ("use_socket_pressures = true\nanswer = 'least squares'", "leave answer out"),
    ],
)
def test_impossible_settings_are_bad_input(tmp_path, text, words):
    with pytest.raises(StudyError, match=words):
        write_study(tmp_path, f"[calibration]\n{text}\n")
