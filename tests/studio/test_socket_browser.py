"""The view Socket in a real browser, over stored runs made from formulas."""

import numpy as np
import pytest
from stored_fields import block

from browsing import serious_findings, until
from completing import write_result
from editing import append
from limbfit import load_study
from limbfit.mesh import write_vtu
from limbfit.results.runs import StageStamp
from limbfit.results.socket import SocketDesignResult, SocketResult


def held(share: float, **more) -> dict:
    row = {"region": "left middle", "mean_kPa": share, "peak_kPa": 10 * share, "shear_kPa": 0.5}
    return {"regions": [row | {"interval_kPa": [0.5 * share, 2 * share]}], **more}


def write_run(results, folder: str, begin: str, factor: float) -> dict:
    """Pressure grows from right to left, 1 kPa per mm from 1 kPa on; ``factor`` times that under load."""
    mesh = block()
    (results / folder).mkdir(parents=True, exist_ok=True)
    for i, share in enumerate((1.0, factor)):
        pressure = share * (1.0 + mesh.points[:, 0] - mesh.points[:, 0].min())
        data = {"pressure_kPa": pressure, "shear_kPa": 0.1 * pressure}
        write_vtu(mesh, results / folder / f"{begin}-{i}.vtu", point_data=data)
    return {"donning": held(1.0), "loads": [held(factor, name="stance", settling_mm=7.5)]}


def write_designs(results, designs: list[dict]) -> None:
    write_result(results, SocketDesignResult, {"designs": designs})
    write_result(results, StageStamp, {}, "socket_design")


