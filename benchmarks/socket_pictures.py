"""The studio's pictures of docs/socket-tutorial.md, of a study that `limbfit socket design` has run.

    python benchmarks/socket_pictures.py STUDY [--to docs/images]

STUDY is `total-surface-bearing-liner` of `examples/openlimb/sockets.py`.  Its shape is shown on a copy, with
an area over the patellar tendon and relief over the fibular head; the designs on the study itself.  In
Chromium with software WebGL; LIMBFIT_CHROMIUM names another program.
"""

import argparse
import os
import shutil
import sys
import tempfile
from pathlib import Path
from typing import Any

from playwright.sync_api import sync_playwright

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))
from browsing import PATIENCE_MS, WITH_WEBGL
from studio import start_server

SIZE = {"width": 1280, "height": 860}
AREAS = """
[[socket.areas]]
name = "tendon"
region = "patellar tendon"
radius_mm = 25.0
depth_mm = 5.0

[[socket.areas]]
name = "fibular head"
region = "fibular head"
radius_mm = 22.0
depth_mm = -3.0
"""


def picture(browser: Any, study: Path, act: Any, file: Path) -> None:
    """The view Socket of a study after ``act(page)``."""
    server, address = start_server(study)
    try:
        page = browser.new_page(viewport=SIZE)
        page.set_default_timeout(PATIENCE_MS)
        page.goto(address + "#/socket")
        act(page)
        page.wait_for_timeout(2000)  # until all is drawn
        page.screenshot(path=file)
        page.close()
    finally:
        server.terminate()
        server.wait()


def show_shape(page: Any) -> None:
    """Its face with its areas, and handles along the brim."""
    page.get_by_role("combobox", name="view").select_option("its shape")
    page.locator(".trim-handle:visible").first.wait_for()


def show_designs(page: Any) -> None:
    """Control and design beside each other under the load, from the fibula's side."""
    page.get_by_role("combobox", name="run", exact=True).select_option("control")
    page.get_by_role("combobox", name="beside it").select_option("design")
    page.locator(".player-words", has_text="design: donning").wait_for()
    page.get_by_label("step", exact=True).fill("1")
    page.locator(".player-words", has_text="design: single stance").wait_for()
    page.get_by_role("button", name="right", exact=True).click()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("study", type=Path)
    parser.add_argument("--to", type=Path, default=Path("docs/images"))
    options = parser.parse_args()
    program = os.environ.get("LIMBFIT_CHROMIUM") or shutil.which("chromium") or shutil.which("google-chrome")
    with tempfile.TemporaryDirectory() as place, sync_playwright() as playwright:
        copy = Path(place) / options.study.resolve().name
        shutil.copytree(options.study, copy, ignore=shutil.ignore_patterns("runs"))
        file = copy / "study.toml"
        file.write_text(file.read_text(encoding="utf-8") + AREAS, encoding="utf-8")
        browser = playwright.chromium.launch(executable_path=program, args=list(WITH_WEBGL))
        picture(browser, copy, show_shape, options.to / "studio-socket-shape.png")
        picture(browser, options.study, show_designs, options.to / "studio-socket-designs.png")
        browser.close()


if __name__ == "__main__":
    main()
