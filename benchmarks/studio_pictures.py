"""The pictures of docs/studio-tutorial.md: a study made in the studio, from an empty folder to its report.

    python benchmarks/studio_pictures.py FOLDER [--to docs/images] [--seed 3]

FOLDER does not exist yet; a synthetic patient and the study that is made of its files go there.  In Chromium
with software WebGL; LIMBFIT_CHROMIUM names another program.
"""

import argparse
import json
import os
import re
import shutil
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from playwright.sync_api import sync_playwright

from limbfit import load_study, make_phantom_study

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))
from browsing import PATIENCE_MS, WITH_WEBGL, drop
from studio import start_server

SIZE = {"width": 1280, "height": 860}
WAIT_S = 3600.0


def wait_for(found: Callable[[], Any], page: Any) -> None:
    """Wait until something is so."""
    end = time.monotonic() + WAIT_S
    while not found():
        if time.monotonic() > end:
            raise TimeoutError("the studio did not come so far")
        page.wait_for_timeout(500)


def film(page: Any, patient: Path, folder: Path, shot: Callable[[str], None]) -> None:
    """Go the whole way; ``shot(name)`` takes a picture."""
    page.locator("#start-form").wait_for()
    drop(page, "#start-drop", patient / "mri")
    wait_for(lambda: "2 images" in page.locator("#start-form").inner_text(), page)
    for name, text in (("image", "plain"), ("markers", "mri/markers")):
        wanted = page.locator(f"select[name={name}] option", has_text=text)
        page.locator(f"select[name={name}]").select_option(wanted.first.get_attribute("value"))
    page.locator("input[name=study]").fill("residual limb")
    shot("start")
    page.get_by_role("button", name="Write study.toml").click()
    page.locator(".view.image[data-state=ready]").wait_for()
    shot("image")
    page.get_by_role("tab", name="Model").click()
    page.get_by_role("button", name="Run the stages until surfaces").click()
    wait_for((folder / "results" / "surfaces" / "surfaces.json").is_file, page)
    page.get_by_role("tab", name="Model").click()
    page.locator(".view.model[data-state=ready]").wait_for()
    wait_for(lambda: not page.locator("#strip .running").count(), page)
    page.get_by_role("button", name="Take the markers").click()
    truth = json.loads((patient / "truth.json").read_text())["sites"]
    wait_for(lambda: load_study(folder, recorded=False).sites, page)
    shot("sites")
    placed = {site.name: site.near for site in load_study(folder, recorded=False).sites}
    page.get_by_role("tab", name="Traces").click()
    for one in truth:
        off = {name: np.linalg.norm(np.subtract(at, one["position_mm"])) for name, at in placed.items()}
        page.locator(f"[data-site='{min(off, key=off.__getitem__)}']").click()
        page.locator(".view.traces .state.empty input[type=file]").wait_for()
        drop(page, ".view.traces .record", patient / "traces" / f"site-{one['name']}.csv")
        page.locator("#trace-facts").wait_for()
    shot("records")
    page.get_by_role("tab", name="Identification").click()
    page.get_by_role("button", name="Run what is missing").click()
    identification = page.locator(".view.identification")
    wait_for(lambda: re.search(r"evaluation ([5-9]|\d\d)", identification.inner_text()), page)
    shot("search")
    wait_for((folder / "results" / "report" / "report.html").is_file, page)
    wait_for(lambda: not page.locator("#strip .running").count(), page)
    page.get_by_role("tab", name="Results").click()
    page.locator(".view.results[data-state=ready]").wait_for()
    shot("results")
    page.goto((folder / "results" / "report" / "report.html").as_uri())
    shot("report")


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--to", type=Path, default=Path("docs/images"), help="where the pictures go")
    parser.add_argument("--seed", type=int, default=3, help="of the patient")
    asked = parser.parse_args()
    asked.folder.mkdir()
    patient, folder = asked.folder / "patient", asked.folder / "study"
    make_phantom_study(patient, seed=asked.seed)
    folder.mkdir()
    program = os.environ.get("LIMBFIT_CHROMIUM") or shutil.which("chromium")
    with sync_playwright() as api:
        browser = api.chromium.launch(executable_path=program, args=list(WITH_WEBGL))
        server, address = start_server(folder)
        try:
            page = browser.new_page(viewport=SIZE)
            page.set_default_timeout(PATIENCE_MS)
            page.goto(address)

            def shot(name: str) -> None:
                page.wait_for_timeout(2000)  # until all is drawn
                page.screenshot(path=asked.to / f"studio-tutorial-{name}.png")
                print(f"{time.strftime('%H:%M:%S')} {name}", flush=True)

            film(page, patient, folder, shot)
        finally:
            server.terminate()
            server.wait()
        browser.close()


if __name__ == "__main__":
    main()
