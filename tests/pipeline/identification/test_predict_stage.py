"""Predictions whose coarse or fine simulation fails, is lost or is doubtful: real solving of two blocks."""

import json
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import pytest
import pyvista as pv

from completing import complete
from layered import blocks_study, layered_block, store_blocks
from limbfit.execution import SerialExecutor
from limbfit.indentation import Simulation, SimulationJob, SiteModel, simulate, to_parameters, to_vector
from limbfit.indentation import simulating as indentation
from limbfit.mesh import write_vtu
from limbfit.pipeline.engine.context import Context, ignore_progress
from limbfit.pipeline.engine.store import COARSE, Store, write_json
from limbfit.pipeline.identification.predict import run_predict
from limbfit.pipeline.simulation.simulations import compute_job_digest
from limbfit.results.base import read_curves
from limbfit.results.identification import CalibrationResult
from limbfit.study import Study

TISSUES = ("skin", "muscle")
TRUTH = {
    "skin": {"c_kPa": 9.0, "m": 6.0, "gamma": 2.0, "tau_s": 0.6},
    "muscle": {"c_kPa": 4.5, "m": 4.5, "gamma": 3.0, "tau_s": 0.3},
}
BEST = to_vector(TRUTH, TISSUES)
ONE = np.tile([6.0, 5.0, 2.5, 0.4], 2)
# thickness of skin and muscle, depth, whether fitted
BLOCKS = {"near": ((3.0, 9.0), 2.5, True), "aside": ((3.0, 13.0), 3.5, False)}
TEXT = """
[study]
name = "two blocks"
[surfaces]
skin = "skin.stl"
[indenter]
edge_radius_mm = 2.0
[solver]
load_steps = 3
unload_steps = 2
penalty_per_mm = 100.0
[mesh.coarse]
edge_near_mm = 6.0
"""
LIMIT = "went over its limits twice"
Choice = Callable[[SimulationJob], bool]


def nothing(job: SimulationJob) -> bool:
    return False


class Losing(SerialExecutor):
    """Loses the simulations that are chosen, as a worker that goes over its limits does; knows the others.

    ``known``: what was simulated before, by digest of its job; a chosen job is not looked up.
    """

    def __init__(self, known: dict[str, Simulation], lost: Choice, anew: Choice = nothing) -> None:
        self.known, self.lost, self.anew = known, lost, anew

    def map(self, function, jobs, keys=None, on_lost=None) -> Iterator:
        for job in jobs:
            if function is not simulate:
                yield function(job)
            elif self.lost(job):
                yield on_lost(job, LIMIT)
            elif self.anew(job):
                yield simulate(job)
            else:
                digest = compute_job_digest(job)
                if digest not in self.known:
                    self.known[digest] = simulate(job)
                yield self.known[digest]


def of(site: str, coarse: bool = False, one: bool = False) -> Choice:
    """The simulations of a site on one of its meshes, with all materials or with one."""

    def chosen(job: SimulationJob) -> bool:
        same_mesh = (job.model.mesh.parent.name == COARSE) == coarse
        return job.model.name == site and same_mesh and (job.parameters == tuple(ONE)) == one

    return chosen


@dataclass(frozen=True)
class Blocks:
    """A study that can be predicted again and again; what is simulated undisturbed is not done twice."""

    study: Study
    store: Store
    known: dict[str, Simulation] = field(default_factory=dict)

    def predicted(self, folder: Path, lost: Choice = nothing, anew: Choice = nothing) -> dict[str, dict]:
        """The stage's rows by site; some simulations lost, some done anew."""
        folder.mkdir()
        executor = Losing(self.known, lost, anew)
        run_predict(Context(self.study, self.store, executor, ignore_progress), folder)
        return {row["site"]: row for row in json.loads((folder / "predict.json").read_text())["sites"]}


@pytest.fixture(scope="module")
def blocks(tmp_path_factory) -> Blocks:
    """Two blocks identified at the truth, with two materials and with one."""
    fitted = {name: fitted for name, (_, _, fitted) in BLOCKS.items()}
    study = blocks_study(tmp_path_factory.mktemp("blocks"), TEXT, fitted)
    store = store_blocks(study, BLOCKS, TRUTH, 4, coarse=3)
    store["calibrate"].mkdir()
    write_json(store["calibrate"] / "calibration.json", complete(CalibrationResult, calibration()))
    return Blocks(study, store)


