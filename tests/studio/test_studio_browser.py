"""The shell and the views Image, Traces and Identification in a real browser."""

import json
import re
import shutil

import numpy as np
import psutil
import pytest
from limb_image import make_segmented
from serving_here import serve_here as serve_here

from browsing import serious_findings, until
from editing import append, edit
from limbfit import run_study
from limbfit.anatomy.imaging import read_labels
from limbfit.study import load_study
from stages import states

SIZES = ((1280, 800), (1920, 1080))


def test_a_dragged_touch_down_is_stored_and_hostile_names_stay_text(study, serve_here, open_page):
    file = study / "study.toml"
    hostile = "<img src=x onerror=window.hacked=1><script>window.hacked=1</script>"
    edit(study, '"stump"', f'"{hostile}"')
    edit(study, 'name = "1"', f'name = "1"  # first\nregion = "{hostile}"')
    run_study(load_study(study), until="traces")
    address = serve_here(study)
    page = open_page(address + "#/traces")
    handle = page.locator("[data-key=touch_down_s]").first
    handle.wait_for()
    before = float(handle.get_attribute("aria-valuenow"))
    box, plot = handle.bounding_box(), page.locator(".u-over").first.bounding_box()
    page.mouse.move(box["x"] + box["width"] / 2, box["y"] + 60)
    page.mouse.down()
    page.mouse.move(box["x"] + box["width"] / 2 + 40, box["y"] + 60, steps=4)
    page.mouse.up()
    until(lambda: load_study(study).site("1").touch_down_s)
    stated = load_study(study).site("1").touch_down_s
    per_pixel = 1.06 * 11.25 / plot["width"]  # s: the record and 3 % at both ends
    assert stated - before == pytest.approx(40 * per_pixel, abs=2 * per_pixel)
    assert "# first" in file.read_text()
    until(lambda: "set by hand" in page.locator("#trace-facts").inner_text())
    until(lambda: page.locator("#strip .stage.stale", has_text="traces").count())
    assert states(study)["traces"] == "stale"
    page.reload()
    page.locator("[data-key=touch_down_s]").first.wait_for()
    assert float(page.locator("[data-key=touch_down_s]").first.get_attribute("aria-valuenow")) == stated
    page.locator("[data-key=touch_down_s]").first.press("ArrowRight")
    until(lambda: load_study(study).site("1").touch_down_s > stated)
    assert page.evaluate("window.hacked") is None
    assert hostile in page.locator("h1").inner_text()
    assert hostile in page.locator(".view.traces h2", has_text="Site 1").inner_text()
    assert page.url.endswith("/#/traces")  # the key is not in sight
    assert serious_findings(page) == []


