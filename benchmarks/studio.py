"""Memory of the studio over hours: its server, its page, and the script's own heap.

    python benchmarks/studio.py STUDY [--minutes 120] [--every 30] [--json studio.json] [--detached]

Works on a copy of STUDY, whose meshes are stored.  The server is started as its command starts it, its
page opened in Chromium (software WebGL; LIMBFIT_CHROMIUM names another program), and a calibration
started with the page's own button; when one has ended its answer is removed and the next is started, so
that a run goes on all the time.  The views are opened in turn, each once a minute, and in each something
is done: another site, its mesh, its fields.  Every ``--every`` seconds the resident memory of the server,
of the page's renderer and of the process that draws is read, and the heap and the nodes of the page's
scripts; every ten minutes the heap once more after garbage was collected.  All of it is in the JSON,
which is written after each reading.

Developer tools keep what a page has loaded, so with ``--detached`` the page is opened by a browser of its
own and goes from view to view by a script of its own; the tools are attached for a moment at the beginning
and at the end, and memory is read from outside.  STUDY itself is watched, not a copy, and nothing in it is
started or changed: let something run on it meanwhile, such as ``limbfit run STUDY``.

Printed at the end: the first value, the medians of the first and of
the last quarter, and the slope after the first quarter.
"""

import argparse
import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import psutil
from playwright.sync_api import sync_playwright

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))
from browsing import WITH_WEBGL
from limbfit.errors import RunError
from limbfit.studio.folder import StudyFolder
from limbfit.studio.processes import find_running, find_starting, stop_run

VIEWS = ("image", "model", "traces", "identification", "results")
STAY_S = 60.0 / len(VIEWS)
COLLECT_S = 600.0
UNITS = {"server": "MB", "renderer": "MB", "drawing": "MB", "heap": "MB", "heap_collected": "MB", "nodes": ""}


def start_server(study: Path) -> tuple[psutil.Process, str]:
    """The server's process and the address that it prints."""
    command = [sys.executable, "-m", "limbfit", "studio", str(study), "--no-browser", "--port", "0"]
    process = psutil.Popen(command, stdout=subprocess.PIPE, text=True)
    for line in process.stdout:
        if found := re.search(r"http://\S+", line):
            return process, found.group()
    raise SystemExit(f"the studio did not start; it ended with {process.wait()}")


