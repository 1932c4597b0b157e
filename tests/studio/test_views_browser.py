"""The views Model and Results in a real browser."""

import numpy as np
import pytest
import pyvista as pv
from serving_here import serve_here as serve_here
from stored_fields import write_outcome, write_stored

from browsing import WITHOUT_WEBGL, serious_findings, until
from editing import append, edit, rewritten
from limbfit import load_study

# Where the camera looks from each side, by the key that shows it (LPS).
SIDES = {"1": (0, 1, 0), "4": (1, 0, 0)}


def hit(study, direction) -> np.ndarray:
    """Where a ray through the middle of the limb first meets the skin: the middle of the picture."""
    skin, bone = (pv.read(study / f"{name}.stl") for name in ("skin", "tibia"))
    low = np.minimum(skin.points.min(axis=0), bone.points.min(axis=0))
    high = np.maximum(skin.points.max(axis=0), bone.points.max(axis=0))
    middle, along = (low + high) / 2, 500.0 * np.array(direction)
    points, _ = skin.ray_trace(middle - along, middle + along)
    return np.asarray(points[np.argmin(points @ along)])


def click_middle(page) -> None:
    box = page.locator(".view.model .lf-canvas").bounding_box()
    page.mouse.click(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)


def test_a_click_on_the_skin_becomes_a_site_within_a_millimetre(study, serve_here, open_page):
    page = open_page(serve_here(study) + "#/model")
    page.get_by_label("skin", exact=True).wait_for()  # the surfaces are there
    for key, direction in SIDES.items():
        page.locator(".view.model .lf-canvas").focus()
        page.keyboard.press(key)
        page.get_by_role("button", name="Add a site").click()
        click_middle(page)
        name = page.locator("input[name=name]")
        until(lambda field=name: field.input_value() and page.get_by_text("Name it and save it.").count())
        name.fill(f"side-{key}")
        page.get_by_role("button", name="Save").click()
        page.get_by_role("heading", name=f"Site side-{key}").wait_for()
        found = np.array(load_study(study).site(f"side-{key}").position)
        assert np.linalg.norm(found - hit(study, direction)) < 1.0
    assert page.locator(".site-list button").count() == 2 + len(SIDES)
    assert serious_findings(page) == []


@pytest.mark.slow
def test_an_animation_is_played_and_its_files_are_downloaded(study, serve, open_page, tmp_path):
    write_stored(study / "results")
    page = open_page(serve(study) + "#/results")
    words, canvas = page.locator(".player-words"), page.locator(".view.results .lf-canvas")
    until(lambda: "von Mises stress" in words.inner_text())
    page.get_by_label("moment", exact=True).fill("0")
    until(lambda: words.inner_text().startswith("0 s; von Mises stress 0 to 0 kPa"))
    at_rest = canvas.screenshot()
    page.get_by_label("speed").select_option("4")
    page.get_by_role("button", name="Play").click()
    until(lambda: words.inner_text().startswith("1.50 s"))
    assert "134 kPa" in words.inner_text()  # the last of 135 cells, at the last step
    until(lambda: page.get_by_role("button", name="Play").count())
    assert canvas.screenshot() != at_rest
    with page.expect_download() as waiting:
        page.get_by_role("link", name="predicted curves (CSV)").click()
    waiting.value.save_as(tmp_path / "1.csv")
    assert (tmp_path / "1.csv").read_bytes() == (study / "results" / "predict" / "1.csv").read_bytes()
    assert serious_findings(page) == []


@pytest.mark.slow
def test_a_hidden_view_reads_nothing_until_it_is_shown(study, serve, open_page):
    page, asked = open_page(serve(study) + "#/model"), []
    page.get_by_role("checkbox", name="skin").wait_for()
    page.on("request", lambda request: asked.append(request.url))
    page.evaluate("location.hash = '#/traces'")
    page.locator("#trace-facts dd").first.wait_for()
    edit(study, 'name = "2"', 'name = "calf"')
    page.locator(".view.traces .side").get_by_text("calf").wait_for()  # what is seen has followed
    assert not [url for url in asked if "/api/model" in url]
    page.evaluate("location.hash = '#/model'")
    page.locator(".site-list").get_by_text("calf").wait_for()
    assert not [url for url in asked if "/api/model/surface" in url]  # they are as they were


@pytest.mark.slow
@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("view", ["model", "results"])
def test_views_are_accessible_at_every_size_and_theme(study, serve, open_page, view, scheme):
    write_stored(study / "results")
    page = open_page(
        serve(study) + f"#/{view}", color_scheme=scheme, viewport={"width": 1920, "height": 1080}
    )
    page.locator(f".view.{view} .lf-canvas").wait_for()
    for width in (1280, 1920):
        page.set_viewport_size({"width": width, "height": 800})
        assert page.evaluate("document.documentElement.scrollWidth <= innerWidth")
        assert serious_findings(page) == []


@pytest.mark.slow
def test_runs_are_kept_and_compared_on_the_page(study, serve, open_page):
    write_stored(study / "results")
    page = open_page(serve(study) + "#/results")
    page.get_by_label("name to keep this run under").fill("before")
    page.get_by_role("button", name="Keep this run").click()
    until(lambda: (study / "results" / "kept" / "before" / "kept.json").is_file())
    until(lambda: page.locator("option", has_text="before").count())
    page.get_by_label("beside").select_option("before")
    page.get_by_role("columnheader", name="error, before (%)").wait_for()
    until(lambda: page.locator(".lf-key").get_by_text("before").count())
    assert page.locator(".lf-key").get_by_text("before").count() == 1


@pytest.mark.slow
def test_without_webgl_the_views_say_so_and_the_rest_works(study, serve, open_page):
    write_stored(study / "results")
    page = open_page(serve(study) + "#/model", arguments=WITHOUT_WEBGL)
    page.get_by_text("does not draw in three dimensions").first.wait_for()
    page.locator("input[name=region]").fill("medial")
    page.locator("input[name=region]").press("Tab")
    until(lambda: load_study(study).site("1").region == "medial")
    page.keyboard.press("Alt+5")
    until(lambda: "von Mises stress" in page.locator(".player-words").inner_text())


@pytest.mark.slow
def test_the_answer_of_another_law_is_shown_as_it_was(study, serve, open_page):
    """Until the study is identified anew; the buttons that do so stay, too."""
    write_outcome(study / "results")
    with rewritten(study / "results" / "calibrate" / "calibration.json") as content:
        found = content["stages"][-1]["parameters"]
        for stage in content["stages"]:
            stage["iterations"][0] |= {"parameters": found, "error_percent": 3.0}
        content["uncertainty"]["intervals_95"] = {
            tissue: {key: [value / 2.0, value * 2.0] for key, value in values.items()}
            for tissue, values in found.items()
        }
    layers = '{ name = "skin", thickness_mm = 1.5 }, { name = "fat", thickness_mm = 3.0 }'
    append(study, f'[material]\nlaw = "fung"\n[geometry]\nlayers = [{layers}]\n')
    page = open_page(serve(study) + "#/identification")
    answer = page.locator("#answer")
    answer.get_by_text("the last calibration that was completed").wait_for()
    rows = answer.get_by_role("table", name="Identified parameters").locator("tbody th").all_inner_texts()
    assert rows == [
        f"{one} {key}" for one in ("skin", "muscle") for key in ("c (kPa)", "m", "gamma", "tau (s)")
    ]
    assert page.locator("#parameters .lf-chart").count() == 4
    assert page.get_by_role("button", name="Run what is missing").is_visible()
