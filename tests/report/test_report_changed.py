"""Reports of studies in which something is more, missing, broken or hostile."""

import json
import shutil
from pathlib import Path

import pytest
from page_outline import Outline, cells_of, render_sections, section_of, without_scripts
from stored_results import SITES, add_fat, leave_unarranged, write_results

from completing import complete, write_result
from editing import rewritten
from limbfit import compress_cube, load_study
from limbfit.errors import InputError
from limbfit.pipeline.commands.run import compute_keys
from limbfit.report import build_report
from limbfit.report.drawing.interactive import _describe_site
from limbfit.report.page import Prose
from limbfit.report.sections.contents import build_summary
from limbfit.report.sections.identification import (
    make_convergence_section,
    make_parameter_section,
    make_prediction_section,
    make_site_table,
)
from limbfit.report.sections.inputs import make_record_check_section
from limbfit.report.sections.methods import make_method_section
from limbfit.report.sections.simulations import make_simulated_section, make_solver_section
from limbfit.report.sections.uncertainty import make_error_table
from limbfit.report.store import load_store
from limbfit.report.words import write_words
from limbfit.results.runs import CompareResult, RunResult, SimulateResult
from limbfit.results.uncertainty import ModelsResult, RegionsResult
from limbfit.results.variants import StiffnessResult

FEW = tuple(row for row in SITES if row[0] in ("PT-1", "TI-2", "TI-5", "PO-6"))
SKIN = {"c_kPa": 9.0, "m": 6.0, "gamma": 2.0, "tau_s": 0.5}


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_results(tmp_path_factory.mktemp("study") / "results", sites=FEW, geometry=False)