class Page:
    """The studio's page in a browser, and what it is made to do."""

    def __init__(self, playwright: Any, program: str, address: str, study: Path) -> None:
        browser = self.chromium = playwright.chromium.launch(executable_path=program, args=list(WITH_WEBGL))
        self.study, self.runs, self.turn, self.errors = study, 0, 0, []
        self.page = browser.new_page(viewport={"width": 1280, "height": 800})
        self.page.set_default_timeout(180_000)
        self.page.on("pageerror", lambda error: self.errors.append(str(error)))
        self.page.goto(address + "#/identification")
        self.devtools = self.page.context.new_cdp_session(self.page)
        self.browser = browser.new_browser_cdp_session()
        self.sites = self.page.evaluate("fetch('/api/study').then((answer) => answer.json())")["sites"]

    def is_running(self) -> bool:
        found = self.page.evaluate("fetch('/api/identification').then((answer) => answer.json())")
        if found["run"] or found["starting"]:
            return True
        if self.runs and found["last"]["state"] != "ended":
            self.errors.append(f"run {self.runs}: {found['last']['state']}, {found['last']['error']}")
        return False

    def run(self) -> None:
        """The button that does what is missing: a whole calibration, as its simulations are removed."""
        for stage in ("calibrate", "predict", "report"):
            shutil.rmtree(self.study / "results" / stage, ignore_errors=True)
        self.show("identification")
        button = self.page.locator("#run-start:enabled")
        button.wait_for()
        button.click()
        self.runs += 1

    def show(self, view: str) -> None:
        self.page.evaluate("(view) => (location.hash = `#/${view}`)", view)
        self.page.locator(f".view.{view}").wait_for()

    def next(self) -> str:
        """The next view, with another site in it at every round; its name."""
        view, n = VIEWS[self.turn % len(VIEWS)], (self.turn // len(VIEWS)) % len(self.sites)
        self.turn += 1
        self.show(view)
        if view in ("model", "traces"):
            self.page.locator(f".view.{view} .side button.site").nth(n).click()
        if view == "model":
            box = self.page.locator(".view.model label.row", has_text="mesh of site").locator("input")
            if box.count() and box.is_enabled():
                box.set_checked(n % 2 == 0)
        if view == "results":
            self.page.locator(".view.results .side select").first.select_option(self.sites[n]["name"])
        return view

    def collect(self) -> None:
        self.devtools.send("HeapProfiler.collectGarbage")

    def heap(self) -> float:
        return self.devtools.send("Runtime.getHeapUsage")["usedSize"] / 1e6

    def resident(self, kind: str) -> float:
        """Memory in MB of the browser's processes of a kind."""
        rows = self.browser.send("SystemInfo.getProcessInfo")["processInfo"]
        return sum(psutil.Process(row["id"]).memory_info().rss for row in rows if row["type"] == kind) / 1e6

    def reading(self) -> dict[str, float]:
        return {
            "renderer": self.resident("renderer"),
            "drawing": self.resident("GPU"),
            "heap": self.heap(),
            "nodes": self.devtools.send("Memory.getDOMCounters")["nodes"],
        }

    def watch(self, server: psutil.Process, options: argparse.Namespace, keep: Callable) -> None:
        """Open views, keep runs going and take readings until the time is over."""
        start = time.monotonic()
        due = dict.fromkeys(("reading", "view", "run"), start) | {"collect": start + COLLECT_S}
        while (now := time.monotonic()) < start + 60 * options.minutes:
            if now >= due["run"]:
                due["run"] = now + 5.0
                if not self.is_running():
                    self.run()
            if now >= due["view"]:
                due["view"] = now + STAY_S
                self.next()
            if now >= due["reading"]:
                due["reading"] = now + options.every
                row = {"minutes": (now - start) / 60, "runs": self.runs}
                row |= {"server": server.memory_info().rss / 1e6} | self.reading()
                if now >= due["collect"]:
                    due["collect"] = now + COLLECT_S
                    self.collect()
                    row["heap_collected"] = self.heap()
                keep(row)
            self.page.wait_for_timeout(500)

    def close(self) -> None:
        stop(StudyFolder(self.study / "study.toml"))
        self.chromium.close()


# The tour of a page that nobody drives: another view in every turn, another site in every round.
TOUR = """([views, stay]) => {
  window.tour = { turn: 0, errors: [] };
  addEventListener("error", (event) => tour.errors.push(event.message));
  addEventListener("unhandledrejection", (event) => tour.errors.push(String(event.reason)));
  setInterval(() => {
    const view = views[tour.turn % views.length], round = Math.floor(tour.turn / views.length);
    tour.turn += 1;
    location.hash = `#/${view}`;
    setTimeout(() => {
      const sites = document.querySelectorAll(`.view.${view} .side button.site`);
      if (sites.length) sites[round % sites.length].click();
      const choice = view === "results" ? document.querySelector(".view.results .side select") : null;
      if (choice) {
        choice.selectedIndex = round % choice.options.length;
        choice.dispatchEvent(new Event("change"));
      }
    }, 2000);
  }, 1000 * stay);
}"""


class Alone:
    """The page in a browser of its own, with developer tools attached in `said` and in the beginning only."""

    def __init__(self, playwright: Any, program: str, address: str, place: Path, stay_s: float) -> None:
        arguments = ["--headless=new", "--remote-debugging-port=0", f"--user-data-dir={place}", *WITH_WEBGL]
        self.process = psutil.Popen(
            [program, *arguments, "--window-size=1280,800", address],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        self.chromium, self.errors = playwright.chromium, []
        note = place / "DevToolsActivePort"
        while not note.exists():
            if self.process.poll() is not None:
                raise SystemExit(f"the browser did not start; it ended with {self.process.poll()}")
            time.sleep(0.2)
        self.port = int(note.read_text().split()[0])
        self._attached(lambda page: page.evaluate(TOUR, [list(VIEWS), stay_s]))

    def _attached(self, do: Callable[[Any], Any]) -> Any:
        browser = self.chromium.connect_over_cdp(f"http://127.0.0.1:{self.port}")
        try:
            page = next(p for p in browser.contexts[0].pages if "127.0.0.1" in p.url)
            page.set_default_timeout(180_000)
            page.locator("#tabs").wait_for()
            return do(page)
        finally:
            browser.close()  # lets go of it; the browser goes on

    def reading(self) -> dict[str, float]:
        """Resident memory, MB."""
        kinds: dict[str, float] = dict.fromkeys(("renderer", "gpu-process"), 0.0)
        for child in self.process.children(recursive=True):
            with suppress(psutil.Error):
                found = re.search(r"--type=(\S+)", " ".join(child.cmdline()))
                if found and found.group(1) in kinds:
                    kinds[found.group(1)] += child.memory_info().rss / 1e6
        return {"renderer": kinds["renderer"], "drawing": kinds["gpu-process"]}

    def said(self) -> None:
        """Take the errors that the page's scripts have met."""
        self.errors = self._attached(lambda page: page.evaluate("window.tour.errors"))

    def watch(self, server: psutil.Process, options: argparse.Namespace, keep: Callable) -> None:
        """Take readings until the time is over."""
        start = time.monotonic()
        while (now := time.monotonic()) < start + 60 * options.minutes:
            keep({"minutes": (now - start) / 60, "server": server.memory_info().rss / 1e6} | self.reading())
            time.sleep(options.every)
        self.said()
        keep({"minutes": options.minutes, "server": server.memory_info().rss / 1e6} | self.reading())

    def close(self) -> None:
        self.process.terminate()
        self.process.wait(30)


def stop(folder: StudyFolder) -> None:
    """Interrupt the run that goes on, and wait for its end: its study is about to be removed."""
    with suppress(RunError):
        stop_run(folder)
    while find_running(folder) is not None or find_starting(folder) is not None:
        time.sleep(0.5)


def told(rows: list[dict[str, float]], name: str) -> str:
    """First value, medians of the first and last quarter, and slope after the first quarter."""
    known = [(row["minutes"] / 60, row[name]) for row in rows if name in row]
    if len(known) < 4:
        return f"{name}: too few readings"
    hours, values = np.array(known).T
    quarter = max(len(values) // 4, 1)
    slope = np.polyfit(hours[quarter:], values[quarter:], 1)[0]
    first, last = np.median(values[:quarter]), np.median(values[-quarter:])
    unit = UNITS[name]
    return (
        f"{name}: first {values[0]:.1f}, median of the first quarter {first:.1f}, of the last {last:.1f}"
        f" {unit}, slope {slope:+.2f} {unit}/h"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("study", type=Path)
    parser.add_argument("--minutes", type=float, default=120.0)
    parser.add_argument("--every", type=float, default=30.0, help="seconds between readings")
    parser.add_argument("--json", type=Path, default=Path("studio.json"))
    parser.add_argument("--detached", action="store_true", help="watch STUDY itself without developer tools")
    parser.add_argument("--stay", type=float, default=STAY_S, help="seconds in each view, detached")
    options = parser.parse_args()
    program = os.environ.get("LIMBFIT_CHROMIUM") or shutil.which("chromium") or shutil.which("google-chrome")
    rows: list[dict[str, float]] = []

    def keep(row: dict[str, float]) -> None:
        rows.append(row)
        options.json.write_text(json.dumps({"readings": rows, "errors": page.errors}, indent=1) + "\n")

    page: Page | Alone
    with tempfile.TemporaryDirectory() as place, sync_playwright() as playwright:
        study = options.study if options.detached else shutil.copytree(options.study, Path(place) / "study")
        server, address = start_server(study)
        try:
            if options.detached:
                page = Alone(playwright, program, address, Path(place), options.stay)
            else:
                page = Page(playwright, program, address, study)
            try:
                page.watch(server, options, keep)
            finally:
                page.close()
        finally:
            server.terminate()
            server.wait(30)
    runs = "" if options.detached else f", {rows[-1]['runs']} runs"
    print(f"{rows[-1]['minutes']:.0f} minutes{runs}, {len(page.errors)} errors of the page")
    for name in UNITS:
        print(told(rows, name))


if __name__ == "__main__":
    main()
