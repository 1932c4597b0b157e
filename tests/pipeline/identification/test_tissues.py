"""Tissues named by the study: vectors, overrides, what makes results stale, and three of them identified."""

from pathlib import Path

import numpy as np
import pytest

from layered import TISSUES, TRUTH, blocks_study, build_block_site, layered_block, store_blocks
from limbfit.cli.commands import parse_parameters
from limbfit.errors import InputError, StudyError
from limbfit.execution import SerialExecutor
from limbfit.identify.fit.parameters import Unknowns, build_stage_groupings, group_by_kind, group_separately
from limbfit.indentation import SimulationJob, list_flat_names, simulate, to_parameters, to_vector
from limbfit.mesh import read_vtu
from limbfit.pipeline.commands.run import compute_keys
from limbfit.pipeline.engine.context import Context, ignore_progress
from limbfit.pipeline.identification.calibrate import run_calibrate
from limbfit.pipeline.identification.predict import run_predict
from limbfit.pipeline.identification.search import build_unknowns
from limbfit.report import build_report
from limbfit.study import SolverTable, Study, load_study

LAYERS = """
[geometry]
layers = [{ name = "skin", thickness_mm = 1.5 }, { name = "fat", thickness_mm = 6.0 }]
"""
TEXT = """
[study]
name = "layers"
[surfaces]
skin = "skin.stl"
[solver]
load_steps = 5
unload_steps = 4
"""
STEPS = SolverTable(load_steps=5, unload_steps=4)


def write_study(folder: Path, more: str = "", sites: tuple[tuple[str, bool], ...] = (("1", True),)) -> Study:
    return blocks_study(folder, TEXT + more, dict(sites))


def test_flat_vectors_go_by_tissue_then_parameter():
    vector = to_vector(TRUTH, TISSUES)
    assert vector.tolist() == [12.0, 6.0, 2.0, 0.6, 2.0, 4.0, 1.0, 1.2, 5.0, 5.0, 3.0, 0.3]
    assert to_parameters(vector, TISSUES) == TRUTH
    assert list(to_parameters(vector, TISSUES[::-1])) == ["muscle", "fat", "skin"]
    assert to_vector(TRUTH, ("muscle", "skin")).tolist() == [5.0, 5.0, 3.0, 0.3, 12.0, 6.0, 2.0, 0.6]


def test_stages_share_by_parameter_and_a_single_tissue_has_one():
    names = tuple(f"{tissue}.{name}" for tissue, name in list_flat_names(TISSUES))
    assert group_by_kind(names) == (0, 1, 2, 3) * 3
    assert group_separately(names) == tuple(range(12))
    assert build_stage_groupings(names) == (group_by_kind(names), group_separately(names))
    assert build_stage_groupings(names[:4]) == ((0, 1, 2, 3),)


def test_forces_and_sensitivities_of_three_tissues_equal_central_differences(tmp_path):
    mesh = layered_block((1.5, 6.0, 16.0), divisions=2)
    few = SolverTable(load_steps=3, unload_steps=2)
    model = build_block_site("1", tmp_path / "1.vtu", mesh, 4.0, few)
    times = tuple(np.linspace(0.0, model.knots_s[-1], 15))
    truth = to_vector(TRUTH, TISSUES)

    def force(vector):
        found = simulate(SimulationJob(model, TISSUES, tuple(vector), times, sensitivities=False))
        assert found.completed
        return found.force_N

    jacobian = simulate(SimulationJob(model, TISSUES, tuple(truth), times)).jacobian
    assert jacobian is not None
    assert jacobian.shape == (15, 12)
    for j, value in enumerate(truth):
        moved = 0.02 * value * np.eye(12)[j]
        difference = (force(truth + moved) - force(truth - moved)) / (0.04 * value)
        assert np.abs(difference).max() > 1e-4
        assert np.abs(jacobian[:, j] - difference).max() < 0.01 * np.abs(difference).max(), j