@pytest.fixture
def copy(results: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The results without what only pictures need, to change and to break."""
    leave_unarranged(monkeypatch)
    return Path(shutil.copytree(results, tmp_path / "results"))


def test_three_tissues_stand_in_every_table_and_curve(copy: Path) -> None:
    text = build_report(add_fat(copy), copy / "report").read_text(encoding="utf-8")
    assert Outline(text).open == []
    cells = cells_of(text, "parameters")
    assert cells[0][4:6] == ["One material", "Three materials"]
    assert [row[0] for row in cells[1:]] == ["Skin"] * 4 + ["Fat"] * 4 + ["Muscle"] * 4
    assert cells[5][3:] == ["4.70", "4.71", "1.80", "0.900 to 3.60", "not determined", "1.80"]
    assert "fat, long-term shear modulus c (0.900 to 3.60 kPa)" in text
    assert "first as one material, then as skin, fat and muscle." in text
    assert "three materials predict better." in text
    assert "Error, three materials (%)" in section_of(text, "prediction")
    assert "skin 1.50 ± 0.01, fat 4.72 ± 1.31" in section_of(text, "meshes")
    assert "skin (1.5 mm), fat (as thick as the segmented fat, at least 1.0 mm)" in text
    convergence = section_of(text, "convergence")
    assert convergence.count("var(--third)") >= 4  # the third tissue's curve, a panel for each parameter
    assert ">truth, fat</text>" in convergence
    assert section_of(text, "parameters").count('scope="col"') >= 12
    assert "two materials" not in text
    assert "two tissues" not in text


def test_names_are_escaped(copy: Path) -> None:
    evil = '<script>alert("x")</script> & $x^2$'
    for file in copy.rglob("*.json"):
        text = file.read_text()
        file.write_text(
            text.replace('"tibia"', json.dumps(evil)).replace("Phantom 7 (coarse)", "a <b>bold</b> limb")
        )
    text = build_report(copy, copy / "report").read_text(encoding="utf-8")
    assert "<script>alert" not in text
    assert "<b>" not in without_scripts(text)
    assert "a &lt;b&gt;bold&lt;/b&gt; limb" in text
    assert "&lt;script&gt;" in text
    assert Outline(text).open == []


@pytest.mark.parametrize(
    "gone",
    [
        {
            "surfaces": ("model", "Label map (cm³)"),
            "mesh": ("meshes", "No meshes are stored yet."),
            "predict": ("prediction", "No predictions are stored yet."),
            "run.json": ("timing", "No times are stored."),
        },
        {
            "traces": ("records", "No indentation records are stored yet."),
            "calibrate": ("parameters", "No parameters have been identified yet."),
        },
    ],
    ids=" and ".join,
)
def test_missing_parts_are_said(copy: Path, gone: dict[str, tuple[str, str]]) -> None:
    for part in gone:
        path = copy / part
        shutil.rmtree(path) if path.is_dir() else path.unlink()
    text = build_report(copy, copy / "report").read_text(encoding="utf-8")
    for section, sentence in gone.values():
        assert sentence in section_of(text, section)
    assert Outline(text).open == []


def test_an_empty_folder_gives_a_report_that_says_so(tmp_path: Path) -> None:
    text = build_report(tmp_path, tmp_path / "report").read_text(encoding="utf-8")
    assert "Nothing has been computed yet" in text
    assert text.count('role="note"') >= 9


def test_no_truth_no_band(copy: Path) -> None:
    (copy / "truth.json").unlink()
    for curve in (copy / "predict").glob("*.csv"):
        rows = [",".join(line.split(",")[:4]) for line in curve.read_text().splitlines()]
        curve.write_text("\n".join(rows))
    text = render_sections(copy, make_parameter_section, make_convergence_section, make_prediction_section)
    assert "Truth" not in text
    assert ">95 % interval</text>" in text  # of the parameters


def test_results_of_another_version_are_refused_with_the_command_that_makes_them_anew(copy: Path) -> None:
    with rewritten(copy / "calibrate" / "calibration.json") as content:
        del content["uncertainty"]
    with pytest.raises(InputError, match=r"no key 'uncertainty'.*run limbfit run again"):
        build_report(copy, copy / "report")


def test_a_failed_simulation_is_named(copy: Path) -> None:
    with rewritten(copy / "predict" / "predict.json") as content:
        content["sites"][3] |= {
            "completed": False,
            "reason": "the step fell below its limit",
            "error_percent": None,
        }
    text = render_sections(copy, make_solver_section)
    assert "did not reach the end of the record at: PO-6" in text
    assert "no: the step fell below its limit" in text


def test_what_is_not_predicted_is_said_with_its_reason(copy: Path) -> None:
    with rewritten(copy / "predict" / "predict.json") as content:
        row = content["sites"][3]
        why = "in the search: went over its limits"
        row |= {"error_one_material_percent": None, "not_predicted": {"interval": why, "one_material": why}}
        row["warnings"] = [f"no force with one material: {why}"]
        content |= {"flags": [], "failed": ["site PO-6, one material: lost"]}
    curve = copy / "predict" / "PO-6.csv"
    rows = [",".join(line.split(",")[:3]) for line in curve.read_text().splitlines()]
    curve.write_text("\n".join(rows))  # no simulated force either
    text = render_sections(copy, make_prediction_section, make_record_check_section, make_solver_section)
    assert f"interval: {why}; one material: {why}" in section_of(text, "solver")
    assert f"Site PO-6: no force with one material: {why}" in section_of(text, "solver")
    assert "Sites not compared with the others: PO-6." in section_of(text, "doubts")
    assert "Not simulated: site PO-6, one material: lost." in section_of(text, "doubts")
    assert "not predicted" in section_of(text, "prediction")


def double_a_site(copy: Path, site: str) -> None:
    """Its record twice, in predictions and traces; the second is off by much more."""
    with rewritten(copy / "predict" / "predict.json") as content:
        at = next(i for i, row in enumerate(content["sites"]) if row["site"] == site)
        row = content["sites"][at]
        twins = [row | {"record": f"{site}-slow"}, row | {"record": f"{site}-fast"}]
        twins[1] |= {"error_percent": 30.0, "error_one_material_percent": 60.0}
        content["sites"][at : at + 1] = twins
    with rewritten(copy / "traces" / "traces.json") as content:
        facts = content["sites"].pop(site)
        content["sites"] |= {f"{site}-slow": facts, f"{site}-fast": facts}


def test_the_summary_and_the_table_count_the_records_of_a_site_as_that_site(copy: Path) -> None:
    double_a_site(copy, "TI-5")
    store = load_store(copy)
    assert store.predict
    table = make_site_table(store)
    in_table = table.foot[1].cells[-2].text
    found = build_summary(store)[0]
    assert isinstance(found, Prose)
    assert f"With one material for all soft tissue the held-out error is {in_table} %" in found.text
    assert [len(errors) for errors in store.predict.compare_held_out()] == [2, 2]


def test_records_of_a_fitted_site_are_fitted_in_the_errors_of_regions(copy: Path) -> None:
    double_a_site(copy, "TI-2")
    names = ("TI-2-slow", "TI-2-fast", "TI-5")
    errors = dict.fromkeys(names, 2.0)
    region = {"region": "tibia", "sites": ["TI-2", "TI-5"], "fitted_sites": ["TI-2"]}
    region |= {"own_error_percent_by_site": errors, "whole_error_percent_by_site": errors}
    content = RegionsResult.model_validate(complete(RegionsResult, {"regions": [region]}))
    table = make_error_table(load_store(copy), content)
    assert [[cell.text for cell in row.cells[1:3]] for row in table.rows] == [
        ["TI-2-slow", "fitted"],
        ["TI-2-fast", "fitted"],
        ["TI-5", "held out"],
    ]
    assert [row.marked for row in table.rows] == [True, True, False]


def test_sites_that_were_not_predicted_from_one_another_are_not_said_to_be(copy: Path) -> None:
    file = copy / "predict" / "predict.json"
    content = json.loads(file.read_text())
    file.write_text(json.dumps(content | {"flags": [], "left_out": []}))
    text = render_sections(copy, make_record_check_section)
    assert "Nothing looks wrong" in text
    assert "every site is predicted from the others" not in text


@pytest.mark.parametrize("equal_m", [None, 4.7])
def test_only_a_law_with_m_is_compared_at_equal_m(equal_m: float | None) -> None:
    content = StiffnessResult.model_validate(complete(StiffnessResult, {"equal_m": equal_m}))
    words = [write_words(name, content=content) for name in ("sensitivity-c", "table sensitivity-c")]
    assert [" m" in text for text in words] == [equal_m is not None] * 2


def describe_sites(results: Path) -> str:
    """What the picture of the limb says of its sites, as JSON."""
    store = load_store(results)
    return json.dumps([_describe_site(store, row) for row in store.sites], separators=(",", ":"))


def test_records_under_a_stated_force_have_errors_of_displacement(copy: Path) -> None:
    with rewritten(copy / "predict" / "predict.json") as content:
        content["sites"] = [row | {"control": "force"} for row in content["sites"]]
    text = render_sections(copy, make_prediction_section, make_method_section)
    assert "the model predicts the displacement with a mean error of" in text
    assert "mean displacement error at the held-out sites" in text
    prediction = section_of(text, "prediction")
    assert "divided by the largest measured displacement" in prediction
    assert "largest force, by phase" not in prediction
    assert "mean absolute displacement difference over the trace" in section_of(text, "method")
    assert '"compared":"displacement"' in describe_sites(copy)


def test_indentations_without_records(copy: Path) -> None:
    for part in ("traces", "calibrate", "predict"):
        shutil.rmtree(copy / part)
    facts = {
        "site": "TI-2",
        "peak_force_N": 7.126,
        "depth_mm": 6.0,
        "penetration_mm": 0.02,
        "completed": True,
    }
    write_result(copy, SimulateResult, facts | {"parameters_from": "start of the study"}, "TI-2")
    (copy / "simulate" / "TI-2.csv").write_text("time_s,displacement_mm,force_N\n0,0,0\n6.25,6,7.126\n")
    text = render_sections(copy, make_simulated_section)
    section = section_of(text, "simulated")
    assert ">7.13<" in section
    assert "Force of the simulated indentations." in section
    assert "no parameters have been identified" in section_of(text, "summary")


def test_broken_summary_names_the_file(copy: Path) -> None:
    (copy / "predict" / "predict.json").write_text('{"sites": [')
    with pytest.raises(InputError, match=r"predict\.json: not readable.*run limbfit run again"):
        build_report(copy, copy / "report")
    assert not (copy / "report").exists()


def test_broken_curve_names_the_file(copy: Path) -> None:
    (copy / "predict" / "PT-1.csv").write_text("time_s,force_measured_N\n1.0\n")
    with pytest.raises(InputError, match=r"PT-1\.csv: its rows do not fit its header"):
        build_report(copy, copy / "report")


def test_no_results_folder(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no results there; run the study first"):
        build_report(tmp_path / "nowhere", tmp_path)


@pytest.mark.slow
def test_experiments_are_shown_unless_stale(copy, tmp_path):
    compress_cube(copy / "cube", parameters={"skin": SKIN, "muscle": SKIN})
    run = json.loads((copy / "run.json").read_text())
    states = {"cube": {"state": "done", "options": {}}, "regions": {"state": "stale"}}
    write_result(copy, RunResult, run | {"experiments": states})
    page = build_report(copy, tmp_path / "out").read_text(encoding="utf-8")
    assert '<section id="cube"' in page
    assert "pig skin, along the spine" in page
    assert '<section id="regions"' not in page
    assert "limbfit regions” are left out" in page


def test_other_models_are_left_out_once_the_study_was_identified_anew(copy):
    """They have no stamp of their own."""
    with rewritten(copy / "calibrate" / "calibration.json") as calibration:
        identified = calibration["stages"][-1]["parameters"]
        write_result(copy, ModelsResult, {"models": [{"model": "the study's own", "parameters": identified}]})
        assert load_store(copy).models is not None
        identified["skin"]["c_kPa"] *= 1.001
    store = load_store(copy)
    assert (store.models, store.outdated) == (None, ("uncertainty --models",))


def test_simulations_with_identified_parameters_are_left_out_once_others_are_identified(copy):
    with rewritten(copy / "calibrate" / "calibration.json") as calibration:
        identified = calibration["stages"][-1]["parameters"]
        for model, names in ((SimulateResult, ("PT-1", "TI-2")), (CompareResult, ("PT-1",))):
            for name, origin in zip(names, ("identified", "given"), strict=False):
                row = {"site": name, "parameters_from": origin, "parameters": identified}
                write_result(copy, model, row, name)
        assert [row.site for row in load_store(copy).simulated] == ["PT-1", "TI-2"]
        identified["skin"]["c_kPa"] *= 1.001
    store = load_store(copy)
    assert ([row.site for row in store.simulated], store.compared) == (["TI-2"], ())
    assert set(store.outdated) == {"simulate --site PT-1", "compare --site PT-1"}


def test_a_report_is_stale_once_other_models_were_weighed(study):
    before = compute_keys(load_study(study))
    (study / "results" / "models").mkdir(parents=True)
    (study / "results" / "models" / "models.json").write_text("{}")
    after = compute_keys(load_study(study))
    assert {stage for stage in before if before[stage] != after[stage]} == {"report"}
