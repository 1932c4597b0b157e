"""The report of a finished study."""

import base64
import hashlib
import json
import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import pytest
from page_outline import Outline, cells_of, section_of, table_of, without_scripts
from stored_results import SITES as ALL_SITES
from stored_results import write_results

from editing import rewritten
from limbfit.report import build_report
from limbfit.report.sections.methods import write_method_parts
from limbfit.report.store import load_store
from limbfit.report.words import write_words
from unpacking import unpack

SITES = tuple(row for row in ALL_SITES if row[0] not in ("LA-3", "PO-4"))


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_results(tmp_path_factory.mktemp("study") / "results", sites=SITES)


@pytest.fixture(scope="module")
def report(results: Path) -> str:
    file = build_report(results, results / "report")
    assert file == results / "report" / "report.html"
    return file.read_text(encoding="utf-8")


def test_one_file_without_requests(report: str) -> None:
    outline = Outline(report)
    links = [a.get(key, "") for _, a in outline.tags for key in ("src", "href", "xlink:href", "srcset")]
    assert [link[:40] for link in links if link and not link.startswith(("#", "data:"))] == []
    written = without_scripts(report)
    assert "http:" not in written
    assert "https:" not in written
    assert re.findall(r"@import|url\((?!#)", written) == []
    assert [a for a in outline.all("script") if "src" in a] == []


def test_nothing_is_doubted_where_no_simulation_was(report: str) -> None:
    written = without_scripts(report)
    assert "doubtful" not in written
    assert "are inside out" not in written


def test_only_the_reports_own_script_may_run(report: str) -> None:
    policy = re.search(r'http-equiv="Content-Security-Policy" content="([^"]*)"', report)
    assert policy
    assert policy.group(1).startswith("default-src 'none';")
    running = re.findall(r"<script>(.*?)</script>", report, re.DOTALL)
    assert len(running) == 1
    digest = base64.b64encode(hashlib.sha256(running[0].encode()).digest()).decode()
    assert policy.group(1).endswith(f"script-src 'sha256-{digest}'")


def test_figures_hold_their_data(report: str) -> None:
    found = _data(report)
    assert set(found) == {"explorer", "records", "iterates"}
    arrays, facts = unpack(base64.b64decode(found["explorer"]["arrays"]))
    assert [site["name"] for site in facts["sites"]] == [site for site, *_ in SITES]
    assert [row["site"] for row in facts["fields"]] == [site for site, _, fitted, *_ in SITES if fitted]
    for surface in facts["surfaces"]:
        faces = arrays[f"{surface['name']}.faces"]
        assert 0 < len(faces) <= 12_000
        assert faces.max() < len(arrays[f"{surface['name']}.points"])
    stress = arrays["field.PT-1.stress"]
    assert stress.shape == arrays["field.PT-1.faces"].shape[:1]
    assert 10 < stress.max() <= 14  # the formula's largest stress stands at the site
    assert found["explorer"]["curves"]["PT-1"]["force_measured_N"][-1] == 0


def _data(text: str) -> dict:
    figures = re.findall(r'<figure id="interactive-(\w+)".*?<script[^>]*>(.*?)</script>', text, re.DOTALL)
    return {name: json.loads(content) for name, content in figures}


def test_well_formed_and_accessible(report: str) -> None:
    outline = Outline(report)
    assert outline.open == []
    names = [a["id"] for _, a in outline.tags if "id" in a]
    assert len(names) == len(set(names))
    assert set(re.findall(r'(?:url\(#|href="#)([^")]+)', report)) <= set(names)
    assert len(outline.all("table")) == report.count("<caption") >= 8
    assert all(header.get("scope") in ("col", "row") for header in outline.all("th"))
    pictures = re.findall(r"<svg[^>]*role=\"img\"[^>]*><title>([^<]*)</title>", report)
    assert len(pictures) == report.count("<svg") >= 9
    assert all(len(title) > 20 for title in pictures)


def test_one_small_file(report: str, results: Path) -> None:
    assert len(report.encode()) < 8e6
    names = {path.name for path in (results / "report").iterdir()}
    assert names == {"report.html", "methods.md", "tables", "figures"}