@pytest.mark.slow
def test_pressure_is_stepped_through_and_read_under_the_pointer(study, serve, open_page):
    page = open_page(serve(study) + "#/socket")
    page.get_by_text("No run of the socket is stored yet.").wait_for()
    results = study / "results"
    content = write_run(results, "socket", "held", 5.0)
    write_result(results, SocketResult, content)
    design = {"name": "design", "simulation": write_run(results, "socket_design", "design", 2.0)}
    write_designs(results, [design])
    write_result(results, StageStamp, {}, "socket")
    words, slider = page.locator(".view.socket .player-words"), page.get_by_label("step", exact=True)
    until(lambda: words.inner_text().startswith("donning; contact pressure at most 10.0 kPa"))
    bar = page.locator(".view.socket .lf-bar")
    scale, canvas = bar.inner_text(), page.locator(".view.socket .lf-canvas")
    donned = canvas.screenshot()
    slider.fill("1")
    until(
        lambda: words.inner_text() == "stance; contact pressure at most 50.0 kPa at a node; settles by 7.5 mm"
    )
    page.get_by_role("cell", name="2.5 to 10.0").wait_for()
    assert bar.inner_text() == scale  # one for all steps
    until(lambda: canvas.screenshot() != donned)
    box = canvas.bounding_box()
    page.mouse.move(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
    told = until(lambda: page.locator(".socket-pointed").inner_text())
    assert told.split("; ")[0] in {
        f"contact pressure {kPa} kPa" for kPa in ("20.0", "35.0")
    }  # nodes beside the middle
    assert "left" in told.split("; ")[1]
    assert serious_findings(page) == []
    page.get_by_role("combobox", name="run").select_option("design")
    slider.fill("1")
    until(lambda: words.inner_text().startswith("stance; contact pressure at most 20.0 kPa"))


def cell(name: str, at: np.ndarray, measured: float, model: float, state: str = "compared") -> dict:
    place = {"position_mm": at.tolist(), "level_mm": 50.0, "angle_deg": 0.0, "error_kPa": 1.5}
    return {"cell": name, "state": state, "regions": [], "measured_kPa": measured, "model_kPa": model} | place


@pytest.mark.slow
def test_cells_of_sensors_are_drawn_beside_the_limb_with_their_agreement(study, serve, open_page, tmp_path):
    results, middle = study / "results", block().points.mean(axis=0)
    content = write_run(results, "socket", "held", 5.0)
    cells = [
        cell("1-1", middle + np.array([8.0, 0.0, 0.0]), 20.0, 26.0),
        cell("1-2", middle + np.array([8.0, 0.0, 3.0]), 40.0, 38.0),
        cell("1-3", middle + np.array([8.0, 0.0, -3.0]), 0.0, 30.0, "dead"),
    ]
    content["sensors"] = [{"name": "sheet", "load": "stance", "counts": {}, "cells": cells}]
    row = {"load": "stance", "region": "all", "cells": 2, "measured_kPa": 30.0, "model_kPa": 32.0}
    content["agreement"] = [row | {"bias_kPa": 2.0, "limits_kPa": [-9.1, 13.1], "within_percent": 50.0}]
    write_result(results, SocketResult, content)
    write_result(results, StageStamp, {}, "socket")
    page = open_page(serve(study) + "#/socket")
    chosen, means = page.get_by_role("combobox", name="sensors"), page.locator(".socket-cells")
    chosen.select_option("measured_kPa")
    until(lambda: means.inner_text() == "no sensor recorded this step")  # it is donning
    canvas = page.locator(".view.socket .lf-canvas")
    page.get_by_label("step", exact=True).fill("1")
    until(lambda: means.inner_text() == "in the colours of the bar; grey rings are not compared")
    measured = canvas.screenshot()
    chosen.select_option("difference")
    until(lambda: "−6.00 to 6.00 kPa" in means.inner_text())
    until(lambda: canvas.screenshot() != measured)
    page.get_by_role("cell", name="-9.1 to 13.1").wait_for()
    page.get_by_role("button", name="left", exact=True).click()
    box = canvas.bounding_box()
    page.mouse.click(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
    until(
        lambda: (
            "cell 1-1 of sheet: measured 20.0 ± 1.5 kPa, model 26.0 kPa" in page.inner_text(".socket-pointed")
        )
    )
    page.screenshot(path=str(tmp_path / "cells.png"))
    assert serious_findings(page) == []


@pytest.mark.slow
def test_two_runs_stand_beside_each_other_on_one_scale_and_turn_together(study, serve, open_page):
    results = study / "results"
    designs = [
        {"name": name, "simulation": write_run(results, "socket_design", name, factor)}
        for name, factor in (("control", 5.0), ("design", 2.0))
    ]
    write_designs(results, designs)
    page = open_page(serve(study) + "#/socket")
    words, canvas = page.locator(".view.socket .player-words"), page.locator(".view.socket .lf-canvas")
    until(lambda: words.inner_text().startswith("donning"))
    page.get_by_role("combobox", name="beside it").select_option("design")
    page.get_by_label("step", exact=True).fill("1")
    until(lambda: "control: stance" in words.inner_text() and "| design: stance" in words.inner_text())
    page.get_by_role("cell", name="−60", exact=True).wait_for()  # peak of 20 instead of 50 kPa
    bars = page.locator(".view.socket .lf-bar")
    assert canvas.count() == bars.count() == 2
    assert bars.nth(0).inner_text() == bars.nth(1).inner_text()
    still = canvas.nth(1).screenshot()
    canvas.nth(0).press("ArrowLeft")
    until(lambda: canvas.nth(1).screenshot() != still)
    assert serious_findings(page) == []
    page.get_by_role("combobox", name="beside it").select_option("nothing")
    until(lambda: canvas.count() == 1)


@pytest.mark.slow
def test_areas_are_placed_by_a_click_written_and_drawn_and_a_run_says_what_is_wrong(study, serve, open_page):
    file = study / "study.toml"
    append(study, "[socket]\ntrim_mm = 40.0  # of the brim\n")
    page = open_page(serve(study) + "#/socket")
    page.get_by_role("combobox", name="view").select_option("its shape")
    words, canvas = page.locator(".socket-shape-words"), page.locator(".view.socket .lf-canvas")
    until(lambda: "cm³" in words.inner_text())
    until(lambda: "offset (mm)" in page.locator(".view.socket .lf-bar").inner_text())
    plain = canvas.screenshot()
    page.get_by_role("button", name="Add an area").click()
    box = canvas.bounding_box()
    page.mouse.click(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
    until(lambda: "mm (LPS)" in page.locator(".view.socket .site-form").inner_text())
    page.get_by_label("depth (mm)").fill("5")
    page.get_by_role("button", name="Save").click()
    (area,) = until(lambda: load_study(study).socket.areas)
    assert (area.name, area.radius_mm, area.depth_mm) == ("area 1", 25.0, 5.0)
    assert area.position[1] < -25.0  # the anterior side is seen first
    assert np.hypot(*area.position[:2]) < 43.0
    assert "# of the brim" in file.read_text()
    until(lambda: canvas.screenshot() != plain)
    assert serious_findings(page) == []
    page.get_by_role("button", name="area 1").click()
    page.get_by_label("radius (mm)").fill("5")
    page.get_by_role("button", name="Save").click()
    until(lambda: "steeper than 45 degrees" in words.inner_text())
    page.get_by_role("button", name="Run the socket").click()
    until(lambda: "steeper than 45 degrees" in page.locator(".view.socket .side [role=status]").inner_text())
    page.get_by_role("button", name="area 1").click()
    page.get_by_role("button", name="Remove").click()
    until(lambda: not load_study(study).socket.areas)


@pytest.mark.slow
def test_the_trimline_is_dragged_written_and_drawn(study, serve, open_page):
    """A handle of the brim, with the mouse and with a key; a drag too far down springs back."""
    file = study / "study.toml"
    append(study, "[socket]\ntrim_mm = 40.0\n")
    page = open_page(serve(study) + "#/socket", may_say="status of 422")
    page.get_by_role("combobox", name="view").select_option("its shape")
    words, canvas = page.locator(".socket-shape-words"), page.locator(".view.socket .lf-canvas")
    until(lambda: "cm³" in words.inner_text())
    seen = page.locator(".trim-handle:visible")
    until(lambda: 6 <= seen.count() <= 12)  # of 16: the others are behind the limb
    plain, told = canvas.screenshot(), words.inner_text()

    def front():
        """The handle in the middle of the picture."""
        box = canvas.bounding_box()
        middle = box["x"] + box["width"] / 2
        places = [seen.nth(i).bounding_box() for i in range(seen.count())]
        return seen.nth(int(np.argmin([abs(one["x"] + one["width"] / 2 - middle) for one in places])))

    def drag(handle, pixels: float) -> None:
        box = handle.bounding_box()
        x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
        page.mouse.move(x, y)
        page.mouse.down()
        page.mouse.move(x, y + pixels / 2)
        page.mouse.move(x, y + pixels)
        page.mouse.up()

    handle = front()
    level = float(handle.get_attribute("aria-valuenow"))
    drag(handle, 60.0)
    until(lambda: "The trimline is in the study" in page.locator("body").inner_text())
    line = until(lambda: load_study(study).socket.trimline)
    assert load_study(study).socket.trim_mm is None
    heights = np.array([point[2] for point in line])
    assert len(line) == 16
    assert level - heights.min() > 5.0
    assert np.sort(np.abs(heights - level))[:15].max() < 0.5  # one handle alone
    until(lambda: canvas.screenshot() != plain)
    until(lambda: words.inner_text() != told)  # the volume below the brim
    assert serious_findings(page) == []
    until(lambda: abs(float(front().get_attribute("aria-valuenow")) - heights.min()) < 0.1)
    front().press("Shift+ArrowUp")
    until(lambda: min(z for *_, z in load_study(study).socket.trimline) > heights.min() + 5.0)
    text, stored = file.read_text(), min(z for *_, z in load_study(study).socket.trimline)
    drag(front(), 330.0)
    until(lambda: "mm of the distal end" in page.locator("body").inner_text())
    until(lambda: abs(float(front().get_attribute("aria-valuenow")) - stored) < 0.1)
    assert file.read_text() == text
    page.get_by_role("button", name="Default brim").click()
    until(lambda: not load_study(study).socket.trimline)
    page.get_by_role("combobox", name="view").select_option("stored runs")
    until(lambda: page.locator(".trim-handle").count() == 0)