def calibration() -> dict:
    """What the stage ``calibrate`` would have stored."""
    stages = [
        {"parameters": to_parameters(vector, TISSUES), "iterations": [{"starts": []}]}
        for vector in (ONE, BEST)
    ]
    residuals = {
        "sites": {"near": {"compared_noise_sd_N": 0.01, "misfit_share": 0.002}},
        "misfit_elsewhere": 0.002,
        "known_scale": 50.0,
    }
    known = {"covariance_log": np.diag(np.full(8, 0.02**2)).tolist(), "residuals": residuals}
    known["most_probable"] = to_parameters(BEST, TISSUES)
    return {"stages": stages, "uncertainty": known}


@pytest.fixture(scope="module")
def whole(blocks, tmp_path_factory) -> tuple[dict[str, dict], Path]:
    """The prediction of which nothing fails."""
    folder = tmp_path_factory.mktemp("whole") / "predict"
    return blocks.predicted(folder), folder


def columns(folder: Path, site: str) -> dict[str, np.ndarray]:
    found = read_curves(folder / f"{site}.csv")
    assert all(np.all(np.isfinite(values)) for values in found.values())
    return found


@pytest.mark.slow
def test_nothing_is_missing_where_nothing_fails(whole):
    rows, folder = whole
    for name, row in rows.items():
        assert row["not_predicted"] == {}
        assert row["warnings"] == []
        assert None not in (row["error_percent"], row["error_one_material_percent"])
        curves = columns(folder, name)
        assert np.mean(curves["force_high_N"] - curves["force_low_N"]) > 0.02
        assert (folder / f"{name}.vtu").is_file()


@pytest.mark.slow
def test_a_held_out_site_is_compared_with_what_the_fitted_record_did(whole):
    """One that is pressed in for longer; strain by tissue, near the indenter at its deepest point."""
    rows, folder = whole
    known = {name: {(r["quantity"], r["tissue"]): r for r in row["loading"]} for name, row in rows.items()}
    for name in BLOCKS:
        sheared = compute_rare_shear(folder / f"{name}.vtu", region=1)
        assert known[name]["shear strain", "muscle"]["high"] == pytest.approx(sheared, rel=0.02)
    assert rows["near"]["outside_records"] == []
    outside = {(r["quantity"], r["tissue"]): r for r in rows["aside"]["outside_records"]}
    assert set(outside) == {
        *(("shear strain", "muscle"), ("compressive strain", "muscle"), ("depth over thickness", None))
    }
    for key, row in outside.items():
        assert row["records"][1] == known["near"][key]["high"]
        assert row["prediction"][1] == known["aside"][key]["high"] > 1.1 * row["records"][1]
    assert 0.01 < outside["shear strain", "muscle"]["share"] < 0.1
    (text,) = json.loads((folder / "predict.json").read_text())["outside_text"]
    assert text.startswith("site aside goes beyond the records: depth over thickness 0.11 (records: 0.078)")


def compute_rare_shear(file: Path, region: int) -> float:
    """What 1 % of a tissue's volume within 20 mm of the pressed skin exceeds, from the stored fields."""
    grid = pv.read(file)
    pressed = grid.points[grid["contact_pressure_kPa"] > 0]
    middles = grid.points[grid.cells_dict[24][:, :4]].mean(axis=1)
    far = np.linalg.norm(middles[:, None] - pressed, axis=2).min(axis=1)
    cells = np.flatnonzero((grid["region"] == region) & (far <= 20.0))
    shear = (grid["largest_stretch"][cells] ** 2 - grid["smallest_stretch"][cells] ** 2) / 4
    volume = grid.compute_cell_sizes()["Volume"][cells]
    order = np.argsort(shear)[::-1]
    return float(shear[order][np.searchsorted(np.cumsum(volume[order]), 0.01 * volume.sum())])


