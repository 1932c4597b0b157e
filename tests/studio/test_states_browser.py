"""Every view in a real browser with nothing to show: it is being read, is missing, or cannot be read."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import pytest
from serving_here import serve_here as serve_here

from browsing import serious_findings
from conftest import write_trace
from limbfit.anatomy.imaging import Volume, write_volume

STUDY = """
[study]
name = "begun"
[image]
path = "image.nrrd"
[[sites]]
name = "a"
position = [0.0, 0.0, 0.0]
depth_mm = 5.0
[[sites]]
name = "b"
trace = "b.csv"
position = [0.0, 0.0, 0.0]
"""
# What each view reads at first, in words and below /api/.
READ = {
    "image": ("the image", "image"),
    "model": ("the model", "model/scene"),
    "traces": ("the record of site b", "traces/b"),
    "identification": ("the search and what came out", "identification"),
    "results": ("the results", "results"),
    "socket": ("the runs of the socket", "socket"),
}
# What is missing where nothing was run, and what is offered.
MISSING = {
    "model": ("no surfaces of the limb yet", ["Run the stages until surfaces"]),
    "identification": ("Nothing is identified yet", ["Run the study"]),
    "results": ("No fields are stored for this site", ["Run the stages until predict"]),
    "socket": ("No run of the socket is stored yet", ["Run the socket", "Run the design"]),
}


@pytest.fixture
def begun(tmp_path):
    """A study with an image and a record, of which nothing was run; a second site has no record."""
    ramp = np.linspace(0.0, 1000.0, 16**3, dtype=np.float32).reshape(16, 16, 16)
    write_volume(tmp_path / "image.nrrd", Volume(ramp, np.full(3, 4.0), np.zeros(3), np.eye(3)))
    write_trace(tmp_path / "b.csv")
    (tmp_path / "study.toml").write_text(STUDY)
    return tmp_path


@contextmanager
def held(page, path: str) -> Iterator[None]:
    """What the page asks for below ``/api/`` is answered only afterwards, as by a slow server."""
    routes: list[Any] = []
    page.route(f"**/api/{path}", lambda route: routes.append(route))
    yield
    for route in routes:
        route.continue_()
    page.unroute(f"**/api/{path}")


def show(page, view: str) -> None:
    page.evaluate("(view) => (location.hash = `#/${view}`)", view)


def state(page, view: str, kind: str):
    """What says of a view, where a user sees it, that it is loading, empty or failed."""
    return page.locator(f".view.{view} .state.{kind}:visible")


def test_every_view_says_that_it_is_read_what_is_missing_and_what_is_wrong(begun, serve_here, open_page):
    page = open_page(serve_here(begun), may_say="status of 422")
    for view, (what, path) in READ.items():
        with held(page, path):
            show(page, view)
            state(page, view, "loading").get_by_text(f"Reading {what} …").wait_for()
            side = page.locator(f".view.{view} .side")
            assert side.is_visible() == (view == "traces")  # others do nothing yet
    assert serious_findings(page) == []
    for view, (text, offered) in MISSING.items():
        show(page, view)
        empty = state(page, view, "empty")
        empty.get_by_text(text).wait_for()
        assert empty.get_by_role("button").all_inner_texts() == offered
        assert page.locator(f".view.{view} .side").is_visible()
        assert state(page, view, "loading").count() == 0
    assert serious_findings(page) == []
    show(page, "image")
    page.locator(".view.image[data-state=ready]").wait_for()
    assert page.locator("#status").inner_text() == ""  # nothing is being read any more
    show(page, "traces")
    page.locator("#trace-facts dd").first.wait_for()
    page.locator("[data-site='a']").click()
    state(page, "traces", "empty").get_by_text("This site has no record").wait_for()
    assert not page.locator("#trace-facts").is_visible()

    file, text = begun / "study.toml", (begun / "study.toml").read_text()
    file.write_text(text + "[[")
    (begun / "b.csv").write_text("no record\n")
    page.reload()
    for view in READ:
        show(page, view)
        failed = state(page, view, "failed")
        failed.get_by_text("study.toml: not valid TOML").wait_for()
        assert failed.get_attribute("role") == "alert"
    assert serious_findings(page) == []
    file.write_text(text)
    state(page, "socket", "empty").wait_for()  # what is seen follows by itself
    show(page, "traces")
    failed = state(page, "traces", "failed")
    failed.get_by_text("Cannot read the record of site b: ").wait_for()
    write_trace(begun / "b.csv")
    failed.get_by_role("button", name="Try again").click()
    page.locator("#trace-facts dd").first.wait_for()