@pytest.mark.parametrize("section", ["model", "meshes", "records", "prediction", "solver"])
def test_every_site_in_every_table(report: str, section: str) -> None:
    text = section_of(report, section)
    for site, *_ in SITES:
        assert f'<th scope="row">{site}</th>' in text


def test_numbers_with_units(report: str) -> None:
    assert re.search(r"<dd>1\.6 ± 0\.2 <small>%</small></dd>", report)
    assert re.search(r"<dd>5\.43 <small>kPa</small></dd>", report)
    assert "(3.26 to 9.23 kPa)" in report
    for label in (
        "Time (s)",
        "Force (N)",
        "Displacement (mm)",
        "Largest force (N)",
        "von Mises stress (kPa)",
    ):
        assert label in report
    assert "At the 3 sites that were not used, the model predicts the force with a mean error of" in report


def test_parameter_table_shows_start_both_stages_interval_and_truth(report: str) -> None:
    cells = cells_of(report, "parameters")
    assert cells[0][3:] == ["Start", "One material", "Two materials", "95 % interval", "Verdict", "Truth"]
    assert cells[2][3:] == ["3.00", "4.82", "4.52", "2.71 to 7.68", "weakly determined", "4.40"]
    assert len(cells) == 9


def test_site_table_marks_the_fitted(report: str) -> None:
    table = table_of(report, "sites")
    marked = re.findall(r'<tr class="marked">\s*<th scope="row">([^<]*)</th>', table)
    assert marked == [site for site, _, fitted, *_ in SITES if fitted]
    assert "0.9 ± 0.3" in table


def test_labels_of_an_image_that_the_study_has_no_more_are_not_reported(tmp_path: Path) -> None:
    folder = write_results(tmp_path / "results", geometry=False)
    with rewritten(folder / "run.json") as run:
        del run["stages"]["segment"]
    assert load_store(folder).segment is None


def test_mesh_facts(report: str) -> None:
    text = section_of(report, "meshes")
    assert "3.00 ± 0.02" in text
    assert '<td class="number">412</td>' in text
    assert "<li>Site TI-2: the layer is thin at the tibial crest</li>" in text


def test_correlations_are_coloured_by_sign(report: str) -> None:
    text = section_of(report, "parameters")
    assert re.search(r'class="number cold" style="--shade:68%">−0\.90<', text)
    assert re.search(r'class="number warm" style="--shade:75%">1\.00<', text)


def test_pictures_show_the_model(report: str) -> None:
    images = [a["href"] for a in Outline(report).all("image") if a["href"].startswith("data:image/png")]
    fitted = sum(fitted for _, _, fitted, *_ in SITES)
    assert len(images) == 4 + 3 * fitted  # four sides; per fitted site the cut, its neighbourhood, the field
    assert len(set(images)) == len(images)
    assert min(len(image) for image in images) > 20_000  # an empty picture compresses to far less


def test_the_summary_tells_what_is_determined_best_first_and_the_parameters_each_product(report: str) -> None:
    summary, parameters = section_of(report, "summary"), section_of(report, "parameters")
    places = [summary.index(word) for word in ("Determined: ", "Weakly determined: ", "Not determined: ")]
    assert places == sorted(places)
    assert "Determined together: 1 of 2 products of them" in summary
    assert "^" not in summary
    assert "muscle c^0.82 · muscle γ^0.57: determined" in parameters
    assert "skin m^0.71 · muscle m^-0.70: not determined by these data" in parameters