@pytest.mark.slow
def test_a_lost_coarse_simulation_takes_the_interval_with_it(blocks, whole, tmp_path):
    """Its scale was 0/0."""
    rows = blocks.predicted(tmp_path / "p", lost=of("aside", coarse=True))
    check_without_interval(rows, whole, tmp_path / "p", "aside", f"in the search: {LIMIT}")
    assert rows["near"] == whole[0]["near"]


@pytest.mark.slow
def test_a_coarse_simulation_that_the_solver_gives_up_takes_the_interval_with_it(
    blocks, whole, tmp_path, monkeypatch
):
    """Its scale came from the force up to where it ended, held from there on."""
    steps_of, chosen = indentation.build_steps, of("aside", coarse=True)

    def few_iterations(model: SiteModel):
        control = steps_of(model)
        coarse = model.name == "aside" and model.mesh.parent.name == COARSE
        return replace(control, most_iterations=8) if coarse else control

    monkeypatch.setattr(indentation, "build_steps", few_iterations)
    indentation._prepared.clear()
    rows = blocks.predicted(tmp_path / "p", anew=chosen)
    indentation._prepared.clear()
    check_without_interval(rows, whole, tmp_path / "p", "aside", "in the search: ")


def check_without_interval(rows, whole, folder: Path, site: str, reason: str) -> None:
    """The site's own mesh gives the force as before; what the coarse one would have added is not there."""
    before, row = whole[0][site], rows[site]
    assert row["error_percent"] == before["error_percent"]
    assert row["completed"]
    assert row["error_one_material_percent"] is None
    assert set(row["not_predicted"]) == {"interval", "one_material"}
    assert all(text.startswith(reason) for text in row["not_predicted"].values())
    assert sum(reason in text for text in row["warnings"]) == 2
    assert set(columns(folder, site)) == {
        *("time_s", "displacement_mm", "force_measured_N", "force_simulated_N")
    }


@pytest.mark.slow
def test_a_lost_simulation_of_a_held_out_site_gives_no_force(blocks, whole, tmp_path):
    rows = blocks.predicted(tmp_path / "p", lost=of("aside"))
    row = rows["aside"]
    assert not row["completed"]
    assert (row["error_percent"], row["error_one_material_percent"]) == (None, None)
    assert row["not_predicted"]["force"] == LIMIT
    assert set(columns(tmp_path / "p", "aside")) == {"time_s", "displacement_mm", "force_measured_N"}
    assert not (tmp_path / "p" / "aside.vtu").is_file()
    content = json.loads((tmp_path / "p" / "predict.json").read_text())
    assert content["mean_error_heldout_percent"] is None
    assert rows["near"] == whole[0]["near"]


@pytest.mark.slow
@pytest.mark.parametrize(("site", "mesh"), [("near", ""), ("aside", "in the search: ")])
def test_a_lost_simulation_with_one_material_leaves_the_rest(blocks, whole, tmp_path, site, mesh):
    """At fitted sites it is the site's own mesh's, at others the coarse one's."""
    rows = blocks.predicted(tmp_path / "p", lost=of(site, coarse=bool(mesh), one=True))
    row, before = rows[site], whole[0][site]
    assert row["not_predicted"] == {"one_material": f"{mesh}{LIMIT}"}
    assert row["error_one_material_percent"] is None
    assert row["error_percent"] == before["error_percent"]
    assert set(columns(tmp_path / "p", site)) == set(columns(whole[1], site)) - {"force_one_material_N"}


@pytest.mark.slow
def test_folded_elements_of_a_coarse_mesh_are_told(blocks, whole, tmp_path):
    """A thin block on a sharp punch folds its elements; the force of the site's own mesh is not doubtful."""
    file = blocks.store["mesh"] / COARSE / "aside.vtu"
    content = file.read_bytes()
    write_vtu(layered_block((3.0, 1.5), TISSUES, divisions=4), file)
    try:
        rows = blocks.predicted(tmp_path / "p")
    finally:
        file.write_bytes(content)
    assert any("in the search" in text and "inside out" in text for text in rows["aside"]["warnings"])
    assert rows["near"]["warnings"] == []