def test_a_tissue_that_does_not_reach_the_site_has_no_influence(tmp_path):
    mesh = layered_block((1.5, 22.0), tissues=("skin", "muscle"), divisions=2)
    model = build_block_site("thin", tmp_path / "thin.vtu", mesh, 3.0, STEPS)
    times = tuple(np.linspace(0.0, model.knots_s[-1], 9))
    three = simulate(SimulationJob(model, TISSUES, tuple(to_vector(TRUTH, TISSUES)), times))
    pair = ("skin", "muscle")
    two = simulate(SimulationJob(model, pair, tuple(to_vector(TRUTH, pair)), times))
    assert three.force_N == pytest.approx(two.force_N, rel=1e-4, abs=1e-6)
    assert np.all(three.jacobian[:, 4:8] == 0.0)
    assert three.jacobian[:, 8:] == pytest.approx(two.jacobian[:, 4:], rel=1e-3, abs=1e-6)


def test_overrides_reach_the_tissue_that_they_name(tmp_path):
    more = "[material.tissues.fat]\nstart = { c_kPa = 2.0 }\nupper = { c_kPa = 10.0, tau_s = 5.0 }\n"
    found = build_unknowns(write_study(tmp_path, LAYERS + more))
    assert isinstance(found, Unknowns)
    assert found.names[4:8] == ("fat.c_kPa", "fat.m", "fat.gamma", "fat.tau_s")
    assert found.start.tolist() == [4.7, 3.0, 1.2, 2.0, 2.0, 3.0, 1.2, 2.0, 4.7, 3.0, 1.2, 2.0]
    assert found.upper.tolist() == [47.0, 20.0, 10.0, 10.0, 10.0, 20.0, 10.0, 5.0, 47.0, 20.0, 10.0, 10.0]
    assert found.lower.tolist() == [0.047, 2.0, 0.01, 0.01] * 3


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("tissues.tendon]\nstart = { m = 4.0 }", "no such tissue; its tissues are skin, fat, muscle"),
        ("tissues.fat]\nstart = { c = 4.0 }", r"material\.tissues\.fat\.start"),
        ("tissues.fat]\nstart = { c_kPa = -1.0 }", r"material\.tissues\.fat\.start\.c_kPa: .*greater than 0"),
        ("tissues.fat]\nstart = { c_kPa = 50.0 }", r"tissues\.fat\.start\.c_kPa lies outside its bounds"),
        ("tissues.fat]\nupper = { c_kPa = 1.0 }", r"tissues\.fat\.start\.c_kPa lies outside its bounds"),
        (
            "tissues.fat]\nstart = { m = 2.5 }\nupper = { m = 2.6 }\n[material.tissues.skin]\n"
            "lower = { m = 2.8 }",
            "bounds of m have no range in common",
        ),
    ],
)
def test_overrides_that_cannot_be_are_refused(tmp_path, override, message):
    with pytest.raises(StudyError, match=message) as caught:
        write_study(tmp_path, f"{LAYERS}[material.{override}\n")
    assert "\n" not in str(caught.value)


def stale(before: dict[str, str], study: Study) -> set[str]:
    after = compute_keys(study)
    return {name for name in before if before[name] != after[name]}


MODEL = {"calibrate", "predict", "report"}


def test_what_is_held_out_does_not_make_a_calibration_stale(tmp_path):
    both = (("1", True), ("2", False))
    before = compute_keys(write_study(tmp_path, sites=both))
    (tmp_path / "2.csv").write_text("another record")
    assert stale(before, load_study(tmp_path)) == {"traces", "predict", "report"}
    alone = write_study(tmp_path, sites=both[:1])
    assert compute_keys(alone)["calibrate"] == before["calibrate"]
    fitted = write_study(tmp_path, sites=(("1", True), ("2", True)))
    assert stale(before, fitted) >= MODEL
    (tmp_path / "1.csv").write_text("another record")
    assert stale(before, write_study(tmp_path, sites=both)) == {"traces", *MODEL}


def test_other_tissues_or_another_start_make_a_calibration_stale(tmp_path):
    before = compute_keys(write_study(tmp_path, LAYERS))
    renamed = write_study(tmp_path, LAYERS.replace('"fat"', '"adipose"'))
    assert {"mesh", *MODEL} <= stale(before, renamed)
    started = write_study(tmp_path, LAYERS + "[material.tissues.fat]\nstart = { m = 4.0 }\n")
    assert stale(before, started) == MODEL