def test_the_report_never_loads_a_solver() -> None:
    code = (
        "import sys, limbfit.report\n"
        "rooms = ('fe', 'identify', 'phantom', 'pipeline', 'indentation', 'study', 'anatomy')\n"
        "print([n for n in sys.modules if n.startswith(tuple('limbfit.' + r for r in rooms))])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_every_table_and_drawing_is_a_file_too(results, report):
    folder = results / "report"
    shown = re.findall(r'<table id="table-([^"]+)"', report)
    assert {file.stem for file in (folder / "tables").glob("*.csv")} == set(shown)
    assert {file.stem for file in (folder / "tables").glob("*.json")} == set(shown)
    drawn = (folder / "figures/errors.svg").read_text(encoding="utf-8")
    assert drawn.startswith("<?xml")
    assert "var(--" not in drawn
    ElementTree.fromstring(drawn)


def test_a_table_file_holds_the_numbers_of_the_page(results, report):
    table = json.loads((results / "report/tables/sites.json").read_text(encoding="utf-8"))
    stored = {row["site"]: row for row in json.loads((results / "predict/predict.json").read_text())["sites"]}
    errors = [name for name in table["columns"] if name.startswith("Error,")][-1]
    column = table["columns"].index(errors)
    for row in table["rows"]:
        site = stored[row["cells"][0]]
        assert row["marked"] == site["fitted"]
        assert row["cells"][column] == pytest.approx(site["error_percent"], abs=0.051)
    lines = (results / "report/tables/sites.csv").read_text(encoding="utf-8").splitlines()
    assert len(lines) == 1 + len(table["rows"]) + len(table["foot"])


def test_methods_say_what_was_done_and_name_nobody(results, report):
    text = (results / "report/methods.md").read_text(encoding="utf-8")
    run = json.loads((results / "run.json").read_text())
    for words in ("## Identification", "## Meshes", "## Software", f"limbfit {run['limbfit']}"):
        assert words in text
    for name, version in run["versions"].items():
        assert f"{name} {version}" in text
    assert str(results) not in text
    assert "nan" not in text.lower().replace("nanometre", "")


def methods_of(results: Path, **settings: object) -> str:
    """The methods of the study with other settings."""
    store = load_store(results)
    run = store.run.model_copy(update={"settings": {**store.run.settings, **settings}})
    return "\n".join(text for _, text in write_method_parts(replace(store, run=run)))


def test_methods_count_one_in_the_singular(results):
    store = load_store(results)
    (name, facts), *_ = store.traces.items()
    held = next(row for row in store.predicted if not row.fitted)
    stages = [stage.model_copy(update={"evaluations": 1}) for stage in store.stages]
    found = store.calibration.model_copy(update={"stages": stages})
    predict = store.predict.model_copy(update={"sites": [held]})
    segment = store.segment.model_copy(update={"repairs": ["one"]})
    alone = [store.placed_sites[facts.site].model_copy(update={"fitted": True})]
    facts = {"traces": {name: facts}, "sites": alone, "predict": predict, "calibration": found}
    told = "\n".join(text for _, text in write_method_parts(replace(store, segment=segment, **facts)))
    for words in ("1 repair was made", "1 site has a record of", "1 was fitted (", "at 1 held-out site ("):
        assert words in told
    assert "converged after 1 evaluation (" in told
    words = write_words("end of a stage", stage=stages[0].model_copy(update={"iterations": [None]}))
    assert "converged after 1 iterate and 1 evaluation; " in words


def test_methods_say_what_moved_the_limb_before(results):
    assert "Before the indenter" not in methods_of(results, material={"law": "ogden", "prestretch": {}})
    clamps = {"force_N": 15.0, "width_mm": 20.0, "clamping_s": 2.0, "settling_s": 5.0}
    material = {"law": "ogden-active", "prestretch": {"skin": 1.1, "muscle": 1.2}}
    assert (
        "Before the indenter touched the limb, pins of 20.0 mm clamped it with 15.0 N each for 7.0 s and "
        "muscle contracted and tissue was pre-stretched (skin by 1.1, muscle by 1.2)."
    ) in methods_of(results, clamps=clamps, material=material)


def test_methods_say_what_was_held_and_that_people_were_asked(results):
    prior = {"muscle.m": {"median": 3.0, "factor": 1.25}}
    held = {"fixed": ["skin.m", "skin.tau_s"], "tied": [["skin.gamma", "muscle.gamma"]]}
    told = methods_of(results, calibration={**held, "priors": "population", "prior": prior})
    assert (
        "Skin.m, skin.tau_s stayed at the start; skin.gamma and muscle.gamma were kept equal; lognormal "
        "priors of c and m were those of people; lognormal priors were put on muscle.m: median 3.0, factor "
        "1.25."
    ) in told
