"""A study is made in the browser: files come into an empty folder, sites are placed, records are dropped."""

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from serving_here import serve_here as serve_here

from browsing import drop, serious_findings, until
from limbfit import StudyResults, load_study, make_phantom_study
from limbfit.anatomy.surfaces.surfaces import load_anatomy
from limbfit.study import Study


def place_site(page: Any, name: str, position: np.ndarray) -> None:
    page.get_by_role("button", name="Add a site").click()
    for axis, value in zip("xyz", position, strict=True):
        page.get_by_label(f"{axis} (mm, LPS)").fill(f"{value:.2f}")
    page.locator("input[name=z]").press("Tab")
    page.locator(".site-form input[name=name]").fill(name)
    page.get_by_role("button", name="Save", exact=True).click()
    page.locator(".site-list strong", has_text=name).wait_for()


def load(folder: Path) -> Study:
    return load_study(folder, recorded=False)


def test_surfaces_sites_and_a_dropped_record_become_a_study(study, tmp_path, serve_here, open_page):
    folder = tmp_path / "new"
    folder.mkdir()
    page = open_page(serve_here(folder), may_say="422")
    page.locator("#start-form").wait_for()
    assert page.get_by_role("tab").all_inner_texts() == ["Start"]
    assert page.get_by_role("button", name="Write study.toml").count() == 0  # there is nothing to name
    drop(page, "#start-drop", study / "skin.stl", study / "tibia.stl")
    until(lambda: "2 surfaces" in page.locator("#start-form").inner_text())
    assert serious_findings(page) == []
    page.locator("select[name=skin]").select_option(label="inputs/skin.stl")
    page.get_by_label("name of the bone in inputs/tibia.stl").fill("tibia")
    page.locator("input[name=study]").fill("stump")
    page.get_by_role("button", name="Write study.toml").click()
    page.locator(".view.model[data-state=ready]").wait_for()
    assert (load(folder).study.name, load(folder).sites) == ("stump", ())
    place_site(page, "1", np.array([40.0, 0.0, 60.0]))
    page.get_by_role("tab", name="Traces").click()
    page.locator(".view.traces .state.empty input[type=file]").wait_for()
    drop(
        page, ".view.traces .record", study / "skin.stl"
    )  # no record: refused in a line, and asked for again
    until(lambda: "skin.stl" in page.locator("#notice").inner_text())
    assert load(folder).site("1").trace is None
    drop(page, ".view.traces .record", study / "1.csv")
    page.locator("#trace-facts").wait_for()
    site = load_study(folder).site("1")
    assert (site.fitted, site.trace, site.depth_mm) == (True, Path("inputs/traces/1.csv"), None)
    assert (folder / "inputs" / "traces" / "1.csv").read_bytes() == (study / "1.csv").read_bytes()


def test_files_come_in_once_and_never_outside_of_the_folder(study, tmp_path, serve_here, open_page):
    folder = tmp_path / "new"
    folder.mkdir()
    page = open_page(serve_here(folder), may_say="422")
    page.locator("#start-form").wait_for()
    send = """([path, text]) => fetch(`/api/start/files/${path}`, {method: "POST", body: text,
        headers: {"Content-Type": "application/octet-stream"}}).then((answer) => answer.status)"""
    assert page.evaluate(send, ["a/b.csv", "first"]) == 200
    assert page.evaluate(send, ["a/b.csv", "first"]) == 200  # the same again
    assert page.evaluate(send, ["a/b.csv", "other"]) == 422
    for path in ("..%2Fb.csv", "%2Fetc%2Fb.csv", ".hidden", "a%5Cb.csv"):
        assert page.evaluate(send, [path, "x"]) == 422, path
    assert [file.name for file in tmp_path.rglob("*") if file.is_file() and study not in file.parents] == [
        "b.csv"
    ]
    (folder / "inputs" / "away").symlink_to(tmp_path)
    assert page.evaluate(send, ["away/b.csv", "x"]) == 422
    assert (folder / "inputs" / "a" / "b.csv").read_text() == "first"


@pytest.mark.slow
def test_from_a_folder_of_dicom_to_a_running_calibration(tmp_path, serve, open_page):
    """The phantom's images are dropped as folders; its markers become sites, its files records."""
    patient, folder = tmp_path / "patient", tmp_path / "new"
    make_phantom_study(patient, seed=3)
    folder.mkdir()
    page = open_page(serve(folder), may_say="404")
    page.locator("#start-form").wait_for()
    drop(page, "#start-drop", patient / "mri")
    until(lambda: "2 images" in page.locator("#start-form").inner_text())
    for name in ("image", "markers"):
        wanted = page.locator(
            f"select[name={name}] option", has_text="plain" if name == "image" else "mri/markers"
        )
        page.locator(f"select[name={name}]").select_option(wanted.first.get_attribute("value"))
    page.get_by_role("button", name="Write study.toml").click()
    page.locator(".view.image[data-state=ready]").wait_for()
    page.get_by_role("tab", name="Model").click()
    page.get_by_role("button", name="Run the stages until surfaces").click()
    until(lambda: (folder / "results" / "surfaces" / "surfaces.json").is_file(), 300)
    page.get_by_role("tab", name="Model").click()
    page.locator(".view.model[data-state=ready]").wait_for()
    until(lambda: not page.locator("#strip .running").count())
    page.get_by_role("button", name="Take the markers").click()
    until(lambda: len(load(folder).sites) == 18)  # the phantom has a marker at each of the paper's sites
    placed = {site.name: site.near for site in load(folder).sites}
    page.get_by_role("tab", name="Traces").click()
    for truth in json.loads((patient / "truth.json").read_text())["sites"]:
        off = {name: np.linalg.norm(np.subtract(near, truth["position_mm"])) for name, near in placed.items()}
        name = min(off, key=lambda one: off[one])
        assert off[name] < 1.5
        page.locator(f"[data-site='{name}']").click()
        page.locator(".view.traces .state.empty input[type=file]").wait_for()
        drop(page, ".view.traces .record", patient / "traces" / f"site-{truth['name']}.csv")
        page.locator("#trace-facts").wait_for()
    assert [site.fitted for site in load_study(folder).sites].count(True) == 6
    assert load_anatomy(folder / "results" / "surfaces").bones
    page.get_by_role("tab", name="Identification").click()
    page.get_by_role("button", name="Run what is missing").click()
    until(lambda: re.search("evaluation [2-9]", page.locator(".view.identification").inner_text()), 900)
    page.get_by_role("button", name="Stop").click()
    until(lambda: not page.locator("#strip .running").count(), 120)
    assert StudyResults(folder / "results").mesh.sites.keys() == {site.name for site in load(folder).sites}