@pytest.mark.slow
def test_a_painted_stroke_is_saved_and_stages_turn_stale(tmp_path, serve, open_page):
    limb = make_segmented(tmp_path)
    file = limb / "results" / "segment" / "labels.seg.nrrd"
    before = read_labels(file)
    page = open_page(serve(limb) + "#/image")
    page.locator(".view.image[data-state=ready]").wait_for()
    assert page.locator("#status").inner_text() == ""
    page.locator("#layout-axial").click()
    canvas = page.locator("#slices")
    box = canvas.bounding_box()
    middle = (box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
    page.mouse.click(*middle)
    place = until(lambda: page.locator("#place").inner_text())
    page.mouse.wheel(0, 120)
    until(lambda: page.locator("#place").inner_text() != place)
    page.get_by_label("tibia").check()
    page.mouse.move(*middle)
    page.mouse.down()
    page.mouse.move(middle[0] + 60, middle[1] + 10, steps=5)
    page.mouse.up()
    said = until(lambda: re.match(r"([\d,]+) voxels painted", page.locator("#changes").inner_text()))
    painted = int(said[1].replace(",", ""))
    canvas.press("p")  # a disc where the crosshair is
    until(lambda: not page.locator("#changes").inner_text().startswith(said[0]))
    page.get_by_role("button", name="Undo").click()
    until(lambda: page.locator("#changes").inner_text().startswith(said[0]))
    page.get_by_role("button", name="Save labels").click()
    until(lambda: "Nothing painted" in page.locator("#changes").inner_text())
    after = read_labels(file)
    changed = after.array != before.array
    assert changed.sum() == painted > 3
    assert np.all(after.array[changed] == before.value("tibia"))
    assert np.count_nonzero(changed.any(axis=(1, 2))) == 1  # one slice
    until(lambda: page.locator("#strip .stage.stale", has_text="segment").count())
    assert states(limb)["segment"] == "stale"
    assert serious_findings(page) == []


@pytest.mark.slow
def test_a_calibration_is_started_watched_reloaded_stopped_and_resumed(
    study, coarse_settings, serve, open_page
):
    append(study, coarse_settings.replace("max_iterations = 2", "max_iterations = 12"))
    run_study(load_study(study), until="mesh")
    page = open_page(serve(study) + "#/identification")
    iterates = re.compile(r"(\d+) iterates")

    def seen() -> int:
        found = iterates.search(page.locator("#convergence-note").inner_text())
        return int(found[1]) if found else 0

    page.locator("#run-start").click()
    until(lambda: seen() >= 2, 300)
    runs = next(study.glob("results/.work-calibrate-*/runs"))
    page.reload()
    until(lambda: seen() >= 3, 300)
    assert page.locator("#run-start").is_disabled()
    second = open_page(page.url.replace("/#", f"/?token={_token(page)}#"))
    until(lambda: second.locator("#run-stop").is_enabled())
    page.locator("#run-stop").click()
    until(
        lambda: (
            page.locator("#run-start").is_enabled() and "Resume" in page.locator("#run-start").inner_text()
        )
    )
    assert "stopped" in page.locator("#run-state").inner_text()
    kept = {one.name: one.stat().st_mtime_ns for one in runs.glob("*.npz")}
    assert len(kept) >= 2
    until(lambda: second.locator("#run-start").is_enabled())
    page.locator("#run-start").click()
    until(lambda: states(study).get("report") == "done", 600)
    done = study / "results" / "calibrate" / "runs"
    assert all((done / name).stat().st_mtime_ns == at for name, at in kept.items())
    until(lambda: page.locator("#answer table").count() == 2)
    until(lambda: "the prediction" in page.locator("#curves").inner_text())


def _token(page) -> str:
    return next(one["value"] for one in page.context.cookies() if one["name"].startswith("limbfit-studio"))


@pytest.mark.slow
def test_a_run_outlives_its_server(study, coarse_settings, serve, open_page):
    longer = coarse_settings.replace("edge_near_mm = 8.0", "edge_near_mm = 4.0")  # than a server starts
    append(study, longer)
    page = open_page(serve(study) + "#/identification")
    page.locator("#run-start").click()
    until(
        lambda: page.locator("#run-stop").is_enabled() and "process" in page.locator("#strip").inner_text(),
        300,
    )
    number = int(re.search(r"process (\d+)", page.locator("#strip").inner_text())[1])
    process = psutil.Process(number)
    server = psutil.Process(process.ppid())
    page.close()
    server.terminate()
    server.wait(30)
    assert process.is_running()
    again = open_page(serve(study) + "#/identification")
    until(lambda: f"process {number}" in again.locator("#strip").inner_text())
    again.locator("#run-stop").click()
    until(lambda: not process.is_running() or process.status() == psutil.STATUS_ZOMBIE, 60)


@pytest.mark.slow
@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_views_are_accessible_at_every_size_and_theme(tmp_path, pristine, serve, open_page, scheme):
    limb = make_segmented(tmp_path)
    stump = shutil.copytree(pristine, tmp_path / "stump")
    for folder, views in ((limb, ("image",)), (stump, ("traces", "identification"))):
        page = open_page(serve(folder), color_scheme=scheme)
        for view in views:
            page.goto(page.url.partition("#")[0] + f"#/{view}")
            page.locator(f".view.{view} .side").wait_for()
            for width, height in SIZES:
                page.set_viewport_size({"width": width, "height": height})
                assert page.evaluate("document.documentElement.scrollWidth <= innerWidth")
                assert serious_findings(page) == []


def test_the_page_is_worked_by_keyboard(study, serve, open_page):
    page = open_page(serve(study))
    for number, name in enumerate(["Image", "Model", "Traces", "Identification", "Results"], 1):
        page.keyboard.press(f"Alt+{number}")
        until(
            lambda wanted=name: page.get_by_role("tab", name=wanted).get_attribute("aria-selected") == "true"
        )
    page.get_by_role("tab", name="Results").press("Home")
    until(lambda: page.get_by_role("tab", name="Image").get_attribute("aria-selected") == "true")
    assert page.evaluate("document.activeElement.id") == "tab-image"
    page.get_by_text("starts from surfaces").wait_for()
    page.get_by_role("button", name="Show the limb").press("Enter")
    page.get_by_role("checkbox", name="skin").wait_for()
    theme = page.evaluate("document.documentElement.dataset.theme")
    page.locator("#theme").press("Enter")
    assert page.evaluate("document.documentElement.dataset.theme") != theme


@pytest.mark.slow
def test_memory_of_server_and_page_stays_level(study, coarse_settings, serve, open_page):
    """A study that writes a log line all the time, watched for three minutes, with views opened in turn."""
    append(study, coarse_settings)
    run_study(load_study(study), until="traces")
    page = open_page(serve(study) + "#/identification")
    server = next(p for p in psutil.Process().children() if "studio" in p.cmdline())
    client = page.context.new_cdp_session(page)
    log = study / "results" / "log" / "20990101T000000.000000.jsonl"
    row = {
        "time": "2099",
        "seconds": 1,
        "event": "progress",
        "stage": "mesh",
        "done": 1,
        "total": 5,
        "text": "x",
    }
    heap, resident = [], []
    for turn in range(36):
        with log.open("a") as stream:
            stream.write((json.dumps(row) + "\n") * 5)
        page.keyboard.press(f"Alt+{(4, 3, 2, 5)[turn % 4]}")
        page.wait_for_timeout(5000)
        client.send("HeapProfiler.collectGarbage")
        heap.append(client.send("Runtime.getHeapUsage")["usedSize"] / 1e6)
        resident.append(server.memory_info().rss / 1e6)
    third = len(heap) // 3
    assert np.median(heap[-third:]) < 1.1 * np.median(heap[third : 2 * third]) + 2.0, heap
    assert np.median(resident[-third:]) < 1.05 * np.median(resident[third : 2 * third]) + 10.0, resident
