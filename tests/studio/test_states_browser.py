"""Every view in a real browser where it has nothing to show yet: it is being read, is missing, or cannot be read."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import pytest

from browsing import serious_findings
from limbfit.anatomy.imaging import Volume, write_volume

PLANNED = """
[study]
name = "planned"
[image]
path = "image.nrrd"
[[sites]]
name = "a"
position = [0.0, 0.0, 0.0]
depth_mm = 5.0
"""
# What is missing in a study of which nothing was run, and what is offered.
MISSING = {
    "model": ("no surfaces of the limb yet", ["Run the stages until surfaces"]),
    "traces": ("This site has no record", []),
    "identification": ("Nothing is identified yet", ["Run the study"]),
    "results": ("No fields are stored for this site", ["Run the stages until predict"]),
    "socket": ("No run of the socket is stored yet", ["Run the socket", "Run the design"]),
}
VIEWS = ("image", *MISSING)
# What a view waits for at first.
READ = {
    "image": "image",
    "model": "model/scene",
    "identification": "identification",
    "results": "results",
    "socket": "socket",
}


@pytest.fixture
def planned(tmp_path):
    """A study of an image alone."""
    image = Volume(np.zeros((8, 8, 8), np.float32), np.full(3, 4.0), np.zeros(3), np.eye(3))
    write_volume(tmp_path / "image.nrrd", image)
    (tmp_path / "study.toml").write_text(PLANNED)
    return tmp_path


def show(page, view: str) -> None:
    page.evaluate("(view) => (location.hash = `#/${view}`)", view)


def states(page, view: str, kind: str):
    """What says so in a view, seen by the user."""
    return page.locator(f".view.{view} .state.{kind}:visible")


@contextmanager
def held(page, path: str) -> Iterator[None]:
    """What the page asks for below ``/api/`` is answered only afterwards, as by a slow server."""
    routes: list[Any] = []
    page.route(f"**/api/{path}", lambda route: routes.append(route))
    yield
    for route in routes:
        route.continue_()
    page.unroute(f"**/api/{path}")


def test_every_view_says_that_it_is_read_then_what_is_missing_and_offers_it(planned, serve, open_page):
    page = open_page(serve(planned) + "#/traces")
    for view, path in READ.items():
        with held(page, path):
            show(page, view)
            states(page, view, "loading").get_by_text("Reading the ").wait_for()
            assert not page.locator(f".view.{view} .side").is_visible()  # nothing there does anything yet
    for view, (text, offered) in MISSING.items():
        show(page, view)
        panel = states(page, view, "empty")
        panel.get_by_text(text).wait_for()
        assert panel.get_by_role("button").all_inner_texts() == offered
        assert page.locator(f".view.{view} .side").is_visible()
        assert page.locator(f".view.{view} .state.loading").count() == 0
        assert serious_findings(page) == []


def test_every_view_says_what_cannot_be_read_and_shows_it_once_it_can(study, serve, open_page):
    address, file = serve(study), study / "study.toml"
    text = file.read_text()
    file.write_text(text + "[[")
    (study / "2.csv").write_text("no record\n")
    page = open_page(address + "#/image", may_say="Failed to load resource")
    for view in VIEWS:
        show(page, view)
        states(page, view, "failed").get_by_text("study.toml").wait_for()
        assert states(page, view, "failed").get_attribute("role") == "alert"
    assert serious_findings(page) == []
    file.write_text(text)  # mended: the page follows by itself
    page.locator(".view.socket[data-state=empty]").wait_for()
    for view in ("model", "identification", "results"):
        show(page, view)
        page.locator(f".view.{view} .side").wait_for()
    show(page, "image")
    states(page, "image", "empty").get_by_text("starts from surfaces").wait_for()
    page.get_by_role("button", name="Show the limb").click()
    page.locator(".view.model .lf-canvas").wait_for()
    show(page, "traces")
    page.locator("#trace-facts dd").first.wait_for()
    with held(page, "traces/2"):
        page.locator("[data-site='2']").click()
        states(page, "traces", "loading").get_by_text("Reading the record of site 2 …").wait_for()
    failed = states(page, "traces", "failed")
    failed.get_by_text("Cannot read the record of site 2: ").wait_for()
    (study / "2.csv").write_text((study / "1.csv").read_text())
    failed.get_by_role("button", name="Try again").click()
    page.locator("#trace-facts dd").first.wait_for()
    assert page.get_by_role("heading", name="Site 2").is_visible()
