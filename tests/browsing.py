"""Real browsers for tests of pages: Chromium with software WebGL, and the studio as its command starts it."""

import os
import re
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

WITH_WEBGL = ("--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader")
WITHOUT_WEBGL = ("--no-sandbox", "--disable-3d-apis")
AXE = Path(__file__).parent / "studio" / "vendor" / "axe.min.js"
PATIENCE_MS = 90_000  # a machine may be busy


@pytest.fixture(scope="session")
def playwright() -> Iterator[Any]:
    api = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    with api.sync_playwright() as running:
        yield running


@pytest.fixture(scope="session")
def launch(playwright: Any) -> Iterator[Callable[..., Any]]:
    """``launch(arguments)``: one browser for each set of them; LIMBFIT_CHROMIUM names another program."""
    program = os.environ.get("LIMBFIT_CHROMIUM") or shutil.which("chromium") or shutil.which("google-chrome")
    running: dict[tuple[str, ...], Any] = {}

    def start(arguments: tuple[str, ...] = WITH_WEBGL) -> Any:
        if program is None:
            pytest.skip("no Chromium on this machine")
        if arguments not in running:
            running[arguments] = playwright.chromium.launch(
                executable_path=program, args=list(arguments), timeout=PATIENCE_MS
            )
        return running[arguments]

    yield start
    for browser in running.values():
        browser.close()


@pytest.fixture
def open_page(launch: Callable[..., Any]) -> Iterator[Callable[..., Any]]:
    """``open_page(address, **options of the page)``; an error on the console of a page fails the test.

    But for those with the text ``may_say`` in them: a browser reports what a server refuses.
    """
    pages, said = [], []

    def start(
        address: str, *, arguments: tuple[str, ...] = WITH_WEBGL, may_say: str | None = None, **options: Any
    ) -> Any:
        page = launch(arguments).new_page(**{"viewport": {"width": 1280, "height": 800}, **options})
        page.set_default_timeout(PATIENCE_MS)

        def listen(message: Any) -> None:
            if message.type == "error" and (may_say is None or may_say not in message.text):
                said.append(message.text)

        page.on("console", listen)
        page.on("pageerror", lambda error: said.append(str(error)))
        pages.append(page)
        page.goto(address)
        return page

    yield start
    for page in pages:
        page.close()
    assert said == [], said


@pytest.fixture
def serve() -> Iterator[Callable[[Path], str]]:
    """``serve(study)``: the address that ``limbfit studio`` prints; it ends with the test."""
    running = []

    def start(study: Path) -> str:
        command = [sys.executable, "-m", "limbfit", "studio", str(study), "--no-browser", "--port", "0"]
        process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        running.append(process)
        assert process.stdout is not None
        for line in process.stdout:
            found = re.search(r"http://\S+", line)
            if found:
                return found.group()
        raise AssertionError(f"no address; ended with {process.wait()}")

    yield start
    for process in running:
        process.terminate()
        process.wait(30)


def serious_findings(page: Any) -> list[tuple[str, list[str]]]:
    """What axe finds of impact serious or critical on the page as it is: rule and elements."""
    page.evaluate(AXE.read_text(encoding="utf-8"))  # not as a script element, which the page's policy refuses
    found = page.evaluate("async () => (await axe.run()).violations")
    return [
        (rule["id"], [node["html"][:200] for node in rule["nodes"]])
        for rule in found
        if rule["impact"] in ("serious", "critical")
    ]


def until(condition: Callable[[], Any], seconds: float = PATIENCE_MS / 1000) -> Any:
    """The first true value of a condition, asked again and again."""
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        value = condition()
        if value:
            return value
        time.sleep(0.1)
    raise AssertionError("did not come true in time")


def drop(page: Any, selector: str, *paths: Path) -> None:
    """Drag files or folders of this machine from outside onto an element, and drop them there."""
    box = page.locator(selector).bounding_box()
    at = {"x": box["x"] + box["width"] / 2, "y": box["y"] + box["height"] / 2}
    data = {"items": [], "files": [str(path) for path in paths], "dragOperationsMask": 1}
    session = page.context.new_cdp_session(page)
    for kind in ("dragEnter", "dragOver", "drop"):
        session.send("Input.dispatchDragEvent", {"type": kind, **at, "data": data})