def test_places_that_share_markers_decide_together(tmp_path):
    """With hints every site takes a marker from the others; a record still matters to its own site only."""
    (tmp_path / "mri").mkdir()
    both = (("1", True), ("2", False))

    def marked(hint: float) -> Study:
        write_study(tmp_path, sites=both)
        file = tmp_path / "study.toml"
        text = file.read_text().replace(
            '[surfaces]\nskin = "skin.stl"', '[image]\npath = "mri"\nmarkers = "mri"'
        )
        file.write_text(
            text.replace("position = [0.0", "near = [0.0").replace("0.0, 0.0, 0.0", f"0, 0, {hint}")
        )
        return load_study(tmp_path)

    before = compute_keys(marked(0.0))
    (tmp_path / "2.csv").write_text("another record")
    assert "calibrate" not in stale(before, marked(0.0))
    assert "calibrate" in stale(before, marked(1.0))


def test_parameters_of_the_command_line_go_by_the_studys_tissues(tmp_path):
    two, three = write_study(tmp_path), write_study(tmp_path, LAYERS)
    text = "12,6,2,0.6, 2,4,1,1.2, 5,5,3,0.3"
    assert parse_parameters(text, three) == TRUTH
    assert parse_parameters(None, three) is None
    with pytest.raises(InputError, match=r"not 12 numbers; give .* of skin, then of fat, then of muscle"):
        parse_parameters("1,2,3,4,5,6,7,8", three)
    with pytest.raises(InputError, match="not 8 numbers"):
        parse_parameters(text, two)
    with pytest.raises(InputError, match="not 12 numbers"):
        parse_parameters(text.replace("12,", "-12,"), three)


# thickness of skin, fat and muscle, depth, whether fitted
BLOCKS = {
    "a": ((1.5, 2.0, 8.0), 2.5, True),
    "b": ((1.5, 9.0, 6.0), 4.0, True),
    "c": ((1.5, 3.0, 22.0), 6.0, True),
    "d": ((2.5, 14.0, 14.0), 7.0, True),
    "e": ((1.5, 6.0, 14.0), 5.0, False),
}


@pytest.mark.slow
def test_three_tissues_are_identified_from_blocks_and_reported(tmp_path):
    sites = tuple((name, fitted) for name, (_, _, fitted) in BLOCKS.items())
    study = write_study(tmp_path, LAYERS + "[calibration]\nrelative_tolerance = 1e-4\n", sites)
    store = store_blocks(study, BLOCKS, TRUTH, 4)
    context = Context(study, store, SerialExecutor(), ignore_progress)
    for stage, run in (("calibrate", run_calibrate), ("predict", run_predict)):
        store[stage].mkdir()
        run(context, store[stage])
    found = store.results.calibration.to_plain()
    assert [stage["name"] for stage in found["stages"]] == ["one material", "three materials"]
    one, three = (stage["parameters"] for stage in found["stages"])
    assert one["skin"] == one["fat"] == one["muscle"]
    # From one material the search ends with the skin's gamma at its bound, in a worse optimum.
    assert found["stages"][-1]["reason"].endswith("with skin.gamma at a bound, and went on from inside")
    limits = found["uncertainty"]["intervals_95"]
    assert list(three) == list(limits) == list(TISSUES)
    assert len(found["uncertainty"]["correlation"]["matrix"]) == 12
    for tissue in ("fat", "muscle"):
        assert three[tissue]["c_kPa"] == pytest.approx(TRUTH[tissue]["c_kPa"], rel=0.1)
    inside = [low <= TRUTH[t][name] <= high for t in TISSUES for name, (low, high) in limits[t].items()]
    assert sum(inside) >= 11, limits
    predicted = store.results.predict.to_plain()
    assert predicted["mean_error_fitted_percent"] < 0.2
    assert predicted["mean_error_heldout_percent"] < 0.5
    assert predicted["sites"][-1]["error_one_material_percent"] > 1.0
    assert read_vtu(store["predict"] / "e.vtu").region_names == TISSUES
    report = build_report(store.folder, store["report"]).read_text(encoding="utf-8")
    assert "three materials predict better" in report
